//! What the parts of the substitution look at together.

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::distance::UNITS_PER_PX;
use crate::light_field::view::LightField;
use crate::stages::specularity_substitution::grid::{Division, Grid};

/// One live frame over the light field.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// The light field.
    pub light_field: &'a LightField,
    /// The live picture, undistorted.
    pub image: &'a Image<Rgb8>,
    /// Depth of the surface in the live picture, mm, 0 where unknown; may be coarser than the picture by an integer step.
    pub depth: &'a Image<f32>,
    /// Distance to the nearest specular pixel, in units of [`UNITS_PER_PX`].
    pub distance: &'a Image<u16>,
    /// 255 where nothing may be touched or learnt: instruments, outside the field.
    pub forbidden: &'a Mask,
    /// Picture pixels along a pixel of `depth`.
    pub depth_step: Division,
    /// Width of the picture over the width for which lengths are given.
    pub scale: f32,
    /// The frame's cells.
    pub grid: Grid,
    /// How far replacement reaches, the ring begins and the ring ends, in units of distance.
    pub reach: u16,
    /// Where the ring begins.
    pub guard: u16,
    /// Where the ring ends.
    pub ring: u16,
}

impl Scene<'_> {
    /// A length in px as a distance of the chamfer map.
    pub fn distance_of(px: f32) -> u16 {
        (px * f32::from(UNITS_PER_PX)).min(60_000.0) as u16
    }

    /// Depth at a pixel, mm; 0 where unknown.
    #[inline]
    pub fn depth_at(&self, x: usize, y: usize) -> f32 {
        let (x, y) = (self.depth_step.of(x), self.depth_step.of(y));
        self.depth.at(x.min(self.depth.width() - 1), y.min(self.depth.height() - 1))
    }

    /// True where a pixel may be replaced.
    #[inline]
    pub fn is_open(&self, x: usize, y: usize) -> bool {
        self.distance.at(x, y) <= self.reach && self.forbidden.at(x, y) == 0
    }
}
