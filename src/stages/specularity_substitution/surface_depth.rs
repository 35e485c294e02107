//! Depth of the light field's surface in the live picture, carried a little into the holes of the measured surface.

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::Image;
use crate::image::hole_filling::HoleFiller;
use crate::light_field::rasterize::DepthRasterizer;
use crate::light_field::view::LightField;
use crate::stages::specularity_substitution::support::Support;

/// Depth is carried into holes over about 2 to this power, px of the depth's picture.
const REACH_LEVELS: usize = 5;
/// Widest picture over which depth is drawn pixel for pixel.
const WIDTH_PX: usize = 480;

/// Picture pixels along a pixel of the depth's picture.
pub fn depth_step(width: usize) -> usize {
    width.div_ceil(WIDTH_PX).max(1)
}

/// Draws it; keeps its memory.
#[derive(Debug)]
pub struct SurfaceDepth {
    rasterizer: DepthRasterizer,
    filler: HoleFiller,
    support: Support,
    /// mm; 0 where unknown.
    pub depth: Image<f32>,
}

impl Default for SurfaceDepth {
    fn default() -> Self {
        Self {
            rasterizer: DepthRasterizer::new(),
            filler: HoleFiller::default(),
            support: Support::default(),
            depth: Image::filled(0, 0, 0.0),
        }
    }
}

impl SurfaceDepth {
    /// Of `light_field` for a picture of `camera` taken at `eye`.
    pub fn draw(&mut self, light_field: &LightField, camera: &CameraModel, eye: &Transform<World, Camera>) {
        self.rasterizer.render(&light_field.surface, camera, eye, &mut self.depth);
        // The survey's stereo is blind under its own specularities: there the surface is taken to go on smoothly. Only the place is
        // guessed so, not the colour, and a wrong place shows on the ring.
        self.support.learn(&self.depth);
        self.filler.fill(&mut self.depth, REACH_LEVELS);
        self.support.restrict(&mut self.depth);
    }
}
