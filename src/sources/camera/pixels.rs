//! A camera's bytes as a picture.

use std::sync::OnceLock;

use image::{DynamicImage, ImageFormat};
use yuv::{YuvBiPlanarImage, YuvConversionMode, YuvPackedImage, YuvRange, YuvStandardMatrix};

use crate::image::buffer::{Image, Rgb8};
use crate::media::layout::{Layout, Matrix, Range};
use crate::sources::camera::device::Mode;

/// Why bytes are no picture.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PixelError {
    /// Bytes are missing.
    #[error("expected {expected} bytes, found {found}")]
    Short {
        /// A whole picture's.
        expected: usize,
        /// That came.
        found: usize,
    },
    /// No JPEG, or one of another size.
    #[error("{0}")]
    Jpeg(String),
    /// The conversion refused.
    #[error("{0}")]
    Conversion(String),
}

/// Bytes as `mode` lays them out, as RGB; `out` takes the picture's size.
pub fn rgb_from_bytes(bytes: &[u8], mode: &Mode, out: &mut Image<Rgb8>) -> Result<(), PixelError> {
    let (width, height) = (mode.width, mode.height);
    if out.size() != (width, height) {
        out.resize(width, height, [0; 3]);
    }
    let expected = mode.bytes();
    if bytes.len() < expected {
        return Err(PixelError::Short {
            expected,
            found: bytes.len(),
        });
    }
    let range = match mode.range {
        Range::Limited => YuvRange::Limited,
        Range::Full => YuvRange::Full,
    };
    let matrix = match mode.matrix {
        Matrix::Bt601 => YuvStandardMatrix::Bt601,
        Matrix::Bt709 => YuvStandardMatrix::Bt709,
        Matrix::Bt2020 => YuvStandardMatrix::Bt2020,
    };
    let row = mode.layout.rows(width, height).map_or(0, |(row, _)| row);
    let stride = mode.stride.max(row);
    let (w, h, s) = (width as u32, height as u32, stride as u32);
    let refused = |error: yuv::YuvError| PixelError::Conversion(error.to_string());
    match mode.layout {
        Layout::Rgb24 => {
            for (from, to) in bytes.chunks(stride).zip(out.as_bytes_mut().chunks_exact_mut(3 * width)) {
                if let Some(from) = from.get(..row) {
                    to.copy_from_slice(from);
                }
            }
            Ok(())
        }
        Layout::Bgr24 => {
            for (from, to) in bytes.chunks(stride).zip(out.pixels_mut().chunks_exact_mut(width)) {
                for (from, to) in from.chunks_exact(3).zip(to) {
                    *to = [from[2], from[1], from[0]];
                }
            }
            Ok(())
        }
        Layout::Yuyv | Layout::Uyvy => {
            // The last row need not be padded; the conversion wants whole strides.
            let padded = with_whole_rows(bytes, stride, height);
            let packed = YuvPackedImage {
                yuy: &padded,
                yuy_stride: s,
                width: w,
                height: h,
            };
            let convert = if mode.layout == Layout::Yuyv {
                yuv::yuyv422_to_rgb
            } else {
                yuv::uyvy422_to_rgb
            };
            convert(&packed, out.as_bytes_mut(), 3 * w, range, matrix).map_err(refused)
        }
        Layout::Nv12 => {
            let padded = with_whole_rows(bytes, stride, height + height.div_ceil(2));
            let (y_plane, uv_plane) = padded.split_at(stride * height);
            let planes = YuvBiPlanarImage {
                y_plane,
                y_stride: s,
                uv_plane,
                uv_stride: s,
                width: w,
                height: h,
            };
            yuv::yuv_nv12_to_rgb(&planes, out.as_bytes_mut(), 3 * w, range, matrix, YuvConversionMode::Balanced).map_err(refused)
        }
        Layout::Mjpeg => {
            let decoded = image::load_from_memory_with_format(&with_huffman_tables(bytes), ImageFormat::Jpeg)
                .map_err(|error| PixelError::Jpeg(format!("expected a JPEG picture: {error}")))?;
            if (decoded.width(), decoded.height()) != (w, h) {
                let found = format!("{}x{}", decoded.width(), decoded.height());
                return Err(PixelError::Jpeg(format!("expected a JPEG picture of {w}x{h}, found {found}")));
            }
            let rgb = match decoded {
                DynamicImage::ImageRgb8(rgb) => rgb,
                other => other.to_rgb8(),
            };
            out.as_bytes_mut().copy_from_slice(rgb.as_raw());
            Ok(())
        }
    }
}

/// The bytes, with what the last row lacks in padding.
fn with_whole_rows(bytes: &[u8], stride: usize, rows: usize) -> std::borrow::Cow<'_, [u8]> {
    match bytes.get(..stride * rows) {
        Some(whole) => whole.into(),
        None => {
            let mut padded = bytes.to_vec();
            padded.resize(stride * rows, 0);
            padded.into()
        }
    }
}

/// Markers of a JPEG file (ITU-T T.81, table B.1).
const MARKER: u8 = 0xff;
const DEFINES_HUFFMAN_TABLES: u8 = 0xc4;
const STARTS_SCAN: u8 = 0xda;

/// The segments of a JPEG file before its first scan, from marker to marker.
fn segments(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = bytes.get(2..).unwrap_or(&[]);
    std::iter::from_fn(move || {
        let &[MARKER, kind, high, low, ..] = rest else { return None };
        if kind == STARTS_SCAN {
            return None;
        }
        let length = 2 + usize::from(u16::from_be_bytes([high, low]));
        let (segment, behind) = rest.split_at_checked(length)?;
        rest = behind;
        Some(segment)
    })
}

fn defines_tables(segment: &&[u8]) -> bool {
    segment.get(1) == Some(&DEFINES_HUFFMAN_TABLES)
}

/// A file that many cameras send without its Huffman tables, with those that are meant then: the ones of ITU-T T.81, annex K.3, which
/// the encoder of the crate `image` uses.
fn with_huffman_tables(bytes: &[u8]) -> std::borrow::Cow<'_, [u8]> {
    static TABLES: OnceLock<Vec<u8>> = OnceLock::new();
    if bytes.len() < 4 || segments(bytes).any(|segment| defines_tables(&segment)) {
        return bytes.into();
    }
    let tables = TABLES.get_or_init(|| {
        let mut file = std::io::Cursor::new(Vec::new());
        match DynamicImage::new_rgb8(8, 8).write_to(&mut file, ImageFormat::Jpeg) {
            Ok(()) => segments(file.get_ref()).filter(defines_tables).flatten().copied().collect(),
            Err(_) => Vec::new(),
        }
    });
    let (start, rest) = bytes.split_at(2);
    [start, tables, rest].concat().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(layout: Layout, width: usize, height: usize, padding: usize) -> Mode {
        Mode {
            width,
            height,
            layout,
            stride: layout.rows(width, height).map_or(0, |(row, _)| row + padding),
            matrix: Matrix::Bt709,
            range: Range::Limited,
            frame_rate_hz: 30.0,
            interlaced: false,
        }
    }

    /// A color in BT.709, limited range, from the standard's own equations.
    fn yuv_of([r, g, b]: Rgb8) -> [u8; 3] {
        let [r, g, b] = [r, g, b].map(|level| f64::from(level) / 255.0);
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        let (u, v) = ((b - y) / 1.8556, (r - y) / 1.5748);
        [16.0 + 219.0 * y, 128.0 + 224.0 * u, 128.0 + 224.0 * v].map(|level| level.round() as u8)
    }

    const COLOR: Rgb8 = [180, 90, 70];

    fn bytes_of(mode: &Mode) -> Vec<u8> {
        let [y, u, v] = yuv_of(COLOR);
        let (row, rows) = mode.layout.rows(mode.width, mode.height).unwrap();
        let mut bytes = Vec::new();
        for line in 0..rows {
            let cell: &[u8] = match mode.layout {
                Layout::Rgb24 => &COLOR,
                Layout::Bgr24 => &[70, 90, 180],
                Layout::Yuyv => &[y, u, y, v],
                Layout::Uyvy => &[u, y, v, y],
                Layout::Nv12 if line < mode.height => &[y],
                Layout::Nv12 => &[u, v],
                Layout::Mjpeg => unreachable!(),
            };
            let mut one: Vec<u8> = cell.iter().copied().cycle().take(row).collect();
            // Padding that would be seen.
            one.resize(mode.stride, 255);
            bytes.extend(one);
        }
        bytes
    }

    #[test]
    fn every_layout_shows_the_color_that_went_in_with_and_without_padding() {
        for layout in Layout::ALL.into_iter().filter(|layout| *layout != Layout::Mjpeg) {
            for padding in [0, 12] {
                let mode = mode(layout, 66, 8, padding);
                let mut bytes = bytes_of(&mode);
                // Drivers may leave out the padding of the last row.
                bytes.truncate(bytes.len() - padding);
                let mut out = Image::filled(0, 0, [0; 3]);
                rgb_from_bytes(&bytes, &mode, &mut out).unwrap();
                assert_eq!(out.size(), (66, 8));
                let worst = out
                    .pixels()
                    .iter()
                    .flat_map(|pixel| (0..3).map(|c| pixel[c].abs_diff(COLOR[c])))
                    .max();
                // Rounding of Y, U and V by half a level each: 0.5 (1.164 + 2.112) at most for blue.
                assert!(worst <= Some(2), "{layout:?} {padding}: {worst:?}");
                bytes.pop();
                let short = rgb_from_bytes(&bytes, &mode, &mut out);
                assert!(matches!(short, Err(PixelError::Short { .. })), "{layout:?}: {short:?}");
            }
        }
    }

    fn jpeg(width: u32, height: u32) -> Vec<u8> {
        let picture = image::RgbImage::from_pixel(width, height, image::Rgb(COLOR));
        let mut bytes = std::io::Cursor::new(Vec::new());
        DynamicImage::ImageRgb8(picture)
            .write_to(&mut bytes, ImageFormat::Jpeg)
            .unwrap();
        bytes.into_inner()
    }

    /// The same file without its Huffman tables, as many cameras send it (the tables of ITU-T T.81, annex K, are meant then).
    fn without_tables(bytes: &[u8]) -> Vec<u8> {
        let (mut at, mut out) = (2, bytes[..2].to_vec());
        while bytes[at + 1] != 0xda {
            let length = 2 + usize::from(bytes[at + 2]) * 256 + usize::from(bytes[at + 3]);
            if bytes[at + 1] != 0xc4 {
                out.extend(&bytes[at..at + length]);
            }
            at += length;
        }
        out.extend(&bytes[at..]);
        out
    }

    #[test]
    fn jpeg_pictures_are_decoded_with_and_without_tables_and_damaged_ones_refused() {
        let mode = mode(Layout::Mjpeg, 64, 48, 0);
        let mut out = Image::filled(0, 0, [0; 3]);
        let whole = jpeg(64, 48);
        for bytes in [whole.clone(), without_tables(&whole)] {
            rgb_from_bytes(&bytes, &mode, &mut out).unwrap();
            assert!(
                out.pixels()
                    .iter()
                    .all(|pixel| (0..3).all(|c| pixel[c].abs_diff(COLOR[c]) <= 4))
            );
        }
        for bytes in [jpeg(32, 48), whole[..30].to_vec(), vec![0; 100], Vec::new()] {
            assert!(matches!(rgb_from_bytes(&bytes, &mode, &mut out), Err(PixelError::Jpeg(_))));
        }
    }
}
