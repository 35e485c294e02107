//! Which blocks of the picture are still, judged against the noise.
//!
//! For each block of 16 × 16 pixels the newest frame is compared with one from the middle of the window and with its
//! oldest. In a still block the mean squared difference is 2 σ² for both; motion adds gradient energy, and the more the
//! older the frame. Single pixels that differ wildly (particles) are left out of the mean; they are `particles`' business.
//! The mean signed difference is tested too: it finds a faint shadow, or the lamp getting brighter, far below the noise.

use crate::image::wide::Kernel;
use crate::stages::temporal_median::noise::{Noise, NoiseTable};

/// Edge of a block, px.
pub const BLOCK: usize = 16;
/// Frames the newest one is compared with: the window's middle and its oldest.
pub const LAGS: usize = 2;

/// Fewer pixels that are not outliers say nothing.
const MIN_INLIERS: u32 = 48;
/// Still: mean squared difference over 2 σ², of a block and of 3 × 3 blocks. The standard deviation of the first is 9 %
/// (256 pixels, Gaussian noise); tuned so that the bias a missed motion may leave stays below what the median gains.
const STILL_RATIO: f32 = 1.55;
const STILL_RATIO_AROUND: f32 = 1.22;
/// Oldest over middle, of 3 × 3 blocks: motion grows with the lag, noise does not.
const STILL_GROWTH: f32 = 1.15;
/// Absolute slack, levels²: rounding and coding.
const SLACK: f32 = 0.25;
/// Signed mean: standard deviations, and levels.
const STILL_SIGMAS: f32 = 3.5;
const STILL_LEVELS: f32 = 0.35;
/// From here on nothing in the block is judged.
const MOVING_RATIO: f32 = 6.0;

/// What one block shows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BlockStats {
    /// Sum of squared differences over the inliers, per lag.
    pub squares: [u32; LAGS],
    /// Sum of signed differences over the inliers, per lag.
    pub sums: [i32; LAGS],
    /// Pixels that differ by no more than the inlier bound, per lag.
    pub inliers: [u32; LAGS],
    /// Mean gray.
    pub level: f32,
    /// Noise variance if the block were smooth: mean squared second difference along the rows over 6.
    pub spatial_variance: f32,
    /// Mean squared central difference along the rows over 2: noise variance plus texture.
    pub texture: f32,
}

impl BlockStats {
    /// Noise variance if the block were still.
    pub fn temporal_variance(&self, lag: usize) -> Option<f32> {
        (self.inliers[lag] >= MIN_INLIERS).then(|| self.squares[lag] as f32 / self.inliers[lag] as f32 / 2.0)
    }
}

/// What a block is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Motion {
    /// Nothing but noise: the median may speak for every pixel.
    Still,
    /// Small systematic differences: only particles are replaced.
    Slow,
    /// Left as it came.
    #[default]
    Moving,
}

/// One row of blocks.
#[derive(Debug)]
pub struct BlockRow<'a> {
    /// Newest, middle and oldest gray rows of this block row.
    pub newest: &'a [u8],
    /// The frames to compare with.
    pub older: [&'a [u8]; LAGS],
    /// Row length, px.
    pub width: usize,
    /// Differences above it are outliers; at most 63.
    pub inlier_bound: u8,
    /// One per block.
    pub stats: &'a mut [BlockStats],
}

impl Kernel for BlockRow<'_> {
    #[inline(always)]
    fn run(self) {
        let bound = self.inlier_bound.min(63);
        for (index, stats) in self.stats.iter_mut().enumerate() {
            let left = index * BLOCK;
            let columns = BLOCK.min(self.width - left);
            *stats = BlockStats::default();
            for lag in 0..LAGS {
                // 16 rows of squares up to 63² fit into u16.
                let mut squares = [0_u16; BLOCK];
                let mut sums = [0_i16; BLOCK];
                let mut inliers = [0_u16; BLOCK];
                for (now, then) in self
                    .newest
                    .chunks_exact(self.width)
                    .zip(self.older[lag].chunks_exact(self.width))
                {
                    let (a, b) = (&now[left..left + columns], &then[left..left + columns]);
                    if let (Ok(a), Ok(b)) = (<&[u8; BLOCK]>::try_from(a), <&[u8; BLOCK]>::try_from(b)) {
                        for i in 0..BLOCK {
                            add(a[i], b[i], bound, &mut squares[i], &mut sums[i], &mut inliers[i]);
                        }
                    } else {
                        for i in 0..columns {
                            add(a[i], b[i], bound, &mut squares[i], &mut sums[i], &mut inliers[i]);
                        }
                    }
                }
                stats.squares[lag] = squares.iter().map(|v| u32::from(*v)).sum();
                stats.sums[lag] = sums.iter().map(|v| i32::from(*v)).sum();
                stats.inliers[lag] = inliers.iter().map(|v| u32::from(*v)).sum();
            }
            texture(self.newest, self.width, left, columns, stats);
        }
    }
}

#[inline(always)]
fn add(a: u8, b: u8, bound: u8, squares: &mut u16, sum: &mut i16, inliers: &mut u16) {
    let difference = i16::from(a) - i16::from(b);
    let inlier = a.abs_diff(b) <= bound;
    let kept = if inlier { difference } else { 0 };
    *squares += (kept * kept) as u16;
    *sum += kept;
    *inliers += u16::from(inlier);
}

/// Brightness, texture and noise of the newest frame, from every other row.
#[inline(always)]
fn texture(gray: &[u8], width: usize, left: usize, columns: usize, stats: &mut BlockStats) {
    let (mut level, mut second, mut central, mut rows) = (0_u32, 0_i32, 0_i32, 0_u32);
    for row in gray.chunks_exact(width).step_by(2) {
        let row = &row[left..left + columns];
        level += row.iter().map(|v| u32::from(*v)).sum::<u32>();
        if let Ok(row) = <&[u8; BLOCK]>::try_from(row) {
            for i in 1..BLOCK - 1 {
                let (a, b, c) = (i32::from(row[i - 1]), i32::from(row[i]), i32::from(row[i + 1]));
                let bend = 2 * b - a - c;
                second += bend * bend;
                central += (c - a) * (c - a);
            }
        } else {
            for i in 1..columns.saturating_sub(1) {
                let (a, b, c) = (i32::from(row[i - 1]), i32::from(row[i]), i32::from(row[i + 1]));
                let bend = 2 * b - a - c;
                second += bend * bend;
                central += (c - a) * (c - a);
            }
        }
        rows += 1;
    }
    let inner = (rows * columns.saturating_sub(2).max(1) as u32).max(1) as f32;
    stats.level = level as f32 / ((rows * columns as u32).max(1)) as f32;
    stats.spatial_variance = second as f32 / inner / 6.0;
    stats.texture = central as f32 / inner / 2.0;
}

/// What a block adds to the sums over its surroundings, per lag: squares, inliers, and the squares that noise would give.
pub type Share = [[f32; 3]; LAGS];

/// Judge every block; `columns` blocks a row. `shares` is working memory.
pub fn classify(stats: &[BlockStats], columns: usize, noise: &Noise, shares: &mut Vec<Share>, motions: &mut [Motion]) {
    let rows = stats.len() / columns.max(1);
    let noise = noise.table();
    shares.clear();
    shares.extend(stats.iter().map(|block| -> Share {
        let variance = noise.variance_at(block.level);
        std::array::from_fn(|lag| {
            let inliers = block.inliers[lag] as f32;
            [block.squares[lag] as f32, inliers, inliers * 2.0 * variance]
        })
    }));
    for y in 0..rows {
        for x in 0..columns {
            let mut around = Share::default();
            for ny in y.saturating_sub(1)..(y + 2).min(rows) {
                for near in &shares[ny * columns + x.saturating_sub(1)..ny * columns + (x + 2).min(columns)] {
                    for (sum, share) in around.as_flattened_mut().iter_mut().zip(near.as_flattened()) {
                        *sum += share;
                    }
                }
            }
            motions[y * columns + x] = judge(&stats[y * columns + x], &around, &noise);
        }
    }
}

fn judge(block: &BlockStats, sums_around: &Share, noise: &NoiseTable) -> Motion {
    let pair_variance = 2.0 * noise.variance_at(block.level);
    let mut still = true;
    let mut strongest = 0.0_f32;
    let mut around = [0.0_f32; LAGS];
    for (lag, around) in around.iter_mut().enumerate() {
        let n = block.inliers[lag];
        if n >= MIN_INLIERS {
            let mean_square = block.squares[lag] as f32 / n as f32;
            let bias = (block.sums[lag] as f32 / n as f32).abs();
            still &= mean_square <= STILL_RATIO * pair_variance + SLACK;
            still &= bias <= STILL_LEVELS + STILL_SIGMAS * (pair_variance / n as f32).sqrt();
            strongest = strongest.max((mean_square - SLACK) / pair_variance);
        }
        let [squares, inliers, expected] = sums_around[lag];
        if inliers >= MIN_INLIERS as f32 {
            still &= squares <= STILL_RATIO_AROUND * expected + SLACK * inliers;
            *around = squares / inliers;
            strongest = strongest.max(((squares / inliers) - SLACK) / (expected / inliers));
        }
    }
    still &= around[1] <= STILL_GROWTH * around[0] + SLACK;
    if still {
        Motion::Still
    } else if strongest < MOVING_RATIO {
        Motion::Slow
    } else {
        Motion::Moving
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::wide;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_block_sums_agree_with_plain_sums() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let (width, rows) = (41, 13);
        let mut plane = || (0..width * rows).map(|_| random.random_range(80..150)).collect::<Vec<u8>>();
        let (newest, middle, oldest) = (plane(), plane(), plane());
        let mut stats = vec![BlockStats::default(); 3];
        wide::run(BlockRow {
            newest: &newest,
            older: [&middle, &oldest],
            width,
            inlier_bound: 30,
            stats: &mut stats,
        });
        for (index, stats) in stats.iter().enumerate() {
            for (lag, older) in [&middle, &oldest].into_iter().enumerate() {
                let (mut squares, mut sum, mut inliers) = (0, 0, 0);
                for y in 0..rows {
                    for x in index * BLOCK..(index * BLOCK + BLOCK).min(width) {
                        let d = i32::from(newest[y * width + x]) - i32::from(older[y * width + x]);
                        if d.abs() <= 30 {
                            squares += (d * d) as u32;
                            sum += d;
                            inliers += 1;
                        }
                    }
                }
                assert_eq!(
                    (stats.squares[lag], stats.sums[lag], stats.inliers[lag]),
                    (squares, sum, inliers)
                );
            }
        }
    }
}
