//! How a view sees a place of the live picture: from which angle, how finely, and whether free of the lamp.

use nalgebra::{Point3, Vector3};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;

/// A view's pixel counts as a sighting from this confidence on; below it speaks only where nobody else does.
const HEARD_FROM: u8 = 120;

/// Nearer to a view's border than this share of its width a place is not seen …
const BORDER_SHARE: f32 = 0.02;
/// … and nearer than this share less and less liked.
const INNER_SHARE: f32 = 0.1;
/// What the border costs, rad.
const BORDER_PENALTY: f32 = 0.1;
/// What seeing from twice as far costs, rad.
const RESOLUTION_PENALTY: f32 = 0.3;

/// A pixel of a hole.
#[derive(Clone, Copy, Debug, Default)]
pub struct Place {
    /// Column.
    pub x: f32,
    /// Row.
    pub y: f32,
    /// mm; 0 where there is no hole.
    pub depth: f32,
}

/// How a view sees a place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Sight {
    /// Not at all: out of the picture, hidden, or under the view's own specularity.
    #[default]
    Unseen,
    /// Through the haze around one.
    Hazy,
    /// As it is.
    Clean,
}

/// Where a view stands against the live camera.
#[derive(Clone, Copy, Debug)]
pub struct Vantage {
    /// From pixels of the live picture to those of the view.
    pub mapping: Mapping,
    /// The view's optical centre in the live camera's space.
    centre: Vector3<f32>,
    /// The live camera's focal lengths and principal point.
    focal: [f32; 2],
    middle: [f32; 2],
}

impl Vantage {
    /// Of `view` against a picture of `live` taken at `eye`.
    pub fn new(live: &CameraModel, eye: &Transform<World, Camera>, view: &View) -> Option<Self> {
        let centre = eye.isometry().inverse() * Point3::from(view.world_from_camera.translation());
        let k = &live.intrinsics;
        Some(Self {
            mapping: Mapping::new(live, eye, view)?,
            centre: centre.coords.map(|c| c as f32),
            focal: [k.fx as f32, k.fy as f32],
            middle: [k.cx as f32, k.cy as f32],
        })
    }

    /// Angle between the viewing rays, loss of resolution and nearness to the view's border, rad-like; infinite if not in the view.
    pub fn penalty(&self, view: &View, place: Place) -> f32 {
        let (x, y, depth) = self.mapping.apply(place.x, place.y, place.depth);
        let (width, height) = (view.camera.width as f32, view.camera.height as f32);
        let margin = x.min(y).min(width - 1.0 - x).min(height - 1.0 - y);
        if depth <= 0.0 || margin.is_nan() || margin < BORDER_SHARE * width {
            return f32::INFINITY;
        }
        let to_eye = place.depth
            * Vector3::new(
                (place.x - self.middle[0]) / self.focal[0],
                (place.y - self.middle[1]) / self.focal[1],
                1.0,
            );
        let to_view = to_eye - self.centre;
        let (far, near) = (to_view.norm(), to_eye.norm());
        // The angle from the chord between the two directions, to its third power.
        let chord = (to_view / far - to_eye / near).norm();
        let angle = chord + chord * chord * chord / 24.0;
        let resolution = (far / near - 1.0).max(0.0);
        let border = margin / (INNER_SHARE * width);
        angle + RESOLUTION_PENALTY * resolution + 1e-4 + BORDER_PENALTY * (1.0 - border).max(0.0)
    }

    /// What the view shows of a place.
    pub fn sight(&self, view: &View, place: Place) -> Sight {
        let (x, y, depth) = self.mapping.apply(place.x, place.y, place.depth);
        let (width, height) = view.image.size();
        if !(depth > 0.0 && x >= 1.0 && y >= 1.0 && x < width as f32 - 2.0 && y < height as f32 - 2.0) {
            return Sight::Unseen;
        }
        let (column, row) = ((x + 0.5) as usize, (y + 0.5) as usize);
        let confidence = view.confidence.at(column, row);
        if confidence == 0 || !is_unoccluded(view.depth.at(column, row), depth) {
            Sight::Unseen
        } else if confidence < HEARD_FROM {
            Sight::Hazy
        } else {
            Sight::Clean
        }
    }
}
