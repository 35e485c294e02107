//! Which views may speak for a region.

use nalgebra::Vector3;

use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::view::{LightField, View};

/// At most so many views are blended.
pub const MAX_VIEWS: usize = 4;

/// Relative difference of depth beyond which a view sees something else.
const OCCLUSION_TOLERANCE: f32 = 0.03;

/// A view that may speak, and how loud.
#[derive(Clone, Copy, Debug, Default)]
pub struct Candidate {
    /// Index of the view.
    pub view: usize,
    /// Its weight by angle, resolution and field of view, 0…1.
    pub weight: f32,
}

/// The views in the order of their penalty at one place; keeps its memory.
#[derive(Debug, Default)]
pub struct CandidateSearch {
    ranked: Vec<(f64, usize)>,
}

impl CandidateSearch {
    /// Choose up to [`MAX_VIEWS`] views for the world points `hole` (a sample of the region, seen from `eye`).
    pub fn choose(
        &mut self,
        light_field: &LightField,
        eye: &Transform<World, Camera>,
        hole: &[Vector3<f64>],
        chosen: &mut Vec<Candidate>,
    ) {
        chosen.clear();
        if hole.is_empty() {
            return;
        }
        let centre = hole.iter().sum::<Vector3<f64>>() / hole.len() as f64;
        self.ranked.clear();
        for (index, view) in light_field.views.iter().enumerate() {
            if let Some(penalty) = penalty(view, eye, &centre) {
                self.ranked.push((penalty, index));
            }
        }
        self.ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        // A view that is itself dazzled here is of no use however near it stands: what it saw of the hole counts.
        self.ranked.truncate(28);
        for entry in &mut self.ranked {
            let seen = coverage(&light_field.views[entry.1], hole);
            entry.0 = if seen < 0.05 {
                f64::MAX
            } else {
                entry.0 + 0.12 * (1.0 - seen)
            };
        }
        self.ranked.retain(|entry| entry.0 < f64::MAX);
        self.ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        // Buehler 2001: weights fall to zero at the first view that is left out.
        let threshold = self
            .ranked
            .get(MAX_VIEWS)
            .map_or_else(|| self.ranked.last().map_or(1.0, |e| 1.5 * e.0 + 0.01), |e| e.0 + 1e-6);
        for &(penalty, view) in self.ranked.iter().take(MAX_VIEWS) {
            let weight = (1.0 - penalty / threshold).max(0.02) as f32;
            chosen.push(Candidate { view, weight });
        }
    }
}

/// Angle between the viewing rays, loss of resolution and nearness to the view's border, rad-like; `None` if not in the view.
fn penalty(view: &View, eye: &Transform<World, Camera>, place: &Vector3<f64>) -> Option<f64> {
    let seen = view.world_from_camera.inverse() * Point::<World>::from_coords(*place);
    let pixel = view.camera.project(seen)?;
    let margin = 0.02 * view.camera.width as f64;
    if !view.camera.contains(pixel, margin) {
        return None;
    }
    let (to_view, to_eye) = (place - view.world_from_camera.translation(), place - eye.translation());
    let angle = to_view.angle(&to_eye);
    let resolution = (to_view.norm() / to_eye.norm() - 1.0).max(0.0);
    let border = border_distance(&view.camera, pixel.x, pixel.y) / (0.1 * view.camera.width as f64);
    Some(angle + 0.3 * resolution + 0.1 * (1.0 - border).max(0.0) + 1e-4)
}

fn border_distance(camera: &CameraModel, x: f64, y: f64) -> f64 {
    x.min(y)
        .min(camera.width as f64 - 1.0 - x)
        .min(camera.height as f64 - 1.0 - y)
}

/// The share of the points that the view saw free of lamp and obstacle.
fn coverage(view: &View, points: &[Vector3<f64>]) -> f64 {
    let camera_from_world = view.world_from_camera.inverse();
    let seen = points.iter().filter(|point| {
        let p = camera_from_world * Point::<World>::from_coords(**point);
        view.camera.project(p).is_some_and(|pixel| {
            let (x, y) = (pixel.x.round(), pixel.y.round());
            x >= 0.0
                && y >= 0.0
                && x < view.camera.width as f64
                && y < view.camera.height as f64
                && view.confidence.at(x as usize, y as usize) > 128
                && is_unoccluded(view.depth.at(x as usize, y as usize), p.coords.z as f32)
        })
    });
    seen.count() as f64 / points.len() as f64
}

/// True if a surface seen at depth `held` is what lies at depth `asked`; an unknown depth hides nothing.
#[inline]
pub fn is_unoccluded(held: f32, asked: f32) -> bool {
    held <= 0.0 || (held - asked).abs() <= OCCLUSION_TOLERANCE * asked
}
