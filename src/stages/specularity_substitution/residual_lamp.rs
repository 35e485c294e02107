//! The lamp's light that even the least dazzled views show, taken off what they measured.
//!
//! Some places shine for every view: a lobe stays on its bump. Light adds up before the camera encodes it, and there a colour is tissue,
//! lit better or worse, plus white light (dichromatic model, Shafer 1985). What colour tissue has nearby is known; how much there is of
//! either follows by least squares, and what the three channels leave over says whether the model holds at all: pale fat on red is of
//! another colour, and is left as it was measured.

use crate::image::color::{fast_linear, fast_srgb, luma};

/// What is measured with at least this confidence shows no lamp …
const SURE: f32 = 0.7;
/// … and with less than this, all that is found comes off.
const DOUBTFUL: f32 = 0.3;
/// The model holds where it leaves over at most this share of the change in colour …
const MOST_LEFT_OVER: f32 = 0.06;
/// … and this much noise, share of white; at twice as much nothing comes off.
const NOISE: f32 = 1.0 / 255.0;
/// Nothing is left darker than this share of the light that nearby tissue sends: where a channel is clipped the model finds too much lamp.
const DARKEST_SHARE: f32 = 0.75;
/// Tissue so near to grey (sine of the angle) cannot be told from white light.
const LEAST_SINE: f32 = 0.05;

/// How little a measured colour can be trusted to show no lamp, 0…1, by its confidence.
#[inline]
pub fn doubt_of(confidence: f32) -> f32 {
    ((SURE - confidence) / (SURE - DOUBTFUL)).clamp(0.0, 1.0)
}

/// `color` less the white light in it, as far as nearby `tissue` tells; `share` of it, 0…1. All in levels.
pub fn without_lamp(color: [f32; 3], tissue: [f32; 3], share: f32) -> [f32; 3] {
    let [color_light, tissue_light] = [color, tissue].map(|levels| levels.map(|v| fast_linear(v / 255.0)));
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    // color = lit · tissue + lamp · white
    let (tt, tw) = (dot(tissue_light, tissue_light), tissue_light.iter().sum::<f32>());
    let (ct, cw) = (dot(color_light, tissue_light), color_light.iter().sum::<f32>());
    let determinant = 3.0 * tt - tw * tw;
    if determinant <= 3.0 * tt * LEAST_SINE * LEAST_SINE {
        return color;
    }
    let (lit, lamp) = ((3.0 * ct - tw * cw) / determinant, (tt * cw - tw * ct) / determinant);
    if lamp <= 0.0 {
        return color;
    }
    let length = |v: [f32; 3]| dot(v, v).sqrt();
    let left_over = length(std::array::from_fn(|c| color_light[c] - lit * tissue_light[c] - lamp));
    let change = length(std::array::from_fn(|c| color_light[c] - tissue_light[c]));
    let holds = (2.0 - left_over / (MOST_LEFT_OVER * change + NOISE)).clamp(0.0, 1.0);
    let most = luma(color_light) - DARKEST_SHARE * luma(tissue_light);
    let off = (share * holds * lamp).min(most);
    if off <= 0.0 {
        return color;
    }
    color_light.map(|light| 255.0 * fast_srgb((light - off).max(0.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::color::{linear_from_srgb, srgb_from_linear};

    const TISSUE: [f32; 3] = [150.0, 60.0, 62.0];

    fn lit(color: [f32; 3], better: f64, lamp: f64) -> [f32; 3] {
        color.map(|v| {
            let light = linear_from_srgb(f64::from(v) / 255.0) * better + lamp;
            (255.0 * srgb_from_linear(light)) as f32
        })
    }

    #[test]
    fn white_light_comes_off_whatever_the_light_on_the_tissue() {
        for better in [0.8, 1.0, 1.3] {
            for lamp in [0.02, 0.1, 0.3] {
                let found = without_lamp(lit(TISSUE, better, lamp), TISSUE, 1.0);
                let truth = lit(TISSUE, better, 0.0);
                for c in 0..3 {
                    // The roots stand for the curve to about a level.
                    assert!((found[c] - truth[c]).abs() < 1.5, "{better} {lamp}: {found:?} for {truth:?}");
                }
            }
        }
    }

    #[test]
    fn a_clipped_gleam_leaves_no_dark_spot() {
        // On a yellow gall bladder, red and green at their end.
        let tissue = [215.0, 180.0, 125.0];
        for blue in [200.0, 225.0, 250.0] {
            let found = without_lamp([255.0, 253.0, blue], tissue, 1.0);
            assert!(luma(found) > 0.85 * luma(tissue), "{found:?}");
        }
    }

    #[test]
    fn tissue_without_lamp_fat_and_grey_stay() {
        for color in [TISSUE, lit(TISSUE, 0.7, 0.0), [214.0, 180.0, 115.0], [205.0, 160.0, 105.0]] {
            let found = without_lamp(color, TISSUE, 1.0);
            for c in 0..3 {
                assert!((found[c] - color[c]).abs() < 1.5, "{found:?} for {color:?}");
            }
        }
        let grey = [190.0, 189.0, 188.0];
        assert_eq!(without_lamp(grey, [120.0, 120.0, 119.0], 1.0), grey);
    }
}
