//! How long a live picture may take: the limits of a line whose picture must not wait.
//!
//! Two limits hold for each frame, both counted from its arrival. Stages are to be done within the *budget*: one that would not be is
//! passed by for that frame. At the *deadline* the picture is shown as it came, whatever becomes of the frame in the line. Between
//! the two lies what a stage may err in its estimate of itself.

use serde::{Deserialize, Serialize};

use crate::time::Span;

/// Limits of a live line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Stages are to be done so long after the frame's arrival.
    pub budget: Span,
    /// So long after its arrival a frame that is not done is shown as it came.
    pub deadline: Span,
    /// A stage that is at one frame for so long counts as hanging and is passed by until it returns.
    pub hang: Span,
    /// A stage that overruns often is switched off for so long, and each time again for twice as long …
    pub rest: Span,
    /// … but never for longer.
    pub longest_rest: Span,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            budget: Span::from_milliseconds(30.0),
            deadline: Span::from_milliseconds(40.0),
            hang: Span::from_milliseconds(100.0),
            rest: Span::from_seconds(3.0),
            longest_rest: Span::from_seconds(60.0),
        }
    }
}

/// Limits as a user sets them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Stages are to be done so long after the frame's arrival, ms.
    pub budget_ms: f64,
    /// So long after its arrival a frame that is not done is shown as it came, ms.
    pub deadline_ms: f64,
    /// A stage that is at one frame for so long counts as hanging, ms.
    pub hang_ms: f64,
    /// A stage that overruns often is switched off for so long at first, ms.
    pub rest_ms: f64,
    /// So many finished frames may wait for the recorder.
    pub frames_before_recorder: usize,
    /// Whether what came in is recorded bit for bit.
    pub lossless_recording: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            budget_ms: 30.0,
            deadline_ms: 40.0,
            hang_ms: 100.0,
            rest_ms: 3000.0,
            frames_before_recorder: 60,
            lossless_recording: false,
        }
    }
}

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        let bounds = [
            ("live.budget_ms", self.budget_ms, 1.0, 1000.0),
            ("live.deadline_ms", self.deadline_ms, self.budget_ms, 2000.0),
            ("live.hang_ms", self.hang_ms, self.deadline_ms, 10_000.0),
            ("live.rest_ms", self.rest_ms, 100.0, 60_000.0),
            ("live.frames_before_recorder", self.frames_before_recorder as f64, 1.0, 1000.0),
        ];
        for (key, found, lowest, highest) in bounds {
            if !(lowest..=highest).contains(&found) {
                return Err(format!("{key}: expected {lowest} to {highest}, found {found}"));
            }
        }
        Ok(())
    }

    /// As the line wants them.
    pub fn limits(&self) -> Limits {
        Limits {
            budget: Span::from_milliseconds(self.budget_ms),
            deadline: Span::from_milliseconds(self.deadline_ms),
            hang: Span::from_milliseconds(self.hang_ms),
            rest: Span::from_milliseconds(self.rest_ms),
            ..Limits::default()
        }
    }
}

/// Of a frame's period, what stages may use.
const BUDGET_SHARE: f64 = 0.9;
/// Of a frame's period, after which the next picture is due anyway.
const DEADLINE_SHARE: f64 = 1.2;

impl Limits {
    /// The same, but no longer than frames that come every `period` allow.
    #[must_use]
    pub fn for_period(mut self, period: Span) -> Self {
        let share = |share: f64| Span::from_seconds(share * period.seconds());
        if period > Span(0) {
            self.budget = self.budget.min(share(BUDGET_SHARE));
            self.deadline = self.deadline.min(share(DEADLINE_SHARE)).max(self.budget);
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faster_pictures_have_tighter_limits() {
        let at_60 = Limits::default().for_period(Span::from_seconds(1.0 / 60.0));
        assert_eq!((at_60.budget.milliseconds(), at_60.deadline.milliseconds()), (15.0, 20.0));
        let slow = Limits::default().for_period(Span::from_seconds(0.2));
        assert_eq!(slow, Limits::default());
        assert_eq!(Limits::default().for_period(Span(0)), Limits::default());
        assert_eq!(Settings::default().limits(), Limits::default());
    }
}
