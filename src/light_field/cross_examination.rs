//! Which pixels of a view show the lamp, told by the other views.
//!
//! One picture's detector must draw its line around a highlight generously, and what it silences is missed later: the lamp's image moves
//! so little between neighbouring views that their generous lines overlap. But the views have one brightness (gains, lamp model) to about
//! a hundredth, and a specularity only ever adds light: a doubtful pixel that is no brighter than what most other views show of the same
//! place shows tissue, and may speak; one that is brighter shows the lamp.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask};
use crate::image::hole_filling::HoleFiller;
use crate::light_field::mapping::Mapping;
use crate::light_field::view::{LampShading, LightField, View};

/// At most so many other views are asked.
const WITNESSES: usize = 40;
/// Fewer answers settle nothing.
const FEWEST_ANSWERS: usize = 4;
/// Of the answers' brightness this quantile counts: up to most of the witnesses may be dazzled themselves.
const QUANTILE: f32 = 0.22;
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
    let mut nearest: Vec<(f64, usize)> = (light_field.views.iter().enumerate())
        .filter(|&(other, _)| other != index)
        .map(|(other, v)| {
            (
                (v.world_from_camera.translation() - view.world_from_camera.translation()).norm(),
                other,
            )
        })
        .collect();
    nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
    // The very nearest are dazzled at the same place: witnesses are spread over all distances.
    let stride = nearest.len().div_ceil(WITNESSES).max(1);
    let witnesses: Vec<Witness<'_>> = (nearest.iter().skip(stride / 2).step_by(stride))
        .filter_map(|&(_, other)| Witness::new(view, &light_field.views[other]))
        .collect();
    let mut confidence = view.confidence.clone();
    let mut answers = Vec::with_capacity(WITNESSES);
    let shading = &light_field.shading;
    for y in 0..view.image.height() {
        for x in 0..view.image.width() {
            let z = depth.at(x, y);
            if view.confidence.at(x, y) == 255 || z <= 0.0 {
                continue;
            }
            answers.clear();
            answers.extend(witnesses.iter().filter_map(|w| w.brightness(shading, x as f32, y as f32, z)));
            if answers.len() < FEWEST_ANSWERS {
                continue;
            }
            answers.sort_by(f32::total_cmp);
            let expected = answers[(QUANTILE * (answers.len() - 1) as f32) as usize];
            let [r, g, b] = view.image.at(x, y).map(f32::from);
            let shown = common_brightness(view, shading, [r, g, b], x as f32, y as f32, z);
            let ratio = (shown - expected) / expected.max(1.0);
            let trust = trust_in(ratio);
            // A clipped pixel tells nothing whatever the others say.
            let clipped = r.min(g).min(b) >= 250.0;
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

    /// The common brightness of what this view shows where (x, y) at depth z lies; `None` if it does not see that.
    fn brightness(&self, shading: &LampShading, x: f32, y: f32, z: f32) -> Option<f32> {
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
        let color = self.view.image.at(column.min(width - 1), row.min(height - 1)).map(f32::from);
        Some(common_brightness(self.view, shading, color, u, v, depth))
    }
}

/// Luma with the view's exposure and lamp undone.
fn common_brightness(view: &View, shading: &LampShading, color: [f32; 3], x: f32, y: f32, z: f32) -> f32 {
    let k = &view.camera.intrinsics;
    let (u, v) = ((x - k.cx as f32) / k.fx as f32, (y - k.cy as f32) / k.fy as f32);
    let rho2 = u * u + v * v;
    let luma = 0.299 * color[0] * view.gain[0] + 0.587 * color[1] * view.gain[1] + 0.114 * color[2] * view.gain[2];
    let lamp = if shading.is_flat() {
        0.0
    } else {
        shading.log_brightness(z * (1.0 + rho2).sqrt(), rho2)
    };
    (luma + DARK_LEVELS) * (-lamp).exp()
}
