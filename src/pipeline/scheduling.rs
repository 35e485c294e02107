//! What the operating system is asked for on behalf of a line's threads: to go first, to stay on some cores, to keep memory in memory.
//! All of it is off unless it is asked for, and a system that refuses is told of once, and done without.

use std::sync::atomic::{AtomicBool, Ordering};

use serde::{Deserialize, Serialize};

/// What is asked for.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Priority among real-time threads (`SCHED_FIFO`), 0 = none.
    pub realtime_priority: u8,
    /// Cores to stay on; empty = any.
    pub cores: Vec<usize>,
    /// Keep all memory from being swapped out.
    pub lock_memory: bool,
}

/// Kernel threads that must run have priorities above this.
const HIGHEST_PRIORITY: u8 = 80;
const MOST_CORES: usize = 1024;

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        if self.realtime_priority > HIGHEST_PRIORITY {
            return Err(format!(
                "scheduling.realtime_priority: expected 0 to {HIGHEST_PRIORITY}, found {}",
                self.realtime_priority
            ));
        }
        if let Some(core) = self.cores.iter().find(|core| **core >= MOST_CORES) {
            return Err(format!("scheduling.cores: expected 0 to {}, found {core}", MOST_CORES - 1));
        }
        Ok(())
    }
}

/// Asks for it, thread by thread.
#[derive(Debug)]
pub struct Scheduling {
    settings: Settings,
    refused: AtomicBool,
}

impl Scheduling {
    /// Nothing is asked yet.
    pub fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            refused: AtomicBool::new(false),
        }
    }

    /// Whether there is anything to ask for.
    pub fn is_idle(&self) -> bool {
        self.settings == Settings::default()
    }

    /// Once, for the whole program.
    pub fn enter_program(&self) {
        if self.settings.lock_memory {
            self.told("keep memory from being swapped out", lock_memory());
        }
    }

    /// In each thread that the picture waits for.
    pub fn enter_thread(&self) {
        if !self.settings.cores.is_empty() {
            self.told("stay on the cores of scheduling.cores", stay_on(&self.settings.cores));
        }
        if self.settings.realtime_priority > 0 {
            self.told("run with real-time priority", go_first(self.settings.realtime_priority));
        }
    }

    fn told(&self, what: &str, outcome: Result<(), String>) {
        if let Err(reason) = outcome
            && !self.refused.swap(true, Ordering::Relaxed)
        {
            tracing::warn!(
                "scheduling: expected to be allowed to {what}, the system refuses ({reason}); it goes on without. \
                `ulimit -r` and `ulimit -l` are the limits, /etc/security/limits.conf raises them (rtprio, memlock)"
            );
        }
    }
}

#[cfg(target_os = "linux")]
fn lock_memory() -> Result<(), String> {
    use rustix::mm::{MlockAllFlags, mlockall};

    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).map_err(|error| error.to_string())
}

#[cfg(target_os = "linux")]
fn stay_on(cores: &[usize]) -> Result<(), String> {
    use rustix::thread::{CpuSet, sched_setaffinity};

    let mut wanted = CpuSet::new();
    cores.iter().for_each(|core| wanted.set(*core));
    sched_setaffinity(None, &wanted).map_err(|error| error.to_string())
}

#[cfg(target_os = "linux")]
fn go_first(priority: u8) -> Result<(), String> {
    use thread_priority::{
        RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy, set_thread_priority_and_policy,
        thread_native_id,
    };

    let value = ThreadPriorityValue::try_from(priority)?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(value), policy)
        .map_err(|error| format!("{error:?}"))
}

#[cfg(not(target_os = "linux"))]
fn lock_memory() -> Result<(), String> {
    Err("only on Linux".to_owned())
}

#[cfg(not(target_os = "linux"))]
fn stay_on(_cores: &[usize]) -> Result<(), String> {
    Err("only on Linux".to_owned())
}

#[cfg(not(target_os = "linux"))]
fn go_first(_priority: u8) -> Result<(), String> {
    Err("only on Linux".to_owned())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_thread_stays_where_it_is_told() {
        let allowed = || {
            let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
            let line = status.lines().find(|line| line.starts_with("Cpus_allowed_list:")).unwrap();
            line.split_whitespace().nth(1).unwrap().to_owned()
        };
        let first: usize = allowed().split(['-', ',']).next().unwrap().parse().unwrap();
        let settings = Settings {
            cores: vec![first],
            ..Settings::default()
        };
        let inside = std::thread::scope(|scope| {
            let thread = std::thread::Builder::new().spawn_scoped(scope, || {
                Scheduling::new(&settings).enter_thread();
                allowed()
            });
            thread.unwrap().join().unwrap()
        });
        assert_eq!(inside, first.to_string());
    }

    #[test]
    fn bounds_are_named() {
        let settings = Settings {
            realtime_priority: 99,
            ..Settings::default()
        };
        assert!(settings.check().unwrap_err().contains("0 to 80"));
        assert!(Scheduling::new(&Settings::default()).is_idle());
    }
}
