//! Blurs of single-channel f32 images with cost independent of the radius, and the decimation they are used on.

use crate::image::buffer::Image;

/// Working memory of [`box_blur`]; keep it between calls so that nothing is allocated.
#[derive(Debug, Default)]
pub struct BlurScratch {
    plane: Vec<f32>,
    sums: Vec<f32>,
}

/// Mean over a (2·radius + 1)² square, in place; at the border the mean of what lies inside the image.
pub fn box_blur(image: &mut Image<f32>, radius: usize, scratch: &mut BlurScratch) {
    let (width, height) = image.size();
    if radius == 0 || width == 0 || height == 0 {
        return;
    }
    scratch.plane.resize(width * height, 0.0);
    for y in 0..height {
        box_mean_of_row(image.row(y), &mut scratch.plane[y * width..(y + 1) * width], radius);
    }
    // Columns: running sums over whole rows, which vectorise.
    scratch.sums.clear();
    scratch.sums.resize(width, 0.0);
    let reach = radius.min(height);
    for y in 0..reach {
        add_row(&mut scratch.sums, &scratch.plane[y * width..(y + 1) * width], 1.0);
    }
    for y in 0..height {
        if y + radius < height {
            let entering = y + radius;
            add_row(
                &mut scratch.sums,
                &scratch.plane[entering * width..(entering + 1) * width],
                1.0,
            );
        }
        if y > radius {
            let leaving = y - radius - 1;
            add_row(
                &mut scratch.sums,
                &scratch.plane[leaving * width..(leaving + 1) * width],
                -1.0,
            );
        }
        let rows = (y + radius).min(height - 1) + 1 - y.saturating_sub(radius);
        let scale = 1.0 / rows as f32;
        for (out, sum) in image.row_mut(y).iter_mut().zip(&scratch.sums) {
            *out = sum * scale;
        }
    }
}

/// Close to a Gaussian of the given standard deviation: three box blurs (Wells 1986). In place.
pub fn gaussian_blur(image: &mut Image<f32>, sigma_px: f32, scratch: &mut BlurScratch) {
    // Three boxes of width w have variance (w² − 1)/4.
    let radius = ((((4.0 * sigma_px * sigma_px + 1.0).sqrt()) - 1.0) / 2.0).round() as usize;
    for _ in 0..3 {
        box_blur(image, radius, scratch);
    }
}

fn box_mean_of_row(source: &[f32], out: &mut [f32], radius: usize) {
    let width = source.len();
    let mut sum: f32 = source[..radius.min(width)].iter().sum();
    for x in 0..width {
        if x + radius < width {
            sum += source[x + radius];
        }
        if x > radius {
            sum -= source[x - radius - 1];
        }
        let count = (x + radius).min(width - 1) + 1 - x.saturating_sub(radius);
        out[x] = sum / count as f32;
    }
}

fn add_row(sums: &mut [f32], row: &[f32], sign: f32) {
    for (sum, value) in sums.iter_mut().zip(row) {
        *sum += sign * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reference_box_blur(image: &Image<f32>, radius: isize) -> Image<f32> {
        let (width, height) = image.size();
        let mut out = Image::filled(width, height, 0.0);
        for y in 0..height as isize {
            for x in 0..width as isize {
                let mut rows = 0.0;
                let mut total = 0.0;
                for v in (y - radius).max(0)..=(y + radius).min(height as isize - 1) {
                    let mut sum = 0.0;
                    let mut count = 0.0;
                    for u in (x - radius).max(0)..=(x + radius).min(width as isize - 1) {
                        sum += image.at(u as usize, v as usize);
                        count += 1.0;
                    }
                    total += sum / count;
                    rows += 1.0;
                }
                out.set(x as usize, y as usize, total / rows);
            }
        }
        out
    }

    #[test]
    fn equals_its_naive_twin() {
        for (width, height, radius) in [(17, 11, 2), (5, 9, 7), (1, 6, 1), (40, 3, 5)] {
            let pixels = (0..width * height).map(|i| ((i * 7919) % 251) as f32).collect();
            let mut image = Image::from_vec(width, height, pixels).unwrap();
            let expected = reference_box_blur(&image, radius as isize);
            box_blur(&mut image, radius, &mut BlurScratch::default());
            for (a, b) in image.pixels().iter().zip(expected.pixels()) {
                assert!((a - b).abs() < 1e-2, "{a} against {b}");
            }
        }
    }
}
