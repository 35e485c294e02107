//! What another thread makes for a stage that runs, and from which frame on it holds.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::frame::FrameId;

/// Hands values over from whoever makes them to the stage that takes them, each from its frame on.
///
/// Stages work on different frames at the same time: what is made at a late stage's frame must not reach an earlier frame that is still
/// under way, or two runs would differ.
pub struct Slot<T>(Arc<Mutex<VecDeque<(FrameId, T)>>>);

impl<T> Slot<T> {
    /// An empty one.
    pub fn new() -> Self {
        Self(Arc::default())
    }

    /// Held for a push or a pop only, never while anything is made.
    fn waiting(&self) -> MutexGuard<'_, VecDeque<(FrameId, T)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lay a value in that holds from frame `from` on. It takes the place of those that wait and would hold from there or later.
    pub fn put(&self, from: FrameId, value: T) {
        let mut waiting = self.waiting();
        let earlier = waiting.partition_point(|(other, _)| *other < from);
        // Values may be large: they are freed after the lock.
        let replaced = waiting.split_off(earlier);
        waiting.push_back((from, value));
        drop(waiting);
        drop(replaced);
    }

    /// The newest value that holds for `frame`, if one has come since the last time.
    pub fn take(&self, frame: FrameId) -> Option<T> {
        let mut waiting = self.waiting();
        let due = waiting.partition_point(|(from, _)| *from <= frame);
        let later = waiting.split_off(due);
        let mut due = std::mem::replace(&mut *waiting, later);
        drop(waiting);
        due.pop_back().map(|(_, value)| value)
    }
}

impl<T> Default for Slot<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T> Clone for Slot<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> fmt::Debug for Slot<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Slot").field("waiting", &self.waiting().len()).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_newest_is_there_and_only_once() {
        let slot = Slot::new();
        let other = slot.clone();
        let any = FrameId(0);
        assert_eq!(slot.take(any), None);
        slot.put(any, 1);
        slot.put(any, 2);
        assert_eq!(other.take(any), Some(2));
        assert_eq!(other.take(any), None);
    }

    #[test]
    fn a_frame_that_was_under_way_does_not_get_what_holds_from_a_later_one() {
        let slot = Slot::new();
        slot.put(FrameId(5), "first");
        slot.put(FrameId(9), "second");
        assert_eq!(slot.take(FrameId(4)), None);
        assert_eq!(slot.take(FrameId(7)), Some("first"));
        assert_eq!(slot.take(FrameId(8)), None);
        assert_eq!(slot.take(FrameId(12)), Some("second"));
    }

    #[test]
    fn what_holds_at_once_comes_before_what_was_to_hold_later() {
        let slot = Slot::new();
        slot.put(FrameId(9), "later");
        slot.put(FrameId(0), "at once");
        assert_eq!(slot.take(FrameId(3)), Some("at once"));
        assert_eq!(slot.take(FrameId(20)), None);
    }
}
