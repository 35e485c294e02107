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
//! Each of them is told by `tracing` once, when it happens, and stands in the [`Outcome`].
//!
//! The last stage's thread hands finished frames to the sinks' queues. Work that a stage spreads over cores goes to rayon's
//! global pool, which all stages share, so stages compete for cores as tasks and not as surplus threads.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{self, RecvTimeoutError};

use crate::image::pool::Pool;
use crate::pipeline::builder::{Door, Pipeline};
use crate::pipeline::control::Controls;
use crate::pipeline::outcome::{Outcome, SinkOutcome, StageOutcome};
use crate::pipeline::queue::{DropCount, Queue, Receiver, Sender};
use crate::pipeline::worker::{FanOut, Handed, Left, Output, Shared, SinkWorker, SourceWorker, StageWorker};

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
}

/// What a waiting caller wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Let it run.
    GoOn,
    /// Finish what is under way, then end.
    Stop,
}

/// A line at work.
#[derive(Debug)]
pub struct RunningPipeline {
    threads: Vec<(String, JoinHandle<Left>)>,
    ended: channel::Receiver<()>,
    controls: Arc<Controls>,
    shared: Arc<Shared>,
    entry_drops: DropCount,
}

/// Starts threads and keeps their handles; each holds an end of `ended` for as long as it lives.
struct Crew {
    threads: Vec<(String, JoinHandle<Left>)>,
    alive: channel::Sender<()>,
}

impl Crew {
    fn start(&mut self, name: &str, work: impl FnOnce() -> Left + Send + 'static) -> Result<(), StartError> {
        let alive = self.alive.clone();
        let handle = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                let left = work();
                drop(alive);
                left
            })
            .map_err(|error| StartError {
                name: name.to_owned(),
                error,
            })?;
        self.threads.push((name.to_owned(), handle));
        Ok(())
    }
}

impl Pipeline {
    /// Start all threads.
    pub fn start(self) -> Result<RunningPipeline, StartError> {
        let under_way = self.frames_under_way();
        let shared = Arc::new(Shared::default());
        let controls = Arc::new(Controls::for_stages(self.stages.iter().map(|stage| stage.name())));
        let (alive, ended) = channel::bounded(1);
        let mut crew = Crew {
            threads: Vec::new(),
            alive,
        };
        let clock = self.clock;
        let tap_count = self.taps.len();

        let mut open = |doors: Vec<Door>, first: usize| -> Result<Vec<Sender<Handed>>, StartError> {
            let mut senders = Vec::new();
            for (index, door) in doors.into_iter().enumerate() {
                let (sender, input) = door.queue.open();
                let worker = SinkWorker {
                    position: first + index,
                    drops: sender.drop_count(),
                    input,
                    essential: door.essential,
                    clock: Arc::clone(&clock),
                    shared: Arc::clone(&shared),
                    sink: door.sink,
                };
                crew.start(worker.sink.name(), move || worker.run())?;
                senders.push(sender);
            }
            Ok(senders)
        };
        let taps = open(self.taps, 0)?;
        let sinks = open(self.sinks, tap_count)?;

        // From the line's end to its beginning: each thread is given the way into the next.
        let mut output = Output::Sinks(FanOut::new(sinks, Arc::clone(&clock), Arc::clone(&shared)));
        let mut entry_drops = None;
        for (position, stage) in self.stages.into_iter().enumerate().rev() {
            let queue = if position == 0 {
                self.entry
            } else {
                Queue::blocking(self.between)
            };
            let (sender, input): (Sender<_>, Receiver<_>) = queue.open();
            entry_drops = Some(sender.drop_count());
            let worker = StageWorker {
                position,
                stage,
                controls: Arc::clone(&controls),
                input,
                output,
                clock: Arc::clone(&clock),
            };
            crew.start(worker.stage.name(), move || worker.run())?;
            output = Output::Next(sender);
        }
        let entry_drops = entry_drops.unwrap_or_else(|| self.entry.open::<()>().0.drop_count());
        let worker = SourceWorker {
            source: self.source,
            output,
            taps,
            copies: Pool::new(under_way),
            keep_original: self.keep_original,
            clock,
            shared: Arc::clone(&shared),
        };
        crew.start("source", move || worker.run())?;
        Ok(RunningPipeline {
            threads: crew.threads,
            ended,
            controls,
            shared,
            entry_drops,
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
        Status {
            frames_in: self.shared.frames_in.load(Ordering::Relaxed),
            frames_out: self.shared.frames_out.load(Ordering::Relaxed),
            frames_dropped: self.entry_drops.get(),
        }
    }

    /// No new frame enters; those under way are finished.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Release);
    }

    /// Wait for the end, asking `look` ten times a second whether to go on.
    pub fn wait_looking(self, mut look: impl FnMut(Status) -> Wish) -> Outcome {
        while self.ended.recv_timeout(LOOK_EVERY) == Err(RecvTimeoutError::Timeout) {
            if look(self.status()) == Wish::Stop {
                self.stop();
            }
        }
        self.wait()
    }

    /// Wait for the end.
    pub fn wait(self) -> Outcome {
        let mut outcome = Outcome::default();
        let mut stages: Vec<(usize, StageOutcome)> = Vec::new();
        let mut sinks: Vec<(usize, SinkOutcome)> = Vec::new();
        for (name, thread) in self.threads {
            let end_to_end = match thread.join() {
                Ok(Left::Source {
                    working,
                    failure,
                    stopped,
                    end_to_end,
                }) => {
                    outcome.source_working = working;
                    outcome.source_failure = failure;
                    outcome.stopped = stopped;
                    end_to_end
                }
                Ok(Left::Stage {
                    position,
                    outcome,
                    end_to_end,
                }) => {
                    stages.push((position, outcome));
                    end_to_end
                }
                Ok(Left::Sink { position, outcome }) => {
                    sinks.push((position, outcome));
                    None
                }
                Err(_) => {
                    outcome.lost_threads.push(name);
                    None
                }
            };
            if let Some(end_to_end) = end_to_end {
                outcome.end_to_end = end_to_end;
            }
        }
        stages.sort_by_key(|(position, _)| *position);
        sinks.sort_by_key(|(position, _)| *position);
        outcome.stages = stages.into_iter().map(|(_, stage)| stage).collect();
        outcome.sinks = sinks.into_iter().map(|(_, sink)| sink).collect();
        outcome.frames_in = self.shared.frames_in.load(Ordering::Relaxed);
        outcome.frames_out = self.shared.frames_out.load(Ordering::Relaxed);
        outcome.frames_dropped = self.entry_drops.get();
        outcome
    }
}
