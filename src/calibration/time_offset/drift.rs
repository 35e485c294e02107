//! Whether picture and pose still agree: the offset looked for again over the last seconds.

use std::collections::VecDeque;

use crate::calibration::time_offset::offset::{TimedMotion, glance};
use crate::robot::pose_buffer::PoseBuffer;
use crate::time::{Span, Timestamp};

/// What is looked at, s.
const KEPT_S: f64 = 15.0;
/// Less than this is too little, s: over 7 s, offsets were found that were wrong by 36 ms and said to be known to 5.
const LEAST_S: f64 = 14.0;
/// How often, s.
const EVERY_S: f64 = 2.0;
/// Looked for in ± this around the offset that is believed, ms.
const RANGE_MS: f64 = 250.0;
/// A drift smaller than this does no harm: at 20 mm/s and 100 mm it moves the picture by 6 px of 1920, ms.
const HARMFUL_MS: f64 = 20.0;
/// And a drift must stand out of its own deviation by so many times.
const SURE: f64 = 4.0;

/// What a look told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Verdict {
    /// The clocks agree within what the motion can tell.
    Agree,
    /// Picture and arm move alike, but at another offset: the one that fits now.
    Drifted {
        /// Add to a pose stamp to get the camera's clock.
        offset: Span,
        /// Standard deviation, ms.
        sigma_ms: f64,
    },
    /// There was not enough motion to tell.
    Silent,
}

/// Watches a live pair of picture and arm.
#[derive(Debug)]
pub struct DriftWatch {
    believed: Span,
    motions: VecDeque<TimedMotion>,
    looked: Option<Timestamp>,
    /// The last look found a drift; a second one makes it sure.
    suspected: bool,
}

impl DriftWatch {
    /// Watch whether `believed` still holds.
    pub fn new(believed: Span) -> Self {
        Self {
            believed,
            motions: VecDeque::new(),
            looked: None,
            suspected: false,
        }
    }

    /// One more motion of the picture; every two seconds a verdict.
    pub fn push(&mut self, motion: TimedMotion, arm: &PoseBuffer) -> Option<Verdict> {
        self.motions.push_back(motion);
        while self
            .motions
            .front()
            .is_some_and(|first| (motion.to - first.from).seconds() > KEPT_S)
        {
            self.motions.pop_front();
        }
        let seen_s = self.motions.front().map_or(0.0, |first| (motion.to - first.from).seconds());
        let looked = *self.looked.get_or_insert(motion.from);
        if (motion.to - looked).seconds() < EVERY_S {
            return None;
        }
        self.looked = Some(motion.to);
        if seen_s < LEAST_S {
            return Some(Verdict::Silent);
        }
        let found = glance(
            self.motions.make_contiguous(),
            arm,
            self.believed,
            Span::from_milliseconds(RANGE_MS),
        );
        let verdict = match found {
            Ok(found) if found.is_sure() => {
                let off_ms = (found.offset.milliseconds() - self.believed.milliseconds()).abs();
                if off_ms > HARMFUL_MS.max(SURE * found.sigma_ms) {
                    Verdict::Drifted {
                        offset: found.offset,
                        sigma_ms: found.sigma_ms,
                    }
                } else {
                    Verdict::Agree
                }
            }
            _ => Verdict::Silent,
        };
        let is_drift = matches!(verdict, Verdict::Drifted { .. });
        let was_suspected = std::mem::replace(&mut self.suspected, is_drift);
        Some(if is_drift && !was_suspected {
            Verdict::Silent
        } else {
            verdict
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::time_offset::offset::tests::wandering;

    fn verdicts(late_ms: impl Fn(f64) -> f64) -> Vec<Verdict> {
        let (motions, arm) = wandering(11, 40.0, 25.0, late_ms);
        let mut watch = DriftWatch::new(Span::from_milliseconds(-40.0));
        motions.iter().filter_map(|motion| watch.push(*motion, &arm)).collect()
    }

    #[test]
    fn clocks_that_agree_are_left_in_peace_and_a_jump_is_noticed() {
        let steady = verdicts(|_| 40.0);
        assert!(steady.len() >= 18);
        assert!(
            steady.iter().all(|verdict| !matches!(verdict, Verdict::Drifted { .. })),
            "{steady:?}"
        );
        assert!(
            steady.iter().filter(|verdict| **verdict == Verdict::Agree).count() >= 9,
            "{steady:?}"
        );
        // After 13 s the arm's stamps are 80 ms later than they were; at the end nothing older is looked at.
        let jumped = verdicts(|t| if t < 13.0 { 40.0 } else { 120.0 });
        let Some(Verdict::Drifted { offset, sigma_ms }) = jumped.last().copied() else {
            panic!("the jump went unnoticed: {jumped:?}");
        };
        assert!((offset.milliseconds() + 120.0).abs() < 4.0 * sigma_ms + 3.0, "{offset:?}");
        assert!(jumped[..6].iter().all(|verdict| !matches!(verdict, Verdict::Drifted { .. })));
    }
}
