//! The stage: depth of the surface, who may speak where, how each view fits, then the picture put together.

use std::sync::Arc;

use crossbeam::queue::ArrayQueue;
use rayon::prelude::*;

use crate::camera::model::CameraModel;
use crate::frame::{Analysis, Frame, Provenance, provenance_code};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::distance::chamfer_distance;
use crate::image::pool::Pool;
use crate::image::specularity::REFERENCE_WIDTH_PX;
use crate::light_field::view::{Kind, LightField};
use crate::pipeline::slot::Slot;
use crate::pipeline::stage::{Stage, StageError};
use crate::stages::specularity_substitution::blend::Canvas;
use crate::stages::specularity_substitution::camera_blending::CameraBlending;
use crate::stages::specularity_substitution::grid::{Division, Grid};
use crate::stages::specularity_substitution::live::Live;
use crate::stages::specularity_substitution::replacement::{Decision, Planes, Shares, mark_left, replace};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::settings::Settings;
use crate::stages::specularity_substitution::sight::{Vantage, Views};
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::speaker::Chosen;
use crate::stages::specularity_substitution::surface_depth::{SurfaceDepth, depth_step};
use crate::stages::specularity_substitution::view_fit::{Comparison, Statistics, ViewFit, Workbench};

/// The picture's camera, and what is made of it.
#[derive(Debug)]
struct Cameras {
    of_picture: CameraModel,
    /// Of the picture that is looked at.
    reduced: CameraModel,
    /// Of the depth's picture.
    of_depth: CameraModel,
}

impl Cameras {
    fn new(camera: &CameraModel, step: usize) -> Self {
        let reduced = camera.reduced(step);
        Self {
            of_picture: camera.clone(),
            of_depth: reduced.scaled(1.0 / depth_step(reduced.width) as f64),
            reduced,
        }
    }
}

/// A light field, made ready to be asked.
#[derive(Debug)]
pub struct Witnesses {
    light_field: Arc<LightField>,
    small_views: Vec<SmallView>,
}

impl Witnesses {
    /// The work of some views' pictures: not for a running line's thread.
    pub fn new(light_field: Arc<LightField>) -> Self {
        Self {
            small_views: light_field.views.par_iter().map(SmallView::of).collect(),
            light_field,
        }
    }
}

/// Replaces specularities by what other views saw; without a light field it only says what it left.
#[derive(Debug)]
pub struct SpecularitySubstitution {
    settings: Settings,
    light_field: Option<Arc<LightField>>,
    small_views: Vec<SmallView>,
    /// Where a newer light field comes.
    newer: Slot<Witnesses>,
    surface: SurfaceDepth,
    cameras: Option<Cameras>,
    distance: Image<u16>,
    forbidden: Mask,
    vantages: Vec<Option<Vantage>>,
    blending: CameraBlending,
    live: Live,
    /// One a view.
    fits: Vec<ViewFit>,
    benches: ArrayQueue<Workbench>,
    canvas: Canvas,
    shares: Shares,
    out: Image<Rgb8>,
    codes: Pool<u8>,
    views: Pool<u16>,
}

impl SpecularitySubstitution {
    /// With a light field, or without one.
    pub fn new(settings: &Settings, light_field: Option<Arc<LightField>>) -> Self {
        let mut stage = Self::awaiting(settings, Slot::new());
        if let Some(light_field) = light_field {
            stage.adopt(Witnesses::new(light_field));
        }
        stage
    }

    /// Without a light field until one comes, and with every newer one from then on.
    pub fn awaiting(settings: &Settings, newer: Slot<Witnesses>) -> Self {
        Self {
            settings: settings.clone(),
            light_field: None,
            small_views: Vec::new(),
            newer,
            surface: SurfaceDepth::default(),
            cameras: None,
            distance: Image::filled(0, 0, 0),
            forbidden: Image::filled(0, 0, 0),
            vantages: Vec::new(),
            blending: CameraBlending::default(),
            live: Live::default(),
            fits: Vec::new(),
            benches: ArrayQueue::new(64),
            canvas: Canvas::default(),
            shares: Shares::default(),
            out: Image::filled(0, 0, [0; 3]),
            codes: Pool::new(64),
            views: Pool::new(32),
        }
    }

    fn adopt(&mut self, witnesses: Witnesses) {
        let Witnesses {
            light_field,
            small_views,
        } = witnesses;
        self.fits = small_views.iter().map(|_| ViewFit::default()).collect();
        self.light_field = Some(light_field);
        self.small_views = small_views;
        self.blending.forget();
    }

    /// Provenance of a picture, still to be filled.
    fn take_planes(&self, (width, height): (usize, usize)) -> Provenance {
        Provenance {
            code: self.codes.take(width, height),
            view: self.views.take(width, height),
            confidence: self.codes.take(width, height),
        }
    }

    /// Where nothing may be touched or learnt.
    fn find_forbidden(&mut self, analysis: &Analysis) {
        self.forbidden.copy_from(&analysis.instruments);
        if let Some(field) = &analysis.field_of_view {
            for (forbidden, &inside) in self.forbidden.pixels_mut().iter_mut().zip(field.pixels()) {
                *forbidden |= 255 - inside;
            }
        }
    }

    fn substitute(&mut self, frame: &mut Frame, analysis: &Analysis, light_field: &LightField, camera: &CameraModel) {
        let step = analysis.step;
        self.find_forbidden(analysis);
        if self.cameras.as_ref().is_none_or(|cameras| cameras.of_picture != *camera) {
            self.cameras = Some(Cameras::new(camera, step));
        }
        let (Some(eye), Some(cameras)) = (&frame.world_from_camera, &self.cameras) else {
            return;
        };
        let image = analysis.image(&frame.image);
        let scale = image.width() as f32 / REFERENCE_WIDTH_PX;
        let settings = &self.settings;
        let reach = Scene::distance_of((settings.reach_px * scale).max(2.0));
        let ring = reach + Scene::distance_of((settings.margin_px * scale).max(6.0));
        let (surface, distance) = (&mut self.surface, &mut self.distance);
        rayon::join(
            || surface.draw(light_field, &cameras.of_depth, eye),
            || chamfer_distance(&analysis.specularities, ring + 1, distance),
        );
        let camera = &cameras.reduced;
        let scene = Scene {
            light_field,
            image,
            depth: &self.surface.depth,
            distance: &self.distance,
            forbidden: &self.forbidden,
            depth_step: Division::by(depth_step(camera.width)),
            scale,
            grid: Grid::over(image.size()),
            reach,
            guard: Scene::distance_of(self.settings.guard_px * scale),
            ring,
        };
        self.vantages.clear();
        self.vantages.extend(
            (light_field.views.iter().zip(&self.small_views)).map(|(view, small)| Vantage::new(camera, eye, view, small)),
        );
        let views = Views {
            full: &light_field.views,
            small: &self.small_views,
            vantages: &self.vantages,
        };
        self.live.look(&scene);
        self.blending
            .choose(&scene, &self.live.holes, &views, self.settings.max_views);
        call_for_fits(&scene, &self.live, &self.blending, &mut self.fits);
        let (benches, vantages) = (&self.benches, &self.vantages);
        let needed = self.fits.par_iter_mut().zip(&self.small_views).zip(vantages).with_max_len(1);
        needed
            .filter(|((fit, _), _)| fit.is_needed())
            .for_each(|((fit, view), vantage)| {
                if let Some(Vantage { small: mapping, .. }) = vantage {
                    let comparison = Comparison {
                        grid: scene.grid,
                        scale: scene.scale,
                        live: &self.live,
                        view,
                        mapping,
                        settings: &self.settings,
                    };
                    let mut bench = benches.pop().unwrap_or_default();
                    fit.measure(&comparison, &mut bench);
                    // More benches than the queue holds are simply freed.
                    let _surplus = benches.push(bench);
                }
            });
        let chosen = Chosen {
            corners: self.blending.corners(),
            fits: &self.fits,
            small_views: &self.small_views,
            vantages: &self.vantages,
        };
        self.canvas.draw(&scene, &self.live, &chosen);
        let (width, height) = frame.image.size();
        if self.out.size() != (width, height) {
            self.out.resize(width, height, [0; 3]);
        }
        let mut provenance = self.take_planes((width, height));
        let planes = Planes {
            image: &mut self.out,
            code: &mut provenance.code,
            view: &mut provenance.view,
            confidence: &mut provenance.confidence,
        };
        self.shares.decide(&scene, &self.canvas, &self.settings);
        self.canvas.take_lamp_off(&scene, &self.live, self.shares.decided());
        let decision = Decision {
            picture: &frame.image,
            specular: &analysis.specularities,
            canvas: &self.canvas,
            shares: &self.shares,
            step,
            grid: scene.grid,
            blocks: &self.live.hole_blocks,
            forbidden: &self.forbidden,
            filled: match light_field.kind {
                Kind::Survey => provenance_code::LIGHT_FIELD,
                Kind::Rolling => provenance_code::RECENT,
            },
        };
        replace(&decision, planes);
        if let Some(alignment) = &mut frame.alignment {
            let sums = (self.fits.iter().filter(|fit| fit.is_needed()))
                .map(ViewFit::statistics)
                .fold(Statistics::default(), |sum, one| Statistics {
                    shift: sum.shift + one.shift,
                    difference: sum.difference + one.difference,
                    count: sum.count + one.count,
                });
            if sums.count > 0.0 {
                alignment.region_shift_px = step as f32 * (sums.shift / sums.count).sqrt();
                alignment.residual_levels = (sums.difference / sums.count).sqrt() * mean_brightness(&self.live);
            }
        }
        frame.provenance = Some(provenance);
        frame.image.swap(&mut self.out);
    }
}

/// Tell every view where it speaks.
fn call_for_fits(scene: &Scene<'_>, live: &Live, blending: &CameraBlending, fits: &mut [ViewFit]) {
    for fit in &mut *fits {
        fit.begin(scene.grid);
    }
    let across = CameraBlending::corners_across(scene.grid);
    for (index, corner) in blending.corners().iter().enumerate() {
        for voice in corner.voices() {
            fits[usize::from(voice.view)].need_around(scene, live, index % across, index / across);
        }
    }
}

fn mean_brightness(live: &Live) -> f32 {
    let (weight, sum) = (live.detail.iter()).fold((0.0_f32, 0.0_f32), |(w, s), block| (w + block[0], s + block[1]));
    sum / weight.max(1e-6)
}

impl Stage for SpecularitySubstitution {
    fn name(&self) -> &'static str {
        "specularity_substitution"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let Some(analysis) = frame.analysis.take() else {
            if frame.timings.iter().any(|timing| timing.bypassed) {
                // Live, the stage before was passed by for lack of time: nothing is known of this picture.
                return Ok(());
            }
            return Err(StageError(
                "no specularity mask: the detection stage must run before the substitution".into(),
            ));
        };
        if frame.scene_cut {
            self.reset();
        }
        if let Some(witnesses) = self.newer.take(frame.id) {
            self.adopt(witnesses);
        }
        let light_field = self.light_field.clone();
        let aligned = frame.alignment.is_some_and(|a| a.aligned) && frame.world_from_camera.is_some();
        match (light_field, frame.camera.clone()) {
            (Some(light_field), Some(camera)) if aligned => {
                self.substitute(frame, &analysis, &light_field, &camera);
            }
            _ => {
                self.reset();
                let mut provenance = self.take_planes(frame.image.size());
                let codes = provenance.code.pixels_mut();
                mark_left(
                    (&analysis.specularities, None),
                    analysis.step,
                    (0, frame.image.width()),
                    codes,
                );
                frame.provenance = Some(provenance);
            }
        }
        frame.analysis = Some(analysis);
        Ok(())
    }

    fn reset(&mut self) {
        for fit in &mut self.fits {
            fit.forget();
        }
        self.blending.forget();
    }
}
