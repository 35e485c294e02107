//! What others may know of a stage while it works: its neighbours, the watchdog, whoever watches the line.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::frame::{Frame, FrameId, StageTiming};
use crate::pipeline::control::Controls;
use crate::pipeline::gate::Gate;
use crate::pipeline::governor::Governor;
use crate::pipeline::ledger::Ledger;
use crate::pipeline::live::Limits;
use crate::pipeline::outcome::StageOutcome;
use crate::pipeline::queue::{Closed, Refused, Sender};
use crate::time::{Clock, Span, Timestamp};

/// How a stage is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Condition {
    /// It treats frames.
    #[default]
    Working,
    /// A switch has it passed by.
    SwitchedOff,
    /// It overran often and is passed by for a while.
    Resting,
    /// It does not return from a frame and is passed by until it does.
    Hanging,
    /// It panicked and is passed by.
    Broken,
}

/// What a stage is at.
#[derive(Clone, Copy, Debug)]
struct Busy {
    frame: FrameId,
    since: Timestamp,
}

struct Care {
    /// Of a live line only.
    governor: Option<Governor>,
    busy: Option<Busy>,
    hangs: u64,
    rests: u64,
}

/// A stage's place in the line.
pub(super) struct Seat {
    pub(super) name: &'static str,
    /// Frames in the queue before the stage, in the stage, or on their way out of it.
    inside: AtomicU64,
    /// Frames that went around the stage because a switch said so.
    passed_off: AtomicU64,
    /// Frames that went around it because it rests, hangs or is broken.
    passed_unfit: AtomicU64,
    hanging: AtomicBool,
    broken: AtomicBool,
    care: Mutex<Care>,
    /// Where frames go from here; taken away from a stage that hangs when the line ends.
    way: Mutex<Option<Way>>,
}

impl Seat {
    pub(super) fn new(name: &'static str, limits: Option<&Limits>) -> Self {
        Self {
            name,
            inside: AtomicU64::new(0),
            passed_off: AtomicU64::new(0),
            passed_unfit: AtomicU64::new(0),
            hanging: AtomicBool::new(false),
            broken: AtomicBool::new(false),
            care: Mutex::new(Care {
                governor: limits.map(Governor::new),
                busy: None,
                hangs: 0,
                rests: 0,
            }),
            way: Mutex::new(None),
        }
    }

    fn care(&self) -> MutexGuard<'_, Care> {
        self.care.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn way(&self) -> MutexGuard<'_, Option<Way>> {
        self.way.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Where frames go from here.
    pub(super) fn set_way(&self, way: Way) {
        *self.way() = Some(way);
    }

    /// Nothing goes on from here any more.
    pub(super) fn cut_way(&self) {
        self.way().take();
    }

    /// A frame leaves the stage.
    pub(super) fn send_on(&self, frame: Frame) -> Result<(), Closed> {
        let sent = self.way().as_ref().map_or(Err(Closed), |way| way.push(frame));
        self.inside.fetch_sub(1, Ordering::AcqRel);
        sent
    }

    /// A frame ends in the stage: nobody waits for it any more.
    pub(super) fn let_drop(&self, frame: Frame) {
        drop(frame);
        self.inside.fetch_sub(1, Ordering::AcqRel);
    }

    /// Ask the governor, if there is one.
    pub(super) fn govern<T>(&self, ask: impl FnOnce(&mut Governor) -> T) -> Option<T> {
        self.care().governor.as_mut().map(ask)
    }

    /// The stage begins with a frame.
    pub(super) fn begin(&self, frame: FrameId, now: Timestamp) {
        self.care().busy = Some(Busy { frame, since: now });
    }

    /// The stage is done with its frame; true when it had been given up.
    pub(super) fn end(&self, now: Timestamp) -> bool {
        let mut care = self.care();
        care.busy = None;
        let given_up = self.hanging.swap(false, Ordering::AcqRel);
        if given_up && let Some(governor) = &mut care.governor {
            governor.send_to_rest(now);
            care.rests += 1;
        }
        given_up
    }

    /// The stage panicked.
    pub(super) fn set_broken(&self) {
        self.broken.store(true, Ordering::Release);
    }

    pub(super) fn is_hanging(&self) -> bool {
        self.hanging.load(Ordering::Acquire)
    }

    /// Blame the stage for a late frame; switched off, it is told about.
    pub(super) fn blame(&self, now: Timestamp) {
        let mut care = self.care();
        let Some(governor) = &mut care.governor else { return };
        let expected = governor.expected();
        let Some(rest) = governor.blame(now) else { return };
        care.rests += 1;
        tracing::warn!(
            stage = self.name,
            "the stage often takes too long (about {:.0} ms a frame) and is switched off for {:.0} s",
            expected.milliseconds(),
            rest.seconds()
        );
    }

    /// Whether the stage is at a frame nobody waits for any more, for too long.
    pub(super) fn look(&self, ledger: &Ledger, now: Timestamp, limit: Span) {
        let mut care = self.care();
        let Some(busy) = care.busy else { return };
        let too_long = now - busy.since >= limit && ledger.is_beyond(busy.frame);
        if too_long && !self.hanging.swap(true, Ordering::AcqRel) {
            care.hangs += 1;
            tracing::error!(
                stage = self.name,
                frame = busy.frame.0,
                "the stage has not returned for {:.0} ms and is passed by until it does; the picture goes on without it",
                (now - busy.since).milliseconds()
            );
        }
    }

    /// Frames that went around the stage.
    pub(super) fn passed_by(&self) -> u64 {
        self.passed_off.load(Ordering::Relaxed) + self.passed_unfit.load(Ordering::Relaxed)
    }

    /// Add what is known here to what the stage's thread has counted.
    pub(super) fn complete(&self, outcome: &mut StageOutcome) {
        let care = self.care();
        outcome.name = self.name;
        outcome.switched_off += self.passed_off.load(Ordering::Relaxed);
        outcome.skipped += self.passed_unfit.load(Ordering::Relaxed);
        (outcome.hangs, outcome.rests) = (care.hangs, care.rests);
    }

    /// How long a frame is expected to take; zero when nothing is known.
    pub(super) fn expected(&self) -> Span {
        self.govern(|governor| governor.expected()).unwrap_or_default()
    }

    pub(super) fn condition(&self, now: Timestamp, switched_off: bool) -> Condition {
        if self.broken.load(Ordering::Acquire) {
            Condition::Broken
        } else if self.is_hanging() {
            Condition::Hanging
        } else if switched_off {
            Condition::SwitchedOff
        } else if self.govern(|governor| governor.rests(now)).unwrap_or(false) {
            Condition::Resting
        } else {
            Condition::Working
        }
    }

    /// True when a frame may go around the stage without overtaking one in it that is still awaited.
    fn may_be_passed_by(&self, now: Timestamp, switched_off: bool) -> bool {
        match self.condition(now, switched_off) {
            Condition::Working => false,
            Condition::Hanging => true,
            Condition::SwitchedOff | Condition::Resting | Condition::Broken => self.inside.load(Ordering::Acquire) == 0,
        }
    }
}

/// The queue before a stage.
#[derive(Clone)]
pub(super) struct StageDoor {
    pub(super) seat: Arc<Seat>,
    pub(super) sender: Sender<Frame>,
    /// In the line, for its switch.
    pub(super) position: usize,
}

/// Where a frame goes from some place in the line: into the first stage behind that takes it, or out.
#[derive(Clone)]
pub(super) struct Way {
    /// Nearest first.
    pub(super) stages: Vec<StageDoor>,
    pub(super) end: Arc<Gate>,
    pub(super) controls: Arc<Controls>,
    pub(super) clock: Arc<dyn Clock>,
}

impl Way {
    /// Send a frame on. A stage that is off, and one that hangs, costs it nothing.
    pub(super) fn push(&self, frame: Frame) -> Result<(), Closed> {
        let mut frame = frame;
        for StageDoor { seat, sender, position } in &self.stages {
            let now = self.clock.now();
            let switched_off = self.controls.is_bypassed(*position);
            if !seat.may_be_passed_by(now, switched_off) {
                seat.inside.fetch_add(1, Ordering::AcqRel);
                match sender.push_unless(frame, || seat.is_hanging()) {
                    Ok(()) => return Ok(()),
                    Err(Refused::Closed) => return Err(Closed),
                    Err(Refused::GivenUp(back)) => frame = back,
                }
                seat.inside.fetch_sub(1, Ordering::AcqRel);
            }
            let count = if switched_off { &seat.passed_off } else { &seat.passed_unfit };
            count.fetch_add(1, Ordering::Relaxed);
            frame.timings.push(StageTiming {
                stage: seat.name,
                entered: now,
                left: now,
                bypassed: true,
            });
        }
        self.end.pass(frame)
    }
}
