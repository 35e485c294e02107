//! Colour tags of a video, and pixels between its format and RGB.
//!
//! Y'CbCr is a linear mix of gamma-encoded R'G'B' by one of a few matrices (ITU-R BT.601, BT.709, BT.2020), in full (0–255)
//! or limited range (luma 16–235, chroma 16–240). A wrong matrix shifts reds and greens by up to 20 levels, a wrong range
//! changes contrast, so both are taken from the tags. Untagged video: BT.709 from 720 lines on, BT.601 below, as players do.
//!
//! 4:2:0 chroma is repeated on the way in and averaged over the same 2×2 pixels on the way out: what was not touched comes
//! back as it was, whatever the siting of the chroma samples.

use ffmpeg_next::color;
use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use yuv::{
    BufferStoreMut, YuvBiPlanarImage, YuvConversionMode, YuvError, YuvGrayImage, YuvPlanarImage, YuvPlanarImageMut, YuvRange,
    YuvStandardMatrix,
};

use crate::image::buffer::{Image, Rgb8};

/// Lines from which untagged video is taken for BT.709.
const HIGH_DEFINITION_LINES: usize = 720;

/// How a video codes colour, as its tags say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ColorTags {
    pub(crate) matrix: color::Space,
    pub(crate) range: color::Range,
    pub(crate) primaries: color::Primaries,
    pub(crate) transfer: color::TransferCharacteristic,
}

impl ColorTags {
    /// No tags at all.
    pub const UNTAGGED: Self = Self {
        matrix: color::Space::Unspecified,
        range: color::Range::Unspecified,
        primaries: color::Primaries::Unspecified,
        transfer: color::TransferCharacteristic::Unspecified,
    };

    /// For video made from pictures that are RGB: BT.709 from 720 lines on, else BT.601; limited range, all tagged.
    pub fn for_lines(lines: usize) -> Self {
        if lines >= HIGH_DEFINITION_LINES {
            Self {
                matrix: color::Space::BT709,
                range: color::Range::MPEG,
                primaries: color::Primaries::BT709,
                transfer: color::TransferCharacteristic::BT709,
            }
        } else {
            Self {
                matrix: color::Space::SMPTE170M,
                range: color::Range::MPEG,
                primaries: color::Primaries::SMPTE170M,
                transfer: color::TransferCharacteristic::SMPTE170M,
            }
        }
    }

    /// As a decoded frame says; formats that are full range by definition count as tagged so.
    pub(crate) fn of_frame(frame: &frame::Video) -> Self {
        let format = frame.format();
        if is_rgb(format) {
            return Self::for_lines(frame.height() as usize);
        }
        let range = if is_full_range_format(format) {
            color::Range::JPEG
        } else {
            frame.color_range()
        };
        Self {
            matrix: frame.color_space(),
            range,
            primaries: frame.color_primaries(),
            transfer: frame.color_transfer_characteristic(),
        }
    }

    /// The matrix by name, e.g. `bt709`; `unknown` when untagged.
    pub fn matrix_name(&self) -> &'static str {
        self.matrix.name().unwrap_or("unknown")
    }

    /// `tv`, `pc` or `unknown`.
    pub fn range_name(&self) -> &'static str {
        self.range.name().unwrap_or("unknown")
    }

    /// The matrix that is used, the untagged being decided by the number of lines.
    pub(crate) fn yuv_matrix(&self, lines: usize) -> YuvStandardMatrix {
        match self.matrix {
            color::Space::BT709 => YuvStandardMatrix::Bt709,
            color::Space::BT470BG | color::Space::SMPTE170M => YuvStandardMatrix::Bt601,
            color::Space::BT2020NCL | color::Space::BT2020CL => YuvStandardMatrix::Bt2020,
            color::Space::SMPTE240M => YuvStandardMatrix::Smpte240,
            color::Space::FCC => YuvStandardMatrix::Fcc,
            _ if lines >= HIGH_DEFINITION_LINES => YuvStandardMatrix::Bt709,
            _ => YuvStandardMatrix::Bt601,
        }
    }

    /// The range that is used; untagged is limited.
    pub(crate) fn yuv_range(&self) -> YuvRange {
        if self.range == color::Range::JPEG {
            YuvRange::Full
        } else {
            YuvRange::Limited
        }
    }

    /// Matrix and range by the names of libavfilter's `scale`.
    pub(crate) fn scale_options(&self, lines: usize) -> String {
        let matrix = match self.yuv_matrix(lines) {
            YuvStandardMatrix::Bt709 => "bt709",
            YuvStandardMatrix::Bt2020 => "bt2020",
            YuvStandardMatrix::Smpte240 => "smpte240m",
            YuvStandardMatrix::Fcc => "fcc",
            _ => "bt601",
        };
        let range = if self.range == color::Range::JPEG { "pc" } else { "tv" };
        format!("in_color_matrix={matrix}:in_range={range}")
    }
}

/// Formats that hold RGB, and need no matrix.
pub(crate) fn is_rgb(format: Pixel) -> bool {
    let name = format.descriptor().map_or("", |d| d.name());
    ["rgb", "bgr", "gbr", "argb", "abgr", "0rgb", "0bgr", "pal8", "bgr0", "rgb0"]
        .iter()
        .any(|start| name.starts_with(start))
}

fn is_full_range_format(format: Pixel) -> bool {
    matches!(
        format,
        Pixel::YUVJ420P | Pixel::YUVJ422P | Pixel::YUVJ444P | Pixel::YUVJ440P | Pixel::YUVJ411P | Pixel::GRAY8
    )
}

/// Bits per colour sample of a format.
pub(crate) fn bit_depth(format: Pixel) -> u32 {
    let Some(descriptor) = format.descriptor() else { return 8 };
    let name = descriptor.name();
    [(16, "16"), (14, "p14"), (12, "12"), (10, "10"), (9, "p9")]
        .iter()
        .find(|(_, mark)| name.contains(mark))
        .map_or(8, |&(bits, _)| if name == "nv16" { 8 } else { bits })
}

/// Whether [`rgb_from_frame`] knows the format; the rest goes through libswscale.
pub(crate) fn converts_directly(format: Pixel) -> bool {
    matches!(
        format,
        Pixel::YUV420P
            | Pixel::YUVJ420P
            | Pixel::YUV422P
            | Pixel::YUVJ422P
            | Pixel::YUV444P
            | Pixel::YUVJ444P
            | Pixel::NV12
            | Pixel::GRAY8
            | Pixel::YUV420P10LE
            | Pixel::YUV422P10LE
            | Pixel::RGB24
            | Pixel::GBRP
    )
}

/// A decoded frame as RGB, by its tags.
pub(crate) fn rgb_from_frame(frame: &frame::Video, tags: &ColorTags, out: &mut Image<Rgb8>) -> Result<(), String> {
    let (width, height) = (frame.width(), frame.height());
    let (range, matrix) = (tags.yuv_range(), tags.yuv_matrix(height as usize));
    let rgb_stride = width * 3;
    let rgb = out.as_bytes_mut();
    match frame.format() {
        Pixel::RGB24 => copy_rows(frame.data(0), frame.stride(0), rgb, rgb_stride as usize),
        Pixel::GBRP => {
            let rows = |plane: usize| frame.data(plane).chunks(frame.stride(plane).max(1));
            let planes = rows(2).zip(rows(0)).zip(rows(1));
            for (to, ((red, green), blue)) in rgb.chunks_exact_mut(rgb_stride as usize).zip(planes) {
                let samples = red.iter().zip(green).zip(blue);
                for (pixel, ((&red, &green), &blue)) in to.chunks_exact_mut(3).zip(samples) {
                    pixel.copy_from_slice(&[red, green, blue]);
                }
            }
            Ok(())
        }
        Pixel::GRAY8 => {
            let image = YuvGrayImage {
                y_plane: frame.data(0),
                y_stride: stride(frame, 0)?,
                width,
                height,
            };
            yuv::yuv400_to_rgb(&image, rgb, rgb_stride, YuvRange::Full, matrix).map_err(text)
        }
        Pixel::NV12 => {
            let image = YuvBiPlanarImage {
                y_plane: frame.data(0),
                y_stride: stride(frame, 0)?,
                uv_plane: frame.data(1),
                uv_stride: stride(frame, 1)?,
                width,
                height,
            };
            yuv::yuv_nv12_to_rgb(&image, rgb, rgb_stride, range, matrix, YuvConversionMode::Balanced).map_err(text)
        }
        Pixel::YUV420P10LE | Pixel::YUV422P10LE => {
            let planes = [words(frame.data(0))?, words(frame.data(1))?, words(frame.data(2))?];
            let strides = [stride(frame, 0)? / 2, stride(frame, 1)? / 2, stride(frame, 2)? / 2];
            let image = planar(planes, strides, width, height);
            let convert = if frame.format() == Pixel::YUV420P10LE {
                yuv::i010_to_rgb
            } else {
                yuv::i210_to_rgb
            };
            convert(&image, rgb, rgb_stride, range, matrix).map_err(text)
        }
        format => {
            let planes = [frame.data(0), frame.data(1), frame.data(2)];
            let image = planar(
                planes,
                [stride(frame, 0)?, stride(frame, 1)?, stride(frame, 2)?],
                width,
                height,
            );
            let convert = match format {
                Pixel::YUV420P | Pixel::YUVJ420P => yuv::yuv420_to_rgb,
                Pixel::YUV422P | Pixel::YUVJ422P => yuv::yuv422_to_rgb,
                Pixel::YUV444P | Pixel::YUVJ444P => yuv::yuv444_to_rgb,
                other => return Err(format!("no direct conversion from {other:?}")),
            };
            convert(&image, rgb, rgb_stride, range, matrix).map_err(text)
        }
    }
}

fn planar<T: Copy + std::fmt::Debug>(planes: [&[T]; 3], strides: [u32; 3], width: u32, height: u32) -> YuvPlanarImage<'_, T> {
    let [y_plane, u_plane, v_plane] = planes;
    let [y_stride, u_stride, v_stride] = strides;
    YuvPlanarImage {
        y_plane,
        y_stride,
        u_plane,
        u_stride,
        v_plane,
        v_stride,
        width,
        height,
    }
}

fn text(error: YuvError) -> String {
    error.to_string()
}

fn stride(frame: &frame::Video, plane: usize) -> Result<u32, String> {
    u32::try_from(frame.stride(plane)).map_err(|_| "rows stored bottom-up".to_owned())
}

fn words(bytes: &[u8]) -> Result<&[u16], String> {
    bytemuck::try_cast_slice(bytes).map_err(|error| error.to_string())
}

/// Copy rows between buffers of different row lengths; `to` is dense.
fn copy_rows(from: &[u8], from_stride: usize, to: &mut [u8], row: usize) -> Result<(), String> {
    if from_stride < row {
        return Err("rows stored bottom-up".to_owned());
    }
    for (source, target) in from.chunks(from_stride).zip(to.chunks_exact_mut(row)) {
        target.copy_from_slice(source.get(..row).ok_or("a row is cut off")?);
    }
    Ok(())
}

/// Y, Cb and Cr planes ready for an encoder, made from RGB.
#[derive(Debug)]
pub(crate) struct Planes {
    image: YuvPlanarImageMut<'static, u8>,
    subsampled: bool,
    range: YuvRange,
    matrix: YuvStandardMatrix,
}

impl Planes {
    /// 4:2:0 for even sizes; odd ones keep every chroma sample (4:4:4).
    pub(crate) fn new(width: usize, height: usize, tags: &ColorTags) -> Self {
        let subsampled = width.is_multiple_of(2) && height.is_multiple_of(2);
        let sampling = if subsampled {
            yuv::YuvChromaSubsampling::Yuv420
        } else {
            yuv::YuvChromaSubsampling::Yuv444
        };
        Self {
            image: YuvPlanarImageMut::alloc(width as u32, height as u32, sampling),
            subsampled,
            range: tags.yuv_range(),
            matrix: tags.yuv_matrix(height),
        }
    }

    pub(crate) fn subsampled(&self) -> bool {
        self.subsampled
    }

    /// Convert a picture of the size given to `new`.
    pub(crate) fn fill(&mut self, picture: &Image<Rgb8>) -> Result<(), String> {
        let convert = if self.subsampled {
            yuv::rgb_to_yuv420
        } else {
            yuv::rgb_to_yuv444
        };
        let row = 3 * picture.width() as u32;
        convert(
            &mut self.image,
            picture.as_bytes(),
            row,
            self.range,
            self.matrix,
            YuvConversionMode::Balanced,
        )
        .map_err(text)
    }

    /// Y, Cb, Cr, each with its row length.
    pub(crate) fn planes(&self) -> [(&[u8], usize); 3] {
        let i = &self.image;
        [
            (plane(&i.y_plane), i.y_stride as usize),
            (plane(&i.u_plane), i.u_stride as usize),
            (plane(&i.v_plane), i.v_stride as usize),
        ]
    }
}

fn plane<'a>(store: &'a BufferStoreMut<'static, u8>) -> &'a [u8] {
    store.borrow()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Y', Cb, Cr by the definition (BT.601 §2.5, BT.709 §3), in 8 bits.
    fn reference_yuv(rgb: Rgb8, red: f64, blue: f64, full: bool) -> [f64; 3] {
        let [r, g, b] = rgb.map(f64::from);
        let luma = red * r + (1.0 - red - blue) * g + blue * b;
        let (cb, cr) = ((b - luma) / (2.0 * (1.0 - blue)), (r - luma) / (2.0 * (1.0 - red)));
        if full {
            [luma, 128.0 + cb, 128.0 + cr]
        } else {
            [
                16.0 + luma * 219.0 / 255.0,
                128.0 + cb * 224.0 / 255.0,
                128.0 + cr * 224.0 / 255.0,
            ]
        }
    }

    fn tags(matrix: color::Space, full: bool) -> ColorTags {
        let range = if full { color::Range::JPEG } else { color::Range::MPEG };
        ColorTags {
            matrix,
            range,
            ..ColorTags::UNTAGGED
        }
    }

    #[test]
    fn planes_follow_the_definition() {
        let matrices = [(color::Space::SMPTE170M, 0.299, 0.114), (color::Space::BT709, 0.2126, 0.0722)];
        for (matrix, red, blue) in matrices {
            for full in [false, true] {
                let tags = tags(matrix, full);
                // 2x2 blocks of one colour, so that the chroma average is that of the colour.
                let side = 128;
                let color_of = |x: usize, y: usize| {
                    let (i, j) = (x / 2, y / 2);
                    [(i * 4) as u8, (j * 4) as u8, (i * 3 + j * 5) as u8]
                };
                let mut picture = Image::filled(side, side, [0; 3]);
                for y in 0..side {
                    for x in 0..side {
                        picture.set(x, y, color_of(x, y));
                    }
                }
                let mut planes = Planes::new(side, side, &tags);
                planes.fill(&picture).unwrap();
                let [y_plane, u_plane, v_plane] = planes.planes();
                let mut bias = [0.0; 3];
                for y in (0..side).step_by(2) {
                    for x in (0..side).step_by(2) {
                        let expected = reference_yuv(color_of(x, y), red, blue, full);
                        let found = [
                            y_plane.0[y * y_plane.1 + x],
                            u_plane.0[y / 2 * u_plane.1 + x / 2],
                            v_plane.0[y / 2 * v_plane.1 + x / 2],
                        ];
                        for ((bias, e), f) in bias.iter_mut().zip(expected).zip(found) {
                            assert!((e - f64::from(f)).abs() <= 1.25, "{matrix:?} {full}: {e} {f}");
                            *bias += (f64::from(f) - e) / (side * side / 4) as f64;
                        }
                    }
                }
                assert!(bias.iter().all(|b| b.abs() < 0.2), "{matrix:?} {full}: bias {bias:?}");
            }
        }
    }

    #[test]
    fn there_and_back_is_nearly_the_same() {
        let tags = tags(color::Space::BT709, false);
        let side = 64;
        let picture = Image::from_vec(
            side,
            side,
            (0..side * side)
                .map(|i| [(i / 256 * 16) as u8, (i % 64 / 2 * 8) as u8, 90])
                .collect(),
        )
        .unwrap();
        let mut planes = Planes::new(side, side, &tags);
        planes.fill(&picture).unwrap();
        let mut frame = frame::Video::new(Pixel::YUV420P, side as u32, side as u32);
        for (index, (plane, row)) in planes.planes().into_iter().enumerate() {
            let stride = frame.stride(index);
            for (from, to) in plane.chunks_exact(row).zip(frame.data_mut(index).chunks_mut(stride)) {
                to[..row].copy_from_slice(from);
            }
        }
        let mut back = Image::filled(side, side, [0; 3]);
        rgb_from_frame(&frame, &tags, &mut back).unwrap();
        let (mut bias, mut largest) = (0.0, 0);
        for (a, b) in back.as_bytes().iter().zip(picture.as_bytes()) {
            bias += (f64::from(*a) - f64::from(*b)) / (3 * side * side) as f64;
            largest = largest.max(a.abs_diff(*b));
        }
        assert!(largest <= 3 && bias.abs() < 0.35, "largest {largest}, bias {bias}");
    }
}
