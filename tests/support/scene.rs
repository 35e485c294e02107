//! A cheap stand-in for an operation: textured tissue that drifts, a lamp's highlights, a dark surround, sensor noise.

use endofield::camera::distortion::Distortion;
use endofield::camera::intrinsics::Intrinsics;
use endofield::camera::model::CameraModel;
use endofield::frame::{Frame, FrameId};
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::time::{Span, Timestamp};

/// A laparoscope-like lens.
pub fn laparoscope(width: usize, height: usize) -> CameraModel {
    let focal = 0.8 * width as f64;
    CameraModel {
        width,
        height,
        intrinsics: Intrinsics {
            fx: focal,
            fy: focal,
            cx: width as f64 / 2.0 - 0.5,
            cy: height as f64 / 2.0 - 0.5,
        },
        distortion: Distortion::BrownConrady {
            k: [-0.25, 0.06, 0.0, 0.0, 0.0, 0.0],
            p: [0.0005, -0.0003],
        },
    }
}

/// One picture of it. Integer arithmetic and a hash only, so it is the same on every machine.
pub fn picture(width: usize, height: usize, number: u64) -> Image<Rgb8> {
    let mut image = Image::filled(width, height, [0; 3]);
    let radius2 = (0.46 * width as f64).powi(2);
    for y in 0..height {
        for x in 0..width {
            let (dx, dy) = (x as f64 - width as f64 / 2.0, y as f64 - height as f64 / 2.0);
            let noise = (hash((y * width + x) as u64 ^ (number << 32)) % 5) as f64 - 2.0;
            if dx * dx + dy * dy > radius2 {
                image.set(x, y, [(2.0 + noise.max(-2.0)) as u8; 3]);
                continue;
            }
            let (u, v) = (x as f64 + number as f64 * 0.7, y as f64 + number as f64 * 0.3);
            let texture = 20.0 * (u * 0.21).sin() * (v * 0.17).cos() + 12.0 * (u * 0.05 + v * 0.09).sin();
            let lamp = (0..6).any(|spot| {
                let (sx, sy) = (
                    width as f64 * (0.25 + 0.09 * spot as f64),
                    height as f64 * (0.35 + 0.06 * spot as f64),
                );
                (x as f64 - sx).hypot(y as f64 - sy) < 2.0 + spot as f64 * 0.5
            });
            let level = |base: f64| {
                if lamp {
                    252.0
                } else {
                    (base + texture + noise).clamp(0.0, 255.0)
                }
            };
            image.set(x, y, [level(150.0) as u8, level(75.0) as u8, level(65.0) as u8]);
        }
    }
    image
}

fn hash(value: u64) -> u64 {
    let mixed = (value ^ (value >> 31)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 33
}

/// Frame `number` of a 25 Hz recording.
pub fn frame(number: u64, image: &Image<Rgb8>, pool: &Pool<Rgb8>) -> Frame {
    let exposed_at = Timestamp(number as i64 * 40_000_000);
    let mut frame = Frame::new(FrameId(number), exposed_at, Timestamp(0), pool.take_copy(image));
    frame.since_previous = Span(if number == 0 { 0 } else { 40_000_000 });
    frame
}
