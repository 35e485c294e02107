//! How far two calibrations from two halves of the views disagree: an honest error, where the RMS only says how well the model bends.
//!
//! After mrcal (Kogan 2022, mrcal.secretsauce.net, "cross-validation" and "projection difference"): points seen through one camera are
//! looked at through the other. As poses and intrinsics can make up for each other, the rigid motion that brings the two closest over
//! the covered part of the picture, at the distance of the boards, comes first.

use std::ops::Range;

use nalgebra::Vector6;

use crate::calibration::camera::coverage::{self, inside, middles, used_pixels};
use crate::calibration::camera::lens::LensModel;
use crate::calibration::camera::refine::{Calibration, View, calibrate};
use crate::calibration::error::LEAST_VIEWS;
use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::Camera;
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{Problem, Settings, minimize};

/// Columns of the map; rows follow the picture's shape.
const COLUMNS: usize = 48;

/// The disagreement over the picture.
#[derive(Clone, Debug)]
pub struct Difference {
    /// Columns of the map.
    pub columns: usize,
    /// px, row by row over the whole picture; `None` beyond the reach of either lens.
    pub map_px: Vec<Option<f64>>,
    /// In the area covered by corners, px.
    pub median_px: f64,
    /// In the area covered by corners, px.
    pub worst_px: f64,
}

/// Calibrate every other view and the rest, and compare; `None` for too few views.
pub fn cross_validated(views: &[View], size: (usize, usize), model: LensModel, whole: &Calibration) -> Option<Difference> {
    let good: Vec<&View> = (views.iter().zip(&whole.views))
        .filter(|(_, result)| result.residuals.iter().any(|residual| residual.used))
        .map(|(view, _)| view)
        .collect();
    if good.len() < 2 * LEAST_VIEWS {
        return None;
    }
    let half = |first: usize| -> Option<Calibration> {
        let views: Vec<View> = good.iter().skip(first).step_by(2).map(|view| (*view).clone()).collect();
        calibrate(&views, size, model).ok()
    };
    let (a, b) = rayon::join(|| half(0), || half(1));
    let distances: Vec<f64> = middles(whole).map(|middle| middle.norm()).collect();
    let mean_mm = distances.iter().sum::<f64>() / distances.len().max(1) as f64;
    compared(&a?.camera, &b?.camera, mean_mm, &coverage::hull(used_pixels(whole).collect()))
}

struct Alignment<'a> {
    points: &'a [Point<Camera>],
    pixels: &'a [Pixel],
    camera: &'a CameraModel,
}

impl Problem for Alignment<'_> {
    type State = Transform<Camera, Camera>;

    fn directions(&self) -> usize {
        6
    }
    fn measured(&self) -> usize {
        2 * self.points.len()
    }
    fn residuals(&self, motion: &Self::State, rows: Range<usize>, out: &mut [f64]) {
        let pairs = self.points.iter().zip(self.pixels).skip(rows.start / 2);
        for ((point, pixel), out) in pairs.zip(out.chunks_exact_mut(2)) {
            let seen = self.camera.project(*motion * *point);
            out[0] = seen.map_or(f64::NAN, |seen| seen.x - pixel.x);
            out[1] = seen.map_or(f64::NAN, |seen| seen.y - pixel.y);
        }
    }
    fn moved(&self, motion: &Self::State, step: &[f64]) -> Self::State {
        motion.perturbed_left(&Vector6::from_column_slice(step))
    }
}

/// Where `b` sees what `a` sees at each pixel, `distance_mm` away.
fn compared(a: &CameraModel, b: &CameraModel, distance_mm: f64, hull: &[Pixel]) -> Option<Difference> {
    let rows = (COLUMNS * a.height).div_ceil(a.width.max(1)).max(1);
    let place = |i: usize| Pixel {
        x: ((i % COLUMNS) as f64 + 0.5) / COLUMNS as f64 * a.width as f64 - 0.5,
        y: ((i / COLUMNS) as f64 + 0.5) / rows as f64 * a.height as f64 - 0.5,
    };
    let point = |pixel: Pixel| -> Option<Point<Camera>> {
        let direction = a.unproject(pixel)?.unit()?;
        Some(Point::from_coords(direction.coords * distance_mm))
    };
    let (mut points, mut pixels) = (Vec::new(), Vec::new());
    for pixel in (0..COLUMNS * rows).map(place).filter(|pixel| inside(hull, *pixel)) {
        if let Some(point) = point(pixel) {
            points.push(point);
            pixels.push(pixel);
        }
    }
    let problem = Alignment {
        points: &points,
        pixels: &pixels,
        camera: b,
    };
    let motion = (points.len() >= 6)
        .then(|| minimize(&problem, Transform::identity(), &Settings::default()))??
        .state;
    let difference = |pixel: Pixel| -> Option<f64> {
        let seen = b.project(motion * point(pixel)?)?;
        Some((seen.x - pixel.x).hypot(seen.y - pixel.y))
    };
    let map_px: Vec<Option<f64>> = (0..COLUMNS * rows).map(|i| difference(place(i))).collect();
    let mut covered: Vec<f64> = (0..COLUMNS * rows)
        .filter(|i| inside(hull, place(*i)))
        .filter_map(|i| map_px[i])
        .collect();
    covered.sort_by(f64::total_cmp);
    Some(Difference {
        columns: COLUMNS,
        median_px: *covered.get(covered.len() / 2)?,
        worst_px: *covered.last()?,
        map_px,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;

    #[test]
    fn a_turned_camera_does_not_differ_and_a_longer_one_does() {
        let a = CameraModel {
            width: 640,
            height: 480,
            intrinsics: Intrinsics {
                fx: 500.0,
                fy: 500.0,
                cx: 320.0,
                cy: 240.0,
            },
            distortion: Distortion::None,
        };
        let corners = [(0.0, 0.0), (639.0, 0.0), (639.0, 479.0), (0.0, 479.0)];
        let hull = coverage::hull(corners.into_iter().map(|(x, y)| Pixel { x, y }).collect());
        assert!(compared(&a, &a, 80.0, &hull).unwrap().worst_px < 1e-6);
        // A principal point 3 px off is a turn but for 3·(320/500)² ≈ 1.2 px at the border.
        let mut b = a.clone();
        b.intrinsics.cx += 3.0;
        let small = compared(&a, &b, 80.0, &hull).unwrap();
        assert!(small.median_px < 1.0 && small.worst_px < 3.0, "{small:?}");
        // 2 % of focal length can be made up for by the distance, on a sphere only nearly.
        b.intrinsics.fx *= 1.05;
        assert!(compared(&a, &b, 80.0, &hull).unwrap().worst_px > small.worst_px);
    }
}
