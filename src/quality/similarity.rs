//! PSNR, texture PSNR and SSIM.
//!
//! - **PSNR** = 10 log₁₀(255² / mean squared error over pixels and channels).
//! - **Texture PSNR**: the same after a Gaussian of σ 8 px was subtracted from both, so that slow differences of brightness
//!   (exposure, the lamp's haze) do not hide whether the texture is right.
//! - **SSIM** (Wang, Bovik, Sheikh, Simoncelli 2004, doi:10.1109/TIP.2003.819861) on gray (0.299, 0.587, 0.114), 11×11 Gaussian
//!   window of σ 1.5 px, C₁ = (0.01·255)², C₂ = (0.03·255)². Borders mirror (…cb|abc…).

use rayon::prelude::*;

use crate::image::buffer::{Image, Rgb8};

/// Squared differences of colours, gathered over pixels and pictures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SquaredError {
    sum: f64,
    pixels: u64,
}

impl SquaredError {
    /// One more pixel.
    #[inline]
    pub fn add(&mut self, a: [f32; 3], b: [f32; 3]) {
        let squares: f32 = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum();
        self.sum += f64::from(squares) / 3.0;
        self.pixels += 1;
    }

    /// Another gathering's pixels too.
    pub fn merge(&mut self, other: &Self) {
        self.sum += other.sum;
        self.pixels += other.pixels;
    }

    /// How many pixels were added.
    pub fn pixels(&self) -> u64 {
        self.pixels
    }

    /// Mean squared error; NaN without pixels.
    pub fn mean(&self) -> f64 {
        self.sum / self.pixels as f64
    }

    /// In dB; NaN without pixels, at most 168 dB.
    pub fn psnr(&self) -> f64 {
        if self.pixels == 0 { f64::NAN } else { psnr_of(self.mean()) }
    }
}

/// PSNR of a mean squared error, dB.
pub fn psnr_of(mean_squared_error: f64) -> f64 {
    10.0 * (255.0_f64.powi(2) / mean_squared_error.max(1e-12)).log10()
}

/// Gray as OpenCV has it: 0.299 R + 0.587 G + 0.114 B, rounded to a level.
pub fn gray_of(pixel: Rgb8) -> u8 {
    let [r, g, b] = pixel.map(u32::from);
    // Fixed point with 14 bits, as cvtColor does.
    ((r * 4899 + g * 9617 + b * 1868 + (1 << 13)) >> 14) as u8
}

/// The picture minus its Gaussian mean.
pub fn texture_of(image: &Image<Rgb8>, sigma_px: f32) -> Image<[f32; 3]> {
    let (width, height) = image.size();
    let mut out = Image::filled(width, height, [0.0_f32; 3]);
    // The kernel's length as OpenCV chooses it for floats.
    let kernel = gaussian(((sigma_px * 8.0 + 1.0).round() as usize | 1) / 2, sigma_px);
    for channel in 0..3 {
        let plane: Vec<f32> = image.pixels().iter().map(|p| f32::from(p[channel])).collect();
        let blurred = blurred(&plane, width, height, &kernel, Border::Edge);
        for ((out, &value), &mean) in out.pixels_mut().iter_mut().zip(&plane).zip(&blurred) {
            out[channel] = value - mean;
        }
    }
    out
}

/// SSIM per pixel, on gray. The pictures must have the same size.
pub fn ssim_map(a: &Image<Rgb8>, b: &Image<Rgb8>) -> Image<f64> {
    let (width, height) = a.size();
    let kernel = gaussian(5, 1.5);
    let gray = |image: &Image<Rgb8>| image.pixels().iter().map(|&p| f32::from(gray_of(p))).collect::<Vec<f32>>();
    let (a, b) = (gray(a), gray(b));
    // Around mid-gray, so that the differences of large squares keep their digits in f32.
    const SHIFT: f32 = 128.0;
    let product = |p: &[f32], q: &[f32]| p.iter().zip(q).map(|(p, q)| (p - SHIFT) * (q - SHIFT)).collect::<Vec<f32>>();
    let centered = |p: &[f32]| p.iter().map(|v| v - SHIFT).collect::<Vec<f32>>();
    let planes = [centered(&a), centered(&b), product(&a, &a), product(&b, &b), product(&a, &b)];
    let [ma, mb, aa, bb, ab] = planes.map(|plane| blurred(&plane, width, height, &kernel, Border::Mirror));
    let (c1, c2) = ((0.01_f64 * 255.0).powi(2), (0.03_f64 * 255.0).powi(2));
    let mut out = Image::filled(width, height, 0.0_f64);
    for (i, value) in out.pixels_mut().iter_mut().enumerate() {
        let [ma, mb, aa, bb, ab] = [ma[i], mb[i], aa[i], bb[i], ab[i]].map(f64::from);
        let (va, vb, cov) = (aa - ma * ma, bb - mb * mb, ab - ma * mb);
        let (ma, mb) = (ma + f64::from(SHIFT), mb + f64::from(SHIFT));
        *value = (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
    }
    out
}

fn gaussian(radius: usize, sigma: f32) -> Vec<f32> {
    let weights: Vec<f64> = (0..=2 * radius)
        .map(|i| (-((i as f64 - radius as f64) / f64::from(sigma)).powi(2) / 2.0).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

#[derive(Clone, Copy)]
enum Border {
    /// cba|abc
    Edge,
    /// cb|abc
    Mirror,
}

fn reflected(index: isize, length: usize, border: Border) -> usize {
    let length = length as isize;
    let mut i = index;
    loop {
        if i < 0 {
            i = match border {
                Border::Edge => -1 - i,
                Border::Mirror if length == 1 => 0,
                Border::Mirror => -i,
            };
        } else if i >= length {
            i = match border {
                Border::Edge => 2 * length - 1 - i,
                Border::Mirror if length == 1 => 0,
                Border::Mirror => 2 * length - 2 - i,
            };
        } else {
            return i as usize;
        }
    }
}

fn blurred(plane: &[f32], width: usize, height: usize, kernel: &[f32], border: Border) -> Vec<f32> {
    let radius = kernel.len() / 2;
    let mut across = vec![0.0_f32; plane.len()];
    across
        .par_chunks_mut(width.max(1))
        .zip(plane.par_chunks(width.max(1)))
        .for_each_init(Vec::new, |padded: &mut Vec<f32>, (out, row)| {
            padded.clear();
            padded.extend((-(radius as isize)..(width + radius) as isize).map(|x| row[reflected(x, width, border)]));
            for (k, &weight) in kernel.iter().enumerate() {
                for (out, value) in out.iter_mut().zip(&padded[k..]) {
                    *out += weight * value;
                }
            }
        });
    let mut out = vec![0.0_f32; plane.len()];
    out.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, out)| {
        for (k, &weight) in kernel.iter().enumerate() {
            let source = reflected(y as isize + k as isize - radius as isize, height, border) * width;
            for (out, value) in out.iter_mut().zip(&across[source..source + width]) {
                *out += weight * value;
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_by_hand() {
        let mut error = SquaredError::default();
        assert!(error.psnr().is_nan());
        error.add([10.0, 10.0, 10.0], [13.0, 10.0, 10.0]);
        error.add([0.0; 3], [0.0; 3]);
        // 9 / 3 channels / 2 pixels.
        assert!((error.mean() - 1.5).abs() < 1e-12);
        assert!((error.psnr() - 10.0 * (65025.0_f64 / 1.5).log10()).abs() < 1e-12);
    }

    #[test]
    fn equal_pictures_have_ssim_one_and_flat_ones_the_luminance_term() {
        let flat = |v: u8| Image::filled(20, 15, [v; 3]);
        assert!(ssim_map(&flat(90), &flat(90)).pixels().iter().all(|s| (s - 1.0).abs() < 1e-6));
        let c1 = 6.5025;
        let expected = (2.0 * 100.0 * 120.0 + c1) / (100.0 * 100.0 + 120.0 * 120.0 + c1);
        let found = ssim_map(&flat(100), &flat(120));
        assert!(
            found.pixels().iter().all(|s| (s - expected).abs() < 1e-4),
            "{}",
            found.at(3, 3)
        );
    }

    #[test]
    fn texture_of_a_flat_picture_is_nothing_and_a_step_keeps_half() {
        let flat = Image::filled(40, 30, [77, 3, 200]);
        assert!(texture_of(&flat, 8.0).pixels().iter().flatten().all(|v| v.abs() < 1e-3));
        let mut step = Image::filled(100, 8, [0_u8; 3]);
        for y in 0..8 {
            for x in 50..100 {
                step.set(x, y, [100; 3]);
            }
        }
        let texture = texture_of(&step, 8.0);
        // Just right of the step the mean is a little above 50.
        assert!((texture.at(50, 4)[0] - (100.0 - 52.5)).abs() < 0.3, "{:?}", texture.at(50, 4));
    }

    #[test]
    fn gray_as_opencv() {
        assert_eq!(gray_of([255, 255, 255]), 255);
        assert_eq!(gray_of([200, 100, 50]), 124);
    }
}
