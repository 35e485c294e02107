//! Which blocks of the picture are still, judged against the noise.
//!
//! For each block of 16 × 16 pixels the newest frame is compared with one from the middle of the window and with its
//! oldest. In a still block the mean squared difference is 2 σ² for both; motion adds gradient energy, and the more the
//! older the frame. Single pixels that differ wildly (particles) are left out of the mean; they are `particles`' business.
//! The mean signed difference is tested too: it finds a faint shadow, or the lamp getting brighter, far below the noise.

use std::ops::Range;

use crate::image::wide::Kernel;
use crate::stages::temporal_median::noise::{Noise, NoiseTable};

/// Edge of a block, px.
pub const BLOCK: usize = 16;
/// Frames the newest one is compared with: the window's middle and its oldest.
pub const LAGS: usize = 2;

/// Blocks treated together: a cache line of each row.
const GROUP: usize = 4;
const COLUMNS: usize = GROUP * BLOCK;
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
        for (index, stats) in self.stats.chunks_mut(GROUP).enumerate() {
            let left = index * GROUP * BLOCK;
            match <&mut [BlockStats; GROUP]>::try_from(&mut *stats) {
                Ok(stats) if left + COLUMNS + 2 <= self.width => {
                    differences(self.newest, self.older, self.width, left, bound, stats);
                    textures(self.newest, self.width, left, stats);
                }
                _ => {
                    for (block, stats) in stats.iter_mut().enumerate() {
                        let left = left + block * BLOCK;
                        let columns = BLOCK.min(self.width - left);
                        difference(self.newest, self.older, self.width, left..left + columns, bound, stats);
                        texture(self.newest, self.width, left, columns, stats);
                    }
                }
            }
        }
    }
}

/// The sums over the differences of a block.
#[inline(always)]
fn difference(newest: &[u8], older: [&[u8]; LAGS], width: usize, columns: Range<usize>, bound: u8, stats: &mut BlockStats) {
    for (lag, older) in older.into_iter().enumerate() {
        let (mut squares, mut sum, mut inliers) = ([0; BLOCK], [0; BLOCK], [0; BLOCK]);
        for (now, then) in newest.chunks_exact(width).zip(older.chunks_exact(width)) {
            let (now, then) = (&now[columns.clone()], &then[columns.clone()]);
            for i in 0..now.len() {
                add(now[i], then[i], bound, &mut squares[i], &mut sum[i], &mut inliers[i]);
            }
        }
        stats.squares[lag] = squares.iter().map(|v| u32::from(*v)).sum();
        stats.sums[lag] = sum.iter().map(|v| i32::from(*v)).sum();
        stats.inliers[lag] = inliers.iter().map(|v| u32::from(*v)).sum();
    }
}

/// The same of several blocks at once. Loops as long as this are vectorized as they stand.
#[inline(always)]
fn differences(newest: &[u8], older: [&[u8]; LAGS], width: usize, left: usize, bound: u8, stats: &mut [BlockStats; GROUP]) {
    for (lag, older) in older.into_iter().enumerate() {
        // 16 rows of squares up to 63² fit into u16.
        let (mut squares, mut sums, mut inliers) = ([0; COLUMNS], [0; COLUMNS], [0; COLUMNS]);
        for (now, then) in newest.chunks_exact(width).zip(older.chunks_exact(width)) {
            if let (Some(now), Some(then)) = (now[left..].first_chunk::<COLUMNS>(), then[left..].first_chunk::<COLUMNS>()) {
                for i in 0..COLUMNS {
                    add(now[i], then[i], bound, &mut squares[i], &mut sums[i], &mut inliers[i]);
                }
            }
        }
        for (block, stats) in stats.iter_mut().enumerate() {
            let (mut square, mut sum, mut count) = (0, 0, 0);
            for i in block * BLOCK..(block + 1) * BLOCK {
                square += u32::from(squares[i]);
                sum += i32::from(sums[i]);
                count += u32::from(inliers[i]);
            }
            stats.squares[lag] = square;
            stats.sums[lag] = sum;
            stats.inliers[lag] = count;
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
        for i in 1..columns.saturating_sub(1) {
            let (a, b, c) = (i32::from(row[i - 1]), i32::from(row[i]), i32::from(row[i + 1]));
            let bend = 2 * b - a - c;
            second += bend * bend;
            central += (c - a) * (c - a);
        }
        rows += 1;
    }
    let inner = (rows * columns.saturating_sub(2).max(1) as u32).max(1) as f32;
    stats.level = level as f32 / ((rows * columns as u32).max(1)) as f32;
    stats.spatial_variance = second as f32 / inner / 6.0;
    stats.texture = central as f32 / inner / 2.0;
}

/// The same of several blocks at once.
#[inline(always)]
fn textures(gray: &[u8], width: usize, left: usize, stats: &mut [BlockStats; GROUP]) {
    let mut levels = [0_u16; COLUMNS];
    // By the column left of the center.
    let (mut seconds, mut centrals) = ([0_i32; COLUMNS], [0_i32; COLUMNS]);
    let mut rows = 0_u32;
    for row in gray.chunks_exact(width).step_by(2) {
        rows += 1;
        let Some(row) = row[left..].first_chunk::<{ COLUMNS + 2 }>() else {
            continue;
        };
        for i in 0..COLUMNS {
            levels[i] += u16::from(row[i]);
        }
        for i in 0..COLUMNS {
            let (a, b, c) = (i32::from(row[i]), i32::from(row[i + 1]), i32::from(row[i + 2]));
            let bend = 2 * b - a - c;
            seconds[i] += bend * bend;
            centrals[i] += (c - a) * (c - a);
        }
    }
    let inner = (rows * (BLOCK as u32 - 2)).max(1) as f32;
    for (block, stats) in stats.iter_mut().enumerate() {
        let (mut level, mut second, mut central) = (0, 0, 0);
        for column in &levels[block * BLOCK..(block + 1) * BLOCK] {
            level += u32::from(*column);
        }
        for i in block * BLOCK..(block + 1) * BLOCK - 2 {
            second += seconds[i];
            central += centrals[i];
        }
        stats.level = level as f32 / (rows * BLOCK as u32).max(1) as f32;
        stats.spatial_variance = second as f32 / inner / 6.0;
        stats.texture = central as f32 / inner / 2.0;
    }
}

/// What a block adds to the sums over its surroundings, per lag: squares, inliers, and the squares that noise would give; at the end
/// filled up to whole registers.
pub type Share = [f32; 8];
/// Of a lag in a [`Share`].
const SHARE_OF_LAG: usize = 3;

/// Judge every block; `columns` blocks a row. `shares` is working memory.
pub fn classify(stats: &[BlockStats], columns: usize, noise: &Noise, shares: &mut Vec<Share>, motions: &mut [Motion]) {
    let rows = stats.len() / columns.max(1);
    let noise = noise.table();
    shares.clear();
    shares.extend(stats.iter().map(|block| -> Share {
        let variance = noise.variance_at(block.level);
        let mut share = Share::default();
        for lag in 0..LAGS {
            let inliers = block.inliers[lag] as f32;
            let of_lag = [block.squares[lag] as f32, inliers, inliers * 2.0 * variance];
            share[lag * SHARE_OF_LAG..][..SHARE_OF_LAG].copy_from_slice(&of_lag);
        }
        share
    }));
    for y in 0..rows {
        for x in 0..columns {
            let mut around = Share::default();
            for ny in y.saturating_sub(1)..(y + 2).min(rows) {
                for near in &shares[ny * columns + x.saturating_sub(1)..ny * columns + (x + 2).min(columns)] {
                    for i in 0..around.len() {
                        around[i] += near[i];
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
        let [squares, inliers, expected] = [0, 1, 2].map(|i| sums_around[lag * SHARE_OF_LAG + i]);
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

    /// Differences above 30 levels are outliers.
    fn stats_of(newest: &[u8], older: [&[u8]; LAGS], width: usize) -> Vec<BlockStats> {
        let mut stats = vec![BlockStats::default(); width.div_ceil(BLOCK)];
        wide::run(BlockRow {
            newest,
            older,
            width,
            inlier_bound: 30,
            stats: &mut stats,
        });
        stats
    }

    #[test]
    fn texture_agrees_with_plain_sums() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        for (width, rows) in [(41_usize, 13_usize), (64, 16), (133, 16), (17, 3)] {
            let gray: Vec<u8> = (0..width * rows).map(|_| random.random()).collect();
            for (index, stats) in stats_of(&gray, [&gray, &gray], width).iter().enumerate() {
                let (left, right) = (index * BLOCK, (index * BLOCK + BLOCK).min(width));
                let (mut level, mut second, mut central, mut all) = (0, 0, 0, 0);
                for y in (0..rows).step_by(2) {
                    let row = &gray[y * width + left..y * width + right];
                    level += row.iter().map(|v| i32::from(*v)).sum::<i32>();
                    all += row.len();
                    for near in row.windows(3) {
                        let [a, b, c] = [0, 1, 2].map(|i| i32::from(near[i]));
                        second += (2 * b - a - c).pow(2);
                        central += (c - a).pow(2);
                    }
                }
                let inner = (rows.div_ceil(2) * (right - left).saturating_sub(2).max(1)) as f32;
                assert_eq!(stats.level, level as f32 / all as f32);
                assert_eq!(stats.spatial_variance, second as f32 / inner / 6.0);
                assert_eq!(stats.texture, central as f32 / inner / 2.0);
            }
        }
    }

    #[test]
    fn the_block_sums_agree_with_plain_sums() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let (width, rows) = (141, 13);
        let mut plane = || (0..width * rows).map(|_| random.random_range(80..150)).collect::<Vec<u8>>();
        let (newest, middle, oldest) = (plane(), plane(), plane());
        for (index, stats) in stats_of(&newest, [&middle, &oldest], width).iter().enumerate() {
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
