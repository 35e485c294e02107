//! One view of a light field, and the light field as the set of them.

use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::geometry::mesh::Mesh;
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

/// Posed views over a surface.
#[derive(Clone, Debug)]
pub struct LightField {
    /// The views, in the order of their frame numbers.
    pub views: Vec<View>,
    /// The proxy surface; empty when none was found.
    pub surface: Mesh<World>,
    /// Add to a pose stamp of the survey to get the camera's clock, as estimated from the survey; zero when unknown.
    pub time_offset: Span,
}
