//! Runs a line: one named thread for the source, for each stage and for each sink, from start to clean stop.
//!
//! **Fail open.** The picture goes on whatever a stage does:
//!
//! | what happens | what the line does |
//! |---|---|
//! | a stage returns an error | the frame goes on as it came, the stage forgets its history, the failure is counted and told once |
//! | a stage panics | the same, and the stage is passed by for good; the outcome says so |
//! | a sink fails or panics | its work is ended as well as it can be, the other sinks go on; an essential one stops the line |
//! | the source fails | what came before is finished, then the failure is the outcome |
//! | the line is asked to stop | no new frame enters, those under way are finished, sinks write their ends |
//!
//! A [live](crate::pipeline::live) line does more, for its picture must not wait:
//!
//! | what happens | what the live line does |
//! |---|---|
//! | a frame is not done at its deadline | its untouched picture goes out in its place |
//! | a stage would not be done within the budget | the frame passes it by |
//! | a stage overruns often | it is passed by for some seconds, told as a warning, then tried again |
//! | a stage hangs | the same until it returns; each stage has a pool of its own, so it holds nobody up |
//!
//! Each of them is told by `tracing` once, when it happens, and stands in the [`Outcome`].
//!
//! The last stage's thread hands finished frames to the sinks' queues. A stage that is switched off costs nothing: the thread before it
//! hands its frames to the one behind. Work that a stage spreads over cores goes to rayon's
//! global pool, which all stages share, so stages compete for cores as tasks and not as surplus threads.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{self, RecvTimeoutError};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::image::pool::Pool;
use crate::pipeline::builder::{Door, Pipeline};
use crate::pipeline::control::Controls;
use crate::pipeline::gate::{Gate, Handed};
use crate::pipeline::ledger::{Ledger, Passed};
use crate::pipeline::outcome::{Outcome, SinkOutcome, StageOutcome};
use crate::pipeline::queue::{DropCount, Queue, Receiver, Sender};
use crate::pipeline::scheduling::Scheduling;
use crate::pipeline::seat::{Condition, Seat, StageDoor, Way};
use crate::pipeline::timing::Summary;
use crate::pipeline::watchdog::Watchdog;
use crate::pipeline::worker::left::{Left, Shared};
use crate::pipeline::worker::sink::SinkWorker;
use crate::pipeline::worker::source::SourceWorker;
use crate::pipeline::worker::stage::StageWorker;
use crate::time::{Clock, Span};

/// How often a waiting caller is asked whether it still wants to wait.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// The operating system gave no thread.
#[derive(Debug, thiserror::Error)]
#[error("expected a thread for `{name}`, the system gave none ({error}): close other programs or raise the limit (`ulimit -u`)")]
pub struct StartError {
    name: String,
    error: std::io::Error,
}

/// How far a running line has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// Frames that the source delivered.
    pub frames_in: u64,
    /// Frames that came to the line's end.
    pub frames_out: u64,
    /// Frames dropped between source and first stage.
    pub frames_dropped: u64,
    /// What came out of a live line, and how.
    pub passed: Passed,
}

/// How a stage is doing right now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageStatus {
    /// Its name.
    pub name: &'static str,
    /// Whether it works, and if not, why.
    pub condition: Condition,
    /// Live: how long a frame is expected to take.
    pub expected: Span,
}

/// What a waiting caller wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Let it run.
    GoOn,
    /// Finish what is under way, then end.
    Stop,
}

/// One thread of the line.
#[derive(Debug)]
struct Member {
    name: String,
    handle: JoinHandle<Left>,
    /// A stage's place in the line.
    seat: Option<usize>,
}

/// A line at work.
pub struct RunningPipeline {
    members: Vec<Member>,
    ended: channel::Receiver<()>,
    controls: Arc<Controls>,
    shared: Arc<Shared>,
    seats: Arc<[Arc<Seat>]>,
    ledger: Arc<Ledger>,
    watchdog: Option<Watchdog>,
    clock: Arc<dyn Clock>,
    entry_drops: DropCount,
    sink_drops: Vec<(&'static str, DropCount)>,
}

impl std::fmt::Debug for RunningPipeline {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RunningPipeline")
            .field("members", &self.members)
            .finish_non_exhaustive()
    }
}

/// Starts threads and keeps their handles; each holds an end of `ended` for as long as it lives.
struct Crew {
    members: Vec<Member>,
    sink_drops: Vec<(&'static str, DropCount)>,
    scheduling: Arc<Scheduling>,
    alive: channel::Sender<()>,
}

impl Crew {
    fn start(&mut self, name: &str, seat: Option<usize>, work: impl FnOnce() -> Left + Send + 'static) -> Result<(), StartError> {
        let alive = self.alive.clone();
        let scheduling = Arc::clone(&self.scheduling);
        let handle = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                scheduling.enter_thread();
                let left = work();
                drop(alive);
                left
            })
            .map_err(|error| StartError {
                name: name.to_owned(),
                error,
            })?;
        self.members.push(Member {
            name: name.to_owned(),
            handle,
            seat,
        });
        Ok(())
    }

    fn start_sinks(
        &mut self,
        doors: Vec<Door>,
        first: usize,
        clock: &Arc<dyn Clock>,
        shared: &Arc<Shared>,
    ) -> Result<Vec<Sender<Handed>>, StartError> {
        let mut senders = Vec::new();
        for (index, door) in doors.into_iter().enumerate() {
            let (sender, input) = door.queue.open();
            let worker = SinkWorker {
                position: first + index,
                drops: sender.drop_count(),
                input,
                essential: door.essential,
                clock: Arc::clone(clock),
                shared: Arc::clone(shared),
                sink: door.sink,
            };
            self.sink_drops.push((worker.sink.name(), sender.drop_count()));
            self.start(worker.sink.name(), None, move || worker.run())?;
            senders.push(sender);
        }
        Ok(senders)
    }
}

/// Threads of a stage's own, so that one that hangs keeps none from the others.
fn pool_of(stage: &'static str, scheduling: &Arc<Scheduling>) -> Result<ThreadPool, StartError> {
    let scheduling = Arc::clone(scheduling);
    ThreadPoolBuilder::new()
        .start_handler(move |_| scheduling.enter_thread())
        .thread_name(move |index| format!("{stage} {index}"))
        .build()
        .map_err(|error| StartError {
            name: stage.to_owned(),
            error: std::io::Error::other(error),
        })
}

impl Pipeline {
    /// Start all threads.
    pub fn start(self) -> Result<RunningPipeline, StartError> {
        self.scheduling.enter_program();
        let under_way = self.frames_under_way();
        let shared = Arc::new(Shared::default());
        let controls = Arc::new(Controls::for_stages(self.stages.iter().map(|stage| stage.name())));
        let limits = self.limits;
        let seats: Arc<[Arc<Seat>]> = self
            .stages
            .iter()
            .map(|stage| Arc::new(Seat::new(stage.name(), limits.as_ref())))
            .collect();
        let (alive, ended) = channel::bounded(1);
        let mut crew = Crew {
            members: Vec::new(),
            sink_drops: Vec::new(),
            scheduling: Arc::clone(&self.scheduling),
            alive,
        };
        let clock = self.clock;
        let tap_count = self.taps.len();
        let taps = crew.start_sinks(self.taps, 0, &clock, &shared)?;
        let sinks = crew.start_sinks(self.sinks, tap_count, &clock, &shared)?;

        let (wake, woken) = channel::bounded(1);
        let ledger = Arc::new(Ledger::default());
        let gate = Arc::new(Gate::new(sinks, Arc::clone(&ledger), Arc::clone(&clock), wake));
        let watchdog = limits.map(|limits| Watchdog {
            gate: Arc::downgrade(&gate),
            ledger: Arc::clone(&ledger),
            seats: Arc::clone(&seats),
            limits,
            clock: Arc::clone(&clock),
        });
        if let Some(watchdog) = watchdog.clone() {
            crew.start("watchdog", None, move || {
                watchdog.run(&woken);
                Left::Watchdog
            })?;
        }

        // From the line's end to its beginning: each thread is given the way on.
        let mut way = Way {
            stages: Vec::new(),
            end: gate,
            controls: Arc::clone(&controls),
            clock: Arc::clone(&clock),
        };
        let mut entry_drops = None;
        for ((position, stage), seat) in self.stages.into_iter().enumerate().zip(seats.iter()).rev() {
            let queue = if position == 0 {
                self.entry
            } else {
                Queue::blocking(self.between)
            };
            let (sender, input): (Sender<_>, Receiver<_>) = queue.open();
            entry_drops = Some(sender.drop_count());
            seat.set_way(way.clone());
            let worker = StageWorker {
                position,
                own_pool: limits
                    .is_some()
                    .then(|| pool_of(stage.name(), &self.scheduling))
                    .transpose()?,
                stage,
                controls: Arc::clone(&controls),
                input,
                seats: Arc::clone(&seats),
                ledger: Arc::clone(&ledger),
                clock: Arc::clone(&clock),
            };
            crew.start(worker.stage.name(), Some(position), move || worker.run())?;
            let door = StageDoor {
                seat: Arc::clone(seat),
                sender,
                position,
            };
            way.stages.insert(0, door);
        }
        let entry_drops = entry_drops.unwrap_or_else(|| self.entry.open::<()>().0.drop_count());
        let worker = SourceWorker {
            source: self.source,
            way,
            taps,
            copies: Pool::new(under_way),
            keep_original: self.keep_original,
            limits,
            clock: Arc::clone(&clock),
            shared: Arc::clone(&shared),
        };
        crew.start("source", None, move || worker.run())?;
        Ok(RunningPipeline {
            members: crew.members,
            ended,
            controls,
            shared,
            seats,
            ledger,
            watchdog,
            clock,
            entry_drops,
            sink_drops: crew.sink_drops,
        })
    }
}

impl RunningPipeline {
    /// The switches of the stages.
    pub fn controls(&self) -> &Arc<Controls> {
        &self.controls
    }

    /// How far the line has come.
    pub fn status(&self) -> Status {
        let passed = self.ledger.passed();
        Status {
            frames_in: self.shared.frames_in.load(Ordering::Relaxed),
            frames_out: passed.out,
            frames_dropped: self.entry_drops.get(),
            passed,
        }
    }

    /// Frames that the queue before a sink has dropped, because the sink was too slow.
    pub fn dropped_before(&self, sink: &str) -> u64 {
        let found = self.sink_drops.iter().find(|(name, _)| *name == sink);
        found.map_or(0, |(_, drops)| drops.get())
    }

    /// From arrival to the end of the line, over the last frames.
    pub fn recent_latency(&self) -> Summary {
        self.ledger.recent()
    }

    /// How each stage is doing, in the order of the line.
    pub fn stages(&self) -> Vec<StageStatus> {
        let now = self.clock.now();
        let seats = self.seats.iter().enumerate();
        seats
            .map(|(position, seat)| StageStatus {
                name: seat.name,
                condition: seat.condition(now, self.controls.is_bypassed(position)),
                expected: seat.expected(),
            })
            .collect()
    }

    /// Look at once for frames that are overdue and stages that hang; the watchdog of a live line does so by itself.
    pub fn look(&self) {
        if let Some(watchdog) = &self.watchdog {
            watchdog.look();
        }
    }

    /// No new frame enters; those under way are finished.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Release);
    }

    /// Wait a tenth of a second, or until a thread of the line ends.
    pub fn wait_a_moment(&self) {
        let _ended = self.ended.recv_timeout(LOOK_EVERY);
    }

    /// Wait for the end, asking `look` ten times a second whether to go on.
    pub fn wait_looking(self, mut look: impl FnMut(&Self) -> Wish) -> Outcome {
        while !self.has_ended() {
            if self.ended.recv_timeout(LOOK_EVERY) == Err(RecvTimeoutError::Timeout) && look(&self) == Wish::Stop {
                self.stop();
            }
        }
        self.outcome()
    }

    /// Wait for the end.
    pub fn wait(self) -> Outcome {
        while !self.has_ended() {
            self.wait_a_moment();
        }
        self.outcome()
    }

    /// True when every thread has ended that will; what a stage that hangs keeps is taken from it, so that the others can.
    pub fn has_ended(&self) -> bool {
        let hanging = |member: &Member| {
            let seat = member.seat.and_then(|seat| self.seats.get(seat))?;
            seat.is_hanging().then_some(seat)
        };
        let source_ended = self.members.last().is_some_and(|source| source.handle.is_finished());
        let at_work = || self.members.iter().filter(|member| !member.handle.is_finished());
        if source_ended {
            at_work().filter_map(hanging).for_each(|seat| seat.cut_way());
        }
        at_work().all(|member| source_ended && hanging(member).is_some())
    }

    fn outcome(self) -> Outcome {
        let mut outcome = Outcome::default();
        let mut stages: Vec<(usize, StageOutcome)> = Vec::new();
        let mut sinks: Vec<(usize, SinkOutcome)> = Vec::new();
        for member in self.members {
            if !member.handle.is_finished() {
                let seat = member.seat.and_then(|position| Some((position, self.seats.get(position)?)));
                stages.extend(seat.map(|(position, seat)| {
                    let mut outcome = StageOutcome::default();
                    seat.complete(&mut outcome);
                    (position, outcome)
                }));
                outcome.lost_threads.push(member.name);
                continue;
            }
            match member.handle.join() {
                Ok(Left::Source {
                    working,
                    failure,
                    stopped,
                }) => {
                    outcome.source_working = working;
                    outcome.source_failure = failure;
                    outcome.stopped = stopped;
                }
                Ok(Left::Stage { position, outcome }) => stages.push((position, outcome)),
                Ok(Left::Sink { position, outcome }) => sinks.push((position, outcome)),
                Ok(Left::Watchdog) => {}
                Err(_) => outcome.lost_threads.push(member.name),
            }
        }
        stages.sort_by_key(|(position, _)| *position);
        sinks.sort_by_key(|(position, _)| *position);
        outcome.stages = stages.into_iter().map(|(_, stage)| stage).collect();
        outcome.sinks = sinks.into_iter().map(|(_, sink)| sink).collect();
        outcome.frames_in = self.shared.frames_in.load(Ordering::Relaxed);
        outcome.passed = self.ledger.passed();
        outcome.frames_out = outcome.passed.out;
        outcome.end_to_end = self.ledger.end_to_end();
        outcome.frames_dropped = self.entry_drops.get();
        outcome
    }
}
