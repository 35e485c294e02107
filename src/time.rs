//! Time: one monotonic nanosecond count for pictures, poses and stages.
//!
//! House rule: only this file reads a clock. Everything else gets its time in the frame or from a [`Clock`] it was handed,
//! so that a test can turn the clock by hand.

use std::ops::{Add, Sub};
use std::sync::atomic::{AtomicI64, Ordering};

/// An instant on the recording's (or the host's monotonic) clock, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Timestamp(pub i64);

impl Timestamp {
    /// From seconds; saturates at the ends of the range.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// In seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// In milliseconds.
    pub fn milliseconds(self) -> f64 {
        self.0 as f64 * 1e-6
    }
}

/// A difference of two instants, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Span(pub i64);

impl Span {
    /// From seconds.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// From milliseconds.
    pub fn from_milliseconds(milliseconds: f64) -> Self {
        Self((milliseconds * 1e6).round() as i64)
    }

    /// In seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// In milliseconds.
    pub fn milliseconds(self) -> f64 {
        self.0 as f64 * 1e-6
    }
}

impl Sub for Timestamp {
    type Output = Span;
    fn sub(self, other: Self) -> Span {
        Span(self.0.saturating_sub(other.0))
    }
}

impl Add<Span> for Timestamp {
    type Output = Self;
    fn add(self, span: Span) -> Self {
        Self(self.0.saturating_add(span.0))
    }
}

impl Sub<Span> for Timestamp {
    type Output = Self;
    fn sub(self, span: Span) -> Self {
        Self(self.0.saturating_sub(span.0))
    }
}

/// Who tells the time.
pub trait Clock: Send + Sync {
    /// The present instant.
    fn now(&self) -> Timestamp;
}

/// The host's `CLOCK_MONOTONIC`, which V4L2 drivers stamp their buffers with.
#[derive(Clone, Copy, Debug, Default)]
pub struct MonotonicClock;

impl Clock for MonotonicClock {
    fn now(&self) -> Timestamp {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        Timestamp(time.tv_sec * 1_000_000_000 + time.tv_nsec)
    }
}

/// Processor time that all threads of this process have used so far.
pub fn process_time() -> Timestamp {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Timestamp(time.tv_sec * 1_000_000_000 + time.tv_nsec)
}

/// A clock that a test turns by hand.
#[derive(Debug, Default)]
pub struct ManualClock(AtomicI64);

impl ManualClock {
    /// Move on by `span`.
    pub fn advance(&self, span: Span) {
        self.0.fetch_add(span.0, Ordering::SeqCst);
    }
}

impl Clock for ManualClock {
    fn now(&self) -> Timestamp {
        Timestamp(self.0.load(Ordering::SeqCst))
    }
}
