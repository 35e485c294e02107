//! A whole picture straightened once, for building; the line has its own table.

use rayon::prelude::*;

use crate::camera::model::CameraModel;
use crate::image::buffer::{Image, Mask, Rgb8};

/// The picture that a pinhole with the same matrix would have taken, and a mask of where it comes from inside the picture
/// (255). Bicubic (Keys 1981, a = −0.5): the views are resampled once more when rendered, and two bilinear steps would blur.
pub fn undistorted(image: &Image<Rgb8>, camera: &CameraModel) -> (Image<Rgb8>, Mask) {
    let (width, height) = image.size();
    let mut out = Image::filled(width, height, [0_u8; 3]);
    let mut field = Image::filled(width, height, 0_u8);
    let k = &camera.intrinsics;
    if width < 4 || height < 4 {
        return (image.clone(), Image::filled(width, height, 255));
    }
    (out.pixels_mut()
        .par_chunks_mut(width)
        .zip(field.pixels_mut().par_chunks_mut(width))
        .enumerate())
    .for_each(|(y, (row, mask))| {
        for x in 0..width {
            let (u, v) = camera.distortion.distort((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy);
            let (px, py) = (k.fx * u + k.cx, k.fy * v + k.cy);
            if px >= -0.5 && py >= -0.5 && px <= width as f64 - 0.5 && py <= height as f64 - 0.5 {
                row[x] = bicubic(image, px as f32, py as f32);
                mask[x] = 255;
            }
        }
    });
    (out, field)
}

fn keys(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        -0.5 * t3 + t2 - 0.5 * t,
        1.5 * t3 - 2.5 * t2 + 1.0,
        -1.5 * t3 + 2.0 * t2 + 0.5 * t,
        0.5 * t3 - 0.5 * t2,
    ]
}

fn bicubic(image: &Image<Rgb8>, x: f32, y: f32) -> Rgb8 {
    let (left, top) = (x.floor(), y.floor());
    let (wx, wy) = (keys(x - left), keys(y - top));
    let (last_x, last_y) = (image.width() as isize - 1, image.height() as isize - 1);
    let mut sum = [0.0_f32; 3];
    for (j, wy) in wy.iter().enumerate() {
        let row = image.row((top as isize + j as isize - 1).clamp(0, last_y) as usize);
        for (i, wx) in wx.iter().enumerate() {
            let pixel = row[(left as isize + i as isize - 1).clamp(0, last_x) as usize];
            for (s, &v) in sum.iter_mut().zip(&pixel) {
                *s += wx * wy * f32::from(v);
            }
        }
    }
    sum.map(|v| (v + 0.5).clamp(0.0, 255.0) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;

    #[test]
    fn a_ramp_is_straightened() {
        let camera = CameraModel {
            width: 80,
            height: 60,
            intrinsics: Intrinsics {
                fx: 70.0,
                fy: 70.0,
                cx: 40.0,
                cy: 29.0,
            },
            distortion: Distortion::BrownConrady {
                k: [-0.2, 0.05, 0.0, 0.0, 0.0, 0.0],
                p: [0.001, -0.001],
            },
        };
        // A ramp over the ideal coordinate, as the lens would show it.
        let mut bent = Image::filled(80, 60, [0_u8; 3]);
        for y in 0..60 {
            for x in 0..80 {
                let ideal = camera
                    .distortion
                    .undistort((x as f64 - 40.0) / 70.0, (y as f64 - 29.0) / 70.0)
                    .unwrap();
                let v = (ideal.0 * 70.0 + 40.0).clamp(0.0, 80.0) * 3.0;
                bent.set(x, y, [v.round() as u8, 0, 0]);
            }
        }
        let (straight, field) = undistorted(&bent, &camera);
        for y in (5..55).step_by(7) {
            for x in (5..75).step_by(7) {
                assert!(
                    (f64::from(straight.at(x, y)[0]) - 3.0 * x as f64).abs() <= 1.6,
                    "{x} {y}: {:?}",
                    straight.at(x, y)
                );
                assert_eq!(field.at(x, y), 255);
            }
        }
    }
}
