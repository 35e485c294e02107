//! A bounded queue that says what happens when it is full, and counts what it drops.
//!
//! It is crossbeam's bounded channel. For [`Overflow::DropOldest`] the sending end also holds a receiving end, with which it takes
//! the oldest waiting item out to make room; `try_send` alone would drop the *newest*, which is the one a live picture needs.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use std::time::Duration;

use crossbeam::channel::{self, SendTimeoutError, TrySendError};

/// What happens when a queue is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overflow {
    /// The sender waits: nothing is lost (replay).
    Block,
    /// The longest waiting item is dropped and counted: nothing waits (live).
    DropOldest,
}

/// How a queue is made: its length and what happens when it is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Queue {
    /// So many items wait at most.
    pub capacity: usize,
    /// What happens when so many wait.
    pub overflow: Overflow,
}

impl Queue {
    /// The sender waits when `capacity` items wait.
    pub fn blocking(capacity: usize) -> Self {
        Self {
            capacity,
            overflow: Overflow::Block,
        }
    }

    /// The oldest of `capacity` items gives way.
    pub fn drop_oldest(capacity: usize) -> Self {
        Self {
            capacity,
            overflow: Overflow::DropOldest,
        }
    }

    /// Only the newest item is worth having: a display.
    pub fn newest_only() -> Self {
        Self::drop_oldest(1)
    }

    /// Both ends of a new queue. A capacity of 0 counts as 1.
    pub fn open<T>(self) -> (Sender<T>, Receiver<T>) {
        let (sender, receiver) = channel::bounded(self.capacity.max(1));
        let shared = Arc::new(Shared::default());
        let oldest = match self.overflow {
            Overflow::Block => None,
            Overflow::DropOldest => Some(receiver.clone()),
        };
        (
            Sender {
                channel: sender,
                oldest,
                shared: Arc::clone(&shared),
            },
            Receiver {
                channel: receiver,
                shared,
            },
        )
    }
}

#[derive(Debug, Default)]
struct Shared {
    dropped: AtomicU64,
    /// The sender's own receiving end keeps the channel connected, so the real receiver's end must be told apart.
    receiver_gone: AtomicBool,
}

/// How many items a queue has dropped; readable while the queue is in use and after.
#[derive(Clone, Debug)]
pub struct DropCount(Arc<Shared>);

impl DropCount {
    /// Items dropped so far.
    pub fn get(&self) -> u64 {
        self.0.dropped.load(Ordering::Relaxed)
    }
}

/// Nobody takes from this queue any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Closed;

/// How often a sender that waits asks whether it still shall.
const ASK_EVERY: Duration = Duration::from_millis(1);

/// Why an item was not taken; it comes back.
#[derive(Debug)]
pub enum Refused<T> {
    /// Nobody takes from this queue any more.
    Closed,
    /// The sender no longer wanted to wait.
    GivenUp(T),
}

/// The end where items go in.
#[derive(Debug)]
pub struct Sender<T> {
    channel: channel::Sender<T>,
    oldest: Option<channel::Receiver<T>>,
    shared: Arc<Shared>,
}

impl<T> Clone for Sender<T> {
    fn clone(&self) -> Self {
        Self {
            channel: self.channel.clone(),
            oldest: self.oldest.clone(),
            shared: Arc::clone(&self.shared),
        }
    }
}

impl<T> Sender<T> {
    /// Put an item in; while the queue is full and would block, ask every millisecond whether to give up.
    pub fn push_unless(&self, item: T, given_up: impl Fn() -> bool) -> Result<(), Refused<T>> {
        if self.oldest.is_some() {
            return self.push(item).map_err(|Closed| Refused::Closed);
        }
        let mut item = item;
        loop {
            item = match self.channel.send_timeout(item, ASK_EVERY) {
                Ok(()) => return Ok(()),
                Err(SendTimeoutError::Disconnected(_)) => return Err(Refused::Closed),
                Err(SendTimeoutError::Timeout(item)) if given_up() => return Err(Refused::GivenUp(item)),
                Err(SendTimeoutError::Timeout(item)) => item,
            };
        }
    }

    /// Put an item in; waits or drops the oldest when the queue is full.
    pub fn push(&self, item: T) -> Result<(), Closed> {
        let Some(oldest) = &self.oldest else {
            return self.channel.send(item).map_err(|_| Closed);
        };
        let mut item = item;
        loop {
            if self.shared.receiver_gone.load(Ordering::Acquire) {
                return Err(Closed);
            }
            match self.channel.try_send(item) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Disconnected(_)) => return Err(Closed),
                Err(TrySendError::Full(back)) => item = back,
            }
            // The receiver may have been quicker; then there is room without a loss.
            if oldest.try_recv().is_ok() {
                self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Reads what this queue drops.
    pub fn drop_count(&self) -> DropCount {
        DropCount(Arc::clone(&self.shared))
    }
}

/// The end where items come out.
#[derive(Debug)]
pub struct Receiver<T> {
    channel: channel::Receiver<T>,
    shared: Arc<Shared>,
}

impl<T> Receiver<T> {
    /// The longest waiting item; waits for one; `None` once the sender is gone and the queue is empty.
    pub fn pop(&self) -> Option<T> {
        self.channel.recv().ok()
    }

    /// The longest waiting item, if any waits.
    pub fn try_pop(&self) -> Option<T> {
        self.channel.try_recv().ok()
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        self.shared.receiver_gone.store(true, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_drops_its_oldest_and_counts() {
        let (sender, receiver) = Queue::drop_oldest(2).open();
        for item in 0..5 {
            sender.push(item).unwrap();
        }
        assert_eq!(sender.drop_count().get(), 3);
        drop(sender);
        assert_eq!((receiver.pop(), receiver.pop(), receiver.pop()), (Some(3), Some(4), None));
    }

    #[test]
    fn newest_only_keeps_the_newest() {
        let (sender, receiver) = Queue::newest_only().open();
        (0..10).for_each(|item| sender.push(item).unwrap());
        assert_eq!(receiver.pop(), Some(9));
    }

    #[test]
    fn a_closed_queue_says_so_in_both_kinds() {
        for queue in [Queue::blocking(1), Queue::drop_oldest(1)] {
            let (sender, receiver) = queue.open();
            drop(receiver);
            assert_eq!(sender.push(1), Err(Closed));
        }
    }

    #[test]
    fn a_sender_that_waits_may_give_up() {
        let (sender, receiver) = Queue::blocking(1).open();
        sender.push_unless(1, || true).unwrap();
        assert!(matches!(sender.push_unless(2, || true), Err(Refused::GivenUp(2))));
        assert_eq!(receiver.try_pop(), Some(1));
        drop(receiver);
        assert!(matches!(sender.push_unless(3, || false), Err(Refused::Closed)));
    }

    #[test]
    fn a_blocking_queue_loses_nothing() {
        let (sender, receiver) = Queue::blocking(3).open();
        std::thread::scope(|scope| {
            scope.spawn(move || (0..1000).for_each(|item| sender.push(item).unwrap()));
            let got: Vec<i32> = std::iter::from_fn(|| receiver.pop()).collect();
            assert_eq!(got, (0..1000).collect::<Vec<_>>());
        });
    }
}
