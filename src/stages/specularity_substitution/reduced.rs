//! The frame at the size at which the substitution works.
//!
//! What the light field knows is no finer than its views and their depth; above [`WORKING_WIDTH_PX`] looking at every pixel costs much and
//! shows little more. The picture itself keeps its size: what was found is carried back in `replacement`.

use rayon::prelude::*;

use crate::camera::model::CameraModel;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::wide;

/// The substitution works on a picture of about this width, px.
const WORKING_WIDTH_PX: f32 = 960.0;

/// Picture pixels along a pixel of the reduced picture.
pub fn reduction_for(width: usize) -> usize {
    (width as f32 / WORKING_WIDTH_PX).round().max(1.0) as usize
}

/// A frame whose pixels are means over squares of the picture's; keeps its memory.
#[derive(Debug)]
pub struct Reduced {
    /// Mean colours.
    pub image: Image<Rgb8>,
    /// 255 where any pixel of the square is specular.
    pub specular: Mask,
    /// 255 where any pixel of the square is forbidden.
    pub forbidden: Mask,
}

impl Default for Reduced {
    fn default() -> Self {
        Self {
            image: Image::filled(0, 0, [0; 3]),
            specular: Image::filled(0, 0, 0),
            forbidden: Image::filled(0, 0, 0),
        }
    }
}

impl Reduced {
    /// Reduce what is marked in a frame by `step`.
    pub fn take_masks(&mut self, step: usize, specular: &Mask, forbidden: &Mask) {
        any_of_squares(specular, step, &mut self.specular);
        any_of_squares(forbidden, step, &mut self.forbidden);
    }
}

/// The camera of a picture reduced by `step`, partial squares at its right and lower border counted.
pub fn reduced_camera(camera: &CameraModel, step: usize) -> CameraModel {
    CameraModel {
        width: camera.width.div_ceil(step),
        height: camera.height.div_ceil(step),
        ..camera.scaled(1.0 / step as f64)
    }
}

fn fit<P: Copy>(out: &mut Image<P>, (width, height): (usize, usize), value: P) {
    if out.size() != (width, height) {
        out.resize(width, height, value);
    }
}

/// So many pixels of a row are reduced together or not at all.
const CHUNK: usize = 16;

/// Reduce a picture by `step` where it will be looked at: where `distance`, of the reduced picture, is at most `reach`, and near there.
pub fn mean_of_squares(image: &Image<Rgb8>, step: usize, (distance, reach): (&Image<u16>, u16), out: &mut Image<Rgb8>) {
    let (width, height) = (image.width().div_ceil(step), image.height().div_ceil(step));
    fit(out, (width, height), [0; 3]);
    let rows = out.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
    rows.with_min_len(16).for_each(|(y, out)| {
        let distances = distance.row(y).chunks(CHUNK);
        for (i, (out, distances)) in out.chunks_mut(CHUNK).zip(distances).enumerate() {
            if distances.iter().all(|&d| d > reach) {
                continue;
            }
            let (begin, end) = (2 * CHUNK * i, 2 * CHUNK * (i + 1));
            if step == 2 && end <= image.width() && 2 * y + 1 < image.height() {
                let (upper, lower) = (&image.row(2 * y)[begin..end], &image.row(2 * y + 1)[begin..end]);
                wide::run(MeanOfPairs { upper, lower, out });
            } else {
                mean_of_lines(image, (i * CHUNK, y), step, out);
            }
        }
    });
}

/// A chunk of squares of two by two, by far the most usual.
struct MeanOfPairs<'a> {
    upper: &'a [Rgb8],
    lower: &'a [Rgb8],
    out: &'a mut [Rgb8],
}

impl wide::Kernel for MeanOfPairs<'_> {
    #[inline(always)]
    fn run(self) {
        let mut columns = [0_u16; 6 * CHUNK];
        let (upper, lower) = (self.upper.as_flattened(), self.lower.as_flattened());
        for ((sum, &a), &b) in columns.iter_mut().zip(upper).zip(lower) {
            *sum = u16::from(a) + u16::from(b);
        }
        for (out, pair) in self.out.iter_mut().zip(columns.chunks_exact(6)) {
            for c in 0..3 {
                out[c] = ((pair[c] + pair[3 + c] + 2) / 4) as u8;
            }
        }
    }
}

/// Reduced pixels from (x, y) on.
fn mean_of_lines(image: &Image<Rgb8>, (x, y): (usize, usize), step: usize, out: &mut [Rgb8]) {
    for (x, out) in (x..).zip(out) {
        let (mut sum, mut count) = ([0_u32; 3], 0);
        for v in y * step..((y + 1) * step).min(image.height()) {
            for pixel in &image.row(v)[x * step..((x + 1) * step).min(image.width())] {
                for (sum, &channel) in sum.iter_mut().zip(pixel) {
                    *sum += u32::from(channel);
                }
                count += 1;
            }
        }
        *out = sum.map(|s| ((s + count / 2) / count.max(1)) as u8);
    }
}

fn any_of_squares(mask: &Mask, step: usize, out: &mut Mask) {
    let (width, height) = (mask.width().div_ceil(step), mask.height().div_ceil(step));
    fit(out, (width, height), 0);
    let rows = out.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
    rows.with_min_len(16).for_each(|(y, out)| {
        out.fill(0);
        for y in y * step..((y + 1) * step).min(mask.height()) {
            wide::run(AnyOfRow {
                row: mask.row(y),
                step,
                out,
            });
        }
    });
}

struct AnyOfRow<'a> {
    row: &'a [u8],
    step: usize,
    out: &'a mut [u8],
}

impl wide::Kernel for AnyOfRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { row, step, out } = self;
        if step == 2 {
            // By far the most usual; the compiler makes vectors of it.
            for (out, pair) in out.iter_mut().zip(row.chunks_exact(2)) {
                *out |= pair[0] | pair[1];
            }
            if let ([last], Some(out)) = (row.chunks_exact(2).remainder(), out.last_mut()) {
                *out |= last;
            }
        } else {
            for (out, square) in out.iter_mut().zip(row.chunks(step)) {
                *out |= square.iter().fold(0, |any, value| any | value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: usize, seed: u32) -> u8 {
        ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(seed).wrapping_mul(40_503) >> 13) as u8
    }

    #[test]
    fn squares_are_averaged_as_the_plainest_way_does_it() {
        for (width, height, step) in [(64, 30, 2), (63, 31, 2), (50, 29, 3), (40, 20, 4)] {
            let pixels = (0..width * height).map(|i| [noise(i, 1), noise(i, 2), noise(i, 3)]);
            let image = Image::from_vec(width, height, pixels.collect()).unwrap();
            let mut out = Image::filled(0, 0, [0; 3]);
            let near = Image::filled(width.div_ceil(step), height.div_ceil(step), 0);
            mean_of_squares(&image, step, (&near, 0), &mut out);
            assert_eq!(out.size(), (width.div_ceil(step), height.div_ceil(step)));
            for y in 0..out.height() {
                for x in 0..out.width() {
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
    fn one_marked_pixel_marks_its_square() {
        let mut mask = Image::filled(31, 17, 0);
        mask.set(30, 16, 255);
        mask.set(5, 4, 255);
        let mut out = Image::filled(0, 0, 0);
        any_of_squares(&mask, 2, &mut out);
        let marked: Vec<_> = (0..9)
            .flat_map(|y| (0..16).map(move |x| (x, y)))
            .filter(|&(x, y)| out.at(x, y) != 0)
            .collect();
        assert_eq!(marked, [(2, 2), (15, 8)]);
    }
}
