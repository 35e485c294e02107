//! A recorded video as the source of the line: as fast as it goes, nothing dropped.

use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, FrameId};
use crate::image::buffer::{Mask, Rgb8};
use crate::image::pool::Pool;
use crate::media::reader::{VideoInfo, VideoReader};
use crate::pipeline::stage::{Source, SourceError};
use crate::time::{Clock, Span, Timestamp};

/// What part of a recording is played, and how.
#[derive(Clone, Debug, Default)]
pub struct Playback {
    /// Exposure time of each frame (`frames.csv`); without it the container's time stamps count.
    pub exposure_times: Option<Vec<Timestamp>>,
    /// Begin with the first frame stamped so or later (container's time).
    pub start: Option<Timestamp>,
    /// End before the first frame stamped so or later (container's time).
    pub end: Option<Timestamp>,
    /// Explains the pixels, where known.
    pub camera: Option<Arc<CameraModel>>,
    /// 255 inside the endoscope's image field, where one was found.
    pub field_of_view: Option<Arc<Mask>>,
}

/// Plays a recording into the line.
pub struct RecordingSource {
    reader: VideoReader,
    playback: Playback,
    clock: Arc<dyn Clock>,
    pool: Pool<Rgb8>,
    previous: Option<Timestamp>,
    ended: bool,
}

impl std::fmt::Debug for RecordingSource {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("RecordingSource")
            .field("reader", &self.reader)
            .finish_non_exhaustive()
    }
}

impl RecordingSource {
    /// A source that takes its pictures from `pool` and the time of arrival from `clock`.
    pub fn new(
        mut reader: VideoReader,
        playback: Playback,
        clock: Arc<dyn Clock>,
        pool: Pool<Rgb8>,
    ) -> Result<Self, SourceError> {
        if let Some(times) = &playback.exposure_times {
            check_exposure_times(times, reader.info().frame_count)?;
        }
        if let Some(start) = playback.start {
            reader.seek(start).map_err(|error| SourceError(error.to_string()))?;
        }
        Ok(Self {
            reader,
            playback,
            clock,
            pool,
            previous: None,
            ended: false,
        })
    }

    /// What is known of the video.
    pub fn info(&self) -> &VideoInfo {
        self.reader.info()
    }

    fn exposure_of(&mut self, number: u64, stamped: Timestamp) -> Result<Timestamp, SourceError> {
        let Some(times) = &self.playback.exposure_times else {
            return Ok(stamped);
        };
        if let Some(time) = usize::try_from(number).ok().and_then(|n| times.get(n)) {
            return Ok(*time);
        }
        self.ended = true;
        Err(SourceError(format!(
            "frames.csv: expected a line for each frame of the video, found {} lines and a frame {number}; \
             add the missing lines, or remove the file to go by the container's time stamps",
            times.len()
        )))
    }
}

fn check_exposure_times(times: &[Timestamp], frames: Option<u64>) -> Result<(), SourceError> {
    if let Some(at) = times.windows(2).position(|pair| matches!(pair, [a, b] if b <= a)) {
        return Err(SourceError(format!(
            "frames.csv: expected exposure times that increase, found frame {} no later than frame {at}; sort or correct the file",
            at + 1
        )));
    }
    if let Some(frames) = frames.filter(|&frames| frames != times.len() as u64) {
        tracing::warn!(
            "frames.csv lists {} frames, the video says it has {frames}; they are matched by number",
            times.len()
        );
    }
    Ok(())
}

impl Source for RecordingSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        if self.ended {
            return Ok(None);
        }
        let decoded = self.reader.next_frame(&self.pool).map_err(|error| {
            self.ended = true;
            SourceError(error.to_string())
        })?;
        let Some(decoded) = decoded.filter(|frame| self.playback.end.is_none_or(|end| frame.timestamp < end)) else {
            self.ended = true;
            return Ok(None);
        };
        let exposed_at = self.exposure_of(decoded.number, decoded.timestamp)?;
        let mut frame = Frame::new(FrameId(decoded.number), exposed_at, self.clock.now(), decoded.image);
        frame.presented_at = decoded.timestamp;
        frame.since_previous = self.previous.map_or(Span(0), |previous| exposed_at - previous);
        frame.camera.clone_from(&self.playback.camera);
        frame.field_of_view.clone_from(&self.playback.field_of_view);
        self.previous = Some(exposed_at);
        Ok(Some(frame))
    }
}
