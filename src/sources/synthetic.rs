//! Pictures from memory at a camera's pace: for whoever has no camera, and for measuring the line.
//!
//! What is exposed when follows the host's clock, so that everything live about the line is real but the pictures.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, FrameId};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::pool::Pool;
use crate::pipeline::stage::{Source, SourceError};
use crate::time::{Clock, Span, Timestamp};

/// A wait looks this often whether to stop.
const NAP: Span = Span(20_000_000);

/// Pictures that are shown one after the other, again and again.
#[derive(Clone, Debug)]
pub struct Clip {
    /// In their order.
    pub pictures: Arc<Vec<Image<Rgb8>>>,
    /// When each was exposed, on the clip's own clock; increasing, one a picture.
    pub times: Vec<Timestamp>,
    /// Explains the pixels, where known.
    pub camera: Option<Arc<CameraModel>>,
    /// 255 inside the endoscope's image field.
    pub field_of_view: Option<Arc<Mask>>,
}

impl Clip {
    /// From picture to picture, on average.
    pub fn period(&self) -> Span {
        match (self.times.first(), self.times.last(), self.times.len()) {
            (Some(first), Some(last), count) if count > 1 => Span((*last - *first).0 / (count as i64 - 1)),
            _ => Span(40_000_000),
        }
    }

    /// From its first picture to the first one's next turn.
    pub fn length(&self) -> Span {
        match (self.times.first(), self.times.last()) {
            (Some(first), Some(last)) => Span((*last - *first).0 + self.period().0),
            _ => Span(0),
        }
    }

    /// The same pictures at another rate.
    #[must_use]
    pub fn at_rate(mut self, frame_rate_hz: f64) -> Self {
        let first = self.times.first().copied().unwrap_or_default();
        for (number, time) in self.times.iter_mut().enumerate() {
            *time = first + Span::from_seconds(number as f64 / frame_rate_hz);
        }
        self
    }

    /// Which picture frame `number` shows, and how long after the first frame it is exposed.
    fn shown(&self, number: u64) -> Option<(usize, Span)> {
        let count = self.pictures.len().min(self.times.len()) as u64;
        if count == 0 {
            return None;
        }
        let (round, place) = (number / count, (number % count) as usize);
        let within = *self.times.get(place)? - *self.times.first()?;
        let rounds = i64::try_from(round).ok()?.checked_mul(self.length().0)?;
        Some((place, Span(rounds.checked_add(within.0)?)))
    }
}

/// How quickly pictures follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// As the clip's times say.
    Own,
    /// As fast as they are taken.
    Unbound,
}

/// Plays a clip at its own pace until it is stopped.
pub struct SyntheticSource {
    clip: Clip,
    clock: Arc<dyn Clock>,
    pool: Pool<Rgb8>,
    stop: Arc<AtomicBool>,
    began: Timestamp,
    pace: Pace,
    next: u64,
    last: u64,
    previous: Option<Timestamp>,
}

impl std::fmt::Debug for SyntheticSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SyntheticSource")
            .field("next", &self.next)
            .finish_non_exhaustive()
    }
}

impl SyntheticSource {
    /// The first picture is due at `began`, on the host's clock; after `count` frames it ends.
    pub fn new(
        clip: Clip,
        began: Timestamp,
        count: Option<u64>,
        clock: Arc<dyn Clock>,
        pool: Pool<Rgb8>,
        stop: Arc<AtomicBool>,
    ) -> Self {
        Self {
            clip,
            clock,
            pool,
            stop,
            began,
            pace: Pace::Own,
            next: 0,
            last: count.unwrap_or(u64::MAX),
            previous: None,
        }
    }

    /// At another pace; what is exposed when stays as the clip says.
    #[must_use]
    pub fn at_pace(mut self, pace: Pace) -> Self {
        self.pace = pace;
        self
    }

    /// Wait until `due`; false when it is to stop.
    fn wait_until(&self, due: Timestamp) -> bool {
        loop {
            if self.stop.load(Ordering::Acquire) {
                return false;
            }
            let left = due - self.clock.now();
            if left <= Span(0) || self.pace == Pace::Unbound {
                return true;
            }
            let nanoseconds = u64::try_from(left.min(NAP).0).unwrap_or(0);
            std::thread::sleep(Duration::from_nanos(nanoseconds));
        }
    }
}

impl Source for SyntheticSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        if self.next >= self.last {
            return Ok(None);
        }
        let Some((place, after)) = self.clip.shown(self.next) else {
            return Ok(None);
        };
        let exposed_at = self.began + after;
        if !self.wait_until(exposed_at) {
            return Ok(None);
        }
        let arrived_at = self.clock.now();
        let Some(picture) = self.clip.pictures.get(place) else {
            return Ok(None);
        };
        let mut frame = Frame::new(FrameId(self.next), exposed_at, arrived_at, self.pool.take_copy(picture));
        frame.since_previous = self.previous.map_or(Span(0), |previous| exposed_at - previous);
        frame.camera.clone_from(&self.clip.camera);
        frame.field_of_view.clone_from(&self.clip.field_of_view);
        frame.scene_cut = place == 0 && self.next > 0;
        self.previous = Some(exposed_at);
        self.next += 1;
        Ok(Some(frame))
    }

    fn stamps_arrivals(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::ManualClock;

    fn clip(count: u8) -> Clip {
        Clip {
            pictures: Arc::new((0..count).map(|level| Image::filled(4, 2, [level; 3])).collect()),
            times: (0..i64::from(count)).map(|n| Timestamp(5_000 + n * 40_000_000)).collect(),
            camera: None,
            field_of_view: None,
        }
    }

    #[test]
    fn pictures_come_in_turn_and_time_goes_on() {
        let clock = Arc::new(ManualClock::default());
        clock.advance(Span::from_seconds(10.0));
        let (pool, stop) = (Pool::new(4), Arc::new(AtomicBool::new(false)));
        // All of them are due already, so nothing waits.
        let began = Timestamp::from_seconds(1.0);
        let mut source = SyntheticSource::new(clip(3), began, Some(7), clock, pool, Arc::clone(&stop));
        let frames: Vec<Frame> = std::iter::from_fn(|| source.next_frame().unwrap()).collect();
        let levels: Vec<u8> = frames.iter().map(|frame| frame.image.at(0, 0)[0]).collect();
        assert_eq!(levels, [0, 1, 2, 0, 1, 2, 0]);
        for (number, frame) in frames.iter().enumerate() {
            assert_eq!(frame.exposed_at, began + Span(40_000_000 * number as i64));
            assert_eq!((frame.id.0, frame.scene_cut), (number as u64, number == 3 || number == 6));
        }
        assert!(frames[1..].iter().all(|frame| frame.since_previous == Span(40_000_000)));
        let mut source = SyntheticSource::new(clip(3), began, None, Arc::new(ManualClock::default()), Pool::new(1), stop);
        source.stop.store(true, Ordering::Release);
        assert!(
            source.next_frame().unwrap().is_none(),
            "what is not due yet is not waited for when it is to stop"
        );
    }

    #[test]
    fn another_rate_stretches_time() {
        let faster = clip(4).at_rate(100.0);
        assert_eq!((faster.period(), faster.length()), (Span(10_000_000), Span(40_000_000)));
        assert_eq!(faster.times[3] - faster.times[0], Span(30_000_000));
        let empty = Clip {
            times: Vec::new(),
            ..clip(2)
        };
        assert!(empty.shown(0).is_none());
    }
}
