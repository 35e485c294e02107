//! The picture at the size at which it is looked at.
//!
//! What the detector asks for are cores and halos some pixels wide, and what the light field knows is no finer than its views and their
//! depth: above [`WORKING_WIDTH_PX`] looking at every pixel costs much and shows little more. The picture itself keeps its size: what was
//! found is carried back.

use std::ops::Range;

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::wide;

/// Pictures are looked at at about this width, px.
const WORKING_WIDTH_PX: f32 = 960.0;

/// Picture pixels along a pixel of the picture as it is looked at.
pub fn reduction_for(width: usize) -> usize {
    reduction_to(width, WORKING_WIDTH_PX)
}

/// By how much a picture is reduced for a width of about `wanted_px`.
pub fn reduction_to(width: usize, wanted_px: f32) -> usize {
    (width as f32 / wanted_px).round().max(1.0) as usize
}

/// Size of a picture reduced by `step`, squares cut off by its right and lower border counted.
pub fn reduced_size((width, height): (usize, usize), step: usize) -> (usize, usize) {
    (width.div_ceil(step), height.div_ceil(step))
}

/// Mean colors of the squares of `step` by `step` pixels; `out` has the reduced size.
pub fn mean_of_squares(image: &Image<Rgb8>, step: usize, out: &mut Image<Rgb8>) {
    let width = out.width().max(1);
    let rows = out.pixels_mut().par_chunks_mut(width).enumerate();
    rows.with_min_len(16).for_each(|(y, out)| {
        if step == 2 && 2 * y + 1 < image.height() {
            let (upper, lower) = (image.row(2 * y), image.row(2 * y + 1));
            wide::run(MeanOfPairs { upper, lower, out });
            if image.width() % 2 == 1 {
                mean_of_lines(image, (width - 1, y), step, &mut out[width - 1..]);
            }
        } else {
            mean_of_lines(image, (0, y), step, out);
        }
    });
}

/// A row of whole squares of two by two, by far the most usual.
struct MeanOfPairs<'a> {
    upper: &'a [Rgb8],
    lower: &'a [Rgb8],
    out: &'a mut [Rgb8],
}

/// So many squares at a time, within registers.
const CHUNK: usize = 16;

impl wide::Kernel for MeanOfPairs<'_> {
    #[inline(always)]
    fn run(self) {
        let (upper, lower) = (self.upper.as_flattened(), self.lower.as_flattened());
        let chunks = self
            .out
            .chunks_mut(CHUNK)
            .zip(upper.chunks(6 * CHUNK))
            .zip(lower.chunks(6 * CHUNK));
        for ((out, upper), lower) in chunks {
            let mut columns = [0_u16; 6 * CHUNK];
            for ((sum, &a), &b) in columns.iter_mut().zip(upper).zip(lower) {
                *sum = u16::from(a) + u16::from(b);
            }
            for (out, pair) in out.iter_mut().zip(columns.as_chunks::<6>().0) {
                for c in 0..3 {
                    out[c] = ((pair[c] + pair[3 + c] + 2) / 4) as u8;
                }
            }
        }
    }
}

/// Reduced pixels from (x, y) on.
fn mean_of_lines(image: &Image<Rgb8>, (x, y): (usize, usize), step: usize, out: &mut [Rgb8]) {
    let rows = y * step..((y + 1) * step).min(image.height());
    for (x, out) in (x..).zip(out) {
        *out = mean_of(image, x * step..((x + 1) * step).min(image.width()), rows.clone());
    }
}

/// Mean color of a rectangle, rounded to the nearest level.
pub fn mean_of(image: &Image<Rgb8>, columns: Range<usize>, rows: Range<usize>) -> Rgb8 {
    let count = (columns.len() * rows.len()).max(1) as u32;
    sum_of(image, columns, rows).map(|sum| ((sum + count / 2) / count) as u8)
}

/// Sum of the colors of a rectangle.
#[inline(always)]
pub fn sum_of(image: &Image<Rgb8>, columns: Range<usize>, rows: Range<usize>) -> [u32; 3] {
    let mut sum = [0; 3];
    for y in rows {
        for pixel in &image.row(y)[columns.clone()] {
            for c in 0..3 {
                sum[c] += u32::from(pixel[c]);
            }
        }
    }
    sum
}

/// The least value of each square: a square is inside only if all of it is.
pub fn least_of_squares(mask: &Mask, step: usize) -> Mask {
    let (width, height) = reduced_size(mask.size(), step);
    let mut out = Image::filled(width, height, u8::MAX);
    for y in 0..mask.height() {
        for (out, square) in out.row_mut(y / step).iter_mut().zip(mask.row(y).chunks(step)) {
            *out = square.iter().fold(*out, |least, &value| least.min(value));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize, seed: u32) -> u8 {
        ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(seed).wrapping_mul(40_503) >> 13) as u8
    }

    #[test]
    fn squares_are_averaged_as_the_plainest_way_does_it() {
        for (width, height, step) in [(64, 30, 2), (63, 31, 2), (1, 1, 2), (50, 29, 3), (40, 20, 4)] {
            let pixels = (0..width * height).map(|i| [noise(i, 1), noise(i, 2), noise(i, 3)]);
            let image = Image::from_vec(width, height, pixels.collect()).unwrap();
            let (across, down) = reduced_size(image.size(), step);
            let mut out = Image::filled(across, down, [0; 3]);
            mean_of_squares(&image, step, &mut out);
            for y in 0..down {
                for x in 0..across {
                    for c in 0..3 {
                        let (columns, rows) = (x * step..((x + 1) * step).min(width), y * step..((y + 1) * step).min(height));
                        let square = rows.flat_map(|v| columns.clone().map(move |u| (u, v)));
                        let values: Vec<f64> = square.map(|(u, v)| f64::from(image.at(u, v)[c])).collect();
                        let mean = values.iter().sum::<f64>() / values.len() as f64;
                        assert!((f64::from(out.at(x, y)[c]) - mean).abs() <= 0.5, "({x}, {y}) of {width}");
                    }
                }
            }
        }
    }

    #[test]
    fn one_pixel_outside_puts_its_square_outside() {
        let mut mask = Image::filled(31, 17, 255);
        mask.set(30, 16, 0);
        mask.set(5, 4, 0);
        let out = least_of_squares(&mask, 2);
        assert_eq!(out.size(), (16, 9));
        let outside: Vec<_> = (0..9)
            .flat_map(|y| (0..16).map(move |x| (x, y)))
            .filter(|&(x, y)| out.at(x, y) == 0)
            .collect();
        assert_eq!(outside, [(2, 2), (15, 8)]);
    }

    #[test]
    fn only_wide_pictures_are_reduced() {
        let steps = [320, 960, 1280, 1920, 3840].map(reduction_for);
        assert_eq!(steps, [1, 1, 1, 2, 4]);
    }
}
