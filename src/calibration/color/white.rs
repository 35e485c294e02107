//! White balance from a white or gray target: one gain a channel, and no more can be told.
//!
//! The light on the target may be as uneven as a scope's: only ratios of the channels count, of each pixel by itself, and their median
//! over all pixels that are neither dark nor clipped. Gains keep the target's luminance.

use crate::image::buffer::{Image, Rgb8};
use crate::image::color::{delta_e_2000, lab_from_linear, linear_from_srgb};
use crate::image::color_correction::{Correction, Encoding, Formula};

/// Levels that a pixel's channels lie between to count.
const RANGE: [u8; 2] = [24, 248];
/// Share of the picture that must count.
const LEAST_SHARE: f64 = 0.02;
/// Larger deviations of ln(ratio) are no target of one color.
const MOST_SPREAD: f64 = 0.15;
/// Channels farther apart than this are no white or gray target under any white balance.
const MOST_RATIO: f64 = 6.0;

/// Parts of a picture each way that are looked at by themselves.
pub const TENTHS: usize = 10;

/// Luminance of linear light.
const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// Why a picture tells no white.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoWhite {
    /// Dark or clipped.
    #[error(
        "expected a white or gray target in at least {:.0} % of the picture, found {found_percent:.1} % neither dark nor clipped; \
         fill the picture with the target and lower the light until it is light gray",
        100.0 * LEAST_SHARE
    )]
    TooLittle {
        /// Share of pixels that count, %.
        found_percent: f64,
    },
    /// Of many colors.
    #[error("expected a target of one color, found colors that spread by {percent:.0} %; fill the picture with the target")]
    ManyColors {
        /// Deviation of the channels' ratio, %.
        percent: f64,
    },
    /// Not gray.
    #[error(
        "expected a white or gray target, found channels as {ratios:.2?} to green; is it white, and is the lamp's light white?"
    )]
    Colored {
        /// Red and blue relative to green.
        ratios: [f64; 2],
    },
}

/// The white balance.
#[derive(Clone, Debug)]
pub struct White {
    /// Of red, green, blue, in linear light.
    pub gains: [f64; 3],
    /// Share of the picture that counted.
    pub share: f64,
    /// Deviation of ln(red/green) and ln(blue/green) over the picture.
    pub spread: [f64; 2],
    /// Mean linear light of the target as seen.
    pub seen: [f64; 3],
    /// ΔE2000 of the target's color to gray of its own luminance, as seen.
    pub before: f64,
    /// The same, corrected.
    pub after: f64,
    /// The same of tenths of the pictures each way, row by row, corrected; nothing where too little of a tenth counts.
    pub after_tenths: Vec<Option<f64>>,
    /// Its mean: what gains cannot mend.
    pub after_local: f64,
}

impl White {
    /// From the pictures of a target.
    pub fn measured(images: &[&Image<Rgb8>]) -> Result<Self, NoWhite> {
        let mut ratios: [Vec<f64>; 2] = Default::default();
        let (mut sum, mut all) = ([0.0; 3], 0);
        for image in images {
            all += image.pixels().len();
            for pixel in image.pixels().iter().filter(|pixel| counts(pixel)) {
                let linear = pixel.map(|level| linear_from_srgb(f64::from(level) / 255.0));
                ratios[0].push((linear[0] / linear[1]).ln());
                ratios[1].push((linear[2] / linear[1]).ln());
                for (sum, v) in sum.iter_mut().zip(linear) {
                    *sum += v;
                }
            }
        }
        let n = ratios[0].len();
        let share = n as f64 / all.max(1) as f64;
        if share < LEAST_SHARE {
            return Err(NoWhite::TooLittle {
                found_percent: 100.0 * share,
            });
        }
        let [red, blue] = ratios.map(middle_and_deviation);
        let spread = [red[1], blue[1]];
        if spread.iter().any(|deviation| *deviation > MOST_SPREAD) {
            return Err(NoWhite::ManyColors {
                percent: 100.0 * spread[0].max(spread[1]),
            });
        }
        let color = [red[0].exp(), 1.0, blue[0].exp()];
        if color.iter().any(|v| !(1.0 / MOST_RATIO..MOST_RATIO).contains(v)) {
            return Err(NoWhite::Colored {
                ratios: [color[0], color[2]],
            });
        }
        let luminance: f64 = color.iter().zip(LUMINANCE).map(|(v, w)| v * w).sum();
        let gains = color.map(|v| luminance / v);
        let seen = sum.map(|v| v / n as f64);
        let after_tenths = tenths(images, gains);
        let told: Vec<f64> = after_tenths.iter().flatten().copied().collect();
        Ok(Self {
            gains,
            share,
            spread,
            seen,
            before: to_gray(seen),
            after: to_gray(scaled(seen, gains)),
            after_local: told.iter().sum::<f64>() / told.len().max(1) as f64,
            after_tenths,
        })
    }

    /// What to apply.
    pub fn correction(&self) -> Correction {
        Correction {
            gamma: [1.0; 3],
            encoding: Encoding::Linear,
            formula: Formula::Matrix {
                matrix: std::array::from_fn(|r| std::array::from_fn(|c| if r == c { self.gains[r] } else { 0.0 })),
                offset: [0.0; 3],
            },
        }
    }
}

/// Whether a pixel is neither dark nor clipped.
pub fn counts(pixel: &Rgb8) -> bool {
    pixel.iter().all(|level| (RANGE[0]..=RANGE[1]).contains(level))
}

fn scaled(linear: [f64; 3], gains: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| linear[c] * gains[c])
}

fn to_gray(linear: [f64; 3]) -> f64 {
    let luminance: f64 = linear.iter().zip(LUMINANCE).map(|(v, w)| v * w).sum();
    delta_e_2000(lab_from_linear(linear), lab_from_linear([luminance; 3]))
}

/// Of tenths of the pictures each way: how far the corrected color is from gray, the mean over the pictures.
fn tenths(images: &[&Image<Rgb8>], gains: [f64; 3]) -> Vec<Option<f64>> {
    let mut differences = vec![(0.0, 0_usize); TENTHS * TENTHS];
    for image in images {
        let mut cells = vec![([0.0; 3], 0_usize); TENTHS * TENTHS];
        let (width, height) = image.size();
        for (index, pixel) in image.pixels().iter().enumerate().filter(|(_, pixel)| counts(pixel)) {
            let (x, y) = (index % width, index / width);
            if let Some((sum, n)) = cells.get_mut(y * TENTHS / height * TENTHS + x * TENTHS / width) {
                *n += 1;
                for (sum, level) in sum.iter_mut().zip(pixel) {
                    *sum += linear_from_srgb(f64::from(*level) / 255.0);
                }
            }
        }
        let enough = width * height / 400;
        for ((sum, n), (difference, pictures)) in cells.iter().zip(&mut differences).filter(|((_, n), _)| *n > enough) {
            *difference += to_gray(scaled(sum.map(|v| v / *n as f64), gains));
            *pictures += 1;
        }
    }
    let mean = |(sum, pictures): (f64, usize)| (pictures > 0).then(|| sum / pictures as f64);
    differences.into_iter().map(mean).collect()
}

/// Median, and deviation by the median of the distances from it.
fn middle_and_deviation(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_unstable_by(f64::total_cmp);
    let middle = values.get(values.len() / 2).copied().unwrap_or(0.0);
    for value in &mut values {
        *value = (*value - middle).abs();
    }
    values.sort_unstable_by(f64::total_cmp);
    [middle, 1.4826 * values.get(values.len() / 2).copied().unwrap_or(0.0)]
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::image::color::srgb_from_linear;

    fn target(color: [f64; 3], noise_levels: f64) -> Image<Rgb8> {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut image = Image::filled(320, 240, [0; 3]);
        for y in 0..240 {
            for x in 0..320 {
                let far = (f64::from(x) - 150.0).hypot(f64::from(y) - 110.0);
                if far > 115.0 {
                    continue;
                }
                let light = 0.7 / (1.0 + (far / 90.0).powi(2));
                let pixel = color.map(|v| {
                    let noise: f64 = random.sample(StandardNormal);
                    (255.0 * srgb_from_linear(v * light) + noise_levels * noise)
                        .round()
                        .clamp(0.0, 255.0) as u8
                });
                image.set(x as usize, y as usize, pixel);
            }
        }
        image
    }

    #[test]
    fn gains_are_taken_back_under_uneven_light() {
        let image = target([1.15, 1.0, 0.8], 2.0);
        let white = White::measured(&[&image]).unwrap();
        // 20 000 pixels of 2 levels in 150 and more: ratios to well below a thousandth; rounding adds as much.
        assert!((white.gains[0] / white.gains[1] * 1.15 - 1.0).abs() < 3e-3, "{white:?}");
        assert!((white.gains[2] / white.gains[1] * 0.8 - 1.0).abs() < 3e-3, "{white:?}");
        assert!(
            white.before > 5.0 && white.after < 0.3 && white.after_local < 0.5,
            "{white:?}"
        );
    }

    #[test]
    fn what_is_no_white_target_is_refused() {
        assert!(matches!(
            White::measured(&[&Image::filled(80, 60, [255; 3])]),
            Err(NoWhite::TooLittle { .. })
        ));
        assert!(matches!(
            White::measured(&[&target([1.0, 0.1, 0.1], 1.0)]),
            Err(NoWhite::Colored { .. })
        ));
        let mut halves = target([1.0, 1.0, 1.0], 1.0);
        for pixel in halves.pixels_mut().iter_mut().step_by(2) {
            pixel[0] /= 2;
        }
        assert!(matches!(White::measured(&[&halves]), Err(NoWhite::ManyColors { .. })));
    }
}
