//! Whether a stage may work on a live frame: not when it would be late, and not for a while when it was late too often.

use crate::pipeline::live::Limits;
use crate::time::{Span, Timestamp};

/// So many of its last frames are looked at …
const FRAMES_LOOKED_AT: u32 = 32;
/// … and so many of them may overrun before the stage is switched off.
const MOST_OVERRUNS: u32 = 8;
/// What a frame that takes longer than expected moves the expectation.
const RISE: f64 = 0.5;
/// What a frame that is quicker moves it: stages are slow now and then, and the slow frames are those that count.
const FALL: f64 = 0.1;
/// What is left of the expectation when a frame was passed by: tried again sooner or later.
const PATIENCE: f64 = 0.95;
/// A stage that stayed in time for so many rests has its rests shortened to the first again.
const FORGIVEN_AFTER_RESTS: i64 = 3;

/// What a stage is to do with a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ruling {
    /// Treat it.
    Work,
    /// Let it pass: it is late already.
    Late,
    /// Let it pass: treating it would make it late.
    TooLong,
    /// Let it pass: the stage is switched off for a while.
    Resting,
}

/// Watches one stage's time.
#[derive(Clone, Debug)]
pub struct Governor {
    limits: Limits,
    expected: Span,
    /// A bit for each of the last frames, the newest the lowest: it overran.
    overruns: u32,
    rest: Span,
    rests_until: Option<Timestamp>,
    returned: Option<Timestamp>,
}

impl Governor {
    /// Nothing is known of the stage yet.
    pub fn new(limits: &Limits) -> Self {
        Self {
            limits: *limits,
            expected: Span(0),
            overruns: 0,
            rest: limits.rest,
            rests_until: None,
            returned: None,
        }
    }

    /// When a frame that arrived then is to be done.
    pub fn due(&self, arrived_at: Timestamp) -> Timestamp {
        arrived_at + self.limits.budget
    }

    /// How long the stage is expected to take.
    pub fn expected(&self) -> Span {
        self.expected
    }

    /// True while the stage is switched off.
    pub fn rests(&self, now: Timestamp) -> bool {
        self.rests_until.is_some_and(|until| now < until)
    }

    /// What to do at `now` with a frame that is to be done at `due`.
    pub fn rule(&mut self, now: Timestamp, due: Timestamp) -> Ruling {
        if let Some(until) = self.rests_until {
            if now < until {
                return Ruling::Resting;
            }
            self.rests_until = None;
            self.returned = Some(now);
            self.overruns = 0;
            // Whether it is as slow as it was is to be found out.
            self.expected = Span(0);
        }
        if now >= due {
            Ruling::Late
        } else if now + self.expected > due {
            self.expected = Span((self.expected.0 as f64 * PATIENCE) as i64);
            Ruling::TooLong
        } else {
            Ruling::Work
        }
    }

    /// The stage took so long for a frame.
    pub fn took(&mut self, span: Span) {
        let surprise = span.0 - self.expected.0;
        let share = if surprise > 0 { RISE } else { FALL };
        self.expected = Span((self.expected.0 as f64 + share * surprise as f64) as i64);
    }

    /// A frame was in time.
    pub fn praise(&mut self, now: Timestamp) {
        self.overruns <<= 1;
        let forgiven = Span(self.rest.0.saturating_mul(FORGIVEN_AFTER_RESTS));
        if self.returned.is_some_and(|at| now - at > forgiven) {
            self.rest = self.limits.rest;
            self.returned = None;
        }
    }

    /// A frame was late, or would have been, by this stage's doing: `Some(for how long)` when it is switched off now.
    pub fn blame(&mut self, now: Timestamp) -> Option<Span> {
        self.overruns = self.overruns << 1 | 1;
        let many = (self.overruns & (u32::MAX >> (32 - FRAMES_LOOKED_AT))).count_ones() >= MOST_OVERRUNS;
        (many && !self.rests(now)).then(|| self.send_to_rest(now))
    }

    /// Switch it off for a while, longer each time.
    pub fn send_to_rest(&mut self, now: Timestamp) -> Span {
        let rest = self.rest;
        self.rests_until = Some(now + rest);
        self.rest = Span(rest.0.saturating_mul(2)).min(self.limits.longest_rest);
        rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: f64) -> Timestamp {
        Timestamp(0) + Span::from_milliseconds(ms)
    }

    fn ms(ms: f64) -> Span {
        Span::from_milliseconds(ms)
    }

    #[test]
    fn what_would_be_late_is_passed_by_and_tried_again() {
        let mut governor = Governor::new(&Limits::default());
        let due = governor.due(at(0.0));
        assert_eq!(due, at(30.0));
        assert_eq!(governor.rule(at(1.0), due), Ruling::Work);
        governor.took(ms(24.0));
        governor.took(ms(24.0));
        assert!((17.0..24.0).contains(&governor.expected().milliseconds()));
        assert_eq!(governor.rule(at(5.0), due), Ruling::Work);
        assert_eq!(governor.rule(at(13.0), due), Ruling::TooLong);
        assert_eq!(governor.rule(at(30.0), due), Ruling::Late);
        // The same frame again and again: the expectation wanes until it is tried.
        let tried = (0..40).position(|_| governor.rule(at(20.0), due) == Ruling::Work);
        assert!(tried.is_some_and(|n| n > 2), "{tried:?}");
    }

    #[test]
    fn one_that_overruns_often_rests_and_comes_back_and_rests_longer() {
        let mut governor = Governor::new(&Limits::default());
        for frame in 0..3 * FRAMES_LOOKED_AT {
            if frame % 8 == 0 {
                assert_eq!(governor.blame(at(0.0)), None, "an overrun now and then is lived with");
            } else {
                governor.praise(at(0.0));
            }
        }
        let begun = (0..20).find_map(|_| governor.blame(at(1000.0)));
        assert_eq!(begun, Some(ms(3000.0)));
        assert_eq!(governor.rule(at(3999.0), at(5000.0)), Ruling::Resting);
        assert!(governor.rests(at(3999.0)));
        governor.took(ms(500.0));
        assert_eq!(
            governor.rule(at(4000.0), at(4030.0)),
            Ruling::Work,
            "back, and tried whatever it took before"
        );
        let again = (0..20).find_map(|_| governor.blame(at(4100.0)));
        assert_eq!(again, Some(ms(6000.0)));
        // After long good conduct the first rest is the next.
        assert_eq!(governor.rule(at(20_000.0), at(20_030.0)), Ruling::Work);
        for frame in 0..2000 {
            governor.praise(at(20_000.0 + 33.0 * f64::from(frame)));
        }
        assert_eq!((0..20).find_map(|_| governor.blame(at(90_000.0))), Some(ms(3000.0)));
    }
}
