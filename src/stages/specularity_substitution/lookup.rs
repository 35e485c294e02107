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
        let color = bicubic(&image, 4, 5, 0.3, 0.6);
        assert!((color[0] - 43.0).abs() < 0.03 && (color[1] - 67.2).abs() < 0.03 && (color[2] - 77.0).abs() < 1e-3);
    }
}
