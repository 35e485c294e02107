//! The end of a line that nobody looks at: measures when frames were handed out, and how evenly.

use std::sync::{Arc, Mutex, PoisonError};

use crate::frame::Frame;
use crate::pipeline::stage::{Sink, SinkError};
use crate::pipeline::timing::Durations;
use crate::time::{Clock, Span, Timestamp};

/// One frame as it came out.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Shown {
    /// Its number at the source.
    pub frame: u64,
    /// When it arrived, on the host's clock, s.
    pub arrived_s: f64,
    /// From its arrival until it was here, ms.
    pub latency_ms: f64,
    /// True when the line was late and it came as it was.
    pub untouched: bool,
    /// Stages that it passed by.
    pub passed_by: u32,
}

/// Where frames spent their time at one stage.
#[derive(Clone, Debug)]
pub struct StageTimes {
    /// The stage's name.
    pub name: &'static str,
    /// In it, per frame that it treated.
    pub working: Durations,
    /// Between the stage before and this one.
    pub waiting: Durations,
}

impl StageTimes {
    /// None yet.
    pub fn new(name: &'static str) -> Self {
        Self {
            name,
            working: Durations::new(),
            waiting: Durations::new(),
        }
    }
}

/// What a meter has measured.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    /// From arrival until here.
    pub latency: Durations,
    /// From frame to frame.
    pub interval: Durations,
    /// How far from the frames' own distance in time that was.
    pub jitter: Durations,
    /// By stage, as they were met.
    pub stages: Vec<StageTimes>,
    /// Of each frame, as far as they are kept.
    pub shown: Vec<Shown>,
    /// Frames seen.
    pub frames: u64,
}

/// Reads what a [`MeterSink`] measures.
#[derive(Clone, Debug, Default)]
pub struct MeterReading(Arc<Mutex<Measured>>);

impl MeterReading {
    /// Everything so far.
    pub fn get(&self) -> Measured {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Forget what was measured: the warm-up is over.
    pub fn begin_anew(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Measured::default();
    }

    /// Frames seen.
    pub fn frames(&self) -> u64 {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).frames
    }
}

/// Measures, and lets frames go.
pub struct MeterSink {
    clock: Arc<dyn Clock>,
    keep: usize,
    reading: MeterReading,
    previous: Option<(Timestamp, Timestamp)>,
}

impl std::fmt::Debug for MeterSink {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("MeterSink").field("keep", &self.keep).finish_non_exhaustive()
    }
}

impl MeterSink {
    /// Keeps single figures of the first `keep` frames.
    pub fn new(clock: Arc<dyn Clock>, keep: usize) -> Self {
        Self {
            clock,
            keep,
            reading: MeterReading::default(),
            previous: None,
        }
    }

    /// Reads what is measured.
    pub fn reading(&self) -> MeterReading {
        self.reading.clone()
    }
}

impl Sink for MeterSink {
    fn name(&self) -> &'static str {
        "display"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let now = self.clock.now();
        let latency = now - frame.arrived_at;
        let mut measured = self.reading.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut sent = frame.arrived_at;
        for timing in &frame.timings {
            let place = measured.stages.iter().position(|stage| stage.name == timing.stage);
            let place = place.unwrap_or_else(|| {
                measured.stages.push(StageTimes::new(timing.stage));
                measured.stages.len() - 1
            });
            if let Some(stage) = measured.stages.get_mut(place) {
                stage.waiting.record(timing.entered - sent);
                if !timing.bypassed {
                    stage.working.record(timing.left - timing.entered);
                }
            }
            sent = timing.left;
        }
        measured.frames += 1;
        measured.latency.record(latency);
        if let Some((shown_at, exposed_at)) = self.previous {
            let interval = now - shown_at;
            measured.interval.record(interval);
            let expected = frame.exposed_at - exposed_at;
            measured.jitter.record(Span((interval.0 - expected.0).abs()));
        }
        self.previous = Some((now, frame.exposed_at));
        if measured.shown.len() < self.keep {
            let passed_by = frame.timings.iter().filter(|timing| timing.bypassed).count();
            measured.shown.push(Shown {
                frame: frame.id.0,
                arrived_s: frame.arrived_at.seconds(),
                latency_ms: latency.milliseconds(),
                untouched: frame.untouched,
                passed_by: u32::try_from(passed_by).unwrap_or(u32::MAX),
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::time::ManualClock;

    #[test]
    fn latency_intervals_and_jitter_are_those_of_the_clock() {
        let clock = Arc::new(ManualClock::default());
        let mut meter = MeterSink::new(Arc::clone(&clock) as Arc<dyn Clock>, 2);
        let reading = meter.reading();
        // Frames 40 ms apart come out 12 ms after their arrival, the third 10 ms late.
        for (number, late_ms) in [(0, 0.0), (1, 0.0), (2, 10.0)] {
            let arrived = Timestamp(0) + Span::from_milliseconds(40.0 * f64::from(number));
            let mut frame = Frame::new(FrameId(number as u64), arrived, arrived, Pool::new(1).take(2, 2));
            frame.untouched = number == 1;
            let now = arrived + Span::from_milliseconds(12.0 + late_ms);
            clock.advance(now - clock.now());
            meter.consume(&Arc::new(frame)).unwrap();
        }
        let measured = reading.get();
        assert_eq!((measured.frames, measured.shown.len()), (3, 2));
        assert!(measured.shown[1].untouched && (measured.shown[1].latency_ms - 12.0).abs() < 1e-9);
        assert!((measured.latency.summary().max_ms - 22.0).abs() < 0.05);
        assert!((measured.interval.summary().max_ms - 50.0).abs() < 0.05);
        assert!((measured.jitter.summary().max_ms - 10.0).abs() < 0.02);
        reading.begin_anew();
        assert_eq!(reading.frames(), 0);
    }
}
