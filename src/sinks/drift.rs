//! Watches whether picture and arm still agree in time, beside the line: it takes the newest picture when it has time for one.

use std::sync::{Arc, Mutex, PoisonError};

use crate::calibration::time_offset::drift::{DriftWatch, Verdict};
use crate::calibration::time_offset::image_motion::MotionTracker;
use crate::calibration::time_offset::offset::TimedMotion;
use crate::frame::Frame;
use crate::pipeline::stage::{Sink, SinkError};
use crate::robot::feed::reader::SharedPoses;
use crate::time::{Span, Timestamp};

/// Pictures closer than this are left out: motion between them tells little, and looking takes time.
const LEAST_STEP: Span = Span(75_000_000);
/// Between pictures farther apart nothing is followed.
const LONGEST_STEP: Span = Span(400_000_000);

/// Reads what a [`DriftSink`] found last.
#[derive(Clone, Debug, Default)]
pub struct DriftReading(Arc<Mutex<Option<Verdict>>>);

impl DriftReading {
    /// The last verdict; `None` before the first.
    pub fn get(&self) -> Option<Verdict> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Follows the picture and asks the arm.
#[derive(Debug)]
pub struct DriftSink {
    tracker: MotionTracker,
    watch: DriftWatch,
    poses: SharedPoses,
    previous: Option<Timestamp>,
    reading: DriftReading,
}

impl DriftSink {
    /// Watch whether `believed` still holds.
    pub fn new(poses: SharedPoses, believed: Span) -> Self {
        Self {
            tracker: MotionTracker::default(),
            watch: DriftWatch::new(believed),
            poses,
            previous: None,
            reading: DriftReading::default(),
        }
    }

    /// Reads what was found.
    pub fn reading(&self) -> DriftReading {
        self.reading.clone()
    }

    fn tell(&self, verdict: Verdict) {
        let mut last = self.reading.0.lock().unwrap_or_else(PoisonError::into_inner);
        let drifted = |verdict: Option<Verdict>| matches!(verdict, Some(Verdict::Drifted { .. }));
        let was_drifted = drifted(*last);
        match verdict {
            Verdict::Drifted { offset, sigma_ms } if !was_drifted => tracing::warn!(
                "picture and arm disagree in time: now {:.0} ± {sigma_ms:.0} ms must be added to a pose's stamp; \
                 measure again with `endofield calibrate time-offset`",
                offset.milliseconds()
            ),
            Verdict::Agree if was_drifted => tracing::info!("picture and arm agree in time again"),
            _ => {}
        }
        // Without motion nothing new is known.
        if verdict != Verdict::Silent || last.is_none() {
            *last = Some(verdict);
        }
    }
}

impl Sink for DriftSink {
    fn name(&self) -> &'static str {
        "drift"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let at = frame.exposed_at;
        if frame.scene_cut
            || self
                .previous
                .is_some_and(|previous| at - previous > LONGEST_STEP || at <= previous)
        {
            self.tracker.reset();
            self.previous = None;
        }
        if self.previous.is_some_and(|previous| at - previous < LEAST_STEP) {
            return Ok(());
        }
        let moved = self.tracker.next(&frame.image);
        let previous = self.previous.replace(at);
        if let (Some(motion), Some(from)) = (moved, previous) {
            // A copy: whoever asks for a pose must not wait while this thinks.
            let arm = self.poses.lock().clone();
            if let Some(verdict) = self.watch.push(TimedMotion { from, to: at, motion }, &arm) {
                self.tell(verdict);
            }
        }
        Ok(())
    }
}
