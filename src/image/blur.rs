//! Blurs of single-channel f32 images with a cost that hardly depends on the radius.
//!
//! Columns: running sums go from row to row, in strips of columns that stay in the cache for all passes. Rows: a running sum would keep
//! only one lane of a vector register busy, so a window's sum is put together from those of 1, 2, 4, … pixels, each made by adding the
//! one before to itself, shifted. Beyond the border stand zeros, and each place has its own share to scale by.

use crate::image::buffer::Image;
use crate::image::wide::{self, Kernel};

/// Columns treated together.
const STRIP: usize = 64;

/// Working memory of [`box_blur`]; keep it between calls so that nothing is allocated.
#[derive(Debug, Default)]
pub struct BlurScratch {
    strips: [Vec<f32>; 2],
    /// Of the columns treated together.
    sums: Vec<f32>,
    rows: [Vec<f32>; 4],
    /// One over the number of places in the window around each place.
    shares: Vec<f32>,
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
    let strip_len = STRIP * (height + 2 * radius + 1);
    for strip in &mut scratch.strips {
        if strip.len() < strip_len {
            strip.resize(strip_len, 0.0);
        }
    }
    scratch.sums.resize(STRIP, 0.0);
    for row in &mut scratch.rows {
        if row.len() < width + 2 * radius {
            row.resize(width + 2 * radius, 0.0);
        }
    }
    set_shares(&mut scratch.shares, width, radius);
    wide::run(AlongRows {
        image,
        radius,
        passes,
        scratch,
    });
    set_shares(&mut scratch.shares, height, radius);
    wide::run(AlongColumns {
        image,
        radius,
        passes,
        scratch,
    });
}

fn set_shares(shares: &mut Vec<f32>, n: usize, radius: usize) {
    shares.clear();
    let count = |at: usize| (at + radius).min(n - 1) + 1 - at.saturating_sub(radius);
    shares.extend((0..n).map(|at| 1.0 / count(at) as f32));
}

struct AlongRows<'a> {
    image: &'a mut Image<f32>,
    radius: usize,
    passes: usize,
    scratch: &'a mut BlurScratch,
}

impl Kernel for AlongRows<'_> {
    #[inline(always)]
    fn run(self) {
        let width = self.image.width();
        let padded = width + 2 * self.radius;
        let BlurScratch {
            rows: [values, sums, doubled, window],
            shares,
            ..
        } = self.scratch;
        let (values, window) = (&mut values[..padded], &mut window[..width]);
        let (mut sums, mut doubled) = (&mut sums[..padded], &mut doubled[..padded]);
        values.fill(0.0);
        for row in self.image.pixels_mut().chunks_exact_mut(width) {
            values[self.radius..][..width].copy_from_slice(row);
            for _ in 0..self.passes {
                // The window's first pixel, then twos, fours, … as the bits of its length say.
                window.copy_from_slice(&values[..width]);
                let (mut covered, mut span) = (1, 1);
                while covered < 2 * self.radius + 1 {
                    let shorter: &[f32] = if span == 1 { values } else { sums };
                    for ((doubled, a), b) in doubled.iter_mut().zip(shorter).zip(&shorter[span..]) {
                        *doubled = a + b;
                    }
                    std::mem::swap(&mut sums, &mut doubled);
                    span *= 2;
                    if (2 * self.radius + 1) & span != 0 {
                        for (window, sum) in window.iter_mut().zip(&sums[covered..]) {
                            *window += sum;
                        }
                        covered += span;
                    }
                }
                let means = values[self.radius..][..width].iter_mut();
                for ((mean, sum), share) in means.zip(window.iter()).zip(shares.iter()) {
                    *mean = sum * share;
                }
            }
            row.copy_from_slice(&values[self.radius..][..width]);
        }
    }
}

struct AlongColumns<'a> {
    image: &'a mut Image<f32>,
    radius: usize,
    passes: usize,
    scratch: &'a mut BlurScratch,
}

impl Kernel for AlongColumns<'_> {
    #[inline(always)]
    fn run(self) {
        let (width, height) = self.image.size();
        // One row more above: what leaves the window at the first place.
        let (above, padded) = (self.radius + 1, height + 2 * self.radius + 1);
        let BlurScratch {
            strips: [strip, other],
            sums,
            shares,
            ..
        } = self.scratch;
        for left in (0..width).step_by(STRIP) {
            let columns = STRIP.min(width - left);
            let inner = columns * above..columns * (above + height);
            let (mut strip, mut other) = (&mut strip[..columns * padded], &mut other[..columns * padded]);
            for strip in [&mut *strip, &mut *other] {
                strip[..inner.start].fill(0.0);
                strip[inner.end..].fill(0.0);
            }
            let rows = self.image.pixels().chunks_exact(width);
            for (place, row) in strip[inner.clone()].chunks_exact_mut(columns).zip(rows) {
                place.copy_from_slice(&row[left..left + columns]);
            }
            for _ in 0..self.passes {
                box_mean(strip, &mut other[inner.clone()], &mut sums[..columns], self.radius, shares);
                std::mem::swap(&mut strip, &mut other);
            }
            let rows = self.image.pixels_mut().chunks_exact_mut(width);
            for (place, row) in strip[inner].chunks_exact(columns).zip(rows) {
                row[left..left + columns].copy_from_slice(place);
            }
        }
    }
}

/// Mean over 2·radius + 1 rows of as many columns as there are `sums`; `padded` has radius + 1 more rows before the first and radius
/// after the last.
#[inline(always)]
fn box_mean(padded: &[f32], out: &mut [f32], sums: &mut [f32], radius: usize, shares: &[f32]) {
    let columns = sums.len();
    let window = columns * (2 * radius + 1);
    sums.fill(0.0);
    for row in padded[..window].chunks_exact(columns) {
        for (sum, value) in sums.iter_mut().zip(row) {
            *sum += value;
        }
    }
    let entering = padded[window..].chunks_exact(columns);
    let rows = out.chunks_exact_mut(columns).zip(padded.chunks_exact(columns)).zip(entering);
    for (((out, leaving), entering), share) in rows.zip(shares) {
        let values = out.iter_mut().zip(sums.iter_mut()).zip(leaving.iter().zip(entering));
        for ((out, sum), (leaving, entering)) in values {
            *sum += entering - leaving;
            *out = *sum * share;
        }
    }
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
