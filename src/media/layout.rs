//! How cameras lay out their pictures, and a picture laid out so.

use crate::image::buffer::{Image, Rgb8};

/// How a camera's pictures lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Layout {
    /// Packed 4:2:2, Y first.
    Yuyv,
    /// Packed 4:2:2, U first.
    Uyvy,
    /// 4:2:0, a plane of Y, then one of U and V in turn.
    Nv12,
    /// A JPEG file for each frame.
    Mjpeg,
    /// Red, green, blue.
    Rgb24,
    /// Blue, green, red.
    Bgr24,
}

impl Layout {
    /// All of them, the best for us first: what needs least work, and keeps most color.
    pub const ALL: [Self; 6] = [Self::Rgb24, Self::Bgr24, Self::Yuyv, Self::Uyvy, Self::Nv12, Self::Mjpeg];

    /// Bytes of a row without padding, and rows of that length in a picture; `None` where that is not fixed.
    pub fn rows(self, width: usize, height: usize) -> Option<(usize, usize)> {
        match self {
            Self::Yuyv | Self::Uyvy => Some((width.div_ceil(2) * 4, height)),
            Self::Nv12 => Some((width, height + height.div_ceil(2))),
            Self::Rgb24 | Self::Bgr24 => Some((3 * width, height)),
            Self::Mjpeg => None,
        }
    }

    /// As drivers name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Yuyv => "YUYV",
            Self::Uyvy => "UYVY",
            Self::Nv12 => "NV12",
            Self::Mjpeg => "MJPG",
            Self::Rgb24 => "RGB3",
            Self::Bgr24 => "BGR3",
        }
    }
}

/// By which matrix colors were mixed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matrix {
    /// ITU-R BT.601.
    Bt601,
    /// ITU-R BT.709.
    Bt709,
    /// ITU-R BT.2020.
    Bt2020,
}

/// Between which levels black and white lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Range {
    /// 16 and 235.
    Limited,
    /// 0 and 255.
    Full,
}

/// Lay a picture out as packed RGB, BGR or 4:2:2 with rows `stride` bytes apart; false when `out` is too short or the layout is another.
/// 4:2:2 is limited range; a row's odd last pixel stands twice.
pub fn lay_out(picture: &Image<Rgb8>, layout: Layout, matrix: Matrix, stride: usize, out: &mut [u8]) -> bool {
    let (width, height) = picture.size();
    let Some((row, rows)) = layout.rows(width, height) else {
        return false;
    };
    if stride < row || rows == 0 || out.len() < (rows - 1) * stride + row {
        return false;
    }
    let mixed = Mixing::by(matrix);
    for (y, to) in out.chunks_mut(stride).take(height).enumerate() {
        let from = picture.row(y);
        match layout {
            Layout::Rgb24 => to.iter_mut().zip(from.as_flattened()).for_each(|(to, from)| *to = *from),
            Layout::Bgr24 => {
                for (to, [r, g, b]) in to.chunks_exact_mut(3).zip(from) {
                    to.copy_from_slice(&[*b, *g, *r]);
                }
            }
            Layout::Yuyv => {
                for (to, pair) in to.chunks_exact_mut(4).zip(from.chunks(2)) {
                    let (Some(&first), Some(&second)) = (pair.first(), pair.last()) else {
                        break;
                    };
                    let [u, v] = mixed.chroma(first, second);
                    to.copy_from_slice(&[mixed.luma(first), u, mixed.luma(second), v]);
                }
            }
            Layout::Uyvy | Layout::Nv12 | Layout::Mjpeg => return false,
        }
    }
    true
}

/// Weights of red, green and blue in Y, U and V, limited range, in 1/65536 (ITU-R BT.601, BT.709, BT.2020: from their Kr and Kb).
struct Mixing([[i32; 3]; 3]);

impl Mixing {
    fn by(matrix: Matrix) -> Self {
        let (kr, kb) = match matrix {
            Matrix::Bt601 => (0.299, 0.114),
            Matrix::Bt709 => (0.2126, 0.0722),
            Matrix::Bt2020 => (0.2627, 0.0593),
        };
        let kg = 1.0 - kr - kb;
        let (luma, chroma) = (219.0 / 255.0, 224.0 / 255.0);
        let (u, v) = (chroma / (2.0 * (1.0 - kb)), chroma / (2.0 * (1.0 - kr)));
        let rows = [
            [luma * kr, luma * kg, luma * kb],
            [-u * kr, -u * kg, u * (1.0 - kb)],
            [v * (1.0 - kr), -v * kg, -v * kb],
        ];
        Self(rows.map(|row| row.map(|weight| f64::round(65536.0 * weight) as i32)))
    }

    fn sum(weights: &[i32; 3], [r, g, b]: [i32; 3]) -> i32 {
        weights[0] * r + weights[1] * g + weights[2] * b
    }

    fn luma(&self, pixel: Rgb8) -> u8 {
        let sum = Self::sum(&self.0[0], pixel.map(i32::from));
        (16 + ((sum + (1 << 15)) >> 16)).clamp(0, 255) as u8
    }

    /// Of the mean of two pixels.
    fn chroma(&self, first: Rgb8, second: Rgb8) -> [u8; 2] {
        let both = [0, 1, 2].map(|channel| i32::from(first[channel]) + i32::from(second[channel]));
        [&self.0[1], &self.0[2]].map(|weights| {
            let sum = Self::sum(weights, both);
            (128 + ((sum + (1 << 16)) >> 17)).clamp(0, 255) as u8
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_are_mixed_as_the_standard_says() {
        // From BT.709's own equations, limited range.
        let [r, g, b] = [180.0, 90.0, 70.0].map(|level: f64| level / 255.0);
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        let expected = [
            16.0 + 219.0 * y,
            128.0 + 224.0 * (b - y) / 1.8556,
            128.0 + 224.0 * (r - y) / 1.5748,
        ];
        let [y, u, v] = expected.map(|level| level.round() as u8);
        let picture = Image::filled(3, 2, [180, 90, 70]);
        let mut out = vec![9; 2 * 10];
        assert!(lay_out(&picture, Layout::Yuyv, Matrix::Bt709, 10, &mut out));
        assert_eq!(out[..10], [y, u, y, v, y, u, y, v, 9, 9]);
        assert_eq!(out[10..18], out[..8]);
    }

    #[test]
    fn rows_keep_their_distance_and_what_does_not_fit_is_refused() {
        let mut picture = Image::filled(2, 2, [1, 2, 3]);
        picture.set(1, 1, [7, 8, 9]);
        let mut out = vec![0; 8 + 6];
        assert!(lay_out(&picture, Layout::Rgb24, Matrix::Bt601, 8, &mut out));
        assert_eq!(out, [1, 2, 3, 1, 2, 3, 0, 0, 1, 2, 3, 7, 8, 9]);
        assert!(lay_out(&picture, Layout::Bgr24, Matrix::Bt601, 6, &mut out));
        assert_eq!(out[6..12], [3, 2, 1, 9, 8, 7]);
        assert!(!lay_out(&picture, Layout::Rgb24, Matrix::Bt601, 8, &mut out[..13]));
        assert!(!lay_out(&picture, Layout::Rgb24, Matrix::Bt601, 5, &mut out));
        assert!(!lay_out(&picture, Layout::Mjpeg, Matrix::Bt601, 8, &mut out));
    }
}
