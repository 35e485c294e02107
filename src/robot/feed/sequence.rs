//! What sequence numbers tell: messages lost, repeated, or an arm that started anew.

use std::collections::VecDeque;

/// Repetitions are recognized this far back.
const REMEMBERED: usize = 64;

/// What a message's number says about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// The first one heard.
    First,
    /// It follows the last one after so many that are missing.
    Next {
        /// Never heard of.
        lost: u32,
    },
    /// Heard before.
    Repeated,
    /// The arm counts anew.
    Restarted,
}

/// Follows the numbers; they wrap at 2³².
#[derive(Clone, Debug, Default)]
pub struct SequenceWatch {
    /// Number and fingerprint, newest last.
    recent: VecDeque<(u32, u32)>,
}

impl SequenceWatch {
    /// Judge a message by its number and fingerprint.
    pub fn judge(&mut self, sequence: u32, fingerprint: u32) -> Order {
        let order = match self.recent.back() {
            None => Order::First,
            // A repetition is the same message; an arm that starts anew repeats numbers, not messages.
            Some(_) if self.recent.contains(&(sequence, fingerprint)) => return Order::Repeated,
            Some((last, _)) => match sequence.wrapping_sub(*last) {
                step @ 1..=0x7FFF_FFFF => Order::Next { lost: step - 1 },
                _ => Order::Restarted,
            },
        };
        if order == Order::Restarted {
            self.recent.clear();
        }
        if self.recent.len() == REMEMBERED {
            self.recent.pop_front();
        }
        self.recent.push_back((sequence, fingerprint));
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_repetitions_wraps_and_restarts() {
        let mut watch = SequenceWatch::default();
        let mut judge = |sequence: u32, fingerprint: u32| watch.judge(sequence, fingerprint);
        assert_eq!(judge(u32::MAX - 1, 1), Order::First);
        assert_eq!(judge(u32::MAX, 2), Order::Next { lost: 0 });
        assert_eq!(judge(2, 3), Order::Next { lost: 2 });
        assert_eq!(judge(2, 3), Order::Repeated);
        assert_eq!(judge(u32::MAX, 2), Order::Repeated);
        assert_eq!(judge(3, 4), Order::Next { lost: 0 });
        assert_eq!(judge(0, 5), Order::Restarted);
        assert_eq!(judge(1, 6), Order::Next { lost: 0 });
    }

    #[test]
    fn memory_is_bounded() {
        let mut watch = SequenceWatch::default();
        for sequence in 0..1000 {
            watch.judge(sequence, sequence);
        }
        assert_eq!(watch.recent.len(), REMEMBERED);
    }
}
