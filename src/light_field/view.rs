//! One view of a light field, and the light field as the set of them.

use std::sync::Arc;

use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::geometry::mesh::Mesh;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::time::{Span, Timestamp};

/// One posed, calibrated, undistorted picture.
#[derive(Clone, Debug)]
pub struct View {
    /// The frame's number in the recording it comes from.
    pub frame_number: u32,
    /// Undistorted colours.
    pub image: Image<Rgb8>,
    /// How much each pixel may speak, 0–255; 0 where the view itself is specular, instrument or out of field.
    pub confidence: Mask,
    /// Depth along the optical axis, mm, of the same size as `image`; 0 where unknown.
    pub depth: Image<f32>,
    /// A pinhole.
    pub camera: Arc<CameraModel>,
    /// Where the camera was.
    pub world_from_camera: Transform<World, Camera>,
    /// What to multiply this view's sRGB values by to match the light field's common brightness, per channel.
    pub gain: [f32; 3],
    /// When it was exposed, on its recording's clock.
    pub exposed_at: Timestamp,
}

/// A scene point that several views saw, as the survey found it.
#[derive(Clone, Debug)]
pub struct SparsePoint {
    /// Where it is.
    pub position: Point<World>,
    /// Who saw it (frame number) and where.
    pub observations: Vec<(u32, Pixel)>,
}

/// How the lamp, which rides on the camera, lights the scene: what is left between two views of one point after their
/// exposure gains. An sRGB value is taken to go with distance^−falloff · exp(v₁ρ² + v₂ρ⁴), ρ the tangent of the angle
/// between the pixel's ray and the optical axis. All zero: light that does not move with the camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LampShading {
    /// Exponent of distance; 2 / 2.2 for a small lamp and a display gamma of 2.2.
    pub falloff: f32,
    /// Coefficients of ρ² and ρ⁴.
    pub vignetting: [f32; 2],
}

impl LampShading {
    /// The logarithm of the model's brightness at a point `distance` mm away whose ray leaves the axis by `rho2` = ρ².
    pub fn log_brightness(&self, distance: f32, rho2: f32) -> f32 {
        rho2 * (self.vignetting[0] + rho2 * self.vignetting[1]) - self.falloff * distance.max(1e-6).ln()
    }

    /// True when there is nothing to undo.
    pub fn is_flat(&self) -> bool {
        *self == Self::default()
    }
}

/// Where the views come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kind {
    /// A survey, made before.
    #[default]
    Survey,
    /// The video's own last frames.
    Rolling,
}

/// Posed views over a surface.
#[derive(Clone, Debug, Default)]
pub struct LightField {
    /// The views, in the order of their frame numbers.
    pub views: Vec<View>,
    /// The proxy surface; empty when none was found.
    pub surface: Mesh<World>,
    /// Add to a pose stamp of the survey to get the camera's clock, as estimated from the survey; zero when unknown.
    pub time_offset: Span,
    /// The survey's scene points; may be empty.
    pub points: Vec<SparsePoint>,
    /// The lamp's part in the brightness of the views.
    pub shading: LampShading,
    /// What made it, for people.
    pub recipe: String,
    /// Where the views come from.
    pub kind: Kind,
}
