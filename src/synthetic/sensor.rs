//! From light to 8-bit pixels: exposure, clipping, sRGB, noise.

use crate::image::buffer::Rgb8;
use crate::synthetic::noise::hash_u64;

/// Entries of the table from linear light to sRGB; the steepest part still gets 20 entries a level.
const CURVE_STEPS: usize = 65536;

/// The camera's electronics.
#[derive(Clone, Debug)]
pub struct Sensor {
    /// 8-bit level, not yet rounded, for linear light 0…1.
    curve: Vec<f32>,
    /// Quantiles of the normal distribution.
    normal: Vec<f32>,
    /// Variance of the read noise, linear².
    read_variance: f32,
    /// Variance of the shot noise per linear light.
    shot_variance: f32,
}

impl Sensor {
    /// About one level of noise at mid-gray, times `noise`.
    pub fn new(noise: f64) -> Self {
        let curve = (0..=CURVE_STEPS).map(|i| level_from_linear(i as f64 / CURVE_STEPS as f64) as f32).collect();
        let normal = (0..4096).map(|i| normal_quantile((f64::from(i) + 0.5) / 4096.0) as f32).collect();
        let variance = (noise * noise) as f32;
        Self { curve, normal, read_variance: 1.2e-7 * variance, shot_variance: 6.5e-5 * variance }
    }

    /// Level (0–255, not rounded) of linear light; clips.
    pub fn level(&self, linear: f32) -> f32 {
        self.curve[(linear.clamp(0.0, 1.0) * CURVE_STEPS as f32 + 0.5) as usize]
    }

    /// A pixel without noise.
    pub fn clean(&self, linear: [f32; 3]) -> Rgb8 {
        linear.map(|v| (self.level(v) + 0.5) as u8)
    }

    /// A pixel with the noise that belongs to `key` (frame and pixel).
    pub fn noisy(&self, linear: [f32; 3], key: u64) -> Rgb8 {
        let bits = hash_u64(key);
        std::array::from_fn(|k| {
            let deviate = self.normal[(bits >> (16 * k)) as usize & 4095];
            // Photons arrive at random before the well overflows.
            let sigma = (self.read_variance + self.shot_variance * linear[k].clamp(0.0, 1.5)).sqrt();
            (self.level(linear[k] + sigma * deviate) + 0.5) as u8
        })
    }
}

/// IEC 61966-2-1.
fn level_from_linear(linear: f64) -> f64 {
    255.0 * if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Quantile of the normal distribution by bisection of its (Abramowitz and Stegun 7.1.26) integral; runs once a table entry.
fn normal_quantile(share: f64) -> f64 {
    let below = |x: f64| {
        let z = x.abs() / std::f64::consts::SQRT_2;
        let t = 1.0 / (1.0 + 0.327_591_1 * z);
        let poly = t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
        let erf = 1.0 - poly * (-z * z).exp();
        0.5 * (1.0 + erf * x.signum())
    };
    let (mut low, mut high) = (-6.0, 6.0);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if below(middle) < share { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// The slow loop that keeps the picture's brightness.
#[derive(Clone, Copy, Debug)]
pub struct AutoExposure {
    /// Mean level it aims at, 0–255.
    pub target_level: f64,
    /// Share of the error (in logarithms) that one frame corrects.
    pub gain: f64,
}

impl Default for AutoExposure {
    fn default() -> Self {
        Self { target_level: 106.0, gain: 0.06 }
    }
}

impl AutoExposure {
    /// Exposure per frame, from each frame's metered light (linear, a few hundred samples a frame).
    pub fn exposures(&self, metered: &[Vec<f32>], sensor: &Sensor) -> Vec<f64> {
        let mean_level = |samples: &[f32], exposure: f64| {
            let sum: f64 = samples.iter().map(|&light| f64::from(sensor.level(light * exposure as f32))).sum();
            sum / samples.len().max(1) as f64
        };
        let mut exposure = 1.0;
        if let Some(first) = metered.first() {
            // The loop had settled before the recording began.
            for _ in 0..60 {
                exposure *= (self.target_level / mean_level(first, exposure).max(1.0)).powf(1.2);
            }
        }
        let mut exposures = Vec::with_capacity(metered.len());
        for samples in metered {
            exposures.push(exposure);
            let error = (self.target_level / mean_level(samples, exposure).max(1.0)).ln();
            exposure *= (2.0 * self.gain * error).exp();
        }
        exposures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mid_gray_noise_is_about_one_level() {
        let sensor = Sensor::new(1.0);
        let clean = f64::from(sensor.level(0.2));
        let mut squares = 0.0;
        for key in 0..20_000 {
            squares += (f64::from(sensor.noisy([0.2; 3], key)[1]) - clean).powi(2);
        }
        let sigma = (squares / 20_000.0).sqrt();
        assert!((0.8..1.3).contains(&sigma), "{sigma}");
    }

    #[test]
    fn the_exposure_loop_settles_on_its_target() {
        let sensor = Sensor::new(1.0);
        let metered: Vec<Vec<f32>> = (0..120).map(|i| vec![if i < 20 { 0.5 } else { 0.1 }; 50]).collect();
        let exposures = AutoExposure::default().exposures(&metered, &sensor);
        let last = sensor.level(0.1 * exposures[119] as f32);
        assert!((last - 106.0).abs() < 2.0, "{last}");
        let first = sensor.level(0.5 * exposures[0] as f32);
        assert!((first - 106.0).abs() < 1.0, "{first}");
    }
}
