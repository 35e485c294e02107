//! What another thread makes for a stage that runs: the newest of it, taken without waiting.

use std::fmt;
use std::sync::Arc;

use crossbeam::queue::ArrayQueue;

/// Holds one value, handed over from whoever makes it to the stage that takes it; a newer one takes an older one's place.
pub struct Slot<T>(Arc<ArrayQueue<T>>);

impl<T> Slot<T> {
    /// An empty one.
    pub fn new() -> Self {
        Self(Arc::new(ArrayQueue::new(1)))
    }

    /// Lay a value in. What was there and was not taken is given back.
    pub fn put(&self, value: T) -> Option<T> {
        self.0.force_push(value)
    }

    /// The newest value, if one has come since the last time.
    pub fn take(&self) -> Option<T> {
        self.0.pop()
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
        f.debug_struct("Slot").field("is_full", &self.0.is_full()).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_newest_is_there_and_only_once() {
        let slot = Slot::new();
        let other = slot.clone();
        assert_eq!(slot.take(), None);
        assert_eq!(slot.put(1), None);
        assert_eq!(slot.put(2), Some(1));
        assert_eq!(other.take(), Some(2));
        assert_eq!(other.take(), None);
    }
}
