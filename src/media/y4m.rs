//! y4m (YUV4MPEG2): uncompressed frames in a pipe, for other programs to go on with.
//!
//! A text header, then per frame the word `FRAME` and the planes. It has one frame rate for all and no time stamps, and no
//! tag for the matrix: readers go by the number of lines, as we do. Full range is told by ffmpeg's `XCOLORRANGE`.

use std::io::{BufWriter, Write};

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::media::color::Planes;
use crate::media::error::MediaError;
use crate::media::writer::{Content, WriterSettings};

/// Writes y4m to any stream.
pub(crate) struct Y4mWriter {
    stream: BufWriter<Box<dyn Write + Send>>,
    name: String,
    planes: Planes,
    frames: u64,
}

impl std::fmt::Debug for Y4mWriter {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("Y4mWriter")
            .field("name", &self.name)
            .field("frames", &self.frames)
            .finish_non_exhaustive()
    }
}

impl Y4mWriter {
    pub(crate) fn new(stream: impl Write + Send + 'static, name: &str, settings: &WriterSettings) -> Result<Self, MediaError> {
        let planes = Planes::new(settings.width, settings.height, &settings.color);
        let full = settings.content == Content::Mask || settings.color.range_name() == "pc";
        let sampling = match (settings.content, planes.subsampled()) {
            (Content::Mask, _) => "Cmono",
            (Content::Color | Content::Lossless, true) => "C420jpeg",
            (Content::Color | Content::Lossless, false) => "C444",
        };
        let (frames, seconds) = settings.average_frame_rate;
        let (across, down) = settings.pixel_aspect;
        let range = if full { "FULL" } else { "LIMITED" };
        let header = format!(
            "YUV4MPEG2 W{} H{} F{frames}:{seconds} Ip A{across}:{down} {sampling} XCOLORRANGE={range}\n",
            settings.width, settings.height
        );
        let mut writer = Self {
            stream: BufWriter::new(Box::new(stream)),
            name: name.to_owned(),
            planes,
            frames: 0,
        };
        writer
            .stream
            .write_all(header.as_bytes())
            .map_err(|error| writer.failed(&error))?;
        Ok(writer)
    }

    fn failed(&self, error: &std::io::Error) -> MediaError {
        MediaError::Write {
            path: self.name.as_str().into(),
            frames: self.frames,
            reason: error.to_string(),
        }
    }

    pub(crate) fn write_color(&mut self, picture: &Image<Rgb8>) -> Result<(), MediaError> {
        let frames = self.frames;
        self.planes.fill(picture).map_err(|reason| MediaError::Write {
            path: self.name.as_str().into(),
            frames,
            reason,
        })?;
        let [y, u, v] = self.planes.planes();
        let written = write_frame(&mut self.stream, &[y.0, u.0, v.0]);
        self.count(written)
    }

    pub(crate) fn write_gray(&mut self, mask: &Mask) -> Result<(), MediaError> {
        let written = write_frame(&mut self.stream, &[mask.as_bytes()]);
        self.count(written)
    }

    fn count(&mut self, written: std::io::Result<()>) -> Result<(), MediaError> {
        written.map_err(|error| self.failed(&error))?;
        self.frames += 1;
        Ok(())
    }

    pub(crate) fn finish(&mut self) -> Result<(), MediaError> {
        self.stream.flush().map_err(|error| self.failed(&error))
    }
}

/// A whole frame, and no byte of it left in the buffer: the reader may be waiting.
fn write_frame(stream: &mut impl Write, planes: &[&[u8]]) -> std::io::Result<()> {
    stream.write_all(b"FRAME\n")?;
    for plane in planes {
        stream.write_all(plane)?;
    }
    stream.flush()
}
