//! From posed pictures to a finished light field: depth, surface, depth of every view, gains.

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Rgb8};
use crate::light_field::confidence::confidence_of;
use crate::light_field::cross_examination;
use crate::light_field::depth::stereo::{DepthMap, Stereo, StereoSettings, confirmed, depth_maps};
use crate::light_field::error::LightFieldError;
use crate::light_field::file::{self, Origin};
use crate::light_field::photometry;
use crate::light_field::prior::PosePrior;
use crate::light_field::rasterize::DepthRasterizer;
use crate::light_field::surface::{SurfaceSettings, fuse};
use crate::light_field::survey::{self, SurveyError, SurveyFrame};
use crate::light_field::survey_report::SurveyReport;
use crate::light_field::undistort::undistorted;
use crate::light_field::view::{LightField, SparsePoint, View};
use crate::progress::Progress;
use crate::time::Timestamp;

/// How a light field is made from posed views.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BuildSettings {
    /// Depth.
    pub stereo: StereoSettings,
    /// Surface.
    pub surface: SurfaceSettings,
}

/// What building found, in figures.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CompletionReport {
    /// Depth maps that were made and fused.
    pub depth_maps: usize,
    /// Of the surface.
    pub vertices: usize,
    /// Of the surface.
    pub triangles: usize,
    /// Share of all views' confident pixels that lie on the surface.
    pub coverage: f64,
    /// Median difference between views of one surface point before gains, log units.
    pub brightness_spread_before: f64,
    /// The same after.
    pub brightness_spread_after: f64,
}

/// One undistorted view without depth: what a survey's frame becomes once its pose is known.
pub fn view_of(
    frame_number: u32,
    exposed_at: Timestamp,
    image: &Image<Rgb8>,
    camera: &CameraModel,
    world_from_camera: Transform<World, Camera>,
) -> View {
    let (straight, field) = undistorted(image, camera);
    let confidence = confidence_of(&straight, &field);
    let (width, height) = straight.size();
    View {
        frame_number,
        image: straight,
        confidence,
        depth: Image::filled(width, height, 0.0),
        camera: Arc::new(camera.pinhole()),
        world_from_camera,
        gain: [1.0; 3],
        exposed_at,
    }
}

/// Views whose poses are the arm's become a light field whose poses fit the pictures; what the pictures do not tie in is left out. Depth and
/// surface are still to come ([`complete`]). The camera is the undistorted pictures' own.
pub fn refined(
    views: Vec<View>,
    camera: &CameraModel,
    prior: &dyn PosePrior,
    settings: &survey::Settings,
    progress: &dyn Progress,
) -> Result<(LightField, SurveyReport), SurveyError> {
    let frames: Vec<SurveyFrame> = (views.iter())
        .map(|view| SurveyFrame {
            frame_number: view.frame_number,
            image: view.image.clone(),
            confidence: view.confidence.clone(),
            exposed_at: view.exposed_at,
        })
        .collect();
    let found = survey::refine(&frames, camera, prior, settings, progress)?;
    let tied = |(mut view, pose): (View, &Option<Transform<World, Camera>>)| {
        view.world_from_camera = (*pose)?;
        Some(view)
    };
    let points = (found.points.into_iter()).map(|point| SparsePoint {
        position: point.position,
        observations: point.observations,
    });
    let light_field = LightField {
        views: views.into_iter().zip(&found.world_from_camera).filter_map(tied).collect(),
        points: points.collect(),
        time_offset: found.time_offset,
        ..LightField::default()
    };
    Ok((light_field, found.report))
}

/// Opens a light field folder; a COLMAP model made elsewhere gets its confidence, depth, surface and gains now, in memory.
pub fn open(folder: &Path, settings: &BuildSettings, progress: &dyn Progress) -> Result<LightField, LightFieldError> {
    let loaded = file::read(folder, progress)?;
    let mut light_field = loaded.light_field;
    if loaded.origin == Origin::Foreign {
        make_confidence(&mut light_field);
        complete(&mut light_field, settings, progress)?;
    }
    Ok(light_field)
}

/// Confidence maps for views that have none but their image field.
pub fn make_confidence(light_field: &mut LightField) {
    light_field
        .views
        .par_iter_mut()
        .for_each(|view| view.confidence = confidence_of(&view.image, &view.confidence));
}

/// Surface, per-view depth and gains for views whose pictures, confidence and poses stand.
///
/// Two passes: a sweep from nothing gives a first surface; around it, with windows that follow its slant, a second and finer
/// one gives the surface that stays.
pub fn complete(
    light_field: &mut LightField,
    settings: &BuildSettings,
    progress: &dyn Progress,
) -> Result<CompletionReport, LightFieldError> {
    if light_field.views.len() < 2 {
        return Err(LightFieldError::TooLittle(format!(
            "expected at least 2 views to find depth, found {}; survey the scene with a moving camera",
            light_field.views.len()
        )));
    }
    let maps = {
        let stereo = Stereo::new(&light_field.views, &light_field.points, &settings.stereo);
        let references = stereo.reference_views();
        let (references, maps) = depth_maps(&stereo, &references, progress)?;
        match fuse(&maps, &settings.surface) {
            None => None,
            Some(mesh) => {
                light_field.surface = mesh;
                Some(second_pass(light_field, &stereo, (&references, &maps), settings, progress)?)
            }
        }
    };
    let Some(maps) = maps else {
        return Err(LightFieldError::TooLittle(
            "no surface: no depth on which two views agree; are the poses right, and does the camera move sideways by a tenth of its distance?".into(),
        ));
    };
    let Some(surface) = fuse(&maps, &settings.surface) else {
        return Err(LightFieldError::TooLittle(
            "the second depth pass found no surface; are the poses right?".into(),
        ));
    };
    light_field.surface = surface;
    rasterize_depths(light_field);
    let photometry = photometry::estimate(&light_field.views, &light_field.surface);
    for (view, gain) in light_field.views.iter_mut().zip(&photometry.gains) {
        view.gain = *gain;
    }
    light_field.shading = photometry.shading;
    cross_examination::refine_confidence(light_field);
    Ok(CompletionReport {
        depth_maps: maps.len(),
        vertices: light_field.surface.vertices.len(),
        triangles: light_field.surface.triangles.len(),
        coverage: coverage(light_field),
        brightness_spread_before: photometry.spread_before,
        brightness_spread_after: photometry.spread_after,
    })
}

fn second_pass(
    light_field: &LightField,
    stereo: &Stereo<'_>,
    (references, first): (&[usize], &[DepthMap]),
    settings: &BuildSettings,
    progress: &dyn Progress,
) -> Result<Vec<DepthMap>, LightFieldError> {
    progress.begin("depth, refined", references.len() as u64);
    let maps: Vec<DepthMap> = (references.par_iter().zip(first))
        .filter_map(|(&view, first)| {
            if progress.stopping() {
                return None;
            }
            let plane = stereo.fine_plane(view);
            let camera = CameraModel {
                width: plane.gray.width(),
                height: plane.gray.height(),
                intrinsics: plane.intrinsics,
                ..(*light_field.views[view].camera).clone()
            };
            let mut depth = Image::filled(0, 0, 0.0);
            DepthRasterizer::new().render(&light_field.surface, &camera, &plane.world_from_camera, &mut depth);
            let map = stereo.near_surface(view, &depth, &first.depth);
            progress.advance(1);
            map
        })
        .collect();
    progress.end();
    if progress.stopping() {
        return Err(LightFieldError::Stopped);
    }
    Ok(confirmed(&maps, settings.stereo.agreement))
}

/// Every view's depth from the surface.
pub fn rasterize_depths(light_field: &mut LightField) {
    let LightField { views, surface, .. } = light_field;
    views.par_iter_mut().for_each_init(DepthRasterizer::new, |rasterizer, view| {
        rasterizer.render(surface, &view.camera, &view.world_from_camera, &mut view.depth);
    });
}

fn coverage(light_field: &LightField) -> f64 {
    let (mut covered, mut all) = (0_usize, 0_usize);
    for view in &light_field.views {
        for (&confidence, &depth) in view.confidence.pixels().iter().zip(view.depth.pixels()) {
            all += usize::from(confidence > 127);
            covered += usize::from(confidence > 127 && depth > 0.0);
        }
    }
    covered as f64 / all.max(1) as f64
}
