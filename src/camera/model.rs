//! The whole camera model: image size, intrinsics, distortion.

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::geometry::point::{Direction, Point};
use crate::geometry::space::Camera;

/// Explains the pixels of one picture.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraModel {
    /// Columns of the picture.
    pub width: usize,
    /// Rows of the picture.
    pub height: usize,
    /// Focal lengths and principal point, px.
    pub intrinsics: Intrinsics,
    /// The lens.
    pub distortion: Distortion,
}

impl CameraModel {
    /// Where `point` is seen; `None` behind the camera. The pixel may lie outside the picture.
    pub fn project(&self, point: Point<Camera>) -> Option<Pixel> {
        let p = point.coords;
        if p.z <= 1e-9 {
            return None;
        }
        let (x, y) = self.distortion.distort(p.x / p.z, p.y / p.z);
        let k = &self.intrinsics;
        Some(Pixel {
            x: k.fx * x + k.cx,
            y: k.fy * y + k.cy,
        })
    }

    /// The direction (z = 1) that lands at `pixel`; `None` outside the lens's field.
    pub fn unproject(&self, pixel: Pixel) -> Option<Direction<Camera>> {
        let k = &self.intrinsics;
        let (x, y) = self.distortion.undistort((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy)?;
        Some(Direction::new(x, y, 1.0))
    }

    /// The same camera without its lens: what explains the picture after undistortion.
    pub fn pinhole(&self) -> Self {
        Self {
            distortion: Distortion::None,
            ..self.clone()
        }
    }

    /// The same camera with its picture scaled by `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        Self {
            width: (self.width as f64 * factor).round() as usize,
            height: (self.height as f64 * factor).round() as usize,
            intrinsics: self.intrinsics.scaled(factor),
            distortion: self.distortion,
        }
    }

    /// The camera of its picture reduced by averaging squares of `step` pixels, squares cut off by the border counted.
    pub fn reduced(&self, step: usize) -> Self {
        Self {
            width: self.width.div_ceil(step),
            height: self.height.div_ceil(step),
            ..self.scaled(1.0 / step as f64)
        }
    }

    /// True if `pixel` lies in the picture, at least `margin` px from its border.
    pub fn contains(&self, pixel: Pixel, margin: f64) -> bool {
        pixel.x >= margin
            && pixel.y >= margin
            && pixel.x <= self.width as f64 - 1.0 - margin
            && pixel.y <= self.height as f64 - 1.0 - margin
    }
}
