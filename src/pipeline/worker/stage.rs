//! A stage's thread: takes frames through it, failing open.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use rayon::ThreadPool;

use crate::frame::{Frame, StageTiming};
use crate::pipeline::control::Controls;
use crate::pipeline::governor::Ruling;
use crate::pipeline::ledger::Ledger;
use crate::pipeline::outcome::StageOutcome;
use crate::pipeline::queue::Receiver;
use crate::pipeline::seat::Seat;
use crate::pipeline::stage::{Stage, StageError};
use crate::pipeline::worker::left::{Left, message_from_panic};
use crate::time::{Clock, Span, Timestamp};

/// When so many frames are missing between two, a stage's history tells nothing about the present.
const RESET_AFTER_LOST_FRAMES: u64 = 8;

/// Takes frames through one stage, failing open.
pub(in crate::pipeline) struct StageWorker {
    pub(in crate::pipeline) position: usize,
    pub(in crate::pipeline) stage: Box<dyn Stage>,
    pub(in crate::pipeline) controls: Arc<Controls>,
    pub(in crate::pipeline) input: Receiver<Frame>,
    pub(in crate::pipeline) seats: Arc<[Arc<Seat>]>,
    pub(in crate::pipeline) ledger: Arc<Ledger>,
    /// Of a live line: a stage that hangs then holds no thread that another stage needs.
    pub(in crate::pipeline) own_pool: Option<ThreadPool>,
    pub(in crate::pipeline) clock: Arc<dyn Clock>,
}

/// How a frame came through a stage.
enum Passage {
    Treated,
    Bypassed,
    /// Nobody waits for it any more.
    Overdue,
}

impl StageWorker {
    pub(in crate::pipeline) fn run(mut self) -> Left {
        let mut state = StageState {
            outcome: StageOutcome {
                name: self.stage.name(),
                ..StageOutcome::default()
            },
            failing: false,
            broken: false,
            was_off: false,
            passed_by: 0,
            strength: None,
            last: None,
            began: None,
        };
        let Some(seat) = self.seats.get(self.position).cloned() else {
            return Left::Watchdog;
        };
        while let Some(mut frame) = self.input.pop() {
            let taken = self.clock.now();
            let sent = frame.timings.last().map_or(frame.arrived_at, |timing| timing.left);
            state.began = None;
            let passed_by = seat.passed_by();
            state.was_off |= passed_by != state.passed_by;
            state.passed_by = passed_by;
            let passage = if self.ledger.is_beyond(frame.id) {
                Passage::Overdue
            } else {
                self.treat(&seat, &mut frame, &mut state)
            };
            let left = self.clock.now();
            // Until a core was free it waited.
            let entered = state.began.unwrap_or(taken);
            state.outcome.waiting.record(entered - sent);
            let bypassed = match passage {
                Passage::Overdue => {
                    state.outcome.overdue += 1;
                    seat.let_drop(frame);
                    continue;
                }
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
            if !bypassed {
                self.judge(&seat, &frame, left);
            }
            if seat.send_on(frame).is_err() {
                break;
            }
        }
        // Whoever waits at the queues behind this stage is told of the end.
        seat.cut_way();
        seat.complete(&mut state.outcome);
        Left::Stage {
            position: self.position,
            outcome: state.outcome,
        }
    }

    fn treat(&mut self, seat: &Seat, frame: &mut Frame, state: &mut StageState) -> Passage {
        let switch = self.controls.switch(self.position);
        if state.broken {
            return Passage::Bypassed;
        }
        if switch.is_some_and(|switch| switch.is_bypassed()) {
            state.outcome.switched_off += 1;
            state.was_off = true;
            return Passage::Bypassed;
        }
        let now = self.clock.now();
        let ruling = seat.govern(|governor| governor.rule(now, governor.due(frame.arrived_at)));
        match ruling {
            None | Some(Ruling::Work) => {}
            Some(Ruling::Resting) => {
                state.outcome.skipped += 1;
                state.was_off = true;
                return Passage::Bypassed;
            }
            Some(Ruling::Late) => {
                state.outcome.skipped += 1;
                return Passage::Bypassed;
            }
            Some(Ruling::TooLong) => {
                state.outcome.skipped += 1;
                self.blame_the_slowest(frame, Some(seat), now);
                return Passage::Bypassed;
            }
        }
        seat.begin(frame.id, now);
        let result = self.work(frame, state);
        let returned = self.clock.now();
        let given_up = seat.end(returned);
        state.last = Some(frame.id.0);
        state.was_off = given_up;
        let passage = match result {
            Ok(Ok(())) => {
                if state.failing {
                    tracing::info!(stage = state.outcome.name, frame = frame.id.0, "the stage works again");
                }
                state.failing = false;
                let began = state.began.unwrap_or(now);
                seat.govern(|governor| governor.took(returned - began));
                Passage::Treated
            }
            Ok(Err(error)) => {
                state.note_failure(frame, &error);
                Passage::Bypassed
            }
            Err(message) => {
                tracing::error!(
                    stage = state.outcome.name,
                    frame = frame.id.0,
                    "the stage panicked and is bypassed from now on (please report this): {message}"
                );
                state.outcome.panic = Some(message);
                state.broken = true;
                seat.set_broken();
                Passage::Bypassed
            }
        };
        if given_up {
            tracing::warn!(
                stage = state.outcome.name,
                "the stage that hung has returned; it rests, then works again"
            );
            return Passage::Overdue;
        }
        passage
    }

    /// The stage's own work; the message of a panic.
    fn work(&mut self, frame: &mut Frame, state: &mut StageState) -> Result<Result<(), StageError>, String> {
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
            let mut process = || {
                *began = Some(clock.now());
                stage.process(frame)
            };
            let result = match &self.own_pool {
                Some(pool) => pool.install(process),
                None => rayon::scope(|_| process()),
            };
            if result.is_err() {
                self.stage.reset();
            }
            result
        }));
        result.map_err(|payload| message_from_panic(payload.as_ref()))
    }

    /// Was the frame in time?
    fn judge(&self, seat: &Seat, frame: &Frame, now: Timestamp) {
        let in_time = seat.govern(|governor| {
            let in_time = now <= governor.due(frame.arrived_at);
            if in_time {
                governor.praise(now);
            }
            in_time
        });
        if in_time == Some(false) {
            self.blame_the_slowest(frame, None, now);
        }
    }

    /// Late is a frame by the stage that took longest for it, not by the one before which its time was up.
    fn blame_the_slowest(&self, frame: &Frame, would_be: Option<&Seat>, now: Timestamp) {
        let spent = frame.timings.iter().filter(|timing| !timing.bypassed);
        let slowest = spent
            .map(|timing| (timing.left - timing.entered, timing.stage))
            .chain(would_be.map(|seat| (seat.expected(), seat.name)))
            .max_by_key(|(span, _)| *span)
            .filter(|(span, _)| *span > Span(0));
        let Some((_, name)) = slowest else { return };
        if let Some(seat) = self.seats.iter().find(|seat| seat.name == name) {
            seat.blame(now);
        }
    }
}

/// What a stage's thread remembers from frame to frame.
struct StageState {
    outcome: StageOutcome,
    failing: bool,
    broken: bool,
    was_off: bool,
    /// Frames that had gone around the stage when it last looked.
    passed_by: u64,
    strength: Option<f32>,
    last: Option<u64>,
    /// When the stage began with the present frame.
    began: Option<Timestamp>,
}

impl StageState {
    fn note_failure(&mut self, frame: &Frame, error: &StageError) {
        self.outcome.failures += 1;
        if !self.failing {
            let message = error.to_string();
            tracing::warn!(
                stage = self.outcome.name,
                frame = frame.id.0,
                "the stage failed, frames pass as they come: {message}"
            );
            self.outcome.first_failure.get_or_insert(message);
        }
        self.failing = true;
    }
}
