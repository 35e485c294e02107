//! What each thread of the line does: the source's, a stage's, a sink's.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::frame::{Frame, StageTiming};
use crate::image::buffer::Rgb8;
use crate::image::pool::Pool;
use crate::pipeline::control::Controls;
use crate::pipeline::outcome::{SinkOutcome, StageOutcome};
use crate::pipeline::queue::{Closed, DropCount, Receiver, Sender};
use crate::pipeline::stage::{Sink, Source, Stage};
use crate::pipeline::timing::Durations;
use crate::time::{Clock, Timestamp};

/// When so many frames are missing between two, a stage's history tells nothing about the present.
const RESET_AFTER_LOST_FRAMES: u64 = 8;

/// A finished frame on its way to a sink, with the instant at which it was handed out.
pub(super) type Handed = (Arc<Frame>, Timestamp);

/// Counts that all threads of a line share with whoever watches it.
#[derive(Debug, Default)]
pub(super) struct Shared {
    pub(super) stop: AtomicBool,
    pub(super) frames_in: AtomicU64,
    pub(super) frames_out: AtomicU64,
}

/// Hands frames to sinks; a sink that ended is left out from then on.
pub(super) struct FanOut {
    doors: Vec<Sender<Handed>>,
    clock: Arc<dyn Clock>,
    shared: Arc<Shared>,
    end_to_end: Durations,
}

impl FanOut {
    pub(super) fn new(doors: Vec<Sender<Handed>>, clock: Arc<dyn Clock>, shared: Arc<Shared>) -> Self {
        Self {
            doors,
            clock,
            shared,
            end_to_end: Durations::new(),
        }
    }

    fn push(&mut self, frame: Frame) -> Result<(), Closed> {
        let now = self.clock.now();
        self.end_to_end.record(now - frame.arrived_at);
        let frame = Arc::new(frame);
        self.doors.retain(|door| door.push((Arc::clone(&frame), now)).is_ok());
        if self.doors.is_empty() {
            return Err(Closed);
        }
        self.shared.frames_out.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }
}

/// Where a frame goes next.
pub(super) enum Output {
    Next(Sender<Frame>),
    Sinks(FanOut),
}

impl Output {
    fn push(&mut self, frame: Frame) -> Result<(), Closed> {
        match self {
            Self::Next(queue) => queue.push(frame),
            Self::Sinks(fan_out) => fan_out.push(frame),
        }
    }

    fn end_to_end(self) -> Option<Durations> {
        match self {
            Self::Next(_) => None,
            Self::Sinks(fan_out) => Some(fan_out.end_to_end),
        }
    }
}

/// What a thread of the line leaves behind.
#[derive(Debug)]
pub(super) enum Left {
    Source {
        working: Durations,
        failure: Option<String>,
        stopped: bool,
        end_to_end: Option<Durations>,
    },
    Stage {
        position: usize,
        outcome: StageOutcome,
        end_to_end: Option<Durations>,
    },
    Sink {
        position: usize,
        outcome: SinkOutcome,
    },
}

/// Asks the source for frames and sends them into the line.
pub(super) struct SourceWorker {
    pub(super) source: Box<dyn Source>,
    pub(super) output: Output,
    /// Sinks of the untouched picture.
    pub(super) taps: Vec<Sender<Handed>>,
    /// Where the copies for taps and side by side come from.
    pub(super) copies: Pool<Rgb8>,
    pub(super) keep_original: bool,
    pub(super) clock: Arc<dyn Clock>,
    pub(super) shared: Arc<Shared>,
}

impl SourceWorker {
    pub(super) fn run(mut self) -> Left {
        let mut working = Durations::new();
        let mut failure = None;
        let mut stopped = false;
        loop {
            if self.shared.stop.load(Ordering::Acquire) {
                stopped = true;
                break;
            }
            let asked = self.clock.now();
            let next = catch_unwind(AssertUnwindSafe(|| self.source.next_frame()));
            let arrived = self.clock.now();
            let mut frame = match next {
                Ok(Ok(Some(frame))) => frame,
                Ok(Ok(None)) => break,
                Ok(Err(error)) => {
                    failure = Some(error.to_string());
                    break;
                }
                Err(payload) => {
                    failure = Some(format!("the source panicked: {}", message_from_panic(payload.as_ref())));
                    break;
                }
            };
            working.record(arrived - asked);
            frame.arrived_at = arrived;
            self.shared.frames_in.fetch_add(1, Ordering::Relaxed);
            if !self.taps.is_empty() {
                let untouched = Arc::new(self.untouched_copy(&frame));
                self.taps.retain(|tap| tap.push((Arc::clone(&untouched), arrived)).is_ok());
            }
            if self.keep_original {
                frame.original = Some(self.copies.take_copy(&frame.image));
            }
            if self.output.push(frame).is_err() {
                break;
            }
        }
        if let Some(message) = &failure {
            tracing::error!("{message}");
        }
        Left::Source {
            working,
            failure,
            stopped,
            end_to_end: self.output.end_to_end(),
        }
    }

    fn untouched_copy(&self, frame: &Frame) -> Frame {
        let mut copy = Frame::new(
            frame.id,
            frame.exposed_at,
            frame.arrived_at,
            self.copies.take_copy(&frame.image),
        );
        copy.since_previous = frame.since_previous;
        copy.camera.clone_from(&frame.camera);
        copy.field_of_view.clone_from(&frame.field_of_view);
        copy.scene_cut = frame.scene_cut;
        copy
    }
}

/// Takes frames through one stage, failing open.
pub(super) struct StageWorker {
    pub(super) position: usize,
    pub(super) stage: Box<dyn Stage>,
    pub(super) controls: Arc<Controls>,
    pub(super) input: Receiver<Frame>,
    pub(super) output: Output,
    pub(super) clock: Arc<dyn Clock>,
}

/// How a frame came through a stage.
enum Passage {
    Treated,
    Bypassed,
}

impl StageWorker {
    pub(super) fn run(mut self) -> Left {
        let mut state = StageState {
            outcome: StageOutcome {
                name: self.stage.name(),
                ..StageOutcome::default()
            },
            failing: false,
            was_off: false,
            strength: None,
            last: None,
            began: None,
        };
        while let Some(mut frame) = self.input.pop() {
            let taken = self.clock.now();
            let sent = frame.timings.last().map_or(frame.arrived_at, |timing| timing.left);
            state.began = None;
            let passage = self.treat(&mut frame, &mut state);
            let left = self.clock.now();
            // Until a core was free it waited.
            let entered = state.began.unwrap_or(taken);
            state.outcome.waiting.record(entered - sent);
            let bypassed = match passage {
                Passage::Treated => {
                    state.outcome.working.record(left - entered);
                    false
                }
                Passage::Bypassed => true,
            };
            frame.timings.push(StageTiming {
                stage: state.outcome.name,
                entered,
                left,
                bypassed,
            });
            if self.output.push(frame).is_err() {
                break;
            }
        }
        Left::Stage {
            position: self.position,
            outcome: state.outcome,
            end_to_end: self.output.end_to_end(),
        }
    }

    fn treat(&mut self, frame: &mut Frame, state: &mut StageState) -> Passage {
        if state.outcome.panic.is_some() {
            return Passage::Bypassed;
        }
        if self.controls.switch(self.position).is_some_and(|switch| switch.is_bypassed()) {
            state.outcome.switched_off += 1;
            state.was_off = true;
            return Passage::Bypassed;
        }
        // A stage works on its own buffers and swaps its result in as its last act, so whatever unwinds before that leaves the
        // frame as it came, and a stage that unwound is never called again: nothing half-done is ever looked at.
        let result = catch_unwind(AssertUnwindSafe(|| {
            let gap = state
                .last
                .is_some_and(|last| frame.id.0 <= last || frame.id.0 - last > RESET_AFTER_LOST_FRAMES);
            if gap || state.was_off {
                self.stage.reset();
            }
            let wanted = self.controls.switch(self.position).and_then(|switch| switch.strength());
            if let Some(strength) = wanted
                && wanted != state.strength
            {
                self.stage.set_strength(strength);
                state.strength = wanted;
            }
            // Inside rayon's pool from the first to the last of the stage's parallel loops: from outside each loop would stand in line
            // behind the loops of all other stages. Measured: 26 instead of 23.5 frames a second at 1080p on two cores.
            let (stage, clock, began) = (&mut self.stage, &self.clock, &mut state.began);
            let result = rayon::scope(|_| {
                *began = Some(clock.now());
                stage.process(frame)
            });
            if result.is_err() {
                self.stage.reset();
            }
            result
        }));
        state.last = Some(frame.id.0);
        state.was_off = false;
        match result {
            Ok(Ok(())) => {
                if state.failing {
                    tracing::info!(stage = state.outcome.name, frame = frame.id.0, "the stage works again");
                }
                state.failing = false;
                Passage::Treated
            }
            Ok(Err(error)) => {
                state.outcome.failures += 1;
                if !state.failing {
                    let message = error.to_string();
                    tracing::warn!(
                        stage = state.outcome.name,
                        frame = frame.id.0,
                        "the stage failed, frames pass as they come: {message}"
                    );
                    state.outcome.first_failure.get_or_insert(message);
                }
                state.failing = true;
                Passage::Bypassed
            }
            Err(payload) => {
                let message = message_from_panic(payload.as_ref());
                tracing::error!(
                    stage = state.outcome.name,
                    frame = frame.id.0,
                    "the stage panicked and is bypassed from now on (please report this): {message}"
                );
                state.outcome.panic = Some(message);
                Passage::Bypassed
            }
        }
    }
}

/// What a stage's thread remembers from frame to frame.
struct StageState {
    outcome: StageOutcome,
    failing: bool,
    was_off: bool,
    strength: Option<f32>,
    last: Option<u64>,
    /// When the stage began with the present frame.
    began: Option<Timestamp>,
}

/// Feeds one sink from its queue.
pub(super) struct SinkWorker {
    pub(super) position: usize,
    pub(super) sink: Box<dyn Sink>,
    pub(super) input: Receiver<Handed>,
    pub(super) drops: DropCount,
    /// When this sink ends before its time, the line stops.
    pub(super) essential: bool,
    pub(super) clock: Arc<dyn Clock>,
    pub(super) shared: Arc<Shared>,
}

impl SinkWorker {
    pub(super) fn run(mut self) -> Left {
        let mut outcome = SinkOutcome {
            name: self.sink.name(),
            ..SinkOutcome::default()
        };
        while let Some((frame, handed)) = self.input.pop() {
            let entered = self.clock.now();
            outcome.waiting.record(entered - handed);
            outcome.failure = failure_of(|| self.sink.consume(&frame));
            if outcome.failure.is_some() {
                break;
            }
            outcome.working.record(self.clock.now() - entered);
            outcome.taken += 1;
        }
        // Closing the queue first lets a line that waits at it go on while the sink writes its end.
        drop(self.input);
        if outcome.failure.is_some() && self.essential {
            self.shared.stop.store(true, Ordering::Release);
        }
        let at_end = failure_of(|| self.sink.finish());
        outcome.failure = outcome.failure.or(at_end);
        if let Some(failure) = &outcome.failure {
            tracing::error!("{failure}");
        }
        outcome.dropped = self.drops.get();
        Left::Sink {
            position: self.position,
            outcome,
        }
    }
}

fn failure_of<E: std::fmt::Display>(work: impl FnOnce() -> Result<(), E>) -> Option<String> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => None,
        Ok(Err(error)) => Some(error.to_string()),
        Err(payload) => Some(format!("it panicked: {}", message_from_panic(payload.as_ref()))),
    }
}

fn message_from_panic(payload: &(dyn Any + Send)) -> String {
    payload
        .downcast_ref::<&str>()
        .map(|text| (*text).to_owned())
        .or_else(|| payload.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".to_owned())
}
