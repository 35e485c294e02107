//! The pinhole part of a camera.

use nalgebra::Matrix3;

/// A place in the image, px; (0, 0) is the centre of the top-left pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pixel {
    /// Column, px, growing to the right.
    pub x: f64,
    /// Row, px, growing downward.
    pub y: f64,
}

/// Focal lengths and principal point, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Principal point, px.
    pub cx: f64,
    /// Principal point, px.
    pub cy: f64,
}

impl Intrinsics {
    /// The camera matrix K (3×3).
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// The same camera with its picture scaled by `factor`; pixel centres at integers.
    pub fn scaled(&self, factor: f64) -> Self {
        Self {
            fx: self.fx * factor,
            fy: self.fy * factor,
            cx: (self.cx + 0.5) * factor - 0.5,
            cy: (self.cy + 0.5) * factor - 0.5,
        }
    }
}
