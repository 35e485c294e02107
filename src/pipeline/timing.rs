//! Where frames spent their time: distributions of durations, and their percentiles.

use hdrhistogram::Histogram;

use crate::time::Span;

/// Durations finer than this are not told apart.
const FINEST_NS: u64 = 1_000;
/// Longer durations count as this long.
const LONGEST_NS: u64 = 1_000_000_000_000;

/// Many durations, to three significant digits, in constant memory.
#[derive(Clone, Debug)]
pub struct Durations {
    histogram: Histogram<u64>,
}

impl Default for Durations {
    fn default() -> Self {
        Self::new()
    }
}

impl Durations {
    /// None yet. All the memory it will ever need is taken here.
    #[expect(clippy::expect_used, reason = "the bounds are constants and a test makes one")]
    pub fn new() -> Self {
        Self {
            histogram: Histogram::new_with_bounds(FINEST_NS, LONGEST_NS, 3).expect("1 <= low, 2 low <= high, digits <= 5"),
        }
    }

    /// Count one more. A negative duration (a clock that stepped back) counts as zero.
    pub fn record(&mut self, span: Span) {
        self.histogram.saturating_record(u64::try_from(span.0).unwrap_or(0));
    }

    /// How many were counted.
    pub fn count(&self) -> u64 {
        self.histogram.len()
    }

    /// The duration that `share` (0–1) of all do not exceed, ms; 0 when there are none.
    pub fn quantile_ms(&self, share: f64) -> f64 {
        if self.histogram.is_empty() {
            0.0
        } else {
            ms_from_ns(self.histogram.value_at_quantile(share))
        }
    }

    /// Count, percentiles and maximum.
    pub fn summary(&self) -> Summary {
        Summary {
            count: self.count(),
            p50_ms: self.quantile_ms(0.5),
            p95_ms: self.quantile_ms(0.95),
            p99_ms: self.quantile_ms(0.99),
            p999_ms: self.quantile_ms(0.999),
            max_ms: ms_from_ns(self.histogram.max()),
        }
    }
}

/// The last few durations: how it goes right now.
#[derive(Clone, Debug)]
pub struct RecentDurations {
    ring: [i64; Self::CAPACITY],
    count: usize,
    next: usize,
}

impl Default for RecentDurations {
    fn default() -> Self {
        Self {
            ring: [0; Self::CAPACITY],
            count: 0,
            next: 0,
        }
    }
}

impl RecentDurations {
    /// Eight seconds at 30 frames a second.
    const CAPACITY: usize = 256;

    /// Count one more; the oldest is forgotten.
    pub fn record(&mut self, span: Span) {
        if let Some(slot) = self.ring.get_mut(self.next) {
            *slot = span.0.max(0);
        }
        self.next = (self.next + 1) % Self::CAPACITY;
        self.count = (self.count + 1).min(Self::CAPACITY);
    }

    /// Count, percentiles and maximum.
    pub fn summary(&self) -> Summary {
        let mut sorted: Vec<i64> = self.ring.iter().take(self.count).copied().collect();
        sorted.sort_unstable();
        // The smallest that so many do not exceed, as the histogram has it.
        let at = |share: f64| {
            let rank = (share * sorted.len() as f64).ceil().max(1.0) as usize;
            let ns = sorted.get(rank - 1).or(sorted.last()).copied().unwrap_or(0);
            ms_from_ns(ns.unsigned_abs())
        };
        Summary {
            count: self.count as u64,
            p50_ms: at(0.5),
            p95_ms: at(0.95),
            p99_ms: at(0.99),
            p999_ms: at(0.999),
            max_ms: at(1.0),
        }
    }
}

/// To a microsecond: the histogram knows no finer.
fn ms_from_ns(ns: u64) -> f64 {
    (ns as f64 * 1e-3).round() * 1e-3
}

/// A distribution of durations in six figures.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Summary {
    /// How many.
    pub count: u64,
    /// Half of them do not exceed this, ms.
    pub p50_ms: f64,
    /// 95 % of them do not exceed this, ms.
    pub p95_ms: f64,
    /// 99 % of them do not exceed this, ms.
    pub p99_ms: f64,
    /// 99.9 % of them do not exceed this, ms.
    pub p999_ms: f64,
    /// The longest, ms.
    pub max_ms: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_known_durations() {
        let mut durations = Durations::new();
        for milliseconds in 1..=100 {
            durations.record(Span::from_milliseconds(f64::from(milliseconds)));
        }
        let summary = durations.summary();
        // Three significant digits: within 0.1 %.
        for (found, expected) in [
            (summary.p50_ms, 50.0),
            (summary.p95_ms, 95.0),
            (summary.p99_ms, 99.0),
            (summary.max_ms, 100.0),
        ] {
            assert!((found - expected).abs() <= 1e-3 * expected, "{summary:?}");
        }
        assert_eq!(summary.count, 100);
    }

    #[test]
    fn the_recent_forget_the_past() {
        let mut recent = RecentDurations::default();
        assert_eq!(recent.summary(), Summary::default());
        (0..1000).for_each(|_| recent.record(Span::from_milliseconds(500.0)));
        (1..=256).for_each(|n| recent.record(Span::from_milliseconds(f64::from(n))));
        let summary = recent.summary();
        assert_eq!(
            (summary.count, summary.p50_ms, summary.p99_ms, summary.max_ms),
            (256, 128.0, 254.0, 256.0)
        );
    }

    #[test]
    fn none_is_all_zero_and_a_step_back_counts_as_zero() {
        assert_eq!(Durations::new().summary(), Summary::default());
        let mut durations = Durations::new();
        durations.record(Span(-5));
        // The histogram's finest bin holds zero: no finer can be told.
        assert_eq!(durations.count(), 1);
        assert!(durations.quantile_ms(1.0) <= ms_from_ns(FINEST_NS));
    }
}
