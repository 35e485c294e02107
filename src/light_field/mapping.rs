//! From a pixel of one pinhole picture, with its depth, to the pixel of a view that shows the same place.

use nalgebra::{Matrix3, Vector3};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::view::View;

/// From a pixel and its depth in one picture to the pixel and depth in a view: p_view ~ M·(x, y, 1)·z + b.
#[derive(Clone, Copy, Debug)]
pub struct Mapping {
    m: [[f32; 3]; 3],
    b: [f32; 3],
}

impl Mapping {
    /// Between two pinholes: from a picture of `live` taken at `eye` to `view`.
    pub fn new(live: &CameraModel, eye: &Transform<World, Camera>, view: &View) -> Option<Self> {
        let view_from_live = view.world_from_camera.inverse() * *eye;
        let rotation = view_from_live.rotation().to_rotation_matrix().into_inner();
        let m: Matrix3<f64> = view.camera.intrinsics.matrix() * rotation * live.intrinsics.matrix().try_inverse()?;
        let b: Vector3<f64> = view.camera.intrinsics.matrix() * view_from_live.translation();
        Some(Self {
            m: std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)] as f32)),
            b: std::array::from_fn(|i| b[i] as f32),
        })
    }

    /// The same mapping onto a picture of the view of which each pixel is `step` × `step` of the view's.
    pub fn onto_coarser(&self, step: f32) -> Self {
        let mut coarser = *self;
        // (u + ½) / step − ½
        let (scale, shift) = (1.0 / step, 0.5 / step - 0.5);
        for i in 0..2 {
            for j in 0..3 {
                coarser.m[i][j] = scale * self.m[i][j] + shift * self.m[2][j];
            }
            coarser.b[i] = scale * self.b[i] + shift * self.b[2];
        }
        coarser
    }

    /// Column, row and depth in the view.
    #[inline(always)]
    pub fn apply(&self, x: f32, y: f32, z: f32) -> (f32, f32, f32) {
        let row = |i: usize| (self.m[i][0] * x + self.m[i][1] * y + self.m[i][2]) * z + self.b[i];
        let depth = row(2);
        let inverse = 1.0 / depth;
        (row(0) * inverse, row(1) * inverse, depth)
    }

    /// [`Self::apply`] for pixels `step` apart along a row, the first at column `left`, at the depths `z`: columns, rows and depths, each as
    /// many as there are depths.
    #[inline(always)]
    pub fn apply_to_row(&self, left: f32, step: f32, y: f32, z: &[f32], [us, vs, depths]: [&mut [f32]; 3]) {
        let [mut first, mut slope] = [[0.0_f32; 3]; 2];
        for i in 0..3 {
            first[i] = self.m[i][0] * left + self.m[i][1] * y + self.m[i][2];
            slope[i] = self.m[i][0] * step;
        }
        let places = z.iter().zip(us).zip(vs).zip(depths);
        for (x, (((&z, u), v), depth)) in (0_i32..).zip(places) {
            let x = x as f32;
            let farness = (first[2] + slope[2] * x) * z + self.b[2];
            let inverse = 1.0 / farness;
            *u = ((first[0] + slope[0] * x) * z + self.b[0]) * inverse;
            *v = ((first[1] + slope[1] * x) * z + self.b[1]) * inverse;
            *depth = farness;
        }
    }
}

/// Relative difference of depth beyond which a view sees something else.
const OCCLUSION_TOLERANCE: f32 = 0.03;

/// True if a surface seen at depth `held` is what lies at depth `asked`; an unknown depth hides nothing.
#[inline(always)]
pub fn is_unoccluded(held: f32, asked: f32) -> bool {
    // Both sides are cheaper than a branch.
    (held <= 0.0) | ((held - asked).abs() <= OCCLUSION_TOLERANCE * asked)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_tells_what_hides() {
        assert!(is_unoccluded(0.0, 80.0) && is_unoccluded(79.0, 80.0) && !is_unoccluded(70.0, 80.0));
    }
}
