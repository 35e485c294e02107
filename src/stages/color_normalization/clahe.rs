//! Contrast-limited adaptive histogram equalization of the lightness, steady in time.
//!
//! Zuiderveld, Graphics Gems IV, 1994: each tile of the picture gets the curve that spreads its own histogram, with a limit
//! to the slope; pixels take the curves of the four nearest tiles, interpolated. Here the curves are smoothed over time, so
//! that they do not flicker, and the new lightness scales all three channels, so that the hue stays.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::ParallelSliceMut as _;

use crate::image::buffer::{Image, Mask, Rgb8};

const COLUMNS: usize = 8;
const ROWS: usize = 6;
const BINS: usize = 256;
/// Steepest slope of a curve.
const MAX_SLOPE: f32 = 2.0;
/// Every how many pixels one is counted, both ways.
const STEP: usize = 2;
/// Up to this lightness nothing changes, then blended in over as many levels again.
const BLACK_LEVEL: f32 = 12.0;

/// The equalizer and its curves.
#[derive(Debug)]
pub struct Clahe {
    curves: Vec<[f32; BINS]>,
    fresh: bool,
}

impl Default for Clahe {
    fn default() -> Self {
        Self {
            curves: vec![identity(); COLUMNS * ROWS],
            fresh: true,
        }
    }
}

fn identity() -> [f32; BINS] {
    std::array::from_fn(|level| level as f32)
}

fn lightness(color: Rgb8) -> usize {
    (77 * usize::from(color[0]) + 150 * usize::from(color[1]) + 29 * usize::from(color[2]) + 128) >> 8
}

impl Clahe {
    /// Forget the past.
    pub fn clear(&mut self) {
        self.fresh = true;
    }

    /// Take this picture's histograms into the curves with weight `alpha` (1 = only this picture).
    pub fn learn(&mut self, image: &Image<Rgb8>, field_of_view: Option<&Mask>, alpha: f32) {
        let (width, height) = image.size();
        let alpha = if self.fresh { 1.0 } else { alpha };
        self.fresh = false;
        let field_of_view = field_of_view.filter(|mask| mask.size() == image.size());
        for (tile, curve) in self.curves.iter_mut().enumerate() {
            let (left, right) = (tile % COLUMNS * width / COLUMNS, (tile % COLUMNS + 1) * width / COLUMNS);
            let (top, bottom) = (tile / COLUMNS * height / ROWS, (tile / COLUMNS + 1) * height / ROWS);
            let mut counts = [0.0_f32; BINS];
            let mut total = 0.0;
            for y in (top..bottom).step_by(STEP) {
                for x in (left..right).step_by(STEP) {
                    let level = lightness(image.at(x, y));
                    if level as f32 > BLACK_LEVEL && field_of_view.is_none_or(|mask| mask.at(x, y) != 0) {
                        counts[level] += 1.0;
                        total += 1.0;
                    }
                }
            }
            let target = curve_from_histogram(&mut counts, total);
            for (value, target) in curve.iter_mut().zip(target) {
                *value += alpha * (target - *value);
            }
        }
    }

    /// Equalize in place, `strength` from 0 to 1.
    pub fn apply(&self, image: &mut Image<Rgb8>, field_of_view: Option<&Mask>, strength: f32) {
        let (width, height) = image.size();
        let field_of_view = field_of_view.filter(|mask| mask.size() == (width, height));
        let place = |at: usize, length: usize, tiles: usize| {
            let place = ((at as f32 + 0.5) / length as f32 * tiles as f32 - 0.5).clamp(0.0, tiles as f32 - 1.0);
            let below = (place as usize).min(tiles - 2);
            (below, place - below as f32)
        };
        image
            .pixels_mut()
            .par_chunks_mut(width.max(1))
            .enumerate()
            .for_each(|(y, row)| {
                let (ty, fy) = place(y, height, ROWS);
                for (x, pixel) in row.iter_mut().enumerate() {
                    let level = lightness(*pixel);
                    if level as f32 <= BLACK_LEVEL || field_of_view.is_some_and(|mask| mask.at(x, y) == 0) {
                        continue;
                    }
                    let (tx, fx) = place(x, width, COLUMNS);
                    let at = |row: usize, column: usize| self.curves[row * COLUMNS + column][level];
                    let upper = at(ty, tx) + fx * (at(ty, tx + 1) - at(ty, tx));
                    let lower = at(ty + 1, tx) + fx * (at(ty + 1, tx + 1) - at(ty + 1, tx));
                    let wanted = upper + fy * (lower - upper);
                    let level = level as f32;
                    let weight = strength * ((level - BLACK_LEVEL) / BLACK_LEVEL).min(1.0);
                    let highest = f32::from(pixel[0].max(pixel[1]).max(pixel[2]));
                    // No channel may clip: the hue would change.
                    let gain = (1.0 + weight * (wanted / level - 1.0)).min(255.0 / highest);
                    *pixel = pixel.map(|v| (f32::from(v) * gain + 0.5) as u8);
                }
            });
    }
}

fn curve_from_histogram(counts: &mut [f32; BINS], total: f32) -> [f32; BINS] {
    if total < BINS as f32 {
        return identity();
    }
    let limit = MAX_SLOPE * total / BINS as f32;
    let excess: f32 = counts.iter().map(|count| (count - limit).max(0.0)).sum();
    let mut sum = 0.0;
    let mut curve = [0.0; BINS];
    for (value, count) in curve.iter_mut().zip(counts.iter()) {
        let share = count.min(limit) + excess / BINS as f32;
        *value = (sum + share / 2.0) / total * 255.0;
        sum += share;
    }
    curve
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contrast_grows_hue_and_black_stay() {
        let mut image = Image::filled(320, 240, [0; 3]);
        for y in 0..240 {
            for x in 40..320 {
                let v = 60 + ((x * 7 + y * 3) % 40) as u8;
                image.set(x, y, [2 * v, v, v / 2]);
            }
        }
        let spread = |image: &Image<Rgb8>| {
            let levels: Vec<_> = (60..300).map(|x| lightness(image.at(x, 120)) as f32).collect();
            let mean = levels.iter().sum::<f32>() / levels.len() as f32;
            levels.iter().map(|v| (v - mean).powi(2)).sum::<f32>()
        };
        let before = image.clone();
        let mut clahe = Clahe::default();
        clahe.learn(&image, None, 1.0);
        clahe.apply(&mut image, None, 1.0);
        assert!(spread(&image) > 1.5 * spread(&before));
        assert_eq!(image.at(10, 10), [0; 3]);
        let (a, b) = (image.at(200, 100), before.at(200, 100));
        let hue = |c: Rgb8| f32::from(c[0]) / f32::from(c[2]);
        assert!((hue(a) / hue(b) - 1.0).abs() < 0.05, "{a:?} from {b:?}");
    }
}
