//! How long work takes: processor time, which others on the machine cannot stretch as they stretch wall time.

use rustix::time::{ClockId, clock_gettime};

/// Processor time that all threads of this process have used so far, ms.
pub fn cpu_ms() -> f64 {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    now.tv_sec as f64 * 1e3 + now.tv_nsec as f64 * 1e-6
}

/// Processor time of `work`, ms, and what it gave.
pub fn timed<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let began = cpu_ms();
    let made = work();
    (cpu_ms() - began, made)
}

/// The fastest of `rounds` runs, ms of processor time: what the work costs when nothing disturbs the caches.
pub fn fastest_ms(rounds: usize, mut work: impl FnMut()) -> f64 {
    (0..rounds).map(|_| timed(&mut work).0).fold(f64::INFINITY, f64::min)
}

/// The middle one; 0 of none.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
