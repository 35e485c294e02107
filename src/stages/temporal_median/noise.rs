//! How noisy the video is, by brightness.
//!
//! Two witnesses: the second difference along a row (its variance is 6 σ² where the picture is smooth) and the difference
//! to an older frame (2 σ² where the scene is still). Either is inflated wherever its condition fails, so the lower
//! quartile over the blocks of one brightness counts. The spatial witness alone would call correlated noise too small,
//! the temporal one alone would take steady motion for noise; the temporal one therefore speaks within bounds that the
//! spatial one sets.

use crate::stages::temporal_median::motion::BlockStats;

const LEVELS: usize = 8;
const BINS: usize = 64;
/// Quarter octaves from 2⁻⁴.
const BINS_PER_OCTAVE: f32 = 4.0;
const LOWEST_LOG2: f32 = -4.0;
const QUANTILE: f32 = 0.25;
/// Fewer blocks of a brightness say nothing about it.
const MIN_BLOCKS: u32 = 12;
/// Rounding to 8 bits and the coder's dead zone: no video is quieter than this.
const MIN_VARIANCE: f32 = 0.35;
/// How much of a rise is believed per frame; a fall is believed at once by half.
const RISE: f32 = 0.04;
const FALL: f32 = 0.5;

#[derive(Clone, Copy, Debug)]
struct Histogram {
    counts: [u32; BINS],
    total: u32,
}

impl Histogram {
    const EMPTY: Self = Self {
        counts: [0; BINS],
        total: 0,
    };

    fn add(&mut self, variance: f32) {
        let bin = ((variance.max(1e-6).log2() - LOWEST_LOG2) * BINS_PER_OCTAVE).clamp(0.0, BINS as f32 - 1.0);
        self.counts[bin as usize] += 1;
        self.total += 1;
    }

    fn quantile(&self) -> Option<f32> {
        if self.total < MIN_BLOCKS {
            return None;
        }
        let wanted = (self.total as f32 * QUANTILE) as u32;
        let mut seen = 0;
        for (bin, count) in self.counts.iter().enumerate() {
            seen += count;
            if seen > wanted {
                return Some(((bin as f32 + 0.5) / BINS_PER_OCTAVE + LOWEST_LOG2).exp2());
            }
        }
        None
    }
}

/// Variance of the gray values' noise, per brightness.
#[derive(Clone, Debug)]
pub struct Noise {
    variance: [Option<f32>; LEVELS],
}

/// [`Noise::variance_at`] looked up.
#[derive(Clone, Copy, Debug)]
pub struct NoiseTable {
    variance: [f32; LEVELS],
}

impl NoiseTable {
    /// Variance at a brightness, levels².
    #[inline]
    pub fn variance_at(&self, level: f32) -> f32 {
        self.variance[bin_of(level)]
    }
}

impl Default for Noise {
    fn default() -> Self {
        Self {
            variance: [None; LEVELS],
        }
    }
}

impl Noise {
    /// Forget what was learnt.
    pub fn clear(&mut self) {
        self.variance = [None; LEVELS];
    }

    /// Variance at a brightness, levels²; the nearest brightness that is known, else one level.
    pub fn variance_at(&self, level: f32) -> f32 {
        let bin = bin_of(level);
        (0..LEVELS)
            .flat_map(|step| [bin.checked_sub(step), Some(bin + step)])
            .flatten()
            .find_map(|bin| self.variance.get(bin).copied().flatten())
            .unwrap_or(1.0)
    }

    /// The variances at all brightnesses, for asking often.
    pub fn table(&self) -> NoiseTable {
        NoiseTable {
            variance: std::array::from_fn(|bin| self.variance_at((bin as f32 + 0.5) * 256.0 / LEVELS as f32)),
        }
    }

    /// Learn from one frame's blocks.
    pub fn learn(&mut self, blocks: &[BlockStats]) {
        let mut spatial = [Histogram::EMPTY; LEVELS];
        let mut temporal = [Histogram::EMPTY; LEVELS];
        for block in blocks {
            let bin = bin_of(block.level);
            // Clipped blocks, black surround and white lamp alike, have no noise to show.
            if block.level < 6.0 || block.level > 249.0 {
                continue;
            }
            spatial[bin].add(block.spatial_variance);
            if let Some(variance) = block.temporal_variance(0) {
                temporal[bin].add(variance);
            }
        }
        for bin in 0..LEVELS {
            let Some(spatial) = spatial[bin].quantile() else { continue };
            let spatial = spatial.max(MIN_VARIANCE);
            let now = temporal[bin]
                .quantile()
                .map_or(spatial, |t| t.clamp(MIN_VARIANCE, 2.5 * spatial + 0.3));
            self.variance[bin] = Some(match self.variance[bin] {
                None => now,
                Some(before) if now < before => before + FALL * (now - before),
                Some(before) => before + RISE * (now - before),
            });
        }
    }
}

fn bin_of(level: f32) -> usize {
    ((level / 256.0 * LEVELS as f32) as usize).min(LEVELS - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_brightness_takes_its_neighbours_noise() {
        let mut noise = Noise::default();
        assert_eq!(noise.variance_at(100.0), 1.0);
        noise.variance[6] = Some(9.0);
        noise.variance[2] = Some(4.0);
        assert_eq!(noise.variance_at(40.0), 4.0);
        assert_eq!(noise.variance_at(250.0), 9.0);
        for level in 0..256 {
            let level = level as f32;
            assert_eq!(noise.table().variance_at(level), noise.variance_at(level));
        }
    }
}
