//! MetaImage sequences (`.mha`, `.igs.mha`, `.seq.mha`): pictures and tracker poses as PLUS and 3D Slicer record them.
//!
//! A header of lines `key = value`, the last of them `ElementDataFile = LOCAL`, then the pixels, of all frames in one piece, as they are
//! or as one zlib stream. What belongs to a frame is in the header as `Seq_Frame0012_Timestamp = …`,
//! `Seq_Frame0012_ProbeToTrackerTransform = ` sixteen numbers, row by row, which map the first space to the second (mm), and
//! `…TransformStatus = OK`; anything but OK (INVALID, out of view) means that the numbers are worth nothing. Lasso et al. 2014, "PLUS:
//! open-source toolkit for ultrasound-guided intervention systems", doi:10.1109/TBME.2014.2322864.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufRead as _, BufReader, Cursor, Read as _};
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};

use crate::image::buffer::{Image, Rgb8};
use crate::time::Timestamp;

/// Longest line and most bytes of a header: a broken file must not eat the memory.
const LONGEST_LINE: u64 = 1 << 20;
const LONGEST_HEADER: usize = 1 << 28;
/// Most bytes of pixels.
const MOST_PIXELS: usize = 1 << 31;
/// How far from orthonormal a rotation may be: numbers are written with six digits.
const ROUNDING: f64 = 1e-3;

/// What can be wrong with a sequence.
#[derive(Debug, thiserror::Error)]
pub enum MetaImageError {
    /// The disk said no.
    #[error("cannot read {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not such a file, or of a kind that is not read.
    #[error("{}: expected {expected}, found {found}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What was expected.
        expected: String,
        /// What there was.
        found: String,
    },
}

/// What is known of a frame.
#[derive(Clone, Debug, Default)]
pub struct SequenceFrame {
    /// When, on the recording computer's clock.
    pub at: Option<Timestamp>,
    /// Whether there is a picture worth looking at.
    pub has_picture: bool,
    /// By name without `Transform`; only those whose status is OK.
    pub transforms: BTreeMap<String, Isometry3<f64>>,
}

/// A sequence without its pixels.
#[derive(Debug)]
pub struct MetaSequence {
    path: PathBuf,
    /// Columns and rows of the pictures; 0 where there are none.
    pub size: (usize, usize),
    /// Frame by frame.
    pub frames: Vec<SequenceFrame>,
    /// All transforms named anywhere, valid or not.
    pub transforms: BTreeSet<String>,
    channels: usize,
    compressed: bool,
    header_bytes: usize,
}

impl MetaSequence {
    /// Read the header.
    pub fn open(path: &Path) -> Result<Self, MetaImageError> {
        let unreadable = |source| MetaImageError::Unreadable {
            path: path.into(),
            source,
        };
        let content = |expected: &str, found: &str| MetaImageError::Content {
            path: path.into(),
            expected: expected.into(),
            found: found.chars().take(80).collect(),
        };
        let mut reader = BufReader::new(File::open(path).map_err(unreadable)?);
        let mut fields: BTreeMap<String, String> = BTreeMap::new();
        let mut header_bytes = 0;
        loop {
            let mut line = Vec::new();
            let read = (&mut reader)
                .take(LONGEST_LINE)
                .read_until(b'\n', &mut line)
                .map_err(unreadable)?;
            header_bytes += read;
            let text = String::from_utf8_lossy(&line);
            let Some((key, value)) = text.split_once('=').filter(|_| header_bytes < LONGEST_HEADER) else {
                return Err(content(
                    "a MetaImage header, lines `key = value` up to `ElementDataFile = LOCAL`",
                    if read == 0 { "the end of the file" } else { text.trim() },
                ));
            };
            let (key, value) = (key.trim().to_owned(), value.trim().to_owned());
            if key == "ElementDataFile" {
                if value != "LOCAL" {
                    return Err(content("pixels in the same file (ElementDataFile = LOCAL)", &value));
                }
                break;
            }
            fields.insert(key, value);
        }
        let field = |key: &str| fields.get(key).map_or("", String::as_str);
        let dimensions: Vec<usize> = field("DimSize").split_whitespace().filter_map(|n| n.parse().ok()).collect();
        let &[width, height, count] = dimensions.as_slice() else {
            return Err(content("DimSize with columns, rows and frames", field("DimSize")));
        };
        let has_pixels = width > 0 && height > 0;
        if has_pixels && field("ElementType") != "MET_UCHAR" {
            return Err(content("8-bit pixels (ElementType = MET_UCHAR)", field("ElementType")));
        }
        let channels = field("ElementNumberOfChannels").parse().unwrap_or(1);
        if ![1, 3].contains(&channels) {
            return Err(content("1 or 3 channels", field("ElementNumberOfChannels")));
        }
        let bytes = [width, height, count, channels]
            .iter()
            .try_fold(1_usize, |product, n| product.checked_mul(*n));
        if bytes.is_none_or(|bytes| bytes > MOST_PIXELS) || count > LONGEST_HEADER / 16 {
            return Err(content("at most 2 GiB of pixels", field("DimSize")));
        }
        let mut sequence = Self {
            path: path.into(),
            size: if has_pixels { (width, height) } else { (0, 0) },
            frames: vec![SequenceFrame::default(); count],
            transforms: BTreeSet::new(),
            channels,
            compressed: field("CompressedData").eq_ignore_ascii_case("true"),
            header_bytes,
        };
        for (key, value) in &fields {
            let Some((number, what)) = key.strip_prefix("Seq_Frame").and_then(|rest| rest.split_once('_')) else {
                continue;
            };
            let Some(number) = number.parse().ok().filter(|number: &usize| *number < count) else {
                return Err(content(&format!("frames below {count}, as DimSize says"), key));
            };
            if let Some(name) = what.strip_suffix("Transform") {
                sequence.transforms.insert(name.to_owned());
                let status = field(&format!("{key}Status"));
                if status == "OK" {
                    let pose = pose_from(value).ok_or_else(|| content("a rigid motion, sixteen numbers row by row", value))?;
                    sequence.frames[number].transforms.insert(name.to_owned(), pose);
                }
            } else if what == "Timestamp" {
                let seconds = value.parse().ok().filter(|seconds: &f64| seconds.is_finite());
                let seconds = seconds.ok_or_else(|| content("a time stamp in seconds", value))?;
                sequence.frames[number].at = Some(Timestamp::from_seconds(seconds));
            } else if what == "ImageStatus" {
                sequence.frames[number].has_picture = has_pixels && value == "OK";
            }
        }
        // Files older than the status have pictures wherever they have pixels.
        if has_pixels && !fields.keys().any(|key| key.ends_with("_ImageStatus")) {
            sequence.frames.iter_mut().for_each(|frame| frame.has_picture = true);
        }
        Ok(sequence)
    }

    /// All pixels, frame by frame.
    pub fn pixels(&self) -> Result<Pixels, MetaImageError> {
        let unreadable = |source| MetaImageError::Unreadable {
            path: self.path.clone(),
            source,
        };
        let mut data = Vec::new();
        let mut file = File::open(&self.path).map_err(unreadable)?;
        file.read_to_end(&mut data).map_err(unreadable)?;
        let data = data.split_off(self.header_bytes.min(data.len()));
        let row = self.size.0 * self.channels;
        let wanted = row * self.size.1 * self.frames.len();
        let content = |found: String| MetaImageError::Content {
            path: self.path.clone(),
            expected: format!("{wanted} bytes of pixels"),
            found,
        };
        let levels = if self.compressed {
            inflated(&data, row, self.size.1 * self.frames.len()).map_err(content)?
        } else {
            data
        };
        if levels.len() < wanted {
            return Err(content(format!("{}", levels.len())));
        }
        Ok(Pixels {
            levels,
            size: self.size,
            channels: self.channels,
        })
    }
}

/// The pixels of all frames.
#[derive(Debug)]
pub struct Pixels {
    levels: Vec<u8>,
    size: (usize, usize),
    channels: usize,
}

impl Pixels {
    /// A frame's picture.
    pub fn picture(&self, frame: usize) -> Option<Image<Rgb8>> {
        let bytes = self.size.0 * self.size.1 * self.channels;
        let levels = self.levels.get(frame * bytes..(frame + 1) * bytes)?;
        let mut image = Image::filled(self.size.0, self.size.1, [0; 3]);
        for (pixel, level) in image.pixels_mut().iter_mut().zip(levels.chunks_exact(self.channels)) {
            *pixel = match *level {
                [r, g, b] => [r, g, b],
                [gray] => [gray; 3],
                _ => return None,
            };
        }
        Some(image)
    }
}

/// A strip of a TIFF picture may be a zlib stream (compression 8): with a header before it, the decoder that is in the house anyway
/// inflates it.
fn inflated(stream: &[u8], row: usize, rows: usize) -> Result<Vec<u8>, String> {
    let too_large = |_| "too much for one piece".to_owned();
    let [row, rows, length] = [row, rows, stream.len()].map(u32::try_from);
    let (row, rows, length) = (row.map_err(too_large)?, rows.map_err(too_large)?, length.map_err(too_large)?);
    // Tag, type (3 = 16 bits, 4 = 32 bits), value.
    let entries: [(u16, u16, u32); 9] = [
        (256, 4, row),
        (257, 4, rows),
        (258, 3, 8),
        (259, 3, 8),
        (262, 3, 1),
        (273, 4, 8 + 2 + 9 * 12 + 4),
        (277, 3, 1),
        (278, 4, rows),
        (279, 4, length),
    ];
    let mut tiff = b"II*\0\x08\0\0\0\x09\0".to_vec();
    for (tag, kind, value) in entries {
        tiff.extend(tag.to_le_bytes());
        tiff.extend(kind.to_le_bytes());
        tiff.extend(1_u32.to_le_bytes());
        tiff.extend(value.to_le_bytes());
    }
    tiff.extend([0; 4]);
    tiff.extend(stream);
    let mut reader = image::ImageReader::with_format(Cursor::new(tiff), image::ImageFormat::Tiff);
    reader.no_limits();
    let picture = reader
        .decode()
        .map_err(|error| format!("a zlib stream that breaks off or is none ({error})"))?;
    Ok(picture.into_luma8().into_raw())
}

fn pose_from(text: &str) -> Option<Isometry3<f64>> {
    let numbers: Vec<f64> = text.split_whitespace().map(str::parse).collect::<Result<_, _>>().ok()?;
    let &[a, b, c, x, d, e, f, y, g, h, i, z, ..] = numbers.as_slice() else {
        return None;
    };
    let matrix = Matrix3::new(a, b, c, d, e, f, g, h, i);
    let rigid = (matrix * matrix.transpose() - Matrix3::identity()).norm() < ROUNDING && matrix.determinant() > 0.0;
    let place = Vector3::new(x, y, z);
    (rigid && numbers.len() == 16 && place.iter().all(|v| v.is_finite()))
        .then(|| Isometry3::from_parts(Translation3::from(place), UnitQuaternion::from_matrix(&matrix)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "ObjectType = Image\nNDims = 3\nCompressedData = False\nDimSize = 3 2 2\nElementType = MET_UCHAR\n\
        Seq_Frame0000_ProbeToTrackerTransform = 0 -1 0 4 1 0 0 5 0 0 1 6 0 0 0 1\nSeq_Frame0000_ProbeToTrackerTransformStatus = OK\n\
        Seq_Frame0000_Timestamp = 12.5\nSeq_Frame0000_ImageStatus = OK\n\
        Seq_Frame0001_ProbeToTrackerTransform = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\nSeq_Frame0001_ProbeToTrackerTransformStatus = INVALID\n\
        Seq_Frame0001_Timestamp = 12.6\nSeq_Frame0001_ImageStatus = INVALID\nElementDataFile = LOCAL\n";

    fn opened(header: &str, data: &[u8]) -> Result<(MetaSequence, Result<Pixels, MetaImageError>), MetaImageError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mha");
        let mut bytes = header.as_bytes().to_vec();
        bytes.extend(data);
        std::fs::write(&path, bytes).unwrap();
        let sequence = MetaSequence::open(&path)?;
        let pixels = sequence.pixels();
        Ok((sequence, pixels))
    }

    #[test]
    fn frames_poses_and_what_is_invalid_are_read() {
        let (sequence, pixels) = opened(HEADER, &[0, 1, 2, 3, 4, 5, 10, 11, 12, 13, 14, 15]).unwrap();
        assert_eq!((sequence.size, sequence.frames.len()), ((3, 2), 2));
        let first = &sequence.frames[0];
        assert_eq!(first.at, Some(Timestamp::from_seconds(12.5)));
        let pose = first.transforms["ProbeToTracker"];
        assert!((pose * nalgebra::Point3::new(1.0, 0.0, 0.0) - nalgebra::Point3::new(4.0, 6.0, 6.0)).norm() < 1e-12);
        assert!(first.has_picture && !sequence.frames[1].has_picture && sequence.frames[1].transforms.is_empty());
        assert!(sequence.transforms.contains("ProbeToTracker"));
        let pixels = pixels.unwrap();
        assert_eq!(pixels.picture(1).unwrap().at(2, 1), [15; 3]);
        assert!(pixels.picture(2).is_none());
    }

    #[test]
    fn a_zlib_stream_is_inflated() {
        // Made by Python's zlib.compress(bytes(range(12))).
        let stream = [
            120, 156, 99, 96, 100, 98, 102, 97, 101, 99, 231, 224, 228, 226, 6, 0, 1, 42, 0, 67,
        ];
        let header = HEADER.replace("CompressedData = False", "CompressedData = True");
        let (_, pixels) = opened(&header, &stream).unwrap();
        assert_eq!(pixels.unwrap().picture(1).unwrap().pixels()[0], [6; 3]);
        let (_, broken) = opened(&header, &stream[..9]).unwrap();
        assert!(matches!(broken, Err(MetaImageError::Content { .. })), "{broken:?}");
    }

    #[test]
    fn what_is_no_sequence_is_refused_with_the_reason() {
        for (header, wanted) in [
            ("\u{1}\u{2}", "ElementDataFile"),
            ("a = b\n", "a MetaImage header"),
            (&HEADER.replace("LOCAL", "pixels.raw"), "LOCAL"),
            (&HEADER.replace("MET_UCHAR", "MET_SHORT"), "MET_SHORT"),
            (&HEADER.replace("3 2 2", "3 2"), "DimSize"),
            (&HEADER.replace("3 2 2", "3 2 1"), "below 1"),
            (&HEADER.replace("3 2 2", "99999999 99999999 9999"), "2 GiB"),
            (&HEADER.replace("0 -1 0 4", "0 -2 0 4"), "rigid"),
            (&HEADER.replace("12.5", "noon"), "noon"),
        ] {
            let error = opened(header, &[0; 12]).unwrap_err().to_string();
            assert!(error.contains(wanted), "{error}");
        }
        let (_, short) = opened(HEADER, &[0; 11]).unwrap();
        assert!(short.unwrap_err().to_string().contains("found 11"));
    }
}
