//! Which pixels of a view show the lamp, told by the other views.
//!
//! One picture's detector must draw its line around a highlight generously, and what it silences is missed later: the lamp's image moves
//! so little between neighbouring views that their generous lines overlap; and the haze beyond that line is too faint for one picture.
//! But the views have one brightness (gains, lamp model) to about a hundredth, and a specularity only ever adds white light (Shafer
//! 1985): the darkest answers that agree with each other show the tissue; what a pixel has more than that, and in white, is the lamp's.
//!
//! Haze is smooth, so all this is done for every second pixel of every second row.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};
use crate::image::hole_filling::HoleFiller;
use crate::light_field::confidence::is_black;
use crate::light_field::lamp_share::{Tissue, difference};
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::{LampShading, LightField, View};

/// Pixels along a square that is judged as one.
const STEP: usize = 2;
/// Pixels within this distance of a doubtful one are judged too, px of a 960 px wide picture.
const HAZE_REACH_PX: f32 = 20.0;
/// Fewer answers settle nothing.
const FEWEST_ANSWERS: usize = 4;
/// Up to this share of white light may be noise.
const CLEAN_TO: f32 = 0.015;
/// The most confidence where the views do not agree on what is darkest: perhaps no view saw it clean.
const TRUST_UNSURE: f32 = 0.1;
/// They do not agree where less than this share of what lies around agrees: a few will by chance.
const SURE_SHARE: f32 = 0.75;
/// Squares around one that is judged.
const SURE_REACH: usize = 2;
/// A pixel with this share of white light speaks where nobody else does, with `HAZY` confidence.
const HAZE: f32 = 0.05;
/// Confidence in a pixel under haze.
const HAZY: f32 = 0.12;
/// A pixel with this share shows the lamp as well as tissue.
const DAZZLED_FROM: f32 = 0.13;
/// Its confidence then: heard only where every view is dazzled, the least dazzled loudest.
const DAZZLED: f32 = 0.035;
/// A pixel with this share shows the lamp only.
const LAMP_ONLY: f32 = 1.5;
/// A pixel lit this much worse than the lamp explains shows something else: steel, a shadow, the surround (shrunk by the prior: a third
/// of the light is missing).
const DARKER: f32 = 0.15;
/// From this level on, in all channels, a pixel says no colour.
const CLIPPED: u8 = 245;
/// Below this share noise is averaged away; above it edges are kept.
const FAINT: f32 = 0.08;
/// Added to both sides, levels: in the dark ratios are noise.
const DARK_LEVELS: f32 = 8.0;
/// Depth is carried into holes over about 2 to this power, px.
const DEPTH_REACH_LEVELS: usize = 6;
/// So near the black around the endoscope's field nothing is asked and nobody answers, px of a 960 px wide picture: all views agree
/// there, on a colour that is no tissue's.
const SURROUND_PX: f32 = 6.0;
/// Exposure and lamp are smooth: held for squares of this many pixels along a side.
const SHADE_PITCH: usize = 8;

/// Settle every view's doubtful pixels (confidence below 255) and those near them; depth maps, gains and the lamp model must stand.
pub fn refine_confidence(light_field: &mut LightField) {
    let field = &*light_field;
    let shades: Vec<Shade> = field.views.par_iter().map(|view| Shade::new(view, &field.shading)).collect();
    let surrounds: Vec<Mask> = field.views.par_iter().map(|view| surround(&view.image)).collect();
    let settled: Vec<Mask> = (0..field.views.len())
        .into_par_iter()
        .map_init(HoleFiller::default, |filler, index| {
            examined(field, (&shades, &surrounds), index, filler)
        })
        .collect();
    for (view, confidence) in light_field.views.iter_mut().zip(settled) {
        view.confidence = confidence;
    }
}

/// Steel, a shadow, the surround.
const SOMETHING_ELSE: f32 = f32::INFINITY;
/// Nothing is known of this square.
const UNKNOWN: f32 = f32::NAN;

/// The views agree on a square, do not, or were not asked.
const SURE: u8 = 1;
const UNSURE: u8 = 2;
const UNASKED: u8 = 0;

fn examined(light_field: &LightField, (shades, surrounds): (&[Shade], &[Mask]), index: usize, filler: &mut HoleFiller) -> Mask {
    let view = &light_field.views[index];
    let (width, height) = view.image.size();
    let mut depth = view.depth.clone();
    filler.fill(&mut depth, DEPTH_REACH_LEVELS);
    let near = near_doubt(&view.confidence);
    let witnesses: Vec<Witness<'_>> = (light_field.views.iter().zip(shades).zip(surrounds).enumerate())
        .filter(|&(other, _)| other != index)
        .filter_map(|(_, ((other, shade), surround))| Witness::new(view, (other, shade, surround)))
        .collect();
    let (across, down) = (width / STEP, height / STEP);
    let mut shares = Image::filled(across, down, UNKNOWN);
    let mut sure = Image::filled(across, down, UNASKED);
    let mut tissue = Tissue::default();
    for row in 0..down {
        for column in 0..across {
            let (x, y) = (column * STEP, row * STEP);
            let z = depth.at(x, y);
            if near.at(x, y) == 0 || z <= 0.0 || surrounds[index].at(x, y) != 0 {
                continue;
            }
            tissue.clear();
            let middle = 0.5 * (STEP as f32 - 1.0);
            let place = (x as f32 + middle, y as f32 + middle);
            for witness in &witnesses {
                match witness.color(place.0, place.1, z) {
                    Some(Answer::Color(color)) => tissue.hear(color),
                    Some(Answer::Clipped) => tissue.hear_clipped(),
                    None => {}
                }
            }
            if tissue.answers() < FEWEST_ANSWERS {
                continue;
            }
            let own = shades[index].common(mean_color(view, x, y), x, y);
            // The pixel is a witness too: with two that agree it need not be outvoted by a dazzled crowd.
            tissue.hear(own);
            let verdict = tissue.judge();
            let found = difference(own, verdict.color);
            shares.set(column, row, if found.lit < -DARKER { SOMETHING_ELSE } else { found.lamp });
            sure.set(column, row, if verdict.is_sure { SURE } else { UNSURE });
        }
    }
    let (smooth, most) = (averaged(&shares), most_trust(&sure));
    let mut confidence = view.confidence.clone();
    for y in 0..down * STEP {
        for x in 0..across * STEP {
            let share = smooth.at(x / STEP, y / STEP);
            if share.is_nan() {
                continue;
            }
            // A clipped pixel tells nothing whatever the others say.
            let clipped = is_clipped(view.image.at(x, y));
            let settled = if clipped {
                0
            } else {
                (254.0 * trust_in(share).min(most.at(x / STEP, y / STEP))).ceil() as u8
            };
            // What no detector doubted and is darker than expected is no lamp: an edge, seen from elsewhere.
            if view.confidence.at(x, y) < 255 || share > CLEAN_TO && share != SOMETHING_ELSE {
                confidence.set(x, y, settled);
            }
        }
    }
    despeckled(&confidence, &view.confidence)
}

/// 255 on black pixels and near them.
fn surround(image: &Image<Rgb8>) -> Mask {
    let (width, height) = image.size();
    let black = image.pixels().iter().map(|&pixel| if is_black(pixel) { 255 } else { 0 });
    let Some(mut mask) = Image::from_vec(width, height, black.collect()) else {
        return Image::filled(width, height, 0);
    };
    widen(&mut mask, SURROUND_PX);
    mask
}

/// Mark what lies within `reach_px`, of a picture 960 px wide, of what is marked.
fn widen(mask: &mut Mask, reach_px: f32) {
    let (width, height) = mask.size();
    let reach = (reach_px * width as f32 / 960.0 * f32::from(UNITS_PER_PX)) as u16;
    let mut distance = Image::filled(width, height, 0);
    chamfer_distance(mask, reach + 1, &mut distance);
    for (value, &distance) in mask.pixels_mut().iter_mut().zip(distance.pixels()) {
        *value = if distance <= reach { 255 } else { 0 };
    }
}

/// 255 on doubtful pixels and near them.
fn near_doubt(confidence: &Mask) -> Mask {
    let mut doubt = confidence.clone();
    for value in doubt.pixels_mut() {
        *value = if *value < 255 { 255 } else { 0 };
    }
    widen(&mut doubt, HAZE_REACH_PX);
    doubt
}

fn mean_color(view: &View, x: usize, y: usize) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for v in y..y + STEP {
        for pixel in &view.image.row(v)[x..x + STEP] {
            for (sum, &channel) in sum.iter_mut().zip(pixel) {
                *sum += f32::from(channel);
            }
        }
    }
    sum.map(|s| s / (STEP * STEP) as f32)
}

/// Faint shares averaged over 3 × 3 squares; strong ones as they are.
fn averaged(shares: &Image<f32>) -> Image<f32> {
    let (width, height) = shares.size();
    let mut out = shares.clone();
    for y in 0..height {
        for x in 0..width {
            let share = shares.at(x, y);
            if share.is_nan() || share > FAINT {
                continue;
            }
            let (mut sum, mut count) = (0.0, 0.0);
            for v in y.saturating_sub(1)..(y + 2).min(height) {
                for &s in &shares.row(v)[x.saturating_sub(1)..(x + 2).min(width)] {
                    if s.is_finite() {
                        sum += s.clamp(-FAINT, 2.0 * FAINT);
                        count += 1.0;
                    }
                }
            }
            out.set(x, y, sum / count);
        }
    }
    out
}

/// The most confidence in each square, by whether the views agree there and around it.
fn most_trust(sure: &Image<u8>) -> Image<f32> {
    let (width, height) = sure.size();
    let mut out = Image::filled(width, height, 1.0);
    for y in 0..height {
        for x in 0..width {
            if sure.at(x, y) == UNASKED {
                continue;
            }
            let (mut agree, mut asked) = (0.0_f32, 0.0_f32);
            for v in y.saturating_sub(SURE_REACH)..(y + SURE_REACH + 1).min(height) {
                for &one in &sure.row(v)[x.saturating_sub(SURE_REACH)..(x + SURE_REACH + 1).min(width)] {
                    agree += if one == SURE { 1.0 } else { 0.0 };
                    asked += if one == UNASKED { 0.0 } else { 1.0 };
                }
            }
            if agree < SURE_SHARE * asked {
                out.set(x, y, TRUST_UNSURE);
            }
        }
    }
    out
}

/// Confidence in a pixel by its share of white light.
fn trust_in(share: f32) -> f32 {
    if share >= LAMP_ONLY {
        0.0
    } else if share >= DAZZLED_FROM {
        DAZZLED * ((LAMP_ONLY - share) / (LAMP_ONLY - DAZZLED_FROM)).powi(6)
    } else if share <= HAZE {
        1.0 - (1.0 - HAZY) * ((share - CLEAN_TO) / (HAZE - CLEAN_TO)).clamp(0.0, 1.0)
    } else {
        DAZZLED + (HAZY - DAZZLED) * (DAZZLED_FROM - share) / (DAZZLED_FROM - HAZE)
    }
}

/// What was settled, eroded by one pixel where it was doubtful: a lone trusted pixel among dazzled ones is noise.
fn despeckled(settled: &Mask, before: &Mask) -> Mask {
    let (width, height) = settled.size();
    let mut out: Mask = Image::filled(width, height, 0);
    for y in 0..height {
        for x in 0..width {
            let value = if before.at(x, y) == 255 {
                settled.at(x, y)
            } else {
                let mut least = 255;
                for v in y.saturating_sub(1)..(y + 2).min(height) {
                    let row = &settled.row(v)[x.saturating_sub(1)..(x + 2).min(width)];
                    least = row.iter().copied().fold(least, u8::min);
                }
                least
            };
            out.set(x, y, value);
        }
    }
    out
}

/// What undoes a view's exposure and lamp, square by square.
struct Shade {
    factors: Image<f32>,
    gain: [f32; 3],
}

impl Shade {
    fn new(view: &View, shading: &LampShading) -> Self {
        let (width, height) = view.image.size();
        let mut factors = Image::filled(width.div_ceil(SHADE_PITCH), height.div_ceil(SHADE_PITCH), 1.0);
        let k = &view.camera.intrinsics;
        if !shading.is_flat() {
            let mut depth = view.depth.clone();
            HoleFiller::default().fill(&mut depth, DEPTH_REACH_LEVELS);
            for row in 0..factors.height() {
                for column in 0..factors.width() {
                    let x = (column * SHADE_PITCH + SHADE_PITCH / 2).min(width - 1);
                    let y = (row * SHADE_PITCH + SHADE_PITCH / 2).min(height - 1);
                    let (u, v) = ((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy);
                    let rho2 = (u * u + v * v) as f32;
                    let z = depth.at(x, y);
                    if z > 0.0 {
                        factors.set(column, row, (-shading.log_brightness(z * (1.0 + rho2).sqrt(), rho2)).exp());
                    }
                }
            }
        }
        Self {
            factors,
            gain: view.gain,
        }
    }

    /// Colour with the view's exposure and lamp undone.
    fn common(&self, color: [f32; 3], x: usize, y: usize) -> [f32; 3] {
        let factor = self.factors.at(x / SHADE_PITCH, y / SHADE_PITCH);
        std::array::from_fn(|c| (color[c] * self.gain[c] + DARK_LEVELS) * factor)
    }
}

/// White, and whatever was there is not known.
fn is_clipped(pixel: Rgb8) -> bool {
    pixel.iter().all(|&level| level >= CLIPPED)
}

/// What a witness says.
enum Answer {
    /// With its exposure and lamp undone.
    Color([f32; 3]),
    Clipped,
}

struct Witness<'a> {
    view: &'a View,
    shade: &'a Shade,
    surround: &'a Mask,
    mapping: Mapping,
}

impl<'a> Witness<'a> {
    fn new(asking: &View, (view, shade, surround): (&'a View, &'a Shade, &'a Mask)) -> Option<Self> {
        let mapping = Mapping::new(&asking.camera, &asking.world_from_camera, view)?;
        Some(Self {
            view,
            shade,
            surround,
            mapping,
        })
    }

    /// What this view shows where (x, y) at depth z lies; `None` if it does not see that.
    fn color(&self, x: f32, y: f32, z: f32) -> Option<Answer> {
        let (u, v, depth) = self.mapping.apply(x, y, z);
        let (width, height) = self.view.image.size();
        if !(u >= 0.0 && v >= 0.0 && u < width as f32 - 1.0 && v < height as f32 - 1.0) {
            return None;
        }
        let (column, row) = ((u + 0.5) as usize, (v + 0.5) as usize);
        if self.surround.at(column, row) != 0 || !is_unoccluded(self.view.depth.at(column, row), depth) {
            return None;
        }
        let pixel = self.view.image.at(column, row);
        Some(if is_clipped(pixel) {
            Answer::Clipped
        } else {
            Answer::Color(self.shade.common(pixel.map(f32::from), column, row))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trust_falls_with_the_share_of_white_light() {
        let trust: Vec<f32> = [0.0, 0.01, 0.04, 0.06, 0.1, 0.2, 0.5, 1.7].map(trust_in).to_vec();
        assert!(trust.windows(2).all(|w| w[0] >= w[1]), "{trust:?}");
        assert!(trust[1] == 1.0 && trust[4] > 0.0 && trust[5] > 0.0 && trust[7] == 0.0);
        assert_eq!((trust_in(-0.2), trust_in(SOMETHING_ELSE)), (1.0, 0.0));
    }

    #[test]
    fn the_black_surround_and_its_rim_are_nobodys_witness() {
        let mut image = Image::filled(960, 40, [90, 40, 30]);
        for y in 0..40 {
            image.row_mut(y)[..100].fill([3, 2, 4]);
        }
        let mask = surround(&image);
        let reach = SURROUND_PX as usize;
        for y in 0..40 {
            assert!(mask.row(y)[..99 + reach].iter().all(|&m| m == 255));
            assert!(mask.row(y)[101 + reach..].iter().all(|&m| m == 0));
        }
    }

    #[test]
    fn a_lone_square_that_agrees_by_chance_is_not_trusted() {
        let mut sure = Image::filled(20, 20, SURE);
        for y in 4..16 {
            sure.row_mut(y)[4..16].fill(UNSURE);
        }
        sure.set(10, 10, SURE);
        sure.set(0, 19, UNASKED);
        let trust = most_trust(&sure);
        assert!(trust.at(10, 10) == TRUST_UNSURE && trust.at(5, 5) == TRUST_UNSURE);
        assert!(trust.at(1, 1) == 1.0 && trust.at(0, 19) == 1.0);
    }

    #[test]
    fn faint_shares_are_averaged_and_strong_ones_kept() {
        let mut shares = Image::filled(5, 5, 0.0);
        shares.set(2, 2, 0.045);
        shares.set(4, 4, 0.3);
        shares.set(0, 4, UNKNOWN);
        let smooth = averaged(&shares);
        assert!((smooth.at(2, 2) - 0.005).abs() < 1e-6 && smooth.at(4, 4) == 0.3 && smooth.at(0, 4).is_nan());
    }
}
