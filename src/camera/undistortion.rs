//! From the lens's picture to a pinhole's: which source pixel every undistorted pixel comes from.
//!
//! By default the pinhole keeps the camera's own focal lengths and principal point. A balance makes a new one, as in OpenCV's
//! fisheye module: at 0 the picture is just filled, at 1 everything that the lens saw is just in the picture.

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::image::remap::{RemapError, RemapTable};

/// Points along each side of the picture that a balance looks at.
const POINTS_PER_SIDE: usize = 33;

/// The table that undistorts pictures of `camera` into pictures of `pinhole`.
pub fn table(camera: &CameraModel, pinhole: &CameraModel) -> Result<RemapTable, RemapError> {
    let (k, n) = (&camera.intrinsics, &pinhole.intrinsics);
    RemapTable::new((pinhole.width, pinhole.height), (camera.width, camera.height), |x, y| {
        let (u, v) = camera.distortion.distort((x as f64 - n.cx) / n.fx, (y as f64 - n.cy) / n.fy);
        Some((k.fx * u + k.cx, k.fy * v + k.cy))
    })
}

/// The pinhole camera for `balance` from 0 (the picture is filled) to 1 (nothing is lost); `None` when the border of the picture
/// lies outside the lens's field.
pub fn balanced_pinhole(camera: &CameraModel, balance: f64) -> Option<CameraModel> {
    let k = &camera.intrinsics;
    let (right, bottom) = (camera.width as f64 - 1.0, camera.height as f64 - 1.0);
    let (mut filled, mut complete) = (0.0_f64, f64::INFINITY);
    for i in 0..POINTS_PER_SIDE {
        let t = i as f64 / (POINTS_PER_SIDE - 1) as f64;
        for (x, y) in [(0.0, t * bottom), (right, t * bottom), (t * right, 0.0), (t * right, bottom)] {
            let direction = camera.unproject(Pixel { x, y })?.coords;
            let (dx, dy) = (k.fx * direction.x, k.fy * direction.y);
            // Zooming by the ratio brings the ideal point to the border of the new picture.
            let across = if x == 0.0 {
                Some(-k.cx / dx)
            } else {
                (x == right).then(|| (right - k.cx) / dx)
            };
            let down = if y == 0.0 {
                Some(-k.cy / dy)
            } else {
                (y == bottom).then(|| (bottom - k.cy) / dy)
            };
            for ratio in [across, down].into_iter().flatten() {
                if !(ratio.is_finite() && ratio > 0.0) {
                    return None;
                }
                filled = filled.max(ratio);
                complete = complete.min(ratio);
            }
        }
    }
    let zoom = filled * (1.0 - balance) + complete * balance;
    let intrinsics = Intrinsics {
        fx: k.fx * zoom,
        fy: k.fy * zoom,
        ..*k
    };
    Some(CameraModel {
        width: camera.width,
        height: camera.height,
        intrinsics,
        distortion: Distortion::None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(distortion: Distortion) -> CameraModel {
        CameraModel {
            width: 320,
            height: 240,
            intrinsics: Intrinsics {
                fx: 250.0,
                fy: 252.0,
                cx: 158.0,
                cy: 121.5,
            },
            distortion,
        }
    }

    fn barrel() -> CameraModel {
        camera(Distortion::BrownConrady {
            k: [-0.28, 0.05, 0.0, 0.0, 0.0, 0.0],
            p: [0.001, -0.0004],
        })
    }

    #[test]
    fn the_table_is_the_lens_to_half_a_step() {
        for model in [
            barrel(),
            camera(Distortion::KannalaBrandt {
                k: [0.05, -0.01, 0.002, 0.0],
            }),
        ] {
            let pinhole = model.pinhole();
            let table = table(&model, &pinhole).unwrap();
            for (x, y) in [(0, 0), (319, 239), (160, 120), (17, 203)] {
                let direction = pinhole
                    .unproject(Pixel {
                        x: x as f64,
                        y: y as f64,
                    })
                    .unwrap();
                let truth = model
                    .project(crate::geometry::point::Point::from_coords(direction.coords))
                    .unwrap();
                let (sx, sy) = table.position(x, y).unwrap();
                assert!((sx - truth.x).abs() <= 1.0 / 64.0 + 1e-9 && (sy - truth.y).abs() <= 1.0 / 64.0 + 1e-9);
            }
        }
    }

    #[test]
    fn balance_fills_or_keeps_all() {
        let camera = barrel();
        let filled = balanced_pinhole(&camera, 0.0).unwrap();
        let table = table(&camera, &filled).unwrap();
        for (x, y) in [(0, 0), (319, 0), (0, 239), (319, 239), (0, 120), (160, 0)] {
            let (sx, sy) = table.position(x, y).unwrap();
            assert!(
                sx > -0.5 && sy > -0.5 && sx < 319.5 && sy < 239.5,
                "({x}, {y}) comes from ({sx}, {sy})"
            );
        }
        let complete = balanced_pinhole(&camera, 1.0).unwrap();
        for (x, y) in [(0.0, 0.0), (319.0, 0.0), (0.0, 239.0), (319.0, 239.0)] {
            let direction = camera.unproject(Pixel { x, y }).unwrap();
            let seen = complete
                .project(crate::geometry::point::Point::from_coords(direction.coords))
                .unwrap();
            assert!(complete.contains(seen, -0.01), "({x}, {y}) is seen at {seen:?}");
        }
    }
}
