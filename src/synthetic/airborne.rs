//! What floats between scope and tissue: particles that streak past, and the smoke of electrocautery.

use nalgebra::Vector3;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::synthetic::noise::{Noise, hash_u64};

/// One particle in one frame: a streak in the picture, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Streak {
    /// Middle.
    pub at: [f64; 2],
    /// Unit direction.
    pub along: [f64; 2],
    /// Half length, px.
    pub half_length_px: f64,
    /// Radius, px.
    pub radius_px: f64,
    /// Its own light, linear after exposure.
    pub light: f32,
    /// How much it covers, 0–1.
    pub cover: f32,
}

/// The particles of frame `frame`: each is seen for one to three frames.
pub fn streaks(seed: u64, frame: u64, per_frame: f64, size: (usize, usize)) -> Vec<Streak> {
    const LONGEST_LIFE: u64 = 3;
    let mut seen = Vec::new();
    // A particle belongs to the frame in which it appears; whoever appeared lately may still be there.
    for age in 0..LONGEST_LIFE.min(frame + 1) {
        let born = frame - age;
        let mut random = ChaCha8Rng::seed_from_u64(hash_u64(seed ^ hash_u64(born ^ 0x9A27)));
        // Two frames of life on average.
        let count = (per_frame / 2.0 * random.random_range(0.4..1.6)).round() as usize;
        for _ in 0..count {
            let life = random.random_range(1..=LONGEST_LIFE);
            let start = [
                random.random_range(0.0..size.0 as f64),
                random.random_range(0.0..size.1 as f64),
            ];
            let heading = random.random_range(0.0..std::f64::consts::TAU);
            let length: f64 = random.random_range(2.0..15.0);
            let radius_px = random.random_range(0.8..2.2);
            let bright = random.random_range(0.0..1.0) < 0.75;
            let light = if bright {
                random.random_range(0.45..1.1)
            } else {
                random.random_range(0.0..0.04)
            } as f32;
            let cover = random.random_range(0.55..0.97) as f32;
            if age < life {
                let along = [heading.cos(), heading.sin()];
                // It moves on by more than its own length: exposure is shorter than the frame.
                let gone = age as f64 * length * 1.8;
                let at = [start[0] + along[0] * gone, start[1] + along[1] * gone];
                seen.push(Streak {
                    at,
                    along,
                    half_length_px: 0.5 * length,
                    radius_px,
                    light,
                    cover,
                });
            }
        }
    }
    seen
}

impl Streak {
    /// How much of pixel (x, y) it covers, 0–1.
    pub fn cover_at(&self, x: f64, y: f64) -> f32 {
        let (dx, dy) = (x - self.at[0], y - self.at[1]);
        let along = (dx * self.along[0] + dy * self.along[1]).clamp(-self.half_length_px, self.half_length_px);
        let distance = (dx - along * self.along[0]).hypot(dy - along * self.along[1]);
        self.cover * ((self.radius_px - distance) / 0.9 + 0.5).clamp(0.0, 1.0) as f32
    }

    /// Pixels it may touch: first and last column, first and last row.
    pub fn extent(&self, size: (usize, usize)) -> [std::ops::Range<usize>; 2] {
        let reach = self.half_length_px + self.radius_px + 1.5;
        let range = |centre: f64, count: usize| {
            let first = (centre - reach).floor().max(0.0) as usize;
            let last = ((centre + reach).ceil().max(0.0) as usize).min(count);
            first.min(last)..last
        };
        [range(self.at[0], size.0), range(self.at[1], size.1)]
    }
}

/// A plume that grows, drifts and thins out again; Koschmieder's law I = J·t + A·(1 − t).
#[derive(Clone, Copy, Debug)]
pub struct Smoke {
    noise: Noise,
    /// Optical depth at its thickest.
    peak: f64,
    /// Length of the recording, s.
    duration_s: f64,
}

/// The smoke's own light, linear after exposure; lit by the scope's lamps, slightly blue.
pub const AIRLIGHT: [f32; 3] = [0.36, 0.37, 0.39];

impl Smoke {
    /// `peak` is the optical depth of the thickest smoke.
    pub fn new(seed: u64, peak: f64, duration_s: f64) -> Self {
        Self {
            noise: Noise::new(seed ^ 0x50C3),
            peak,
            duration_s: duration_s.max(0.1),
        }
    }

    /// Transmission t at (x, y) in widths of the picture from its centre.
    pub fn transmission(&self, seconds: f64, x: f64, y: f64) -> f64 {
        let share = seconds / self.duration_s;
        // The knife works from 20 % to 45 % of the recording; then the smoke is sucked away.
        let grown = ((share - 0.2) / 0.25).clamp(0.0, 1.0) * (-((share - 0.45).max(0.0) / 0.22)).exp();
        if grown <= 0.0 {
            return 1.0;
        }
        let (dx, dy) = (x - 0.08 + 0.15 * share, y - 0.12 + 0.35 * share);
        let reach = 0.10 + 0.45 * share;
        let plume = (-(dx * dx + dy * dy) / (reach * reach)).exp();
        let drift = Vector3::new(4.0 * x + 0.3 * seconds, 4.0 * y + 0.9 * seconds, 0.35 * seconds);
        let wisps = (0.75 + 0.9 * self.noise.octaves(drift, 3)).max(0.05);
        (-self.peak * grown * (0.25 + 0.75 * plume) * wisps).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn particles_come_and_go_within_three_frames() {
        for frame in 0..10_u64 {
            let now = streaks(5, frame, 12.0, (640, 360));
            assert!(!now.is_empty());
            let later = streaks(5, frame + 3, 12.0, (640, 360));
            // Direction and length identify a particle.
            let same = |a: &Streak, b: &Streak| a.along == b.along && a.half_length_px == b.half_length_px;
            assert!(!now.iter().any(|a| later.iter().any(|b| same(a, b))));
        }
    }

    #[test]
    fn smoke_is_absent_at_first_thickest_in_the_middle_and_goes() {
        let smoke = Smoke::new(3, 1.2, 10.0);
        assert_eq!(smoke.transmission(0.5, 0.0, 0.0), 1.0);
        let mean = |t: f64| {
            (0..100)
                .map(|i| smoke.transmission(t, f64::from(i % 10) * 0.09 - 0.45, f64::from(i / 10) * 0.05 - 0.25))
                .sum::<f64>()
                / 100.0
        };
        assert!(mean(4.5) < 0.75 && mean(9.9) > mean(4.5) + 0.1);
    }
}
