//! Writing a video, to whatever the name of the output says.

use std::path::{Path, PathBuf};

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::media::color::ColorTags;
use crate::media::container_writer::ContainerWriter;
use crate::media::error::MediaError;
use crate::media::image_files::{ImageWriter, NumberedName};
use crate::media::reader::VideoInfo;
use crate::media::y4m::Y4mWriter;
use crate::time::Timestamp;

/// Where a video is written to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// A video file: `.mp4`, `.mkv`, `.avi` or `.mov`.
    File(PathBuf),
    /// Numbered PNGs: a folder (`000000.png`, …) or a pattern such as `out/f_%06d.png`.
    Images(PathBuf),
    /// y4m on stdout.
    Y4mStdout,
}

impl Output {
    /// From what a user types: `-`, a path that ends in `/` or holds `%`, or a file by its ending.
    pub fn from_argument(argument: &Path) -> Result<Self, MediaError> {
        let text = argument.to_string_lossy();
        if text == "-" {
            return Ok(Self::Y4mStdout);
        }
        if text.ends_with('/') || NumberedName::parse(argument).is_some() {
            return Ok(Self::Images(argument.into()));
        }
        let ending = argument
            .extension()
            .map(|e| e.to_string_lossy().to_ascii_lowercase())
            .unwrap_or_default();
        match ending.as_str() {
            "mp4" | "mkv" | "avi" | "mov" => Ok(Self::File(argument.into())),
            "" => Err(MediaError::UnknownOutput {
                path: argument.into(),
                found: "no ending".to_owned(),
            }),
            other => Err(MediaError::UnknownOutput {
                path: argument.into(),
                found: format!(".{other}"),
            }),
        }
    }
}

/// What the frames are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// Colour pictures, visually lossless.
    Color,
    /// Colour pictures, bit for bit; in a container only.
    Lossless,
    /// 8-bit masks, lossless.
    Mask,
}

/// Sound to copy from a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sound {
    /// The file it comes from.
    pub path: PathBuf,
    /// Nothing before this.
    pub start: Option<Timestamp>,
    /// Nothing from here on.
    pub end: Option<Timestamp>,
}

/// How a video is written.
#[derive(Clone, Debug)]
pub struct WriterSettings {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// What the frames are.
    pub content: Content,
    /// Frames per second on average, as a fraction.
    pub average_frame_rate: (i32, i32),
    /// Units of the time stamps, s, as a fraction; the input's own keep its stamps exact.
    pub time_base: (i32, i32),
    /// Width to height of a pixel.
    pub pixel_aspect: (i32, i32),
    /// How colour is coded and tagged.
    pub color: ColorTags,
    /// Constant rate factor of x264: smaller is better and larger.
    pub crf: u8,
    /// x264's speed preset.
    pub preset: String,
    /// Sound to copy along.
    pub sound: Option<Sound>,
    /// Metadata of the container.
    pub metadata: Vec<(String, String)>,
    /// Subtracted from every time stamp: the start of a trimmed clip.
    pub origin: Timestamp,
}

impl WriterSettings {
    /// For pictures that have no video behind them.
    pub fn new(width: usize, height: usize, average_frame_rate: (i32, i32)) -> Self {
        Self {
            width,
            height,
            content: Content::Color,
            average_frame_rate,
            time_base: (1, 90_000),
            pixel_aspect: (1, 1),
            color: ColorTags::for_lines(height),
            // Measured on noisy endoscope video: at least 46 dB to what was handed in, 4:2:0 included, in half the time of
            // `superfast` and a third of `veryfast`.
            crf: 7,
            preset: "ultrafast".to_owned(),
            sound: None,
            metadata: Vec::new(),
            origin: Timestamp(0),
        }
    }

    /// To write what was read: size, rate, stamps, colour tags and metadata as they are.
    pub fn like(info: &VideoInfo) -> Self {
        // Tick units too coarse for frames, or beyond what the muxers hold, are replaced by 90 kHz.
        let fine = info.time_base.0 > 0 && info.time_base.1 / info.time_base.0 >= 1000 && info.time_base.1 <= 1_000_000;
        let mut settings = Self::new(info.width, info.height, info.average_frame_rate);
        if fine {
            settings.time_base = info.time_base;
        }
        settings.pixel_aspect = info.pixel_aspect;
        settings.color = info.color;
        settings.metadata.clone_from(&info.metadata);
        settings
    }

    /// The same video's masks: lossless gray, without sound.
    #[must_use]
    pub fn for_masks(&self) -> Self {
        Self {
            content: Content::Mask,
            sound: None,
            ..self.clone()
        }
    }
}

#[derive(Debug)]
enum Kind {
    Container(Box<ContainerWriter>),
    Images(ImageWriter),
    Y4m(Y4mWriter),
}

/// Writes a video frame by frame. What was written is playable at any time, also when the program is killed.
#[derive(Debug)]
pub struct VideoWriter {
    kind: Kind,
    path: PathBuf,
    size: (usize, usize),
    content: Content,
    finished: bool,
}

impl VideoWriter {
    /// Open the output; without `force` nothing is overwritten.
    pub fn create(output: &Output, settings: &WriterSettings, force: bool) -> Result<Self, MediaError> {
        let size = (settings.width, settings.height);
        let (kind, path) = match output {
            Output::File(path) => {
                refuse_overwriting(path, settings, force)?;
                (
                    Kind::Container(Box::new(ContainerWriter::create(path, settings)?)),
                    path.clone(),
                )
            }
            Output::Images(path) => {
                let name = NumberedName::parse(path).unwrap_or_else(|| NumberedName::in_folder(path));
                (Kind::Images(ImageWriter::create(name, size, force)?), path.clone())
            }
            Output::Y4mStdout => (
                Kind::Y4m(Y4mWriter::new(std::io::stdout(), "stdout", settings)?),
                PathBuf::from("-"),
            ),
        };
        Ok(Self {
            kind,
            path,
            size,
            content: settings.content,
            finished: false,
        })
    }

    /// Write y4m to a stream called `name`.
    pub fn to_stream(
        stream: impl std::io::Write + Send + 'static,
        name: &str,
        settings: &WriterSettings,
    ) -> Result<Self, MediaError> {
        let kind = Kind::Y4m(Y4mWriter::new(stream, name, settings)?);
        Ok(Self {
            kind,
            path: name.into(),
            size: (settings.width, settings.height),
            content: settings.content,
            finished: false,
        })
    }

    /// Where it is written to.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Write a colour picture.
    pub fn write(&mut self, picture: &Image<Rgb8>, timestamp: Timestamp) -> Result<(), MediaError> {
        let is_color = self.content != Content::Mask;
        self.check(picture.size(), if is_color { self.content } else { Content::Color })?;
        match &mut self.kind {
            Kind::Container(writer) => writer.write_color(picture, timestamp),
            Kind::Images(writer) => writer.write(picture.as_bytes(), false),
            Kind::Y4m(writer) => writer.write_color(picture),
        }
    }

    /// Write a mask.
    pub fn write_gray(&mut self, mask: &Mask, timestamp: Timestamp) -> Result<(), MediaError> {
        self.check(mask.size(), Content::Mask)?;
        match &mut self.kind {
            Kind::Container(writer) => writer.write_gray(mask, timestamp),
            Kind::Images(writer) => writer.write(mask.as_bytes(), true),
            Kind::Y4m(writer) => writer.write_gray(mask),
        }
    }

    fn check(&self, found: (usize, usize), content: Content) -> Result<(), MediaError> {
        if content != self.content {
            let expected = if self.content == Content::Mask { "mask" } else { "colour" };
            return Err(MediaError::WrongKind {
                path: self.path.clone(),
                expected,
            });
        }
        if found != self.size {
            return Err(MediaError::WrongSize {
                path: self.path.clone(),
                expected: self.size,
                found,
            });
        }
        Ok(())
    }

    /// Complete the output. Calling it again does nothing.
    pub fn finish(&mut self) -> Result<(), MediaError> {
        if std::mem::replace(&mut self.finished, true) {
            return Ok(());
        }
        match &mut self.kind {
            Kind::Container(writer) => writer.finish(),
            Kind::Images(writer) => writer.finish(),
            Kind::Y4m(writer) => writer.finish(),
        }
    }
}

fn refuse_overwriting(path: &Path, settings: &WriterSettings, force: bool) -> Result<(), MediaError> {
    if !path.exists() {
        return Ok(());
    }
    if !force {
        return Err(MediaError::Exists { path: path.into() });
    }
    let input = settings.sound.as_ref().and_then(|sound| sound.path.canonicalize().ok());
    if input.is_some() && input == path.canonicalize().ok() {
        return Err(MediaError::SameAsInput { path: path.into() });
    }
    Ok(())
}
