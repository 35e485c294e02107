//! What a pixel must exceed to shine: the background of the darkest channel, how much it varies, and what is bright but wide.

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::{Image, Mask};
use crate::image::specularity::cells::Cells;
use crate::image::specularity::settings::{REFERENCE_WIDTH_PX, Settings};

/// Cells that stand out by more than this from the mean of the round before hardly count, levels.
const ROUNDS: [f32; 3] = [12.0, 8.0, 8.0];
/// What stands out keeps a little say, so that a wide bright area is still its own background.
const SAY_OF_EXCEPTIONS: f32 = 0.02;
/// Bounds lie at least so many mean deviations above the background.
const CORE_SPREADS: f32 = 2.5;
const HALO_SPREADS: f32 = 1.2;

/// What a pixel must exceed, one value a cell.
#[derive(Debug)]
pub(super) struct Bounds {
    /// In the darkest channel, to be a core.
    pub core: Image<f32>,
    /// In the darkest channel, to be a halo.
    pub halo: Image<f32>,
    /// In darkest − whiteness · brightest, to be white light.
    pub white: Image<f32>,
    /// The same with a core's whiteness.
    pub core_white: Image<f32>,
}

/// Working memory.
#[derive(Debug)]
pub(super) struct Background {
    weight: Image<f32>,
    blurred_weight: Image<f32>,
    least: Image<f32>,
    most: Image<f32>,
    spread: Image<f32>,
    opened: Image<f32>,
    /// The same for a core, which is narrower.
    core_opened: Image<f32>,
    /// The result.
    pub bounds: Bounds,
}

impl Background {
    pub fn new() -> Self {
        let empty = || Image::filled(0, 0, 0.0);
        Self {
            weight: empty(),
            blurred_weight: empty(),
            least: empty(),
            most: empty(),
            spread: empty(),
            opened: empty(),
            core_opened: empty(),
            bounds: Bounds {
                core: empty(),
                halo: empty(),
                white: empty(),
                core_white: empty(),
            },
        }
    }

    /// Fill `bounds` from the cells that are not `steel`; `brightness` is 1 in a well exposed picture.
    pub fn find(&mut self, settings: &Settings, cells: &Cells, steel: &Mask, brightness: f32, scratch: &mut BlurScratch) {
        let cells_per_px = cells.size().0 as f32 / REFERENCE_WIDTH_PX;
        let sigma = settings.background_sigma_px * cells_per_px;
        let known = || {
            cells
                .valid
                .pixels()
                .iter()
                .zip(steel.pixels())
                .map(|(&v, &s)| v != 0 && s == 0)
        };
        self.weight.copy_from(&cells.least);
        for (weight, known) in self.weight.pixels_mut().iter_mut().zip(known()) {
            *weight = if known { 1.0 } else { 0.0 };
        }
        for limit in ROUNDS {
            self.blur_weight(sigma, scratch);
            self.least.copy_from(&cells.least);
            weighted_mean(&mut self.least, &self.weight, &self.blurred_weight, sigma, scratch);
            let levels = cells.least.pixels().iter().zip(self.least.pixels());
            for ((weight, known), (level, mean)) in self.weight.pixels_mut().iter_mut().zip(known()).zip(levels) {
                let usual = if level - mean < limit { 1.0 } else { SAY_OF_EXCEPTIONS };
                *weight = if known { usual } else { 0.0 };
            }
        }
        self.blur_weight(sigma, scratch);
        for (mean, levels) in [(&mut self.least, &cells.least), (&mut self.most, &cells.most)] {
            mean.copy_from(levels);
            weighted_mean(mean, &self.weight, &self.blurred_weight, sigma, scratch);
        }
        // Mean absolute deviation of the unexceptional cells.
        self.spread.copy_from(&cells.least);
        for (spread, mean) in self.spread.pixels_mut().iter_mut().zip(self.least.pixels()) {
            *spread = (*spread - mean).abs();
        }
        weighted_mean(&mut self.spread, &self.weight, &self.blurred_weight, sigma, scratch);
        self.open(settings, cells, cells_per_px);
        self.set_bounds(settings, brightness);
    }

    fn blur_weight(&mut self, sigma: f32, scratch: &mut BlurScratch) {
        self.blurred_weight.copy_from(&self.weight);
        gaussian_blur(&mut self.blurred_weight, sigma, scratch);
    }

    /// Opening: erosion, then dilation, by squares; invalid cells take no part in the erosion.
    fn open(&mut self, settings: &Settings, cells: &Cells, cells_per_px: f32) {
        for (opened, width_px) in [
            (&mut self.opened, settings.max_width_px),
            (&mut self.core_opened, settings.core_max_width_px),
        ] {
            let radius = (0.5 * width_px * cells_per_px).round().max(1.0) as usize;
            opened.copy_from(&cells.least);
            for (opened, valid) in opened.pixels_mut().iter_mut().zip(cells.valid.pixels()) {
                *opened = if *valid != 0 { *opened } else { 255.0 };
            }
            // The blurred weight is not needed any more.
            extreme_over_square(opened, radius, lower, 255.0, &mut self.blurred_weight);
            extreme_over_square(opened, radius, higher, 0.0, &mut self.blurred_weight);
        }
    }

    fn set_bounds(&mut self, settings: &Settings, brightness: f32) {
        let spread = &self.spread;
        let beyond = |bound: &mut Image<f32>, mean: &Image<f32>, opened: &Image<f32>, levels: f32, spreads: f32| {
            bound.copy_from(mean);
            let found = opened.pixels().iter().zip(spread.pixels());
            for (bound, (opened, spread)) in bound.pixels_mut().iter_mut().zip(found) {
                *bound = bound.max(*opened) + levels.max(spreads * spread);
            }
        };
        let bounds = &mut self.bounds;
        let (core, halo) = (settings.core_levels * brightness, settings.halo_levels * brightness);
        beyond(&mut bounds.core, &self.least, &self.core_opened, core, CORE_SPREADS);
        beyond(&mut bounds.halo, &self.least, &self.opened, halo, HALO_SPREADS);
        for (white, whiteness) in [
            (&mut bounds.white, settings.whiteness),
            (&mut bounds.core_white, settings.core_whiteness),
        ] {
            white.copy_from(&self.least);
            for (white, most) in white.pixels_mut().iter_mut().zip(self.most.pixels()) {
                *white -= whiteness * most;
            }
        }
    }
}

/// values ← blur(weight · value)/blur(weight); where no weight is near, 0.
fn weighted_mean(
    values: &mut Image<f32>,
    weight: &Image<f32>,
    blurred_weight: &Image<f32>,
    sigma_px: f32,
    scratch: &mut BlurScratch,
) {
    for (value, w) in values.pixels_mut().iter_mut().zip(weight.pixels()) {
        *value *= w;
    }
    gaussian_blur(values, sigma_px, scratch);
    for (value, w) in values.pixels_mut().iter_mut().zip(blurred_weight.pixels()) {
        *value = if *w > 1e-4 { *value / w } else { 0.0 };
    }
}

/// The lower of two numbers; unlike `f32::min` a single instruction.
pub(super) fn lower(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
}

fn higher(a: f32, b: f32) -> f32 {
    if b > a { b } else { a }
}

/// The extreme over a (2·radius + 1)² square, in place; `neutral` stands for what lies outside.
pub(super) fn extreme_over_square<P: Copy>(
    image: &mut Image<P>,
    radius: usize,
    pick: impl Fn(P, P) -> P,
    neutral: P,
    rows: &mut Image<P>,
) {
    let (width, height) = image.size();
    if rows.size() != image.size() {
        rows.resize(width, height, neutral);
    }
    // Tap after tap over whole rows: this the compiler vectorizes.
    for y in 0..height {
        let (source, out) = (image.row(y), rows.row_mut(y));
        out.copy_from_slice(source);
        for shift in 1..=radius.min(width.saturating_sub(1)) {
            for (out, value) in out[shift..].iter_mut().zip(source) {
                *out = pick(*out, *value);
            }
            for (out, value) in out.iter_mut().zip(&source[shift..]) {
                *out = pick(*out, *value);
            }
        }
    }
    for y in 0..height {
        let out = image.row_mut(y);
        out.copy_from_slice(rows.row(y));
        for v in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            for (out, value) in out.iter_mut().zip(rows.row(v)) {
                *out = pick(*out, *value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extreme_is_the_extreme_of_the_square() {
        for (width, height, radius) in [(31_usize, 17_usize, 3_usize), (5, 4, 9), (1, 1, 2)] {
            let pixels = (0..width * height).map(|i| ((i * 7919) % 251) as f32).collect();
            let image = Image::from_vec(width, height, pixels).unwrap();
            let (mut found, mut rows) = (image.clone(), Image::filled(0, 0, 0.0));
            extreme_over_square(&mut found, radius, f32::min, 255.0, &mut rows);
            for y in 0..height {
                for x in 0..width {
                    let expected = (y.saturating_sub(radius)..(y + radius + 1).min(height))
                        .flat_map(|v| (x.saturating_sub(radius)..(x + radius + 1).min(width)).map(move |u| (u, v)))
                        .map(|(u, v)| image.at(u, v))
                        .fold(255.0, f32::min);
                    assert_eq!(found.at(x, y), expected);
                }
            }
        }
    }
}
