//! What came in, as a recording that `process` can play: pictures, exposure times, poses, and what is known of the camera.
//!
//! Everything on disk is whole at any moment: the video is Matroska in clusters of a second, and every line of text is written when
//! it is known. When the disk is full or fails, the part that stands is closed, frames are counted as lost, and after a while a new
//! part is begun in a folder of its own beside the first (`DIR.2`, `DIR.3`, …). The line never waits for any of this: the recorder
//! has a queue that drops, and a thread of its own.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use crossbeam::channel::Receiver;

use crate::frame::Frame;
use crate::media::writer::{Content, Output, VideoWriter, WriterSettings};
use crate::pipeline::stage::{Sink, SinkError};
use crate::robot::feed::message::Sample;
use crate::robot::trajectory::{stamp_text, tum_head, tum_line};
use crate::time::{Span, Timestamp};

/// After a failure a new part is tried this often.
const RETRY: Span = Span(5_000_000_000);
/// Samples of the arm taken over at once.
const MOST_SAMPLES: usize = 10_000;

/// What a recorder has done.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Recorded {
    /// Frames written.
    pub frames: u64,
    /// Frames that could not be written.
    pub lost: u64,
    /// Poses written.
    pub poses: u64,
    /// Folders begun.
    pub parts: u32,
    /// The last failure.
    pub failure: Option<String>,
}

/// Reads what a [`RecorderSink`] does.
#[derive(Clone, Debug, Default)]
pub struct RecorderReading(Arc<Mutex<Recorded>>);

impl RecorderReading {
    /// Everything so far.
    pub fn get(&self) -> Recorded {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn change(&self, change: impl FnOnce(&mut Recorded)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// What is recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Track {
    /// What came in: `video.mkv`, its times in `frames.csv`, the arm's poses.
    Raw,
    /// What went out: `enhanced.mkv`, its times in `enhanced.csv`.
    Enhanced,
}

impl Track {
    /// Its recorder's name in the line.
    pub fn sink_name(self) -> &'static str {
        match self {
            Self::Raw => "recorder",
            Self::Enhanced => "enhanced recorder",
        }
    }

    fn files(self) -> [&'static str; 2] {
        match self {
            Self::Raw => ["video.mkv", "frames.csv"],
            Self::Enhanced => ["enhanced.mkv", "enhanced.csv"],
        }
    }
}

/// Where and how to record.
#[derive(Clone, Debug)]
pub struct RecorderSettings {
    /// What.
    pub track: Track,
    /// [`Content::Color`] or [`Content::Lossless`].
    pub content: Content,
    /// The folder of the first part.
    pub folder: PathBuf,
    /// Frames a second, for the container.
    pub frame_rate_hz: f64,
    /// Files to lay beside the pictures: camera.yaml and the like.
    pub beside: Vec<PathBuf>,
}

/// One folder that is being written.
#[derive(Debug)]
struct Part {
    video: VideoWriter,
    frames: File,
    times_name: &'static str,
    poses: Option<File>,
    folder: PathBuf,
    size: (usize, usize),
    written: u64,
}

/// Writes what it is given; meant for a tap, which sees pictures untouched.
#[derive(Debug)]
pub struct RecorderSink {
    settings: RecorderSettings,
    arm: Option<Receiver<Sample>>,
    part: Option<Part>,
    parts: u32,
    retry_at: Option<Timestamp>,
    reading: RecorderReading,
}

impl RecorderSink {
    /// The folder is made at once, so that one that cannot be made is told of before the line begins.
    pub fn new(settings: RecorderSettings, arm: Option<Receiver<Sample>>) -> Result<Self, SinkError> {
        fs::create_dir_all(&settings.folder)
            .map_err(|error| SinkError(format!("cannot make {}: {error}", settings.folder.display())))?;
        Ok(Self {
            settings,
            arm,
            part: None,
            parts: 0,
            retry_at: None,
            reading: RecorderReading::default(),
        })
    }

    /// Reads what is done.
    pub fn reading(&self) -> RecorderReading {
        self.reading.clone()
    }

    /// Begin the next part, for pictures like this frame's.
    fn begin(&mut self, frame: &Frame) -> Result<Part, String> {
        self.parts += 1;
        let mut folder = self.settings.folder.clone();
        if self.parts > 1 {
            let mut name = folder.file_name().unwrap_or_default().to_owned();
            name.push(format!(".{}", self.parts));
            folder.set_file_name(name);
        }
        let said = |path: &Path, error: &std::io::Error| format!("cannot write {}: {error}", path.display());
        fs::create_dir_all(&folder).map_err(|error| said(&folder, &error))?;
        for file in &self.settings.beside {
            let Some(name) = file.file_name() else { continue };
            let to = folder.join(name);
            fs::copy(file, &to).map_err(|error| said(&to, &error))?;
        }
        let (width, height) = frame.image.size();
        let rate = ((self.settings.frame_rate_hz * 1e3).round().max(1.0) as i32, 1000);
        let mut writing = WriterSettings::new(width, height, rate);
        writing.origin = frame.exposed_at;
        writing.content = self.settings.content;
        let [video_name, times_name] = self.settings.track.files();
        let path = folder.join(video_name);
        let video = VideoWriter::create(&Output::File(path), &writing, true).map_err(|error| error.to_string())?;
        let make = |name: &str| {
            let path = folder.join(name);
            File::create(&path).map_err(|error| said(&path, &error))
        };
        let mut frames = make(times_name)?;
        frames
            .write_all(b"frame,timestamp_s\n")
            .map_err(|error| said(&folder.join(times_name), &error))?;
        let poses = match &self.arm {
            Some(_) => {
                let mut file = make("poses.tum")?;
                file.write_all(tum_head("T_base_hand").as_bytes())
                    .map_err(|error| said(&folder.join("poses.tum"), &error))?;
                Some(file)
            }
            None => None,
        };
        self.reading.change(|recorded| recorded.parts += 1);
        Ok(Part {
            video,
            frames,
            times_name,
            poses,
            folder,
            size: (width, height),
            written: 0,
        })
    }

    fn record(&mut self, frame: &Frame) -> Result<(), String> {
        if self.part.as_ref().is_some_and(|part| part.size != frame.image.size()) {
            self.close();
        }
        let mut part = match self.part.take() {
            Some(part) => part,
            None => self.begin(frame)?,
        };
        let done = part.write(frame);
        let poses = part.write_poses(self.arm.as_ref());
        // A part that failed is closed as well as it can be; what stands in it stays playable.
        if done.is_ok() && poses.is_ok() {
            self.part = Some(part);
        } else {
            let _whole = part.video.finish();
        }
        done?;
        let count = poses?;
        self.reading.change(|recorded| {
            recorded.frames += 1;
            recorded.poses += count;
        });
        Ok(())
    }

    fn close(&mut self) {
        let Some(mut part) = self.part.take() else { return };
        let count = part.write_poses(self.arm.as_ref());
        let ended = part.video.finish();
        let failure = count.as_ref().err().cloned().or(ended.err().map(|error| error.to_string()));
        self.reading.change(|recorded| {
            recorded.poses += count.unwrap_or(0);
            recorded.failure = failure.or(recorded.failure.take());
        });
    }
}

impl Part {
    fn write(&mut self, frame: &Frame) -> Result<(), String> {
        self.video
            .write(&frame.image, frame.exposed_at)
            .map_err(|error| error.to_string())?;
        let line = format!("{},{}\n", self.written, stamp_text(frame.exposed_at));
        self.frames
            .write_all(line.as_bytes())
            .map_err(|error| format!("cannot write {}: {error}", self.folder.join(self.times_name).display()))?;
        self.written += 1;
        Ok(())
    }

    fn write_poses(&mut self, arm: Option<&Receiver<Sample>>) -> Result<u64, String> {
        let (Some(file), Some(arm)) = (&mut self.poses, arm) else {
            return Ok(0);
        };
        let mut text = String::new();
        let mut count = 0;
        for sample in arm.try_iter().take(MOST_SAMPLES) {
            text += &tum_line(sample.pose.stamp, sample.pose.base_from_hand.isometry());
            count += 1;
        }
        file.write_all(text.as_bytes())
            .map_err(|error| format!("cannot write {}: {error}", self.folder.join("poses.tum").display()))?;
        Ok(count)
    }
}

impl Sink for RecorderSink {
    fn name(&self) -> &'static str {
        self.settings.track.sink_name()
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        if self.retry_at.is_some_and(|at| frame.exposed_at < at) {
            self.reading.change(|recorded| recorded.lost += 1);
            return Ok(());
        }
        let was_failing = self.retry_at.take().is_some();
        match self.record(frame) {
            Ok(()) if was_failing => tracing::info!("{}: records again, as part {}", self.name(), self.parts),
            Ok(()) => {}
            Err(reason) => {
                if !was_failing {
                    tracing::error!("{}: {reason}; frames are lost until it can be written again", self.name());
                }
                self.retry_at = Some(frame.exposed_at + RETRY);
                self.reading.change(|recorded| {
                    recorded.lost += 1;
                    recorded.failure = Some(reason);
                });
            }
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        self.close();
        let recorded = self.reading.get();
        match recorded.failure {
            Some(failure) => Err(SinkError(format!("the recording lacks {} frames: {failure}", recorded.lost))),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::media::reader::{Input, VideoReader};
    use crate::recording::folder::Recording;

    fn frame(number: u64, width: usize) -> Arc<Frame> {
        let at = Timestamp(1_000_000_000_000 + number as i64 * 40_000_000);
        let mut image = Pool::new(1).take(width, 48);
        image.fill([10 + 8 * (number % 30) as u8; 3]);
        Arc::new(Frame::new(FrameId(number), at, at, image))
    }

    fn settings(folder: &Path) -> RecorderSettings {
        RecorderSettings {
            track: Track::Raw,
            content: Content::Color,
            folder: folder.to_owned(),
            frame_rate_hz: 25.0,
            beside: Vec::new(),
        }
    }

    #[test]
    fn what_is_recorded_is_a_recording_at_any_moment() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rec");
        let mut sink = RecorderSink::new(settings(&path), None).unwrap();
        for number in 0..30 {
            sink.consume(&frame(number, 64)).unwrap();
        }
        // Before its end: the times of all frames are there.
        let times = fs::read_to_string(path.join("frames.csv")).unwrap();
        assert_eq!(times.lines().count(), 31);
        sink.finish().unwrap();
        let recording = Recording::open(&path).unwrap();
        let times = recording.frame_times.unwrap();
        assert_eq!((times.len(), times[3]), (30, frame(3, 64).exposed_at));
        let mut reader = VideoReader::open(&Input::from_argument(recording.video.path())).unwrap();
        let pool = Pool::new(1);
        for number in 0..30_u64 {
            let picture = reader.next_frame(&pool).unwrap().unwrap();
            assert_eq!(picture.timestamp, Timestamp(number as i64 * 40_000_000));
            assert!(picture.image.at(5, 5)[1].abs_diff(10 + 8 * number as u8) <= 2);
        }
        assert!(reader.next_frame(&pool).unwrap().is_none());
    }

    /// Every pixel another.
    fn noise(number: u64, (width, height): (usize, usize)) -> Arc<Frame> {
        let at = Timestamp(7_000_000_000 + number as i64 * 33_366_700);
        let mut image = Pool::new(1).take(width, height);
        let mut state = 0x9e37_79b9_u32.wrapping_mul(number as u32 + 1);
        for byte in image.as_bytes_mut() {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *byte = (state >> 24) as u8;
        }
        Arc::new(Frame::new(FrameId(number), at, at, image))
    }

    #[test]
    fn both_tracks_lie_beside_each_other_and_a_lossless_one_comes_back_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        // Odd sizes have no 4:2:0.
        for size in [(64, 48), (63, 47)] {
            let path = folder.path().join(format!("rec{}", size.0));
            for (track, content) in [(Track::Raw, Content::Lossless), (Track::Enhanced, Content::Color)] {
                let settings = RecorderSettings {
                    track,
                    content,
                    ..settings(&path)
                };
                let mut sink = RecorderSink::new(settings, None).unwrap();
                (0..12).for_each(|number| sink.consume(&noise(number, size)).unwrap());
                sink.finish().unwrap();
            }
            assert!(path.join("enhanced.mkv").is_file() && path.join("enhanced.csv").is_file());
            let recording = Recording::open(&path).unwrap();
            let times = recording.frame_times.unwrap();
            let mut reader = VideoReader::open(&Input::from_argument(recording.video.path())).unwrap();
            let pool = Pool::new(1);
            for number in 0..12 {
                let (was, is) = (noise(number, size), reader.next_frame(&pool).unwrap().unwrap());
                assert_eq!(times[number as usize], was.exposed_at);
                assert!(was.image.as_bytes() == is.image.as_bytes(), "frame {number} of {size:?}");
            }
            assert!(reader.next_frame(&pool).unwrap().is_none());
        }
    }

    #[test]
    fn another_size_and_a_failing_disk_begin_a_new_part_and_the_gap_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rec");
        let mut sink = RecorderSink::new(settings(&path), None).unwrap();
        let reading = sink.reading();
        sink.consume(&frame(0, 64)).unwrap();
        // Where the second part should be a file lies.
        fs::write(folder.path().join("rec.2"), "in the way").unwrap();
        sink.consume(&frame(1, 32)).unwrap();
        sink.consume(&frame(2, 32)).unwrap();
        assert_eq!((reading.get().frames, reading.get().lost), (1, 2));
        // Five seconds later it is tried again.
        sink.consume(&frame(127, 32)).unwrap();
        let recorded = reading.get();
        assert_eq!((recorded.frames, recorded.lost, recorded.parts), (2, 2, 2));
        let told = sink.finish().unwrap_err().to_string();
        assert!(told.contains("lacks 2 frames") && told.contains("rec.2"), "{told}");
        for (name, width) in [("rec", 64), ("rec.3", 32)] {
            let recording = Recording::open(&folder.path().join(name)).unwrap();
            let mut reader = VideoReader::open(&Input::from_argument(recording.video.path())).unwrap();
            assert_eq!(reader.next_frame(&Pool::new(1)).unwrap().unwrap().image.width(), width);
        }
    }
}
