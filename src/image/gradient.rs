//! Brightness slopes of a gray image.
//!
//! Central differences on an already smoothed image: on one smoothed with a binomial they are as good as Scharr's kernel and
//! half the price. At the border the one-sided difference is taken.

use crate::image::buffer::{Image, Rgb8};

/// Gray (Rec. 709 luma of the stored values, 0–255) from sRGB.
pub fn gray_from_rgb(image: &Image<Rgb8>) -> Image<f32> {
    let mut gray = Image::filled(image.width(), image.height(), 0.0);
    for (out, p) in gray.pixels_mut().iter_mut().zip(image.pixels()) {
        *out = 0.2126 * f32::from(p[0]) + 0.7152 * f32::from(p[1]) + 0.0722 * f32::from(p[2]);
    }
    gray
}

/// Slopes along x and y, gray levels per px.
pub fn gradient(image: &Image<f32>) -> (Image<f32>, Image<f32>) {
    let (width, height) = image.size();
    let mut along_x = Image::filled(width, height, 0.0);
    let mut along_y = Image::filled(width, height, 0.0);
    for y in 0..height {
        let row = image.row(y);
        let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
        let scale_y = 1.0 / (below - above).max(1) as f32;
        for (x, out) in along_x.row_mut(y).iter_mut().enumerate() {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
            *out = (row[right] - row[left]) / (right - left).max(1) as f32;
        }
        let (up, down) = (image.row(above), image.row(below));
        for (out, (d, u)) in along_y.row_mut(y).iter_mut().zip(down.iter().zip(up)) {
            *out = (d - u) * scale_y;
        }
    }
    (along_x, along_y)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_has_its_slope_everywhere() {
        let mut image = Image::filled(9, 7, 0.0f32);
        for y in 0..7 {
            for x in 0..9 {
                image.set(x, y, 3.0 * x as f32 - 2.0 * y as f32);
            }
        }
        let (gx, gy) = gradient(&image);
        assert!(gx.pixels().iter().all(|g| (g - 3.0).abs() < 1e-5));
        assert!(gy.pixels().iter().all(|g| (g + 2.0).abs() < 1e-5));
    }
}
