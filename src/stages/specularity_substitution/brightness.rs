//! The brightness of a view brought to that of the live picture, place by place.
//!
//! On good pixels the logarithm of the ratio live : view is measured per channel; a Gaussian normalized convolution carries it into the
//! hole. Measured on a path-traced scene this makes 6 dB against one gain per view.

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::Image;
use crate::stages::specularity_substitution::warp::Window;

/// The ratio is held on a grid of this pitch, px: it is smooth.
const PITCH_PX: usize = 4;
/// Added to both sides of the ratio, levels: in the dark the ratio is noise.
const DARK_LEVELS: f32 = 6.0;
/// Ratios beyond this (natural logarithm) are not lighting.
const MAX_LOG_RATIO: f32 = 1.2;

/// Weight of the window's mean ratio against what is near; a fully good cell weighs `PITCH_PX`².
const FAR_WEIGHT: f32 = 0.02;

/// Log ratios over a window; keeps its memory.
#[derive(Debug)]
pub struct LogRatio {
    weight: Image<f32>,
    channels: [Image<f32>; 3],
}

impl Default for LogRatio {
    fn default() -> Self {
        let plane = || Image::filled(0, 0, 0.0);
        Self {
            weight: plane(),
            channels: [plane(), plane(), plane()],
        }
    }
}

impl LogRatio {
    /// Measure live : view where `weight(i)` > 0.
    pub fn measure(
        &mut self,
        window: Window,
        live: impl Fn(usize) -> [f32; 3],
        view: impl Fn(usize) -> [f32; 3],
        weight: impl Fn(usize) -> f32,
        sigma_px: f32,
        scratch: &mut BlurScratch,
    ) {
        let (width, height) = (window.width.div_ceil(PITCH_PX), window.height.div_ceil(PITCH_PX));
        self.weight.resize(width, height, 0.0);
        for channel in &mut self.channels {
            channel.resize(width, height, 0.0);
        }
        for y in 0..window.height {
            for x in 0..window.width {
                let index = y * window.width + x;
                let w = weight(index);
                if w <= 0.0 {
                    continue;
                }
                let (a, b) = (live(index), view(index));
                let ratios: [f32; 3] = std::array::from_fn(|c| ((a[c] + DARK_LEVELS) / (b[c] + DARK_LEVELS).max(1.0)).ln());
                if ratios.iter().any(|r| r.abs() > MAX_LOG_RATIO) {
                    continue;
                }
                let cell = (y / PITCH_PX) * width + x / PITCH_PX;
                self.weight.pixels_mut()[cell] += w;
                for (channel, ratio) in self.channels.iter_mut().zip(ratios) {
                    channel.pixels_mut()[cell] += w * ratio;
                }
            }
        }
        let sigma = sigma_px / PITCH_PX as f32;
        let total: f32 = self.weight.pixels().iter().sum();
        gaussian_blur(&mut self.weight, sigma, scratch);
        for channel in &mut self.channels {
            // Far inside a wide hole nothing reaches: there the window's mean ratio holds.
            let mean = channel.pixels().iter().sum::<f32>() / total.max(1e-6);
            gaussian_blur(channel, sigma, scratch);
            for (value, weight) in channel.pixels_mut().iter_mut().zip(self.weight.pixels()) {
                *value = (*value + FAR_WEIGHT * mean) / (weight + FAR_WEIGHT);
            }
        }
    }

    /// `color` of the pixel in column `x` and row `y` of the window, in the live picture's brightness.
    #[inline]
    pub fn apply(&self, color: [f32; 3], x: usize, y: usize) -> [f32; 3] {
        let (width, height) = self.weight.size();
        let at = |i: usize, limit: usize| {
            let place = ((i as f32 + 0.5) / PITCH_PX as f32 - 0.5).clamp(0.0, limit as f32 - 1.0);
            (place as usize, (place as usize + 1).min(limit - 1), place.fract())
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (at(x, width), at(y, height));
        std::array::from_fn(|c| {
            let plane = &self.channels[c];
            let top = plane.at(x0, y0) + (plane.at(x1, y0) - plane.at(x0, y0)) * fx;
            let bottom = plane.at(x0, y1) + (plane.at(x1, y1) - plane.at(x0, y1)) * fx;
            ((color[c] + DARK_LEVELS) * (top + (bottom - top) * fy).exp() - DARK_LEVELS).clamp(0.0, 255.0)
        })
    }
}
