//! Colours of a picture between its pixels.

use crate::image::buffer::{Image, Rgb8};

/// Catmull and Rom's cubic (Keys 1981, a = −½), which keeps the tissue's texture; `x`, `y` at least 1 and 2 from the far borders.
#[inline]
pub fn bicubic(image: &Image<Rgb8>, x: usize, y: usize, fx: f32, fy: f32) -> [f32; 3] {
    let (wx, wy) = (cubic_weights(fx), cubic_weights(fy));
    let width = image.width();
    let pixels = image.pixels();
    let mut sum = [0.0_f32; 3];
    for (row, wy) in wy.iter().enumerate() {
        let begin = (y + row - 1) * width + x - 1;
        let mut across = [0.0_f32; 3];
        for (pixel, wx) in pixels[begin..begin + 4].iter().zip(wx) {
            for (sum, &channel) in across.iter_mut().zip(pixel) {
                *sum += wx * f32::from(channel);
            }
        }
        for (sum, across) in sum.iter_mut().zip(across) {
            *sum += wy * across;
        }
    }
    sum
}

#[inline]
fn cubic_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t + 2.0 * t2 - t3),
        0.5 * (2.0 - 5.0 * t2 + 3.0 * t3),
        0.5 * (t + 4.0 * t2 - 3.0 * t3),
        0.5 * (t3 - t2),
    ]
}

/// Red, green, blue and confidence of a small picture, linear between pixels; confidence is the least of the four.
#[inline]
pub fn bilinear_with_confidence(image: &Image<[u8; 4]>, x: usize, y: usize, fx: f32, fy: f32) -> ([f32; 3], u8) {
    let (upper, lower) = (&image.row(y)[x..x + 2], &image.row(y + 1)[x..x + 2]);
    let color = std::array::from_fn(|c| {
        let top = f32::from(upper[0][c]) + (f32::from(upper[1][c]) - f32::from(upper[0][c])) * fx;
        let bottom = f32::from(lower[0][c]) + (f32::from(lower[1][c]) - f32::from(lower[0][c])) * fx;
        top + (bottom - top) * fy
    });
    (color, upper[0][3].min(upper[1][3]).min(lower[0][3]).min(lower[1][3]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_lookups_give_back_a_plane() {
        let mut image = Image::filled(12, 10, [0; 3]);
        let mut small = Image::filled(12, 10, [0; 4]);
        for y in 0..10 {
            for x in 0..12 {
                let value = [(10 * x) as u8, (12 * y) as u8, 77];
                image.set(x, y, value);
                small.set(x, y, [value[0], value[1], 77, (100 + x) as u8]);
            }
        }
        let color = bicubic(&image, 4, 5, 0.3, 0.6);
        assert!((color[0] - 43.0).abs() < 1e-3 && (color[1] - 67.2).abs() < 1e-3 && (color[2] - 77.0).abs() < 1e-3);
        let (color, confidence) = bilinear_with_confidence(&small, 4, 5, 0.3, 0.6);
        assert!((color[0] - 43.0).abs() < 1e-3 && (color[1] - 67.2).abs() < 1e-3 && confidence == 104);
    }
}
