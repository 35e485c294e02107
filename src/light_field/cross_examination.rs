//! Which pixels of a view show the lamp, told by the other views.
//!
//! One picture's detector must draw its line around a highlight generously, and what it silences is missed later: the lamp's image moves
//! so little between neighbouring views that their generous lines overlap. But the views have one brightness (gains, lamp model) to about
//! a hundredth, and a specularity only ever adds white light (Shafer 1985): the darkest answers that agree with each other show the
//! tissue; a doubtful pixel that is no brighter, or no whiter, shows tissue too and may speak; one that is brighter and whiter shows the
//! lamp.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask};
use crate::image::hole_filling::HoleFiller;
use crate::light_field::mapping::Mapping;
use crate::light_field::view::{LampShading, LightField, View};

/// Fewer answers settle nothing.
const FEWEST_ANSWERS: usize = 4;
/// So many answers, and this share of all, must agree to be the tissue's: most of the witnesses may be dazzled themselves.
const FEWEST_AGREEING: usize = 3;
/// See [`FEWEST_AGREEING`].
const AGREEING_SHARE: f32 = 0.08;
/// At least so many of the darkest answers are looked at.
const DARKEST: usize = 12;
/// Answers agree when they differ by at most this share.
const AGREEMENT: f32 = 0.05;
/// White light of up to this share of the brightness may be noise of the colours.
const WHITE_NOISE: f32 = 0.015;
/// Below this ratio of colour to brightness the tissue is too white to tell the lamp's light by its colour.
const LEAST_COLOR: f32 = 0.15;
/// A pixel this much brighter begins to lose confidence, share of its brightness.
const BRIGHTER_FROM: f32 = 0.035;
/// A pixel this much brighter has only `HAZY` confidence left: it speaks where nobody else does.
const HAZE: f32 = 0.07;
/// Confidence in a pixel under haze.
const HAZY: f32 = 0.12;
/// A pixel this much brighter shows the lamp as well as tissue.
const BRIGHTER_TO: f32 = 0.13;
/// Its confidence then: heard only where every view is dazzled, the least dazzled loudest.
const DAZZLED: f32 = 0.035;
/// A pixel this much brighter shows the lamp only.
const LAMP_ONLY: f32 = 0.6;
/// A pixel this much darker shows something else: steel, a shadow, the surround.
const DARKER: f32 = 0.12;
/// Added to both sides, levels: in the dark ratios are noise.
const DARK_LEVELS: f32 = 8.0;
/// Views disagree in depth by at most this share.
const OCCLUSION_TOLERANCE: f32 = 0.03;
/// Depth is carried into holes over about 2 to this power, px.
const DEPTH_REACH_LEVELS: usize = 6;

/// Settle every view's doubtful pixels (confidence below 255); their depth maps, gains and the lamp model must stand.
pub fn refine_confidence(light_field: &mut LightField) {
    let field = &*light_field;
    let settled: Vec<Mask> = (0..field.views.len())
        .into_par_iter()
        .map_init(HoleFiller::default, |filler, index| examined(field, index, filler))
        .collect();
    for (view, confidence) in light_field.views.iter_mut().zip(settled) {
        view.confidence = confidence;
    }
}

fn examined(light_field: &LightField, index: usize, filler: &mut HoleFiller) -> Mask {
    let view = &light_field.views[index];
    let mut depth = view.depth.clone();
    filler.fill(&mut depth, DEPTH_REACH_LEVELS);
    let witnesses: Vec<Witness<'_>> = (light_field.views.iter().enumerate())
        .filter(|&(other, _)| other != index)
        .filter_map(|(_, other)| Witness::new(view, other))
        .collect();
    let mut confidence = view.confidence.clone();
    let mut answers = Vec::with_capacity(witnesses.len() + 1);
    let shading = &light_field.shading;
    for y in 0..view.image.height() {
        for x in 0..view.image.width() {
            let z = depth.at(x, y);
            if view.confidence.at(x, y) == 255 || z <= 0.0 {
                continue;
            }
            let own = common_color(view, shading, view.image.at(x, y), x as f32, y as f32, z);
            answers.clear();
            answers.extend(witnesses.iter().filter_map(|w| w.color(shading, x as f32, y as f32, z)));
            if answers.len() < FEWEST_ANSWERS {
                continue;
            }
            // The pixel is a witness too: with two that agree it need not be outvoted by a dazzled crowd.
            answers.push(own);
            let tissue = darkest_agreeing(&mut answers);
            let trust = trust_in(lamp_share(own, tissue));
            let [r, g, b] = view.image.at(x, y);
            // A clipped pixel tells nothing whatever the others say.
            let clipped = r.min(g).min(b) >= 250;
            confidence.set(x, y, if clipped { 0 } else { (254.0 * trust) as u8 });
        }
    }
    despeckled(&confidence, &view.confidence)
}

/// Confidence in a pixel by how much brighter it is than the witnesses say, as a share.
fn trust_in(ratio: f32) -> f32 {
    if ratio < -DARKER || ratio >= LAMP_ONLY {
        0.0
    } else if ratio >= BRIGHTER_TO {
        DAZZLED * ((LAMP_ONLY - ratio) / (LAMP_ONLY - BRIGHTER_TO)).powi(2)
    } else if ratio <= HAZE {
        1.0 - (1.0 - HAZY) * ((ratio - BRIGHTER_FROM) / (HAZE - BRIGHTER_FROM)).clamp(0.0, 1.0)
    } else {
        DAZZLED + (HAZY - DAZZLED) * (BRIGHTER_TO - ratio) / (BRIGHTER_TO - HAZE)
    }
}

/// What was settled, eroded by one pixel where it was doubtful: a lone trusted pixel among dazzled ones is noise.
fn despeckled(settled: &Mask, before: &Mask) -> Mask {
    let (width, height) = settled.size();
    let mut out: Mask = Image::filled(width, height, 0);
    for y in 0..height {
        for x in 0..width {
            let value = if before.at(x, y) == 255 {
                255
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

struct Witness<'a> {
    view: &'a View,
    mapping: Mapping,
}

impl<'a> Witness<'a> {
    fn new(asking: &View, view: &'a View) -> Option<Self> {
        Mapping::new(&asking.camera, &asking.world_from_camera, view).map(|mapping| Self { view, mapping })
    }

    /// The common colour of what this view shows where (x, y) at depth z lies; `None` if it does not see that.
    fn color(&self, shading: &LampShading, x: f32, y: f32, z: f32) -> Option<[f32; 3]> {
        let (u, v, depth) = self.mapping.apply(x, y, z);
        let (width, height) = self.view.image.size();
        if !(u >= 0.0 && v >= 0.0 && u <= width as f32 - 1.0 && v <= height as f32 - 1.0) {
            return None;
        }
        let (column, row) = ((u + 0.5) as usize, (v + 0.5) as usize);
        let held = self.view.depth.at(column.min(width - 1), row.min(height - 1));
        if held > 0.0 && (held - depth).abs() > OCCLUSION_TOLERANCE * depth {
            return None;
        }
        let color = self.view.image.at(column.min(width - 1), row.min(height - 1));
        Some(common_color(self.view, shading, color, u, v, depth))
    }
}

/// The mean of the darkest answers that agree with each other.
fn darkest_agreeing(answers: &mut Vec<[f32; 3]>) -> [f32; 3] {
    let enough = FEWEST_AGREEING.max((AGREEING_SHARE * answers.len() as f32) as usize);
    let darker = |a: &[f32; 3], b: &[f32; 3]| luma(*a).total_cmp(&luma(*b));
    let looked_at = DARKEST.max(answers.len() / 4);
    if answers.len() > looked_at {
        answers.select_nth_unstable_by(looked_at, darker);
        answers.truncate(looked_at);
    }
    answers.sort_unstable_by(darker);
    let mean = |group: &[[f32; 3]]| -> [f32; 3] { std::array::from_fn(|c| group.iter().map(|a| a[c]).sum::<f32>() / group.len() as f32) };
    (answers.windows(enough))
        .find(|group| luma(group[enough - 1]) <= (1.0 + AGREEMENT) * luma(group[0]))
        .map_or_else(|| answers[answers.len() / 2], mean)
}

/// Light that `color` has and `tissue` has not, as a share of the tissue's brightness; negative when it is darker. Only white light counts,
/// where the tissue has a colour: what is brighter in the tissue's own colour is lit better.
fn lamp_share(color: [f32; 3], tissue: [f32; 3]) -> f32 {
    let brightness = luma(tissue).max(1.0);
    let brighter = (luma(color) - luma(tissue)) / brightness;
    let mean = tissue.iter().sum::<f32>() / 3.0;
    let colorful = tissue.map(|t| t - mean);
    let square: f32 = colorful.iter().map(|c| c * c).sum();
    if square < (LEAST_COLOR * mean).powi(2) {
        return brighter;
    }
    // color = a·tissue + s·white, least squares: a from the part of both that is not white.
    let a = color.iter().zip(colorful).map(|(c, k)| c * k).sum::<f32>() / square;
    let white = (color.iter().sum::<f32>() / 3.0 - a * mean) / brightness;
    if white < -WHITE_NOISE {
        // More colourful than what was taken for the tissue: the others show more of the lamp than this one.
        return brighter.clamp(-DARKER, 0.0);
    }
    brighter.min(white.max(0.0) + WHITE_NOISE)
}

fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// Colour with the view's exposure and lamp undone.
fn common_color(view: &View, shading: &LampShading, color: [u8; 3], x: f32, y: f32, z: f32) -> [f32; 3] {
    let k = &view.camera.intrinsics;
    let (u, v) = ((x - k.cx as f32) / k.fx as f32, (y - k.cy as f32) / k.fy as f32);
    let rho2 = u * u + v * v;
    let lamp = if shading.is_flat() {
        0.0
    } else {
        shading.log_brightness(z * (1.0 + rho2).sqrt(), rho2)
    };
    let factor = (-lamp).exp();
    std::array::from_fn(|c| (f32::from(color[c]) * view.gain[c] + DARK_LEVELS) * factor)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TISSUE: [f32; 3] = [170.0, 80.0, 70.0];

    #[test]
    fn a_few_clean_answers_outvote_a_dazzled_crowd() {
        let mut answers: Vec<[f32; 3]> = (0..20).map(|i| TISSUE.map(|c| c + 12.0 + 8.0 * i as f32)).collect();
        answers.extend([TISSUE, TISSUE.map(|c| c * 1.01), TISSUE.map(|c| c * 1.02)]);
        assert!((luma(darkest_agreeing(&mut answers)) / luma(TISSUE) - 1.01).abs() < 0.01);
    }

    #[test]
    fn only_white_light_is_the_lamps() {
        assert!(lamp_share(TISSUE.map(|c| c + 20.0), TISSUE) > 0.15);
        assert!(lamp_share(TISSUE.map(|c| c * 1.2), TISSUE) < 0.02);
        assert!(lamp_share(TISSUE.map(|c| c * 0.8), TISSUE) < -0.15);
        // White tissue: brightness alone decides.
        assert!(lamp_share([215.0; 3], [195.0; 3]) > 0.09);
    }
}
