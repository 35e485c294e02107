//! The live picture, small, as the views are compared with it.

use rayon::prelude::*;

use crate::image::color::luma;
use crate::stages::specularity_substitution::grid::{Grid, SMALL_PER_BLOCK, SMALL_PER_CELL, Smoother, Span, Sums};
use crate::stages::specularity_substitution::scene::Scene;

/// Added to levels before they are compared as ratios: in the dark ratios are noise.
pub const DARK_LEVELS: f32 = 6.0;

/// No good pixel.
const NOWHERE: u32 = u32::MAX;

/// A pixel of the small picture.
#[derive(Clone, Copy, Debug, Default)]
struct SmallPixel {
    color: [f32; 3],
    /// mm; 0 where the pixel shows the lamp, an instrument or nothing, or is too far from any hole to matter.
    depth: f32,
}

/// A good pixel of the small picture.
#[derive(Clone, Copy, Debug)]
pub struct Good {
    /// Its middle in the picture, px.
    pub x: f32,
    /// Its middle in the picture, px.
    pub y: f32,
    /// Depth, mm.
    pub depth: f32,
    /// Luma with [`DARK_LEVELS`] added.
    pub brightness: f32,
    /// Mean colour with [`DARK_LEVELS`] added.
    pub color: [f32; 3],
    /// Half the relative slope of brightness, a small px, right and down; if all neighbours are good.
    pub slope: Option<[f32; 2]>,
    /// The neighbours' places among the good pixels: left, right, above, below; past the end where they are not good.
    pub around: [u32; 4],
    /// Column and row within the block.
    pub within: [u8; 2],
}

/// The good pixels around the holes of one frame; keeps its memory.
#[derive(Debug, Default)]
pub struct Live {
    /// The good pixels, block by block.
    pub good: Vec<Good>,
    /// Where each block's good pixels begin; one more at the end.
    pub first: Vec<u32>,
    /// 1 for every cell with a pixel that may be replaced.
    pub holes: Vec<u8>,
    /// 1 for every block with such a cell.
    pub hole_blocks: Vec<u8>,
    /// Per block, smoothed: weight, brightness, squared detail (both relative).
    pub detail: Vec<Sums>,
    small: Vec<SmallPixel>,
    places: Vec<u32>,
    smoother: Smoother,
}

impl Live {
    /// Look at a frame.
    pub fn look(&mut self, scene: &Scene<'_>) {
        let grid = scene.grid;
        let (width, height) = grid.small();
        self.small.clear();
        self.small.resize(width * height, SmallPixel::default());
        self.holes.clear();
        self.holes.resize(grid.count(), 0);
        self.small
            .par_chunks_mut(width * SMALL_PER_CELL)
            .zip(self.holes.par_chunks_mut(grid.across))
            .enumerate()
            .for_each(|(row, (pixels, holes))| {
                look_at_row(scene, row, pixels, holes);
            });
        self.hole_blocks.clear();
        self.hole_blocks.resize(grid.blocks().0 * grid.blocks().1, 0);
        for (cell, &hole) in self.holes.iter().enumerate() {
            let (column, row) = (cell % grid.across * grid.cell, cell / grid.across * grid.cell);
            self.hole_blocks[grid.block_at(column, row)] |= hole;
        }
        self.gather(grid);
        self.measure_detail(grid);
    }

    /// How many good pixels the blocks of a rectangle have.
    pub fn good_in(&self, grid: Grid, span: Span) -> usize {
        let count = |row: usize| {
            let blocks = span.row(row, grid.blocks().0);
            (self.first[blocks.end] - self.first[blocks.start]) as usize
        };
        span.rows().map(count).sum()
    }

    /// The good pixels of a block, and the place of the first.
    #[inline]
    pub fn good_of(&self, block: usize) -> (usize, &[Good]) {
        let (first, end) = (self.first[block] as usize, self.first[block + 1] as usize);
        (first, &self.good[first..end])
    }

    /// Put the good pixels in the order of blocks.
    fn gather(&mut self, grid: Grid) {
        let (width, height) = grid.small();
        let (across, down) = grid.blocks();
        self.good.clear();
        self.first.clear();
        self.places.clear();
        self.places.resize(width * height, NOWHERE);
        for (row, column) in (0..down).flat_map(|row| (0..across).map(move |column| (row, column))) {
            self.first.push(self.good.len() as u32);
            let columns = column * SMALL_PER_BLOCK..((column + 1) * SMALL_PER_BLOCK).min(width);
            for y in row * SMALL_PER_BLOCK..((row + 1) * SMALL_PER_BLOCK).min(height) {
                for x in columns.clone() {
                    let pixel = self.small[y * width + x];
                    if pixel.depth <= 0.0 {
                        continue;
                    }
                    self.places[y * width + x] = self.good.len() as u32;
                    let middle = |at: usize| (at * grid.step) as f32 + 0.5 * grid.step as f32 - 0.5;
                    self.good.push(Good {
                        x: middle(x),
                        y: middle(y),
                        depth: pixel.depth,
                        brightness: luma(pixel.color) + DARK_LEVELS,
                        color: pixel.color.map(|c| c + DARK_LEVELS),
                        slope: None,
                        around: [0; 4],
                        within: [(x % SMALL_PER_BLOCK) as u8, (y % SMALL_PER_BLOCK) as u8],
                    });
                }
            }
        }
        self.first.push(self.good.len() as u32);
        let past = self.good.len() as u32;
        for y in 0..height {
            for x in 0..width {
                let place = self.places[y * width + x];
                if place == NOWHERE {
                    continue;
                }
                let at = |x: usize, y: usize| {
                    let inside = x < width && y < height;
                    inside
                        .then(|| self.places[y * width + x])
                        .filter(|&p| p != NOWHERE)
                        .unwrap_or(past)
                };
                let around = [at(x.wrapping_sub(1), y), at(x + 1, y), at(x, y.wrapping_sub(1)), at(x, y + 1)];
                let slope = around.iter().all(|&place| place != past).then(|| {
                    let [left, right, above, below] = around.map(|place| self.good[place as usize].brightness);
                    let share = 0.25 / self.good[place as usize].brightness;
                    [share * (right - left), share * (below - above)]
                });
                let good = &mut self.good[place as usize];
                (good.around, good.slope) = (around, slope);
            }
        }
    }

    /// How much the tissue differs from its own mean, block by block.
    fn measure_detail(&mut self, grid: Grid) {
        let (across, down) = grid.blocks();
        let all = Span {
            left: 0,
            top: 0,
            right: across,
            bottom: down,
        };
        // First the mean, then the deviation from it.
        self.detail.clear();
        for block in 0..across * down {
            let mut sums = [0.0; 8];
            for good in self.good_of(block).1 {
                sums[0] += 1.0;
                sums[1] += good.brightness;
            }
            self.detail.push(sums);
        }
        self.smoother.smooth(grid, all, &mut self.detail);
        for block in 0..across * down {
            let mean = (self.detail[block][1] / self.detail[block][0].max(1e-6)).max(1.0);
            let mut sums = [0.0; 8];
            for good in self.good_of(block).1 {
                sums[0] += 1.0;
                sums[1] += good.brightness;
                sums[2] += (good.brightness / mean - 1.0).powi(2);
            }
            self.detail[block] = sums;
        }
        self.smoother.smooth(grid, all, &mut self.detail);
    }
}

/// One row of cells.
fn look_at_row(scene: &Scene<'_>, row: usize, pixels: &mut [SmallPixel], holes: &mut [u8]) {
    let grid = scene.grid;
    let width = grid.small().0;
    for y in row * grid.cell..((row + 1) * grid.cell).min(grid.height) {
        for (distances, hole) in scene.distance.row(y).chunks(grid.cell).zip(holes.iter_mut()) {
            let nearest = distances.iter().fold(u16::MAX, |least, &d| least.min(d));
            *hole |= u8::from(nearest <= scene.reach);
        }
    }
    // The middle of a small pixel stands for its distance, which changes by less than the guard is wide.
    let step = grid.step;
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (left, top) = (index % width * step, (row * SMALL_PER_CELL + index / width) * step);
        if left + step > grid.width || top + step > grid.height {
            continue;
        }
        let (x, y) = (left + step / 2, top + step / 2);
        let distance = scene.distance.at(x, y);
        if distance <= scene.guard || distance > scene.ring || scene.forbidden.at(x, y) != 0 {
            continue;
        }
        let mut sum = [0_u32; 3];
        for v in top..top + step {
            for source in &scene.image.row(v)[left..left + step] {
                for (sum, &channel) in sum.iter_mut().zip(source) {
                    *sum += u32::from(channel);
                }
            }
        }
        let count = (step * step) as f32;
        pixel.color = sum.map(|s| s as f32 / count);
        if pixel.color.iter().any(|&c| c < 250.0) {
            pixel.depth = scene.depth_at(x, y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{Example, HOLE, in_hole};

    #[test]
    fn good_pixels_lie_around_the_hole_and_know_their_neighbours() {
        let example = Example::new(&[], [1.0; 3], (0.0, 0.0));
        let scene = example.scene();
        let mut live = Live::default();
        live.look(&scene);
        assert!(live.good.len() > 800);
        for (place, good) in live.good.iter().enumerate() {
            let (x, y) = (good.x as usize, good.y as usize);
            let distance = scene.distance.at(x, y);
            assert!(!in_hole(x, y) && distance > scene.guard && distance <= scene.ring);
            assert!((good.brightness - DARK_LEVELS - luma(example.image.at(x, y).map(f32::from))).abs() < 1e-3);
            let block = scene.grid.block_at(x, y);
            let (first, of_block) = live.good_of(block);
            assert!((first..first + of_block.len()).contains(&place));
            for (neighbour, (dx, dy)) in good
                .around
                .into_iter()
                .zip([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
            {
                if let Some(neighbour) = live.good.get(neighbour as usize) {
                    assert_eq!((neighbour.x, neighbour.y), (good.x + dx, good.y + dy));
                }
            }
            if let Some(slope) = good.slope {
                let at = |i: usize| live.good[good.around[i] as usize].brightness;
                assert!((slope[0] - 0.25 * (at(1) - at(0)) / good.brightness).abs() < 1e-5);
                assert!((slope[1] - 0.25 * (at(3) - at(2)) / good.brightness).abs() < 1e-5);
            }
        }
        assert_eq!(live.hole_blocks[scene.grid.block_at(HOLE.0, HOLE.1)], 1);
        assert_eq!(live.hole_blocks[0], 0);
    }
}
