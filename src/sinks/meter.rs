//! The end of a line that nobody looks at: measures when frames were handed out, and how evenly.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::frame::{Frame, provenance_code};
use crate::image::buffer::Mask;
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

/// How many of the specular pixels the light field covered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Coverage {
    /// Frames that were looked at.
    pub frames: u64,
    /// Pixels that were filled with what other views saw.
    pub filled: u64,
    /// Specular pixels that were left as they came.
    pub left: u64,
}

impl Coverage {
    /// Of the specular pixels, the share that was filled; `None` when there were none.
    pub fn share(&self) -> Option<f64> {
        let all = self.filled + self.left;
        (all > 0).then(|| self.filled as f64 / all as f64)
    }

    fn look(&mut self, codes: &Mask) {
        self.frames += 1;
        for code in codes.pixels() {
            match *code {
                provenance_code::LIGHT_FIELD | provenance_code::RECENT => self.filled += 1,
                provenance_code::LEFT => self.left += 1,
                _ => {}
            }
        }
    }
}

/// Every so many frames are looked at for their coverage.
const COVERAGE_EVERY: u64 = 4;
/// So many of those looked at are summed up.
const COVERAGE_OVER: usize = 16;

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
    /// Of the last few seconds.
    pub coverage: Coverage,
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

    /// The specular pixels of the last frames.
    pub fn coverage(&self) -> Coverage {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).coverage
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
    frames: u64,
    reading: MeterReading,
    previous: Option<(Timestamp, Timestamp)>,
    covered: VecDeque<Coverage>,
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
            frames: 0,
            reading: MeterReading::default(),
            previous: None,
            covered: VecDeque::with_capacity(COVERAGE_OVER),
        }
    }

    /// The specular pixels of the last frames that were looked at.
    fn coverage_with(&mut self, frame: &Frame) -> Coverage {
        let mut one = Coverage::default();
        if let Some(provenance) = &frame.provenance {
            one.look(&provenance.code);
        }
        if self.covered.len() == COVERAGE_OVER {
            self.covered.pop_front();
        }
        self.covered.push_back(one);
        self.covered.iter().fold(Coverage::default(), |sum, one| Coverage {
            frames: sum.frames + one.frames,
            filled: sum.filled + one.filled,
            left: sum.left + one.left,
        })
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
        self.frames += 1;
        let coverage = (self.frames % COVERAGE_EVERY == 1).then(|| self.coverage_with(frame));
        let mut measured = self.reading.0.lock().unwrap_or_else(PoisonError::into_inner);
        measured.coverage = coverage.unwrap_or(measured.coverage);
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
