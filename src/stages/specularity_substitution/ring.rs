//! The small shift between a drawn view and the live picture, found on the good pixels around a hole.
//!
//! Detail (luminance over its surroundings) is compared, so that brightness plays no part; Gauss–Newton on two unknowns with a prior
//! around zero, because a ring without texture must not invent a shift.

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::Image;
use crate::stages::specularity_substitution::warp::Window;

/// A shift is expected to be about this long at 960 px width, px.
const EXPECTED_PX: f32 = 0.7;
/// Detail of tissue and noise left after a good fit.
const RESIDUAL_SCALE: f32 = 0.03;

/// Detail of a window; keeps its memory.
#[derive(Debug)]
pub struct Detail {
    /// Relative detail; 0 where not usable.
    pub values: Image<f32>,
    weight: Image<f32>,
}

impl Default for Detail {
    fn default() -> Self {
        Self {
            values: Image::filled(0, 0, 0.0),
            weight: Image::filled(0, 0, 0.0),
        }
    }
}

impl Detail {
    /// Of `color` where `usable`; `sigma_px` is the extent of the surroundings.
    pub fn measure(
        &mut self,
        window: Window,
        color: impl Fn(usize) -> [f32; 3],
        usable: impl Fn(usize) -> bool,
        sigma_px: f32,
        scratch: &mut BlurScratch,
    ) {
        self.values.resize(window.width, window.height, 0.0);
        self.weight.resize(window.width, window.height, 0.0);
        for index in 0..window.area() {
            if usable(index) {
                self.values.pixels_mut()[index] = luminance(color(index));
                self.weight.pixels_mut()[index] = 1.0;
            }
        }
        gaussian_blur(&mut self.values, sigma_px, scratch);
        gaussian_blur(&mut self.weight, sigma_px, scratch);
        for index in 0..window.area() {
            let (mean, weight) = (self.values.pixels()[index], self.weight.pixels()[index]);
            self.values.pixels_mut()[index] = if usable(index) && weight > 0.05 && mean > 0.0 {
                (luminance(color(index)) * weight / mean - 1.0).clamp(-0.5, 0.5)
            } else {
                0.0
            };
        }
    }
}

/// Luma, levels.
#[inline]
pub fn luminance([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// By how much the live pixel must be moved before the view is looked up, px, so that `drawn` fits `live`; where `usable`.
/// `None` when too few pixels are usable.
pub fn shift_between(live: &Detail, drawn: &Detail, usable: impl Fn(usize) -> bool, scale: f32) -> Option<[f32; 2]> {
    let (width, height) = live.values.size();
    let (a, b) = (live.values.pixels(), drawn.values.pixels());
    let (mut xx, mut xy, mut yy, mut xr, mut yr, mut count) = (0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0_u32);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            if !(usable(i) && usable(i - 1) && usable(i + 1) && usable(i - width) && usable(i + width)) {
                continue;
            }
            // The mean of both gradients halves the bias of noise (Efficient second-order, Malis 2004).
            let gx = 0.25 * (b[i + 1] - b[i - 1] + a[i + 1] - a[i - 1]);
            let gy = 0.25 * (b[i + width] - b[i - width] + a[i + width] - a[i - width]);
            let r = a[i] - b[i];
            let w = 1.0 / (1.0 + (r / RESIDUAL_SCALE).powi(2));
            xx += w * gx * gx;
            xy += w * gx * gy;
            yy += w * gy * gy;
            xr += w * gx * r;
            yr += w * gy * r;
            count += 1;
        }
    }
    if count < 30 {
        return None;
    }
    // The prior: neighbouring pixels tell much the same, so a residual's information counts for a fifth.
    let expected = EXPECTED_PX * scale;
    let prior = 5.0 * (RESIDUAL_SCALE / expected).powi(2);
    let (xx, yy) = (xx + prior, yy + prior);
    let determinant = xx * yy - xy * xy;
    if determinant <= 0.0 {
        return None;
    }
    Some([(yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant])
}
