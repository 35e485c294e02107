//! Colours of a picture between its pixels.

use crate::image::buffer::{Image, Rgb8};

/// Steps of a pixel for which the cubic's weights are held.
const STEPS: usize = 256;

/// Weights of four neighbouring pixels for a place after the second, by the fraction in 1/[`STEPS`] px.
static WEIGHTS: [[f32; 4]; STEPS + 1] = weights();

const fn weights() -> [[f32; 4]; STEPS + 1] {
    let mut table = [[0.0; 4]; STEPS + 1];
    let mut step = 0;
    while step <= STEPS {
        let t = step as f32 / STEPS as f32;
        let (t2, t3) = (t * t, t * t * t);
        table[step] = [
            0.5 * (-t + 2.0 * t2 - t3),
            0.5 * (2.0 - 5.0 * t2 + 3.0 * t3),
            0.5 * (t + 4.0 * t2 - 3.0 * t3),
            0.5 * (t3 - t2),
        ];
        step += 1;
    }
    table
}

/// Catmull and Rom's cubic (Keys 1981, a = −½), which keeps the tissue's texture; `x`, `y` at least 1 and 2 from the far borders.
#[inline(always)]
pub fn bicubic(image: &Image<Rgb8>, x: usize, y: usize, fx: f32, fy: f32) -> [f32; 3] {
    let weights = |f: f32| &WEIGHTS[((f * STEPS as f32 + 0.5) as usize).min(STEPS)];
    let (wx, wy) = (weights(fx), weights(fy));
    let (width, bytes) = (image.width(), image.as_bytes());
    // Down first: twelve channels side by side.
    let mut sums = [0.0_f32; 12];
    for (row, wy) in (y - 1..).zip(wy) {
        let begin = 3 * (row * width + x - 1);
        for (sum, &channel) in sums.iter_mut().zip(&bytes[begin..begin + 12]) {
            *sum += wy * f32::from(channel);
        }
    }
    std::array::from_fn(|c| wx[0] * sums[c] + wx[1] * sums[3 + c] + wx[2] * sums[6 + c] + wx[3] * sums[9 + c])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_is_given_back() {
        let mut image = Image::filled(12, 10, [0; 3]);
        for y in 0..10 {
            for x in 0..12 {
                image.set(x, y, [(10 * x) as u8, (12 * y) as u8, 77]);
            }
        }
        // At a step of the table, to rounding; between steps, to half a step along the plane's slope.
        let color = bicubic(&image, 4, 5, 0.25, 0.625);
        assert!((color[0] - 42.5).abs() < 1e-3 && (color[1] - 67.5).abs() < 1e-3 && (color[2] - 77.0).abs() < 1e-3);
        let color = bicubic(&image, 4, 5, 0.3, 0.6);
        assert!((color[0] - 43.0).abs() < 0.03 && (color[1] - 67.2).abs() < 0.03 && (color[2] - 77.0).abs() < 1e-3);
    }

    /// The plainest possible: Keys' cubic of each of the sixteen pixels.
    fn reference(image: &Image<Rgb8>, u: f64, v: f64, c: usize) -> f64 {
        let cubic = |d: f64| match d.abs() {
            d if d < 1.0 => 1.5 * d * d * d - 2.5 * d * d + 1.0,
            d if d < 2.0 => -0.5 * d * d * d + 2.5 * d * d - 4.0 * d + 2.0,
            _ => 0.0,
        };
        let mut sum = 0.0;
        for y in 0..image.height() {
            for x in 0..image.width() {
                sum += f64::from(image.at(x, y)[c]) * cubic(u - x as f64) * cubic(v - y as f64);
            }
        }
        sum
    }

    #[test]
    fn agrees_with_the_plain_twin() {
        let noise = (0..20 * 14_u32).map(|i| [7919, 104_729, 1_299_709].map(|p| (i.wrapping_mul(p) >> 3) as u8));
        let image = Image::from_vec(20, 14, noise.collect()).unwrap();
        for (u, v) in [(1.0_f64, 1.0_f64), (4.37, 6.81), (16.99, 10.5), (9.002, 3.25)] {
            let found = bicubic(&image, u as usize, v as usize, u.fract() as f32, v.fract() as f32);
            for (c, found) in found.into_iter().enumerate() {
                // A place is off by at most half a step, along which a pixel changes by at most 255 · 1.5 levels an axis.
                let bound = 2.0 * 0.5 / STEPS as f64 * 255.0 * 1.5;
                let expected = reference(&image, u, v, c);
                assert!(
                    (f64::from(found) - expected).abs() < bound,
                    "({u}, {v}): {found} for {expected}"
                );
            }
        }
    }
}
