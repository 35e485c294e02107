//! One region of the specular mask: draw, align, brighten, blend, judge.

use nalgebra::Vector3;

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::blur::BlurScratch;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::light_field::mapping::Mapping;
use crate::light_field::view::LightField;
use crate::stages::specularity_substitution::brightness::LogRatio;
use crate::stages::specularity_substitution::candidates::{Candidate, CandidateSearch, MAX_PLACES, MAX_VIEWS};
use crate::stages::specularity_substitution::ring::{Detail, luminance, shift_between};
use crate::stages::specularity_substitution::stage::Settings;
use crate::stages::specularity_substitution::warp::{WarpedView, Window};

/// On the ring a live pixel counts as at most this much brighter than what was measured, levels.
const BRIGHTER_AT_MOST: f32 = 4.0;

/// What a region looks at of the live frame.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// The light field.
    pub light_field: &'a LightField,
    /// The live picture, undistorted.
    pub image: &'a Image<Rgb8>,
    /// Depth of the surface in the live picture, mm, 0 where unknown; may be coarser than the picture by an integer step.
    pub depth: &'a Image<f32>,
    /// Distance to the nearest specular pixel, thirds of a px.
    pub distance: &'a Image<u16>,
    /// 255 where nothing may be touched or learnt: instruments, outside the field.
    pub forbidden: &'a Mask,
    /// Explains the picture.
    pub camera: &'a CameraModel,
    /// Where it was taken.
    pub eye: &'a Transform<World, Camera>,
    /// Width of the picture over the width for which lengths are given.
    pub scale: f32,
}

/// What became of a region.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Verdict {
    /// No view saw it, or the surface is unknown.
    #[default]
    Unseen,
    /// The ring does not fit within the bound.
    Unfit,
    /// Replaced.
    Filled,
}

/// A region's result, over its window; kept between frames.
#[derive(Debug, Default)]
pub struct Filled {
    /// Where it lies.
    pub window: Window,
    /// What became of it.
    pub verdict: Verdict,
    /// New colours.
    pub color: Vec<Rgb8>,
    /// How much of the old pixel is gone, 0…1.
    pub alpha: Vec<f32>,
    /// The loudest view, and how sure (0–255).
    pub source: Vec<(u16, u8)>,
    /// Root mean square difference on the ring, levels.
    pub residual_levels: f32,
    /// Root mean square shift of its views, px.
    pub shift_px: f32,
}

/// Working memory of one region at a time.
#[derive(Debug, Default)]
pub struct Workbench {
    search: CandidateSearch,
    chosen: Vec<Candidate>,
    hole: Vec<Vector3<f64>>,
    depth: Vec<f32>,
    live: Vec<[f32; 3]>,
    good: Vec<bool>,
    fine: Vec<bool>,
    views: [WarpedView; MAX_VIEWS],
    ratios: [LogRatio; MAX_VIEWS],
    live_detail: Detail,
    drawn_detail: Detail,
    blended: Vec<[f32; 3]>,
    belief: Vec<f32>,
    excess: Vec<f32>,
    scratch: BlurScratch,
}

impl Workbench {
    /// Treat the region in `window`; its hole is where the distance to a specular pixel is zero.
    pub fn fill(&mut self, scene: &Scene<'_>, settings: &Settings, window: Window, out: &mut Filled) {
        out.window = window;
        out.verdict = Verdict::Unseen;
        out.color.clear();
        out.alpha.clear();
        out.source.clear();
        self.look(scene, settings, window);
        self.search.choose(scene.light_field, scene.eye, &self.hole, &mut self.chosen);
        if self.chosen.is_empty() {
            return;
        }
        out.shift_px = self.draw_aligned(scene, settings, window);
        self.match_brightness(settings, window, scene.scale);
        self.blend(window);
        let fit = self.ring_fit();
        out.residual_levels = fit.map_or(0.0, |(residual, _)| residual);
        out.verdict = match fit {
            Some((residual, detail)) if residual <= settings.max_ring_levels.max(settings.max_ring_share * detail) => {
                Verdict::Filled
            }
            _ => Verdict::Unfit,
        };
        if out.verdict == Verdict::Filled {
            self.replace(scene, settings, window, out);
        }
    }

    /// Take the window's part of the frame: colours, depth, which pixels are good, and points of the hole in space.
    fn look(&mut self, scene: &Scene<'_>, settings: &Settings, window: Window) {
        for buffer in [&mut self.depth, &mut self.excess, &mut self.belief] {
            buffer.clear();
        }
        self.live.clear();
        self.good.clear();
        self.fine.clear();
        self.hole.clear();
        let step = scene.image.width().div_ceil(scene.depth.width()).max(1);
        let guard = (settings.guard_px * scene.scale * 3.0) as u16;
        for y in window.top..window.top + window.height {
            let depths = scene.depth.row((y / step).min(scene.depth.height() - 1));
            let columns = window.left..window.left + window.width;
            for (x, pixel) in columns.clone().zip(&scene.image.row(y)[columns]) {
                let depth = depths[(x / step).min(depths.len() - 1)];
                let distance = scene.distance.at(x, y);
                let forbidden = scene.forbidden.at(x, y) != 0;
                self.depth.push(if forbidden { 0.0 } else { depth });
                self.live.push(pixel.map(f32::from));
                self.good
                    .push(!forbidden && distance > guard && depth > 0.0 && pixel.iter().any(|&c| c < 250));
                self.fine.push(distance <= guard);
            }
        }
        // Places of the hole, evenly among its pixels.
        let wanted = |bench: &Self, index: usize| bench.fine[index] && bench.depth[index] > 0.0;
        let pixels = (0..window.area()).filter(|&i| wanted(self, i)).count();
        let every = pixels.div_ceil(MAX_PLACES).max(1);
        let mut counted = 0;
        for index in 0..window.area() {
            if !wanted(self, index) {
                continue;
            }
            if counted % every == 0 {
                let k = &scene.camera.intrinsics;
                let (x, y) = (
                    (window.left + index % window.width) as f64,
                    (window.top + index / window.width) as f64,
                );
                let z = f64::from(self.depth[index]);
                let point = nalgebra::Point3::new((x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z);
                self.hole.push((scene.eye.isometry() * point).coords);
            }
            counted += 1;
        }
    }

    /// Draw every chosen view, and once more with the shift its ring asks for. Returns the root mean square shift, px.
    fn draw_aligned(&mut self, scene: &Scene<'_>, settings: &Settings, window: Window) -> f32 {
        let sigma = 6.0 * scene.scale.max(0.5);
        let (live, good) = (&self.live, &self.good);
        self.live_detail
            .measure(window, |i| live[i], |i| good[i], sigma, &mut self.scratch);
        let (mut sum, mut count) = (0.0, 0);
        for (slot, candidate) in self.chosen.iter().enumerate() {
            let view = &scene.light_field.views[candidate.view];
            let Some(mapping) = Mapping::new(scene.camera, scene.eye, view) else {
                self.views[slot].confidence.clear();
                continue;
            };
            let drawn = &mut self.views[slot];
            let mut shift = [0.0_f32; 2];
            if settings.align_on_ring {
                let limit = settings.max_shift_px * scene.scale;
                for _ in 0..settings.ring_rounds {
                    drawn.draw(view, &mapping, window, &self.depth, shift, None);
                    let (color, confidence) = (&drawn.color, &drawn.confidence);
                    let usable = |i: usize| good[i] && confidence[i] > 0.5;
                    self.drawn_detail
                        .measure(window, |i| color[i], usable, sigma, &mut self.scratch);
                    let Some(step) = shift_between(&self.live_detail, &self.drawn_detail, usable, scene.scale) else {
                        break;
                    };
                    shift = [
                        (shift[0] + step[0]).clamp(-limit, limit),
                        (shift[1] + step[1]).clamp(-limit, limit),
                    ];
                    // A step is right to about a tenth of its length.
                    if step[0].abs().max(step[1].abs()) < 0.4 {
                        break;
                    }
                }
            }
            drawn.draw(view, &mapping, window, &self.depth, shift, Some(&self.fine));
            sum += shift[0] * shift[0] + shift[1] * shift[1];
            count += 1;
        }
        if count > 0 { (sum / count as f32).sqrt() } else { 0.0 }
    }

    fn match_brightness(&mut self, settings: &Settings, window: Window, scale: f32) {
        let (live, good) = (&self.live, &self.good);
        for ((view, ratio), _) in self.views.iter().zip(&mut self.ratios).zip(&self.chosen) {
            if view.confidence.is_empty() {
                continue;
            }
            let weight = |i: usize| if good[i] { view.confidence[i] } else { 0.0 };
            ratio.measure(
                window,
                |i| live[i],
                |i| view.color[i],
                weight,
                settings.brightness_sigma_px * scale,
                &mut self.scratch,
            );
        }
    }

    fn blend(&mut self, window: Window) {
        self.blended.clear();
        for y in 0..window.height {
            for x in 0..window.width {
                let index = y * window.width + x;
                let (mut sum, mut total) = ([0.0_f32; 3], 0.0_f32);
                for ((view, ratio), candidate) in self.views.iter().zip(&self.ratios).zip(&self.chosen) {
                    let Some(&confidence) = view.confidence.get(index) else {
                        continue;
                    };
                    if confidence <= 0.0 {
                        continue;
                    }
                    let weight = candidate.weight * confidence;
                    let color = ratio.apply(view.color[index], x, y);
                    for (sum, channel) in sum.iter_mut().zip(color) {
                        *sum += weight * channel;
                    }
                    total += weight;
                }
                self.blended.push(if total > 0.0 { sum.map(|s| s / total) } else { [0.0; 3] });
                self.belief.push(total);
            }
        }
    }

    /// Root mean square difference of live and blended luminance on the good pixels, and of the live detail itself, levels.
    fn ring_fit(&self) -> Option<(f32, f32)> {
        let (mut difference, mut detail, mut count) = (0.0_f32, 0.0_f32, 0_u32);
        for (index, good) in self.good.iter().enumerate() {
            if *good && self.belief[index] > 0.0 {
                let level = luminance(self.live[index]);
                // The lamp only adds light: haze that no detector saw must not condemn a good fit.
                let d = (level - luminance(self.blended[index])).min(BRIGHTER_AT_MOST);
                difference += d * d;
                let texture = self.live_detail.values.pixels()[index] * level;
                detail += texture * texture;
                count += 1;
            }
        }
        (count >= 30).then(|| ((difference / count as f32).sqrt(), (detail / count as f32).sqrt()))
    }

    /// Replace what is brighter than what was measured.
    fn replace(&mut self, scene: &Scene<'_>, settings: &Settings, window: Window, out: &mut Filled) {
        // How much more light the live pixel shows than it should; the least of the channels, since the lamp is white.
        for index in 0..window.area() {
            let excess = if self.belief[index] > 0.0 {
                luminance(self.live[index]) - luminance(self.blended[index])
            } else {
                0.0
            };
            self.excess.push(excess);
        }
        let reach = settings.reach_px * scene.scale * 3.0;
        let (low, high) = (settings.excess_low_levels, settings.excess_high_levels);
        for y in 0..window.height {
            for x in 0..window.width {
                let index = y * window.width + x;
                let distance = f32::from(scene.distance.at(window.left + x, window.top + y));
                let belief = self.belief[index];
                let alpha = if belief <= 0.0 || scene.forbidden.at(window.left + x, window.top + y) != 0 || distance > reach {
                    0.0
                } else {
                    // The mean over 3 × 3 pixels: noise does not decide.
                    let local = mean_of_neighbours(&self.excess, &self.belief, x, y, window);
                    let near = (1.0 - distance / reach).clamp(0.0, 1.0);
                    let ramp = ((local.max(0.6 * self.excess[index]) - low) / (high - low)).clamp(0.0, 1.0);
                    smooth(ramp) * smooth((2.0 * near).min(1.0))
                };
                out.alpha.push(alpha);
                out.color.push(self.blended[index].map(|v| (v + 0.5) as u8));
                let loudest = self.loudest(index);
                out.source.push((loudest, (255.0 * (belief / 1.5).min(1.0)) as u8));
            }
        }
    }

    fn loudest(&self, index: usize) -> u16 {
        let mut best = (0.0, 0);
        for (view, candidate) in self.views.iter().zip(&self.chosen) {
            let weight = candidate.weight * view.confidence.get(index).copied().unwrap_or(0.0);
            if weight > best.0 {
                best = (weight, candidate.view as u16);
            }
        }
        best.1
    }
}

fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

fn mean_of_neighbours(excess: &[f32], belief: &[f32], x: usize, y: usize, window: Window) -> f32 {
    let (mut sum, mut count) = (0.0, 0.0);
    for v in y.saturating_sub(1)..(y + 2).min(window.height) {
        for u in x.saturating_sub(1)..(x + 2).min(window.width) {
            let index = v * window.width + u;
            if belief[index] > 0.0 {
                sum += excess[index];
                count += 1.0;
            }
        }
    }
    sum / f32::max(count, 1.0)
}
