//! Colours of a picture between its pixels.

use crate::image::buffer::{Image, Rgb8};

/// Steps of a pixel for which the cubic's weights are held.
const STEPS: usize = 256;

/// Weights of four neighbouring pixels for a place after the second, by the fraction in 1/[`STEPS`] px.
static WEIGHTS: [[f32; 4]; STEPS + 1] = weights();

/// The cubic of Mitchell and Netravali (1988, B = C = 1/3) at a distance of 0…2 px. Catmull and Rom's keeps more of the finest texture, and
/// all of the views' noise with it, which is the greater part of what is that fine.
const fn mitchell(d: f32) -> f32 {
    let (d2, d3) = (d * d, d * d * d);
    if d < 1.0 {
        (7.0 * d3 - 12.0 * d2 + 16.0 / 3.0) / 6.0
    } else {
        (-7.0 / 3.0 * d3 + 12.0 * d2 - 20.0 * d + 32.0 / 3.0) / 6.0
    }
}

const fn weights() -> [[f32; 4]; STEPS + 1] {
    let mut table = [[0.0; 4]; STEPS + 1];
    let mut step = 0;
    while step <= STEPS {
        let t = step as f32 / STEPS as f32;
        table[step] = [mitchell(1.0 + t), mitchell(t), mitchell(1.0 - t), mitchell(2.0 - t)];
        step += 1;
    }
    table
}

/// A coordinate of at least 0 as a pixel and the way to the next, 0…1.
#[inline(always)]
pub fn split(at: f32) -> (usize, f32) {
    // Signed, as the processor has no other: an unsigned conversion takes several steps and a branch.
    let pixel = at as i32;
    (pixel as usize, at - pixel as f32)
}

/// Four pixels side by side, channel by channel, and four numbers that mean nothing.
pub type Strip = [f32; 16];

/// The cubic down the four rows around row `y` + `fy`, for the four
/// pixels around column `x` and its right neighbour. `x`, `y` at least 1, 2 from the right border and 3 from the lower one.
#[inline(always)]
pub fn cubic_down(image: &Image<Rgb8>, x: usize, y: usize, fy: f32, out: &mut Strip) {
    let weights = weights_at(fy);
    let (pitch, begin) = (3 * image.width(), 3 * ((y - 1) * image.width() + x - 1));
    let bytes = &image.as_bytes()[begin..begin + 3 * pitch + 16];
    let (a, b, c, d) = (
        &bytes[..16],
        &bytes[pitch..][..16],
        &bytes[2 * pitch..][..16],
        &bytes[3 * pitch..][..16],
    );
    for i in 0..16 {
        let (a, b, c, d) = (f32::from(a[i]), f32::from(b[i]), f32::from(c[i]), f32::from(d[i]));
        out[i] = weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d;
    }
}

/// The same cubic along a strip; three channels and a number that means nothing.
#[inline(always)]
pub fn cubic_across(strip: &Strip, fx: f32) -> [f32; 4] {
    let weights = weights_at(fx);
    let mut color = [0.0; 4];
    for (c, value) in color.iter_mut().enumerate() {
        *value = weights[0] * strip[c] + weights[1] * strip[3 + c] + weights[2] * strip[6 + c] + weights[3] * strip[9 + c];
    }
    color
}

#[inline(always)]
fn weights_at(fraction: f32) -> &'static [f32; 4] {
    &WEIGHTS[((fraction * STEPS as f32 + 0.5) as i32 as usize).min(STEPS)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bicubic(image: &Image<Rgb8>, u: f32, v: f32) -> [f32; 3] {
        let ((x, fx), (y, fy)) = (split(u), split(v));
        let mut strip = [0.0; 16];
        cubic_down(image, x, y, fy, &mut strip);
        let [r, g, b, _] = cubic_across(&strip, fx);
        [r, g, b]
    }

    #[test]
    fn a_plane_is_given_back() {
        let mut image = Image::filled(12, 10, [0; 3]);
        for y in 0..10 {
            for x in 0..12 {
                image.set(x, y, [(10 * x) as u8, (12 * y) as u8, 77]);
            }
        }
        // At a step of the table, to rounding; between steps, to half a step along the plane's slope.
        let color = bicubic(&image, 4.25, 5.625);
        assert!((color[0] - 42.5).abs() < 1e-3 && (color[1] - 67.5).abs() < 1e-3 && (color[2] - 77.0).abs() < 1e-3);
        let color = bicubic(&image, 4.3, 5.6);
        assert!((color[0] - 43.0).abs() < 0.03 && (color[1] - 67.2).abs() < 0.03 && (color[2] - 77.0).abs() < 1e-3);
    }

    /// The plainest possible: the cubic with its two parameters, of each of the sixteen pixels.
    fn reference(image: &Image<Rgb8>, u: f64, v: f64, c: usize) -> f64 {
        const B: f64 = 1.0 / 3.0;
        const C: f64 = 1.0 / 3.0;
        let cubic = |d: f64| match d.abs() {
            d if d < 1.0 => ((12.0 - 9.0 * B - 6.0 * C) * d.powi(3) + (-18.0 + 12.0 * B + 6.0 * C) * d * d + 6.0 - 2.0 * B) / 6.0,
            d if d < 2.0 => {
                ((-B - 6.0 * C) * d.powi(3) + (6.0 * B + 30.0 * C) * d * d + (-12.0 * B - 48.0 * C) * d + 8.0 * B + 24.0 * C)
                    / 6.0
            }
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
            let found = bicubic(&image, u as f32, v as f32);
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
