//! Numbered pictures as a video: reading a folder in the order of its numbers, writing PNGs.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageReader as Decoder};

use crate::image::buffer::{Image, Rgb8};
use crate::image::pool::Pool;
use crate::media::color::ColorTags;
use crate::media::error::MediaError;
use crate::media::reader::{DecodedFrame, VideoInfo};
use crate::time::{Span, Timestamp};

/// Frame rate of pictures, which carry no time; `frames.csv` overrides it.
const FRAMES_PER_SECOND: i32 = 25;

const ENDINGS: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff", "pnm", "ppm", "pgm", "pbm"];

/// A name with a number in it: `prefix%06dsuffix`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NumberedName {
    folder: PathBuf,
    prefix: String,
    digits: usize,
    suffix: String,
}

impl NumberedName {
    /// From a path whose last part holds `%d` or `%0Nd`.
    pub(crate) fn parse(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let (prefix, rest) = name.split_once('%')?;
        let (digits, suffix) = rest.split_once('d')?;
        let digits = if digits.is_empty() { 0 } else { digits.parse().ok()? };
        let folder = path.parent().map_or_else(PathBuf::new, Path::to_path_buf);
        Some(Self {
            folder,
            prefix: prefix.to_owned(),
            digits,
            suffix: suffix.to_owned(),
        })
    }

    /// The plain `FOLDER/%06d.png`.
    pub(crate) fn in_folder(folder: &Path) -> Self {
        Self {
            folder: folder.into(),
            prefix: String::new(),
            digits: 6,
            suffix: ".png".to_owned(),
        }
    }

    pub(crate) fn folder(&self) -> &Path {
        if self.folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            &self.folder
        }
    }

    pub(crate) fn path(&self, number: u64) -> PathBuf {
        self.folder
            .join(format!("{}{number:0width$}{}", self.prefix, self.suffix, width = self.digits))
    }

    fn number_in(&self, name: &str) -> Option<u64> {
        let digits = name.strip_prefix(self.prefix.as_str())?.strip_suffix(self.suffix.as_str())?;
        (digits.len() >= self.digits && digits.bytes().all(|b| b.is_ascii_digit())).then(|| digits.parse().ok())?
    }
}

/// The last run of digits in a name without its ending: what numbers `frame_0012.png`.
pub fn last_number(name: &str) -> Option<u64> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |at| at + 1);
    stem.get(start..end)?.parse().ok()
}

/// Pictures of a folder or pattern, by number.
fn list(path: &Path) -> Result<Vec<PathBuf>, MediaError> {
    let pattern = NumberedName::parse(path);
    let folder = pattern.as_ref().map_or(path, NumberedName::folder);
    let entries = std::fs::read_dir(folder).map_err(|_| MediaError::Missing { path: path.into() })?;
    let mut found = Vec::new();
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let known = name
            .rsplit_once('.')
            .is_some_and(|(_, ending)| ENDINGS.contains(&ending.to_ascii_lowercase().as_str()));
        let number = match &pattern {
            Some(pattern) => pattern.number_in(&name),
            None if known => last_number(&name),
            None => None,
        };
        if let Some(number) = number {
            found.push((number, name, entry.path()));
        }
    }
    if found.is_empty() {
        return Err(MediaError::NoImages { path: path.into() });
    }
    found.sort();
    Ok(found.into_iter().map(|(_, _, path)| path).collect())
}

fn decode(path: &Path) -> Result<image::RgbImage, MediaError> {
    let refuse = |reason: String| MediaError::Image {
        path: path.into(),
        reason,
    };
    let decoder = Decoder::open(path).map_err(|e| refuse(e.to_string()))?;
    let decoder = decoder.with_guessed_format().map_err(|e| refuse(e.to_string()))?;
    Ok(decoder.decode().map_err(|e| refuse(e.to_string()))?.into_rgb8())
}

/// True for a file that ends like a picture.
pub fn is_picture(path: &Path) -> bool {
    path.is_file()
        && path
            .extension()
            .is_some_and(|ending| ENDINGS.contains(&ending.to_string_lossy().to_ascii_lowercase().as_str()))
}

/// One picture, as 8-bit RGB.
pub fn read(path: &Path) -> Result<Image<Rgb8>, MediaError> {
    let picture = decode(path)?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let mut image = Image::filled(width, height, [0; 3]);
    image.as_bytes_mut().copy_from_slice(picture.as_raw());
    Ok(image)
}

/// One PNG; an existing file is replaced.
pub fn write(path: &Path, image: &Image<Rgb8>) -> Result<(), MediaError> {
    write_png(path, image.as_bytes(), image.size(), ExtendedColorType::Rgb8).map_err(|reason| MediaError::Write {
        path: path.into(),
        frames: 0,
        reason,
    })
}

/// Reads pictures one after the other, evenly spaced in time.
#[derive(Debug)]
pub(crate) struct ImageReader {
    files: Vec<PathBuf>,
    info: VideoInfo,
    next: usize,
}

impl ImageReader {
    pub(crate) fn open(path: &Path) -> Result<Self, MediaError> {
        let files = list(path)?;
        let first = files.first().ok_or_else(|| MediaError::NoImages { path: path.into() })?;
        let picture = decode(first)?;
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        let info = VideoInfo {
            width,
            height,
            average_frame_rate: (FRAMES_PER_SECOND, 1),
            time_base: (1, FRAMES_PER_SECOND),
            frame_count: Some(files.len() as u64),
            duration_s: Some(files.len() as f64 / f64::from(FRAMES_PER_SECOND)),
            color: ColorTags::for_lines(height),
            bit_depth: 8,
            interlaced: false,
            has_audio: false,
            pixel_aspect: (1, 1),
            rotation_degrees: 0,
            codec: "images".to_owned(),
            metadata: Vec::new(),
        };
        Ok(Self { files, info, next: 0 })
    }

    pub(crate) fn info(&self) -> &VideoInfo {
        &self.info
    }

    fn stamp(index: usize) -> Timestamp {
        Timestamp(0) + Span(index as i64 * 1_000_000_000 / i64::from(FRAMES_PER_SECOND))
    }

    pub(crate) fn seek(&mut self, start: Timestamp) {
        self.next = (0..self.files.len())
            .find(|&i| Self::stamp(i) >= start)
            .unwrap_or(self.files.len());
    }

    pub(crate) fn next_frame(&mut self, pool: &Pool<Rgb8>) -> Result<Option<DecodedFrame>, MediaError> {
        let Some(path) = self.files.get(self.next) else {
            return Ok(None);
        };
        let index = self.next;
        let picture = decode(path).inspect_err(|_| self.next = self.files.len())?;
        let found = (picture.width() as usize, picture.height() as usize);
        let expected = (self.info.width, self.info.height);
        let timestamp = Self::stamp(index);
        if found != expected {
            let name = path.display().to_string();
            self.next = self.files.len();
            return Err(MediaError::SizeChanged {
                name,
                expected,
                found,
                frame: index as u64,
                seconds: timestamp.seconds(),
            });
        }
        self.next += 1;
        let mut image = pool.take(expected.0, expected.1);
        image.as_bytes_mut().copy_from_slice(picture.as_raw());
        Ok(Some(DecodedFrame {
            image,
            timestamp,
            number: index as u64,
        }))
    }
}

/// Writes one PNG, quickly rather than small.
fn write_png(path: &Path, bytes: &[u8], size: (usize, usize), kind: ExtendedColorType) -> Result<(), String> {
    let file = File::create(path).map_err(|e| e.to_string())?;
    let encoder = PngEncoder::new_with_quality(BufWriter::new(file), CompressionType::Fast, FilterType::Adaptive);
    encoder
        .write_image(bytes, size.0 as u32, size.1 as u32, kind)
        .map_err(|e| e.to_string())
}

/// Writes numbered PNGs.
#[derive(Debug)]
pub(crate) struct ImageWriter {
    name: NumberedName,
    size: (usize, usize),
    written: u64,
}

impl ImageWriter {
    pub(crate) fn create(name: NumberedName, size: (usize, usize), force: bool) -> Result<Self, MediaError> {
        let folder = name.folder();
        std::fs::create_dir_all(folder).map_err(|e| MediaError::Create {
            path: folder.into(),
            reason: e.to_string(),
        })?;
        let entries = std::fs::read_dir(folder).map_err(|e| MediaError::Create {
            path: folder.into(),
            reason: e.to_string(),
        })?;
        let there = entries
            .flatten()
            .find(|entry| name.number_in(&entry.file_name().to_string_lossy()).is_some());
        match there {
            Some(entry) if !force => Err(MediaError::Exists { path: entry.path() }),
            _ => Ok(Self { name, size, written: 0 }),
        }
    }

    pub(crate) fn write(&mut self, bytes: &[u8], gray: bool) -> Result<(), MediaError> {
        let path = self.name.path(self.written);
        let kind = if gray {
            ExtendedColorType::L8
        } else {
            ExtendedColorType::Rgb8
        };
        write_png(&path, bytes, self.size, kind).map_err(|reason| {
            // Half a picture is of no use to anybody.
            let _gone = std::fs::remove_file(&path);
            MediaError::Write {
                path: path.clone(),
                frames: self.written,
                reason,
            }
        })?;
        self.written += 1;
        Ok(())
    }

    /// Frames of an earlier, longer run that was overwritten would look like the end of this one.
    pub(crate) fn finish(&mut self) -> Result<(), MediaError> {
        let mut number = self.written;
        loop {
            let path = self.name.path(number);
            match std::fs::remove_file(&path) {
                Ok(()) => number += 1,
                Err(_) => return Ok(()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbered_names_are_parsed_and_made() {
        let name = NumberedName::parse(Path::new("out/f_%04d.png")).unwrap();
        assert_eq!(name.path(12), Path::new("out/f_0012.png"));
        assert_eq!(name.path(123_456), Path::new("out/f_123456.png"));
        assert_eq!(name.number_in("f_0012.png"), Some(12));
        assert_eq!(name.number_in("f_12.png"), None);
        assert_eq!(name.number_in("g_0012.png"), None);
        assert_eq!(NumberedName::parse(Path::new("out/plain.png")), None);
    }

    #[test]
    fn the_last_number_counts() {
        assert_eq!(last_number("cam1_frame_0012.png"), Some(12));
        assert_eq!(last_number("7.jpg"), Some(7));
        assert_eq!(last_number("cover.png"), None);
    }
}
