//! Blurs of single-channel f32 images with cost independent of the radius.
//!
//! A running sum goes from pixel to pixel, so one row keeps only one lane of a vector register busy. Therefore rows are treated
//! [`LANES`] at a time, transposed into a strip that stays in the cache for all passes; columns need no transposing.

use crate::image::buffer::Image;
use crate::image::wide::{self, Kernel};

/// Rows, or columns, treated together.
const LANES: usize = 16;

/// One value of each of the rows (columns) treated together.
type Lanes = [f32; LANES];

/// Working memory of [`box_blur`]; keep it between calls so that nothing is allocated.
#[derive(Debug, Default)]
pub struct BlurScratch {
    strip: Vec<Lanes>,
    blurred: Vec<Lanes>,
}

/// Mean over a (2·radius + 1)² square, in place; at the border the mean of what lies inside the image.
pub fn box_blur(image: &mut Image<f32>, radius: usize, scratch: &mut BlurScratch) {
    repeated_box_blur(image, radius, 1, scratch);
}

/// Close to a Gaussian of the given standard deviation: three box blurs (Wells 1986). In place.
pub fn gaussian_blur(image: &mut Image<f32>, sigma_px: f32, scratch: &mut BlurScratch) {
    // Three boxes of width w have variance (w² − 1)/4.
    let radius = ((((4.0 * sigma_px * sigma_px + 1.0).sqrt()) - 1.0) / 2.0).round() as usize;
    repeated_box_blur(image, radius, 3, scratch);
}

/// Boxes along rows and boxes along columns commute, also at the border, so each way is done at once.
fn repeated_box_blur(image: &mut Image<f32>, radius: usize, passes: usize, scratch: &mut BlurScratch) {
    let (width, height) = image.size();
    if radius == 0 || width == 0 || height == 0 {
        return;
    }
    let longest = width.max(height);
    if scratch.strip.len() < longest {
        scratch.strip.resize(longest, [0.0; LANES]);
        scratch.blurred.resize(longest, [0.0; LANES]);
    }
    wide::run(BothWays {
        image,
        radius,
        passes,
        scratch,
    });
}

struct BothWays<'a> {
    image: &'a mut Image<f32>,
    radius: usize,
    passes: usize,
    scratch: &'a mut BlurScratch,
}

impl Kernel for BothWays<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            image,
            radius,
            passes,
            scratch,
        } = self;
        let (width, height) = image.size();
        let BlurScratch { strip, blurred } = scratch;
        let (strip, blurred) = (&mut strip[..width.max(height)], &mut blurred[..width.max(height)]);
        for rows in image.pixels_mut().chunks_mut(LANES * width) {
            for left in (0..width).step_by(LANES) {
                for (lane, row) in rows.chunks_exact(width).enumerate().take(LANES) {
                    match row[left..].first_chunk::<LANES>() {
                        Some(values) => (0..LANES).for_each(|i| strip[left + i][lane] = values[i]),
                        None => (left..width).for_each(|x| strip[x][lane] = row[x]),
                    }
                }
            }
            boxes(&mut strip[..width], &mut blurred[..width], radius, passes);
            for left in (0..width).step_by(LANES) {
                for (lane, row) in rows.chunks_exact_mut(width).enumerate().take(LANES) {
                    match row[left..].first_chunk_mut::<LANES>() {
                        Some(values) => (0..LANES).for_each(|i| values[i] = blurred[left + i][lane]),
                        None => (left..width).for_each(|x| row[x] = blurred[x][lane]),
                    }
                }
            }
        }
        for left in (0..width).step_by(LANES) {
            for (place, row) in strip.iter_mut().zip(image.pixels().chunks_exact(width)) {
                match row[left..].first_chunk::<LANES>() {
                    Some(values) => *place = *values,
                    None => place[..width - left].copy_from_slice(&row[left..]),
                }
            }
            boxes(&mut strip[..height], &mut blurred[..height], radius, passes);
            for (place, row) in blurred.iter().zip(image.pixels_mut().chunks_exact_mut(width)) {
                match row[left..].first_chunk_mut::<LANES>() {
                    Some(values) => *values = *place,
                    None => row[left..].copy_from_slice(&place[..width - left]),
                }
            }
        }
    }
}

/// An odd number of box means along a strip, from `strip` into `out`; `strip` is used up.
#[inline(always)]
fn boxes(strip: &mut [Lanes], out: &mut [Lanes], radius: usize, passes: usize) {
    box_mean(strip, out, radius);
    for _ in 1..passes.div_ceil(2) {
        box_mean(out, strip, radius);
        box_mean(strip, out, radius);
    }
}

/// Mean over 2·radius + 1 places; at the ends over those that there are.
#[inline(always)]
fn box_mean(source: &[Lanes], out: &mut [Lanes], radius: usize) {
    let n = source.len();
    let mut sum = [0.0; LANES];
    for place in source.iter().take(radius) {
        add(&mut sum, place);
    }
    // Entering, whole and leaving stretches have no decisions to make inside.
    let whole = 1.0 / (2 * radius + 1) as f32;
    let (inner_begin, inner_end) = (radius + 1, n.saturating_sub(radius));
    let ends = (0..n.min(inner_begin)).chain(inner_end.max(inner_begin).min(n)..n);
    let end = |at: usize, sum: &mut Lanes, out: &mut [Lanes]| {
        if at + radius < n {
            add(sum, &source[at + radius]);
        }
        if at > radius {
            subtract(sum, &source[at - radius - 1]);
        }
        let count = (at + radius).min(n - 1) + 1 - at.saturating_sub(radius);
        out[at] = scaled(sum, 1.0 / count as f32);
    };
    for at in ends.clone().take_while(|at| *at < inner_begin) {
        end(at, &mut sum, out);
    }
    if inner_begin < inner_end {
        let entering = &source[inner_begin + radius..];
        // A copy that nothing points to can stay in registers.
        let mut running = sum;
        for ((out, entering), leaving) in out[inner_begin..inner_end].iter_mut().zip(entering).zip(source) {
            for lane in 0..LANES {
                // The difference first: the sum then waits for one addition a step, not for two.
                running[lane] += entering[lane] - leaving[lane];
                out[lane] = running[lane] * whole;
            }
        }
        sum = running;
    }
    for at in ends.skip_while(|at| *at < inner_begin) {
        end(at, &mut sum, out);
    }
}

#[inline(always)]
fn add(sum: &mut Lanes, place: &Lanes) {
    for lane in 0..LANES {
        sum[lane] += place[lane];
    }
}

#[inline(always)]
fn subtract(sum: &mut Lanes, place: &Lanes) {
    for lane in 0..LANES {
        sum[lane] -= place[lane];
    }
}

#[inline(always)]
fn scaled(sum: &Lanes, scale: f32) -> Lanes {
    std::array::from_fn(|lane| sum[lane] * scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reference_box_blur(image: &Image<f32>, radius: isize) -> Image<f32> {
        let (width, height) = image.size();
        let mut out = Image::filled(width, height, 0.0);
        for y in 0..height as isize {
            for x in 0..width as isize {
                let mut rows = 0.0;
                let mut total = 0.0;
                for v in (y - radius).max(0)..=(y + radius).min(height as isize - 1) {
                    let mut sum = 0.0;
                    let mut count = 0.0;
                    for u in (x - radius).max(0)..=(x + radius).min(width as isize - 1) {
                        sum += image.at(u as usize, v as usize);
                        count += 1.0;
                    }
                    total += sum / count;
                    rows += 1.0;
                }
                out.set(x as usize, y as usize, total / rows);
            }
        }
        out
    }

    #[test]
    fn equals_its_naive_twin() {
        for (width, height, radius) in [(17, 11, 2), (5, 9, 7), (1, 6, 1), (40, 3, 5)] {
            let pixels = (0..width * height).map(|i| ((i * 7919) % 251) as f32).collect();
            let mut image = Image::from_vec(width, height, pixels).unwrap();
            let expected = reference_box_blur(&image, radius as isize);
            box_blur(&mut image, radius, &mut BlurScratch::default());
            for (a, b) in image.pixels().iter().zip(expected.pixels()) {
                assert!((a - b).abs() < 1e-2, "{a} against {b}");
            }
        }
    }
}
