//! The detail of a picture, freed of its lighting, at several scales.
//!
//! The lamp rides on the camera, so the same tissue is brighter from near and darker from aside. What two pictures share is the
//! *ratio* of each pixel to its surroundings: detail = luminance / blurred luminance − 1. Both sides of an alignment use it.

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::{Image, Mask, Rgb8};

/// Width of the finest scale, px, at most.
const FINEST_WIDTH_PX: usize = 480;
/// Scales, each half the one before.
pub const SCALES: usize = 3;
/// Surroundings: standard deviation of the blur, px of the scale.
const SURROUNDINGS_SIGMA_PX: f32 = 5.0;

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
    /// Fill the scales from a picture; pixels for which `usable` is false take no part.
    pub fn build(&mut self, image: &Image<Rgb8>, usable: &(dyn Fn(usize, usize) -> bool + Sync), scratch: &mut BlurScratch) {
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

/// Where a mask is zero in a picture of the same size.
pub fn outside(mask: &Mask) -> impl Fn(usize, usize) -> bool + Sync + '_ {
    |x, y| mask.at(x, y) == 0
}

fn shrink_picture(
    image: &Image<Rgb8>,
    usable: &(dyn Fn(usize, usize) -> bool + Sync),
    step: usize,
    luminance: &mut Image<f32>,
    known: &mut Image<f32>,
) {
    let (width, height) = (image.width() / step, image.height() / step);
    for plane in [&mut *luminance, &mut *known] {
        if plane.size() != (width, height) {
            plane.resize(width, height, 0.0);
        }
    }
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut count) = (0_u32, 0_u32);
            for v in y * step..(y + 1) * step {
                for (u, &[r, g, b]) in image.row(v)[x * step..(x + 1) * step].iter().enumerate() {
                    if usable(x * step + u, v) {
                        // Rec. 601 luma in 1/256.
                        sum += 77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b);
                        count += 256;
                    }
                }
            }
            let full = 256 * (step * step) as u32;
            let enough = 4 * count >= 3 * full;
            luminance.set(x, y, if count > 0 { sum as f32 / count as f32 } else { 0.0 });
            known.set(x, y, if enough && sum > 8 * count { 1.0 } else { 0.0 });
        }
    }
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
