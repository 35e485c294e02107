//! Mean and covariance of the tissue's colors.
//!
//! Every eighth pixel both ways (2 × 2 averaged) is looked at. What is not tissue is left out: outside the image field,
//! near black, clipped, specular (bright and colorless), and steel (colorless). A picture that is mostly steel says
//! nothing about tissue.

use nalgebra::{Matrix3, Vector3};

use crate::image::buffer::{Image, Mask, Rgb8};

/// Distance of the samples, px.
const STEP: usize = 8;
/// Samples treated together.
const LANES: usize = 64;
/// Darker than 5 % of full scale: surround or shadow.
const MIN_LEVEL: f32 = 13.0;
/// From here on a channel counts as clipped.
const CLIPPED_LEVEL: f32 = 250.0;
/// Specular: brighter than this and less saturated than that.
const SPECULAR_LEVEL: f32 = 205.0;
const SPECULAR_SATURATION: f32 = 0.25;
/// Steel: less saturated than this at any brightness. Tissue under a scope's lamp lies above 0.25.
const STEEL_SATURATION: f32 = 0.15;
/// Fewer samples make no statistics.
const MIN_SAMPLES: usize = 64;

/// A cluster of colors, 8-bit sRGB units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Mean color.
    pub mean: Vector3<f64>,
    /// Covariance of the colors.
    pub covariance: Matrix3<f64>,
}

/// What one frame told.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measurement {
    /// The tissue's colors; `None` where too few were seen.
    pub statistics: Option<Statistics>,
    /// Share of steel among the lit samples, 0 to 1.
    pub instrument_share: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Other,
    Steel,
    Tissue,
}

/// Samples of a row: looked up one after the other without a question asked, then judged together.
struct Samples {
    /// Red, green, blue, corrected.
    colors: [[f32; LANES]; 3],
    /// In the image field, and not clipped.
    usable: [bool; LANES],
}

impl Samples {
    /// The first `count` samples from (x, y) on; `inside` says by number which lie in the image field.
    #[inline(always)]
    fn gather(
        image: &Image<Rgb8>,
        (x, y): (usize, usize),
        count: usize,
        inside: impl Fn(usize) -> bool,
        correct: impl Fn([f32; 3]) -> [f32; 3],
    ) -> Self {
        let (upper, lower) = (&image.row(y)[x..], &image.row(y + 1)[x..]);
        let mut samples = Self {
            colors: [[0.0; LANES]; 3],
            usable: [false; LANES],
        };
        let pairs = upper.chunks(STEP).zip(lower.chunks(STEP));
        for (i, (upper, lower)) in pairs.enumerate().take(count) {
            let ([a, b, ..], [c, d, ..]) = (upper, lower) else {
                break;
            };
            if !inside(i) {
                continue;
            }
            let mut color = [0.0; 3];
            let mut highest = 0;
            for k in 0..3 {
                let sum = u16::from(a[k]) + u16::from(b[k]) + u16::from(c[k]) + u16::from(d[k]);
                color[k] = f32::from(sum) / 4.0;
                highest = highest.max(a[k].max(b[k]).max(c[k].max(d[k])));
            }
            let color = correct(color);
            for (plane, value) in samples.colors.iter_mut().zip(color) {
                plane[i] = value;
            }
            samples.usable[i] = f32::from(highest) < CLIPPED_LEVEL;
        }
        samples
    }

    #[inline(always)]
    fn kinds(&self, judged: impl Fn([f32; 3]) -> [f32; 3]) -> [Kind; LANES] {
        let mut kinds = [Kind::Other; LANES];
        let [red, green, blue] = &self.colors;
        for i in 0..LANES {
            let seen = judged([red[i], green[i], blue[i]]);
            let highest = seen[0].max(seen[1]).max(seen[2]);
            let lowest = seen[0].min(seen[1]).min(seen[2]);
            let saturation = (highest - lowest) / highest;
            let specular = (highest > SPECULAR_LEVEL) & (saturation < SPECULAR_SATURATION);
            let lit = self.usable[i] & (highest >= MIN_LEVEL) & !specular;
            let kind = if saturation < STEEL_SATURATION {
                Kind::Steel
            } else {
                Kind::Tissue
            };
            kinds[i] = if lit { kind } else { Kind::Other };
        }
        kinds
    }
}

/// Measure the tissue of a picture. `correct` maps each sample first (a camera's fixed correction); `judged` maps the result
/// further, to the reference's colors as far as they are known: whether a color is steel can only be told there, because a
/// tint gives steel a color.
pub fn measure(
    image: &Image<Rgb8>,
    field_of_view: Option<&Mask>,
    correct: impl Fn([f32; 3]) -> [f32; 3],
    judged: impl Fn([f32; 3]) -> [f32; 3],
) -> Measurement {
    let (width, height) = image.size();
    let field_of_view = field_of_view.filter(|mask| mask.size() == image.size());
    let (mut tissue, mut steel) = (0_usize, 0_usize);
    let mut sum = [0.0_f64; 3];
    let mut products = [0.0_f64; 6];
    for y in (STEP / 2..height.saturating_sub(1)).step_by(STEP) {
        let columns: usize = (STEP / 2..width.saturating_sub(1)).len();
        for first in (0..columns.div_ceil(STEP)).step_by(LANES) {
            let left = STEP / 2 + first * STEP;
            let count = LANES.min(columns.div_ceil(STEP) - first);
            let inside = |i: usize| field_of_view.is_none_or(|mask| mask.at(left + i * STEP, y) != 0);
            let samples = Samples::gather(image, (left, y), count, inside, &correct);
            let kinds = samples.kinds(&judged);
            for (i, kind) in kinds.into_iter().enumerate().take(count) {
                match kind {
                    Kind::Other => {}
                    Kind::Steel => steel += 1,
                    Kind::Tissue => {
                        tissue += 1;
                        let [r, g, b] = [0, 1, 2].map(|c| f64::from(samples.colors[c][i]));
                        for (sum, value) in sum.iter_mut().zip([r, g, b]) {
                            *sum += value;
                        }
                        for (sum, value) in products.iter_mut().zip([r * r, r * g, r * b, g * g, g * b, b * b]) {
                            *sum += value;
                        }
                    }
                }
            }
        }
    }
    let instrument_share = steel as f64 / (steel + tissue).max(1) as f64;
    if tissue < MIN_SAMPLES {
        return Measurement {
            statistics: None,
            instrument_share,
        };
    }
    let n = tissue as f64;
    let mean = Vector3::from(sum) / n;
    let [rr, rg, rb, gg, gb, bb] = products.map(|p| p / n);
    let covariance = Matrix3::new(rr, rg, rb, rg, gg, gb, rb, gb, bb) - mean * mean.transpose();
    Measurement {
        statistics: Some(Statistics { mean, covariance }),
        instrument_share,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn tissue_is_measured_and_the_rest_left_out() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut image = Image::filled(640, 400, [2, 2, 3]);
        for y in 0..400 {
            for x in 0..640 {
                let color = match x {
                    0..100 => continue,
                    100..160 => [128, 130, 127],
                    160..200 => [255, 255, 250],
                    _ => {
                        let t: f64 = random.random_range(-30.0..30.0);
                        [160.0 + t, 90.0 + 0.7 * t, 80.0 + 0.5 * t].map(|v: f64| v.round() as u8)
                    }
                };
                image.set(x, y, color);
            }
        }
        let found = measure(&image, None, |c| c, |c| c);
        let statistics = found.statistics.unwrap();
        // Uniform ±30 averaged over 2 × 2: variance 300 / 4 = 75, its mean known to 8.7 / √2750 = 0.17.
        assert!(
            (statistics.mean - Vector3::new(160.0, 90.0, 80.0)).norm() < 0.8,
            "{}",
            statistics.mean
        );
        assert!(
            (statistics.covariance[(0, 0)] - 75.0).abs() < 8.0,
            "{}",
            statistics.covariance
        );
        assert!((found.instrument_share - 60.0 / 500.0).abs() < 0.02);
    }
}
