//! What came out of a line: counted by its end, read by everybody.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::frame::FrameId;
use crate::pipeline::timing::{Durations, RecentDurations, Summary};
use crate::time::Span;

/// What came out of the line, and how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Passed {
    /// Frames handed to the sinks, all in all.
    pub out: u64,
    /// Of these, handed out as they came because they were overdue.
    pub rescued: u64,
    /// Frames that never came out because a later one was quicker.
    pub overtaken: u64,
    /// Frames that came to the end after their untouched picture had been handed out.
    pub late: u64,
}

#[derive(Default)]
struct Tally {
    passed: Passed,
    end_to_end: Durations,
    recent: RecentDurations,
}

/// The books of a line's end.
#[derive(Default)]
pub(super) struct Ledger {
    tally: Mutex<Tally>,
    /// One more than the number of the last frame that came out of a live line; 0 before the first.
    beyond: AtomicU64,
}

impl Ledger {
    fn tally(&self) -> MutexGuard<'_, Tally> {
        self.tally.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Change the counts.
    pub(super) fn count(&self, change: impl FnOnce(&mut Passed)) {
        change(&mut self.tally().passed);
    }

    /// From arrival to the line's end a frame took so long.
    pub(super) fn record(&self, span: Span) {
        let mut tally = self.tally();
        tally.end_to_end.record(span);
        tally.recent.record(span);
    }

    /// An awaited frame of a live line comes out.
    pub(super) fn set_out(&self, frame: FrameId) {
        self.beyond.store(frame.0 + 1, Ordering::Release);
    }

    /// True when nobody waits for this frame of a live line any more.
    pub(super) fn is_beyond(&self, frame: FrameId) -> bool {
        frame.0 < self.beyond.load(Ordering::Acquire)
    }

    /// What came out so far.
    pub(super) fn passed(&self) -> Passed {
        self.tally().passed
    }

    /// From arrival to the line's end, over all frames.
    pub(super) fn end_to_end(&self) -> Durations {
        self.tally().end_to_end.clone()
    }

    /// From arrival to the line's end, over the last frames.
    pub(super) fn recent(&self) -> Summary {
        self.tally().recent.summary()
    }
}
