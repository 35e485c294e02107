//! Everything a feed has counted, and how it goes right now.

use serde::Serialize;

use crate::robot::feed::clock::ClockEstimate;
use crate::robot::feed::driver::DriverCounts;
use crate::robot::feed::message::Sample;
use crate::time::{Span, Timestamp};

/// Counted since the feed began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FeedStatistics {
    /// Bytes that came.
    pub bytes: u64,
    /// Bytes that belong to no message.
    pub bytes_skipped: u64,
    /// Whole messages.
    pub intact: u64,
    /// What looked like a message and had the wrong check.
    pub bad_check: u64,
    /// Whole messages of an unknown version or type.
    pub unknown: u64,
    /// Messages not as their format says.
    pub malformed: u64,
    /// Messages missing from the sequence.
    pub lost: u64,
    /// Messages heard before; not delivered again.
    pub repeated: u64,
    /// Times the arm counted, or its clock ran, anew.
    pub restarts: u64,
    /// Poses delivered.
    pub poses: u64,
    /// Refused: a number that is none, or no rotation.
    pub refused_number: u64,
    /// Refused: a joint where it cannot be, or not as many joints as the arm has.
    pub refused_joints: u64,
    /// Refused: the arm itself says that it cannot be trusted.
    pub refused_fault: u64,
    /// Delivered, but too late for the pose buffer: not later than the one before.
    pub out_of_order: u64,
    /// Messages with a fault bit set.
    pub with_faults: u64,
    /// Samples that a listener was too slow for.
    pub overrun: u64,
    /// Times the line was opened.
    pub opened: u64,
    /// Times it broke.
    pub hang_ups: u64,
    /// Times it fell silent.
    pub silences: u64,
}

impl FeedStatistics {
    /// Take over what the driver counts.
    pub fn set_driver_counts(&mut self, counts: &DriverCounts) {
        self.bytes = counts.bytes;
        self.bytes_skipped = counts.bytes_skipped;
        self.intact = counts.intact;
        self.bad_check = counts.bad_check;
        self.unknown = counts.unknown;
        self.malformed = counts.malformed;
    }
}

/// How the line is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// The port cannot be opened; why.
    Absent(String),
    /// Open, and nothing has come yet or for a while.
    Silent,
    /// Bytes come, but for a while no message was among them.
    Garbled,
    /// Messages come.
    Speaking,
    /// The file or pipe is at its end.
    Ended,
}

impl LinkState {
    /// One word.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Absent(_) => "absent",
            Self::Silent => "silent",
            Self::Garbled => "garbled",
            Self::Speaking => "speaking",
            Self::Ended => "ended",
        }
    }
}

/// How much later than at best messages came, over the last ones.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Delays {
    /// Median.
    pub p50: Span,
    /// 99th percentile.
    pub p99: Span,
    /// Largest.
    pub max: Span,
}

/// A feed at an instant.
#[derive(Clone, Debug)]
pub struct FeedStatus {
    /// The line.
    pub link: LinkState,
    /// Since when it is so.
    pub since: Timestamp,
    /// Poses a second over the last ones; 0 when none came for a while.
    pub rate_hz: f64,
    /// How much later than at best they came.
    pub delays: Delays,
    /// Of the last message.
    pub status: u8,
    /// Of the last message.
    pub faults: u16,
    /// The last sample.
    pub last: Option<Sample>,
    /// Why the last refused message was refused.
    pub refusal: Option<String>,
    /// The device's clock.
    pub clock: Option<ClockEstimate>,
    /// All counts.
    pub statistics: FeedStatistics,
}

/// The last messages' arrivals and delays.
#[derive(Clone, Debug)]
pub struct RecentMessages {
    /// Arrival and delay; a ring.
    ring: [(Timestamp, Span); Self::CAPACITY],
    count: usize,
    next: usize,
}

impl Default for RecentMessages {
    fn default() -> Self {
        Self {
            ring: [(Timestamp(0), Span(0)); Self::CAPACITY],
            count: 0,
            next: 0,
        }
    }
}

impl RecentMessages {
    const CAPACITY: usize = 256;
    /// Rate and delays speak of this long.
    const WINDOW: Span = Span(2_000_000_000);

    /// One more.
    pub fn push(&mut self, arrival: Timestamp, delay: Span) {
        if let Some(slot) = self.ring.get_mut(self.next) {
            *slot = (arrival, delay);
        }
        self.next = (self.next + 1) % Self::CAPACITY;
        self.count = (self.count + 1).min(Self::CAPACITY);
    }

    /// Messages a second, and their delays, as of `now`.
    pub fn summary(&self, now: Timestamp) -> (f64, Delays) {
        let recent = self.ring.iter().take(self.count).filter(|(at, _)| now - *at <= Self::WINDOW);
        let mut delays: Vec<Span> = recent.clone().map(|(_, delay)| *delay).collect();
        let Some(first) = recent.map(|(at, _)| *at).min() else {
            return (0.0, Delays::default());
        };
        delays.sort_unstable();
        let at = |share: f64| delays.get(((delays.len() - 1) as f64 * share).round() as usize);
        let percentile = |share: f64| at(share).copied().unwrap_or_default();
        // So many began after the first: a silence shows at once.
        let seconds = (now - first).seconds();
        let rate_hz = if delays.len() > 1 {
            (delays.len() - 1) as f64 / seconds.max(1e-3)
        } else {
            0.0
        };
        let delays = Delays {
            p50: percentile(0.5),
            p99: percentile(0.99),
            max: percentile(1.0),
        };
        (rate_hz, delays)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_and_delays_of_the_last_two_seconds() {
        let mut recent = RecentMessages::default();
        assert_eq!(recent.summary(Timestamp(0)).0, 0.0);
        let at = |i: i64| Timestamp(i * 10_000_000);
        for i in 0..1000 {
            recent.push(at(i), Span(if i % 100 == 0 { 9_000_000 } else { i % 10 }));
        }
        let (rate, delays) = recent.summary(at(999));
        assert!((rate - 100.0).abs() < 1.0, "{rate}");
        assert_eq!(delays.max, Span(9_000_000));
        assert!(delays.p50 <= Span(9));
        assert_eq!(recent.summary(at(1999)).0, 0.0);
    }
}
