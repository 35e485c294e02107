//! The detail of a picture, freed of its lighting, at several scales.
//!
//! The lamp rides on the camera, so the same tissue is brighter from near and darker from aside. What two pictures share is the
//! *ratio* of each pixel to its surroundings: detail = luminance / blurred luminance − 1. Both sides of an alignment use it.

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::wide::{self, Kernel};

/// Width of the finest scale, px, at most.
const FINEST_WIDTH_PX: usize = 480;
/// Scales, each half the one before.
pub const SCALES: usize = 3;
/// Surroundings: standard deviation of the blur, px of the scale.
const SURROUNDINGS_SIGMA_PX: f32 = 5.0;
/// Pixels treated at a time, within the first-level cache.
const CHUNK: usize = 192;
/// A mean of luma (in 1/256) below this is too dark to have detail.
const MIN_LEVEL: u32 = 8;

/// Which pixels of a picture take part. Masks of another size than the picture are not looked at.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usable<'a> {
    /// Not where one of these is set.
    pub without: [Option<&'a Mask>; 2],
    /// Only where this mask exceeds this level.
    pub within: Option<(&'a Mask, u8)>,
}

/// One scale.
#[derive(Clone, Debug)]
pub struct Scale {
    /// Picture pixels a pixel of this scale, along each axis.
    pub step: usize,
    /// Detail, relative units.
    pub detail: Image<f32>,
    /// 1 where the pixel and its surroundings are known, 0 where masked.
    pub weight: Image<f32>,
}

/// All scales, finest first; owns its working memory.
#[derive(Clone, Debug)]
pub struct DetailPyramid {
    /// The scales, finest first.
    pub scales: Vec<Scale>,
    luminance: Image<f32>,
    known: Image<f32>,
    blurred: Image<f32>,
}

fn plane() -> Image<f32> {
    Image::filled(0, 0, 0.0)
}

impl Default for DetailPyramid {
    fn default() -> Self {
        let scale = Scale {
            step: 1,
            detail: plane(),
            weight: plane(),
        };
        Self {
            scales: vec![scale; SCALES],
            luminance: plane(),
            known: plane(),
            blurred: plane(),
        }
    }
}

impl DetailPyramid {
    /// Fill the scales from the usable pixels of a picture.
    pub fn build(&mut self, image: &Image<Rgb8>, usable: &Usable<'_>, scratch: &mut BlurScratch) {
        let finest = image.width().div_ceil(FINEST_WIDTH_PX).max(1);
        for (index, scale) in self.scales.iter_mut().enumerate() {
            scale.step = finest << index;
            let (width, height) = (image.width() / scale.step, image.height() / scale.step);
            for plane in [&mut scale.detail, &mut scale.weight] {
                if plane.size() != (width, height) {
                    plane.resize(width, height, 0.0);
                }
            }
        }
        let (first, rest) = self.scales.split_at_mut(1);
        shrink_picture(image, usable, first[0].step, &mut self.luminance, &mut self.known);
        detail_of(&self.luminance, &self.known, &mut first[0], &mut self.blurred, scratch);
        for scale in rest {
            halve(&mut self.luminance, &mut self.known, scale.detail.size());
            detail_of(&self.luminance, &self.known, scale, &mut self.blurred, scratch);
        }
    }
}

fn shrink_picture(image: &Image<Rgb8>, usable: &Usable<'_>, step: usize, luminance: &mut Image<f32>, known: &mut Image<f32>) {
    let (width, height) = (image.width() / step, image.height() / step);
    for plane in [&mut *luminance, &mut *known] {
        if plane.size() != (width, height) {
            plane.resize(width, height, 0.0);
        }
    }
    let fitting = |mask: &&Mask| mask.size() == image.size();
    let usable = Usable {
        without: usable.without.map(|mask| mask.filter(fitting)),
        within: usable.within.filter(|(mask, _)| mask.size() == image.size()),
    };
    // A step beyond the chunk would take a picture of a hundred thousand columns.
    let step = step.min(CHUNK);
    for y in 0..height {
        wide::run(ShrunkRow {
            image,
            usable,
            step,
            y,
            luminance: luminance.row_mut(y),
            known: known.row_mut(y),
        });
    }
}

/// One row of the finest scale.
struct ShrunkRow<'a> {
    image: &'a Image<Rgb8>,
    usable: Usable<'a>,
    step: usize,
    y: usize,
    luminance: &'a mut [f32],
    known: &'a mut [f32],
}

impl Kernel for ShrunkRow<'_> {
    #[inline(always)]
    fn run(self) {
        let (step, width) = (self.step, self.image.width());
        let chunk = CHUNK / step;
        let cells = self.luminance.chunks_mut(chunk).zip(self.known.chunks_mut(chunk));
        for (index, (luminance, known)) in cells.enumerate() {
            let mut columns = [[0_u16; CHUNK]; 4];
            for v in self.y * step..(self.y + 1) * step {
                let at = v * width + index * chunk * step;
                add_row(self.image, &self.usable, at, &mut columns);
            }
            // The usual steps are known to the compiler.
            match step {
                2 => finish::<2>(&columns, 2, luminance, known),
                4 => finish::<4>(&columns, 4, luminance, known),
                _ => finish::<0>(&columns, step, luminance, known),
            }
        }
    }
}

/// Mean luma, and whether enough is known, from sums down the columns of red, green, blue and of usable pixels, `step` columns a cell;
/// `STEP` is that number or 0.
#[inline(always)]
fn finish<const STEP: usize>(columns: &[[u16; CHUNK]; 4], step: usize, luminance: &mut [f32], known: &mut [f32]) {
    let mut totals = [[0_u32; CHUNK]; 4];
    for (totals, columns) in totals.iter_mut().zip(columns) {
        if STEP > 0 {
            for (total, columns) in totals.iter_mut().zip(columns.as_chunks::<STEP>().0) {
                for sum in columns {
                    *total += u32::from(*sum);
                }
            }
        } else {
            for (total, columns) in totals.iter_mut().zip(columns.chunks_exact(step)) {
                *total = columns.iter().map(|sum| u32::from(*sum)).sum();
            }
        }
    }
    let [red, green, blue, counts] = &totals;
    let full = (step * step) as u32;
    for (i, (luminance, known)) in luminance.iter_mut().zip(known).enumerate().take(CHUNK) {
        // Rec. 601 luma in 1/256.
        let sum = 77 * red[i] + 150 * green[i] + 29 * blue[i];
        let count = 256 * counts[i];
        *luminance = if count > 0 { sum as f32 / count as f32 } else { 0.0 };
        *known = if 4 * counts[i] >= 3 * full && sum > MIN_LEVEL * count {
            1.0
        } else {
            0.0
        };
    }
}

/// Add red, green, blue and number of the usable ones among the [`CHUNK`] pixels from `at` on; what lies beyond the row is added too
/// and not used.
#[inline(always)]
fn add_row(image: &Image<Rgb8>, usable: &Usable<'_>, at: usize, columns: &mut [[u16; CHUNK]; 4]) {
    let mut mask = [255_u8; CHUNK];
    let mut padded = [0; CHUNK];
    for without in usable.without.into_iter().flatten() {
        let without = chunk_from(without.pixels(), at, &mut padded);
        for i in 0..CHUNK {
            mask[i] = if without[i] == 0 { mask[i] } else { 0 };
        }
    }
    if let Some((within, level)) = usable.within {
        let within = chunk_from(within.pixels(), at, &mut padded);
        for i in 0..CHUNK {
            mask[i] = if within[i] > level { mask[i] } else { 0 };
        }
    }
    let mut padded = [[0; 3]; CHUNK];
    let pixels = chunk_from(image.pixels(), at, &mut padded);
    let (mut red, mut green, mut blue) = ([0_u8; CHUNK], [0_u8; CHUNK], [0_u8; CHUNK]);
    for i in 0..CHUNK {
        let [r, g, b] = pixels[i];
        red[i] = r;
        green[i] = g;
        blue[i] = b;
    }
    let [reds, greens, blues, counts] = columns;
    for i in 0..CHUNK {
        reds[i] = reds[i].wrapping_add(u16::from(red[i] & mask[i]));
        greens[i] = greens[i].wrapping_add(u16::from(green[i] & mask[i]));
        blues[i] = blues[i].wrapping_add(u16::from(blue[i] & mask[i]));
    }
    for i in 0..CHUNK {
        counts[i] = counts[i].wrapping_add(u16::from(mask[i] & 1));
    }
}

/// [`CHUNK`] values from `at` on, padded at the end of the image.
#[inline(always)]
fn chunk_from<'a, P: Copy>(values: &'a [P], at: usize, padded: &'a mut [P; CHUNK]) -> &'a [P; CHUNK] {
    values[at..].first_chunk().unwrap_or_else(|| {
        padded[..values.len() - at].copy_from_slice(&values[at..]);
        padded
    })
}

/// Halve in place, keeping the mean of what is known.
fn halve(luminance: &mut Image<f32>, known: &mut Image<f32>, (width, height): (usize, usize)) {
    let source_width = luminance.width();
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (u, v) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let index = (2 * y + v) * source_width + 2 * x + u;
                sum += luminance.pixels()[index] * known.pixels()[index];
                weight += known.pixels()[index];
            }
            // Written behind the reading position: rows shrink to a quarter.
            let target = y * width + x;
            luminance.pixels_mut()[target] = if weight > 0.0 { sum / weight } else { 0.0 };
            known.pixels_mut()[target] = if weight >= 3.0 { 1.0 } else { 0.0 };
        }
    }
    for plane in [luminance, known] {
        plane.crop_rows(width, height);
    }
}

fn detail_of(luminance: &Image<f32>, known: &Image<f32>, scale: &mut Scale, blurred: &mut Image<f32>, scratch: &mut BlurScratch) {
    let mean = &mut scale.detail;
    mean.copy_from(luminance);
    for (m, k) in mean.pixels_mut().iter_mut().zip(known.pixels()) {
        *m *= k;
    }
    blurred.copy_from(known);
    gaussian_blur(mean, SURROUNDINGS_SIGMA_PX, scratch);
    gaussian_blur(blurred, SURROUNDINGS_SIGMA_PX, scratch);
    scale.weight.copy_from(known);
    let pixels = mean.pixels_mut().iter_mut().zip(blurred.pixels()).zip(luminance.pixels());
    for (((m, b), l), w) in pixels.zip(scale.weight.pixels_mut()) {
        let usable = *w > 0.0 && *b > 0.3 && *m > 0.0;
        *m = if usable { (l * b / *m - 1.0).clamp(-0.5, 0.5) } else { 0.0 };
        *w = if usable { 1.0 } else { 0.0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};

    #[test]
    fn shrinking_agrees_with_its_plain_twin() {
        for (width, height, step) in [(401, 30, 4), (197, 22, 3), (33, 9, 1)] {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(step as u64);
            let mut mask = |share: f64| {
                let pixels = (0..width * height).map(|_| if random.random_bool(share) { 255 } else { 0 });
                Image::from_vec(width, height, pixels.collect()).unwrap()
            };
            let (without, within) = (mask(0.15), mask(0.95));
            let image = Image::from_vec(width, height, (0..width * height).map(|_| random.random()).collect()).unwrap();
            let usable = Usable {
                without: [None, Some(&without)],
                within: Some((&within, 200)),
            };
            let (mut luminance, mut known) = (plane(), plane());
            shrink_picture(&image, &usable, step, &mut luminance, &mut known);
            for y in 0..height / step {
                for x in 0..width / step {
                    let (mut sum, mut count) = (0_u32, 0_u32);
                    for (u, v) in (y * step..(y + 1) * step).flat_map(|v| (x * step..(x + 1) * step).map(move |u| (u, v))) {
                        if without.at(u, v) == 0 && within.at(u, v) > 200 {
                            let [r, g, b] = image.at(u, v).map(u32::from);
                            sum += 77 * r + 150 * g + 29 * b;
                            count += 256;
                        }
                    }
                    let mean = if count > 0 { sum as f32 / count as f32 } else { 0.0 };
                    assert_eq!(luminance.at(x, y), mean);
                    let enough = 4 * count >= 3 * 256 * (step * step) as u32 && sum > 8 * count;
                    assert_eq!(known.at(x, y) > 0.0, enough);
                }
            }
        }
    }
}
