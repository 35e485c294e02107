//! The stage: depth of the surface, regions of the mask, all regions at once on the pool's threads, then the picture put together.

use std::sync::Arc;

use crossbeam::queue::ArrayQueue;
use rayon::prelude::*;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, Provenance, provenance_code};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::Components;
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};
use crate::image::hole_filling::HoleFiller;
use crate::image::pool::Pool;
use crate::image::specularity::REFERENCE_WIDTH_PX;
use crate::light_field::rasterize::DepthRasterizer;
use crate::light_field::view::LightField;
use crate::pipeline::stage::{Stage, StageError};
use crate::stages::specularity_substitution::region::{Filled, Scene, Verdict, Workbench};
use crate::stages::specularity_substitution::warp::Window;

/// How specularities are replaced. Lengths are for a picture 960 px wide and scale with its width.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Pixels nearer than this to a specular one are not trusted for fitting: the lobe's haze, px.
    pub guard_px: f32,
    /// Replacement reaches at most so far beyond the mask, px.
    pub reach_px: f32,
    /// Good pixels so far around a region are looked at, px.
    pub margin_px: f32,
    /// Brightness is fitted over about this radius, px.
    pub brightness_sigma_px: f32,
    /// A pixel this much brighter than what was measured begins to be replaced, levels.
    pub excess_low_levels: f32,
    /// A pixel this much brighter is replaced wholly, levels.
    pub excess_high_levels: f32,
    /// Whether a small shift is looked for on each ring.
    pub align_on_ring: bool,
    /// Rounds of that search.
    pub ring_rounds: usize,
    /// The longest shift, px.
    pub max_shift_px: f32,
    /// A ring fits when its root mean square difference is at most this, levels …
    pub max_ring_levels: f32,
    /// … or at most this share of its own detail.
    pub max_ring_share: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            guard_px: 5.0,
            reach_px: 9.0,
            margin_px: 22.0,
            brightness_sigma_px: 15.0,
            excess_low_levels: 3.0,
            excess_high_levels: 8.0,
            align_on_ring: true,
            ring_rounds: 3,
            max_shift_px: 4.0,
            max_ring_levels: 6.0,
            max_ring_share: 0.7,
        }
    }
}

/// Replaces specularities by what other views saw; without a light field it only says what it left.
#[derive(Debug)]
pub struct SpecularitySubstitution {
    settings: Settings,
    light_field: Option<Arc<LightField>>,
    rasterizer: DepthRasterizer,
    filler: HoleFiller,
    depth: Image<f32>,
    coarse_camera: Option<CameraModel>,
    distance: Image<u16>,
    zone: Mask,
    forbidden: Mask,
    components: Components,
    regions: Vec<Filled>,
    windows: Vec<Window>,
    benches: ArrayQueue<Box<Workbench>>,
    out: Image<Rgb8>,
    codes: Pool<u8>,
    views: Pool<u16>,
}

/// Depth is carried into holes over about 2 to this power, px of the depth's picture.
const DEPTH_REACH_LEVELS: usize = 6;

/// Widest picture over which depth is drawn pixel for pixel.
const DEPTH_WIDTH_PX: usize = 960;

impl SpecularitySubstitution {
    /// With a light field, or without one.
    pub fn new(settings: &Settings, light_field: Option<Arc<LightField>>) -> Self {
        Self {
            settings: settings.clone(),
            light_field,
            rasterizer: DepthRasterizer::new(),
            filler: HoleFiller::default(),
            depth: Image::filled(0, 0, 0.0),
            coarse_camera: None,
            distance: Image::filled(0, 0, 0),
            zone: Image::filled(0, 0, 0),
            forbidden: Image::filled(0, 0, 0),
            components: Components::default(),
            regions: Vec::new(),
            windows: Vec::new(),
            benches: ArrayQueue::new(64),
            out: Image::filled(0, 0, [0; 3]),
            codes: Pool::new(64),
            views: Pool::new(32),
        }
    }

    fn find_regions(&mut self, frame: &Frame, specular: &Mask, scale: f32) {
        let (width, height) = specular.size();
        let reach = ((self.settings.reach_px * scale).max(2.0) * f32::from(UNITS_PER_PX)) as u16;
        chamfer_distance(specular, 60 * UNITS_PER_PX, &mut self.distance);
        for mask in [&mut self.zone, &mut self.forbidden] {
            if mask.size() != (width, height) {
                mask.resize(width, height, 0);
            }
        }
        for (zone, &distance) in self.zone.pixels_mut().iter_mut().zip(self.distance.pixels()) {
            *zone = if distance <= reach { 255 } else { 0 };
        }
        match &frame.instruments {
            Some(instruments) => self.forbidden.copy_from(instruments),
            None => self.forbidden.fill(0),
        }
        if let Some(field) = &frame.field_of_view {
            for (forbidden, &inside) in self.forbidden.pixels_mut().iter_mut().zip(field.pixels()) {
                *forbidden |= 255 - inside;
            }
        }
        self.components.label(&self.zone);
        let margin = (self.settings.margin_px * scale).max(6.0) as usize;
        self.windows.clear();
        self.windows.extend(self.components.regions().iter().map(|region| {
            let (left, top) = (
                (region.left as usize).saturating_sub(margin),
                (region.top as usize).saturating_sub(margin),
            );
            let (right, bottom) = (
                (region.right as usize + margin).min(width),
                (region.bottom as usize + margin).min(height),
            );
            Window {
                left,
                top,
                width: right - left,
                height: bottom - top,
            }
        }));
        if self.regions.len() < self.windows.len() {
            self.regions.resize_with(self.windows.len(), Filled::default);
        }
    }

    fn draw_depth(&mut self, light_field: &LightField, frame: &Frame, camera: &CameraModel) {
        let Some(pose) = &frame.world_from_camera else { return };
        let step = camera.width.div_ceil(DEPTH_WIDTH_PX).max(1);
        let coarse = self.coarse_camera.get_or_insert_with(|| camera.scaled(1.0 / step as f64));
        if coarse.width != camera.width / step {
            *coarse = camera.scaled(1.0 / step as f64);
        }
        self.rasterizer.render(&light_field.surface, coarse, pose, &mut self.depth);
        // The survey's stereo is blind under its own specularities: there the surface is taken to go on smoothly. Only the place is
        // guessed so, not the colour, and a wrong place shows on the ring.
        self.filler.fill(&mut self.depth, DEPTH_REACH_LEVELS);
    }

    /// The frame's pixels, each from its region's result.
    fn put_together(&mut self, frame: &mut Frame, specular: &Mask) {
        self.out.copy_from(&frame.image);
        let Provenance {
            mut code,
            mut view,
            mut confidence,
        } = self.all_left(specular);
        let (mut energy, mut shift, mut count) = (0.0_f32, 0.0_f32, 0.0_f32);
        for run in self.components.runs() {
            let filled = &self.regions[run.label as usize];
            if filled.verdict != Verdict::Filled {
                continue;
            }
            let (y, window) = (run.y as usize, filled.window);
            for x in run.begin as usize..run.end as usize {
                let index = (y - window.top) * window.width + x - window.left;
                let alpha = filled.alpha[index];
                if alpha < 0.02 {
                    if alpha > 0.0 || filled.source[index].1 > 0 {
                        // Looked at, and found to be tissue.
                        code.set(x, y, provenance_code::UNTOUCHED);
                    }
                    continue;
                }
                let (old, new) = (frame.image.at(x, y), filled.color[index]);
                let mixed = std::array::from_fn(|c| {
                    let (old, new) = (f32::from(old[c]), f32::from(new[c]));
                    (old + alpha * (new - old) + 0.5) as u8
                });
                self.out.set(x, y, mixed);
                code.set(x, y, provenance_code::LIGHT_FIELD);
                view.set(x, y, filled.source[index].0);
                confidence.set(x, y, filled.source[index].1);
            }
        }
        for filled in self
            .regions
            .iter()
            .take(self.windows.len())
            .filter(|f| f.verdict == Verdict::Filled)
        {
            energy += filled.residual_levels * filled.residual_levels;
            shift += filled.shift_px * filled.shift_px;
            count += 1.0;
        }
        if let Some(alignment) = &mut frame.alignment
            && count > 0.0
        {
            alignment.residual_levels = (energy / count).sqrt();
            alignment.region_shift_px = (shift / count).sqrt();
        }
        frame.provenance = Some(Provenance { code, view, confidence });
        frame.image.swap(&mut self.out);
    }

    /// Every specularity left as it was.
    fn all_left(&self, specular: &Mask) -> Provenance {
        let (width, height) = specular.size();
        let mut code = self.codes.take_copy(specular);
        for value in code.pixels_mut() {
            *value = if *value != 0 {
                provenance_code::LEFT
            } else {
                provenance_code::UNTOUCHED
            };
        }
        let (mut view, mut confidence) = (self.views.take(width, height), self.codes.take(width, height));
        view.fill(0);
        confidence.fill(0);
        Provenance { code, view, confidence }
    }
}

impl Stage for SpecularitySubstitution {
    fn name(&self) -> &'static str {
        "specularity_substitution"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let Some(specular) = frame.specularities.take() else {
            return Err(StageError(
                "no specularity mask: the detection stage must run before the substitution".into(),
            ));
        };
        let light_field = self.light_field.clone();
        let aligned = frame.alignment.is_some_and(|a| a.aligned) && frame.world_from_camera.is_some();
        match (light_field, frame.camera.clone()) {
            (Some(light_field), Some(camera)) if aligned && specular.size() == frame.image.size() => {
                let scale = specular.width() as f32 / REFERENCE_WIDTH_PX;
                self.draw_depth(&light_field, frame, &camera);
                self.find_regions(frame, &specular, scale);
                if let Some(eye) = &frame.world_from_camera {
                    let scene = Scene {
                        light_field: &light_field,
                        image: &frame.image,
                        depth: &self.depth,
                        distance: &self.distance,
                        forbidden: &self.forbidden,
                        camera: &camera,
                        eye,
                        scale,
                    };
                    let (settings, benches) = (&self.settings, &self.benches);
                    self.regions
                        .par_iter_mut()
                        .zip(&self.windows)
                        .with_max_len(1)
                        .for_each(|(filled, &window)| {
                            let mut bench = benches.pop().unwrap_or_default();
                            bench.fill(&scene, settings, window, filled);
                            // More benches than the queue holds are simply freed.
                            let _surplus = benches.push(bench);
                        });
                }
                self.put_together(frame, &specular);
            }
            _ => frame.provenance = Some(self.all_left(&specular)),
        }
        frame.specularities = Some(specular);
        Ok(())
    }
}
