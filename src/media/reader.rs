//! A video as a run of RGB frames, wherever it lies: a file, numbered pictures, or a stream on stdin.

use std::path::{Path, PathBuf};

use crate::image::buffer::Rgb8;
use crate::image::pool::{Pool, Pooled};
use crate::media::color::ColorTags;
use crate::media::container_reader::ContainerReader;
use crate::media::error::MediaError;
use crate::media::image_files::ImageReader;
use crate::time::Timestamp;

/// Where a video is read from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Input {
    /// A video file that libav knows.
    File(PathBuf),
    /// A folder of pictures, or a pattern such as `frames/%06d.png`; in the order of their numbers.
    ImageFolder(PathBuf),
    /// A y4m stream on stdin.
    Y4mStdin,
}

impl Input {
    /// From what a user types: `-`, a folder, a pattern with `%`, or a file.
    pub fn from_argument(argument: &Path) -> Self {
        if argument == Path::new("-") {
            Self::Y4mStdin
        } else if argument.is_dir() || argument.to_string_lossy().contains('%') {
            Self::ImageFolder(argument.into())
        } else {
            Self::File(argument.into())
        }
    }
}

/// What is known of a video before all of it is read.
#[derive(Clone, Debug)]
pub struct VideoInfo {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames per second on average, as a fraction.
    pub average_frame_rate: (i32, i32),
    /// Units of the container's time stamps, s, as a fraction.
    pub time_base: (i32, i32),
    /// Number of frames: exact for pictures, as the container says or from its duration otherwise.
    pub frame_count: Option<u64>,
    /// Length, s, where known.
    pub duration_s: Option<f64>,
    /// Colour tags as read.
    pub color: ColorTags,
    /// Bits per colour sample; everything is handed on in 8.
    pub bit_depth: u32,
    /// The first frame is flagged interlaced: frames are deinterlaced.
    pub interlaced: bool,
    /// There is sound as well.
    pub has_audio: bool,
    /// Width to height of a pixel.
    pub pixel_aspect: (i32, i32),
    /// Clockwise turn that a player would apply, degrees; it is not applied here.
    pub rotation_degrees: i32,
    /// Codec by name; `images` for pictures.
    pub codec: String,
    /// The container's metadata.
    pub metadata: Vec<(String, String)>,
}

impl VideoInfo {
    /// Frames per second on average.
    pub fn frames_per_second(&self) -> f64 {
        f64::from(self.average_frame_rate.0) / f64::from(self.average_frame_rate.1.max(1))
    }
}

/// One frame of a video.
#[derive(Debug)]
pub struct DecodedFrame {
    /// The picture.
    pub image: Pooled<Rgb8>,
    /// The container's time stamp.
    pub timestamp: Timestamp,
    /// Its number in the recording, from 0.
    pub number: u64,
}

#[derive(Debug)]
enum Kind {
    Container(Box<ContainerReader>),
    Images(ImageReader),
}

/// Reads a video from its first frame to its last.
#[derive(Debug)]
pub struct VideoReader {
    kind: Kind,
}

impl VideoReader {
    /// Open, and decode the first frame, so that what [`info`](Self::info) says is true of the pictures.
    pub fn open(input: &Input) -> Result<Self, MediaError> {
        let kind = match input {
            Input::File(path) => Kind::Container(Box::new(ContainerReader::open(path)?)),
            Input::ImageFolder(path) => Kind::Images(ImageReader::open(path)?),
            Input::Y4mStdin => return Self::from_stream(std::io::stdin(), "stdin"),
        };
        Ok(Self { kind })
    }

    /// Read y4m (or anything that libav recognises without going back) from a stream called `name`.
    pub fn from_stream(stream: impl std::io::Read + Send + 'static, name: &str) -> Result<Self, MediaError> {
        Ok(Self {
            kind: Kind::Container(Box::new(ContainerReader::from_stream(stream, name)?)),
        })
    }

    /// What is known of the video.
    pub fn info(&self) -> &VideoInfo {
        match &self.kind {
            Kind::Container(reader) => reader.info(),
            Kind::Images(reader) => reader.info(),
        }
    }

    /// The next frame; `None` after the last. After an error the video is at its end.
    pub fn next_frame(&mut self, pool: &Pool<Rgb8>) -> Result<Option<DecodedFrame>, MediaError> {
        match &mut self.kind {
            Kind::Container(reader) => reader.next_frame(pool),
            Kind::Images(reader) => reader.next_frame(pool),
        }
    }

    /// Go to the first frame stamped `start` or later, exactly; frame numbers stay those of the whole recording.
    pub fn seek(&mut self, start: Timestamp) -> Result<(), MediaError> {
        match &mut self.kind {
            Kind::Container(reader) => reader.seek(start),
            Kind::Images(reader) => {
                reader.seek(start);
                Ok(())
            }
        }
    }
}
