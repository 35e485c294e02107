//! The live picture, small, as the views are compared with it.

use std::ops::Range;

use rayon::prelude::*;

use crate::image::color::luma;
use crate::image::reduction::sum_of;
use crate::stages::specularity_substitution::grid::{Grid, SMALL_PER_BLOCK, SMALL_PER_CELL, Smoother, Span, Sums};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::tile::{Tile, total};

/// Added to levels before they are compared as ratios: in the dark ratios are noise.
pub const DARK_LEVELS: f32 = 6.0;

/// No tile.
const NOWHERE: u32 = u32::MAX;

/// A pixel of the small picture.
#[derive(Clone, Copy, Debug, Default)]
struct SmallPixel {
    color: [f32; 3],
    /// mm; 0 where the pixel shows the lamp, an instrument or nothing, or is too far from any hole to matter.
    depth: f32,
}

/// The good pixels around the holes of one frame; keeps its memory.
#[derive(Debug, Default)]
pub struct Live {
    /// The blocks that have good pixels.
    tiles: Vec<Tile>,
    /// Where each block stands among them.
    places: Vec<u32>,
    /// How many good pixels the blocks before each have; one more at the end.
    before: Vec<u32>,
    /// 1 for every cell with a pixel that may be replaced.
    pub holes: Vec<u8>,
    /// 1 for every block with such a cell.
    pub hole_blocks: Vec<u8>,
    /// Per block, smoothed: weight, brightness, squared detail (relative); then red, green and blue, with [`DARK_LEVELS`] added.
    pub detail: Vec<Sums>,
    small: Vec<SmallPixel>,
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
            (self.before[blocks.end] - self.before[blocks.start]) as usize
        };
        span.rows().map(count).sum()
    }

    /// The good pixels of a block, if it has any.
    #[inline]
    pub fn tile(&self, block: usize) -> Option<&Tile> {
        self.tiles.get(self.places[block] as usize)
    }

    /// Put the good pixels into the tiles of their blocks.
    fn gather(&mut self, grid: Grid) {
        self.tiles.clear();
        self.places.clear();
        self.before.clear();
        self.before.push(0);
        let mut all = 0;
        for (column, row) in grid.everywhere().places() {
            if has_good(&self.small, grid.small(), column, row) {
                self.places.push(self.tiles.len() as u32);
                let mut tile = Tile::EMPTY;
                fill(&mut tile, &self.small, grid.small(), column, row);
                all += tile.count as u32;
                self.tiles.push(tile);
            } else {
                self.places.push(NOWHERE);
            }
            self.before.push(all);
        }
    }

    /// How much the tissue differs from its own mean, block by block.
    fn measure_detail(&mut self, grid: Grid) {
        let (across, down) = grid.blocks();
        let all = grid.everywhere();
        // First the mean, then the deviation from it.
        self.detail.clear();
        for block in 0..across * down {
            let mut sums = [0.0; 8];
            for brightness in self.tile(block).into_iter().flat_map(good_brightness) {
                sums[0] += 1.0;
                sums[1] += brightness;
            }
            self.detail.push(sums);
        }
        self.smoother.smooth(grid, all, &mut self.detail);
        for block in 0..across * down {
            let mean = (self.detail[block][1] / self.detail[block][0].max(1e-6)).max(1.0);
            let mut sums = [0.0; 8];
            for brightness in self.tile(block).into_iter().flat_map(good_brightness) {
                sums[0] += 1.0;
                sums[1] += brightness;
                sums[2] += (brightness / mean - 1.0).powi(2);
            }
            if let Some(tile) = self.tile(block) {
                for (sum, plane) in sums[3..].iter_mut().zip(&tile.color) {
                    *sum = total(plane);
                }
            }
            self.detail[block] = sums;
        }
        self.smoother.smooth(grid, all, &mut self.detail);
    }
}

fn good_brightness(tile: &Tile) -> impl Iterator<Item = f32> {
    tile.brightness.iter().copied().filter(|&brightness| brightness > 0.0)
}

/// The columns and rows of a block in the small picture.
fn reach_of(column: usize, row: usize, (width, height): (usize, usize)) -> (Range<usize>, Range<usize>) {
    let along = |at: usize, end: usize| at * SMALL_PER_BLOCK..((at + 1) * SMALL_PER_BLOCK).min(end);
    (along(column, width), along(row, height))
}

fn has_good(small: &[SmallPixel], size: (usize, usize), column: usize, row: usize) -> bool {
    let (columns, mut rows) = reach_of(column, row, size);
    rows.any(|y| small[y * size.0..][columns.clone()].iter().any(|pixel| pixel.depth > 0.0))
}

/// Fill the tile of a block from the small picture, `width` × `height`.
fn fill(tile: &mut Tile, small: &[SmallPixel], (width, height): (usize, usize), column: usize, row: usize) {
    let good_at = |x: usize, y: usize| {
        let pixel = (x < width && y < height).then(|| small[y * width + x]);
        pixel.filter(|pixel| pixel.depth > 0.0)
    };
    let brightness_at = |x: usize, y: usize| good_at(x, y).map(|pixel| luma(pixel.color) + DARK_LEVELS);
    let (columns, rows) = reach_of(column, row, (width, height));
    for (v, y) in rows.enumerate() {
        for (u, x) in columns.clone().enumerate() {
            let Some(pixel) = good_at(x, y) else { continue };
            let place = v * SMALL_PER_BLOCK + u;
            tile.good[tile.count] = place as u8;
            tile.count += 1;
            tile.depth[place] = pixel.depth;
            for (plane, channel) in tile.color.iter_mut().zip(pixel.color) {
                plane[place] = channel + DARK_LEVELS;
            }
            let brightness = luma(pixel.color) + DARK_LEVELS;
            tile.brightness[place] = brightness;
            let around = [
                brightness_at(x.wrapping_sub(1), y),
                brightness_at(x + 1, y),
                brightness_at(x, y.wrapping_sub(1)),
                brightness_at(x, y + 1),
            ];
            if let [Some(left), Some(right), Some(above), Some(below)] = around {
                let share = 0.25 / brightness;
                tile.slope[0][place] = share * (right - left);
                tile.slope[1][place] = share * (below - above);
                tile.inner[place] = 1.0;
            }
        }
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
        let sum = sum_of(scene.image, left..left + step, top..top + step);
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
        let good = live.good_in(scene.grid, scene.grid.everywhere());
        assert!(good > 800);
        let mut found = 0;
        // In the example a small pixel is a pixel.
        let lattice = |x: usize, y: usize| {
            let tile = live.tile(scene.grid.block_at(x, y))?;
            let brightness = tile.brightness[y % SMALL_PER_BLOCK * SMALL_PER_BLOCK + x % SMALL_PER_BLOCK];
            (brightness > 0.0).then_some(brightness)
        };
        for y in 1..scene.grid.height - 1 {
            for x in 1..scene.grid.width - 1 {
                let Some(here) = lattice(x, y) else { continue };
                found += 1;
                let distance = scene.distance.at(x, y);
                assert!(!in_hole(x, y) && distance > scene.guard && distance <= scene.ring);
                let color = example.image.at(x, y).map(f32::from);
                assert!((here - DARK_LEVELS - luma(color)).abs() < 1e-3);
                let tile = live.tile(scene.grid.block_at(x, y)).unwrap();
                let place = y % SMALL_PER_BLOCK * SMALL_PER_BLOCK + x % SMALL_PER_BLOCK;
                assert_eq!(tile.color.map(|plane| plane[place]), color.map(|c| c + DARK_LEVELS));
                let around = [lattice(x - 1, y), lattice(x + 1, y), lattice(x, y - 1), lattice(x, y + 1)];
                assert_eq!(tile.inner[place] > 0.0, around.iter().all(Option::is_some));
                if let [Some(left), Some(right), Some(above), Some(below)] = around {
                    assert!((tile.slope[0][place] - 0.25 * (right - left) / here).abs() < 1e-5);
                    assert!((tile.slope[1][place] - 0.25 * (below - above) / here).abs() < 1e-5);
                }
            }
        }
        assert_eq!(found, good);
        assert_eq!(live.hole_blocks[scene.grid.block_at(HOLE.0, HOLE.1)], 1);
        assert_eq!(live.hole_blocks[0], 0);
    }
}
