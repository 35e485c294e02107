//! The live picture, small, as the views are compared with it.

use rayon::prelude::*;

use crate::image::color::luma;
use crate::stages::specularity_substitution::grid::{Grid, SMALL_PER_CELL, Smoother, Span, Sums};
use crate::stages::specularity_substitution::scene::Scene;

/// Added to levels before they are compared as ratios: in the dark ratios are noise.
pub const DARK_LEVELS: f32 = 6.0;

/// A pixel of the small picture.
#[derive(Clone, Copy, Debug, Default)]
pub struct LivePixel {
    /// Mean colour, levels.
    pub color: [f32; 3],
    /// Luma with [`DARK_LEVELS`] added.
    pub brightness: f32,
    /// Depth, mm; 0 where the pixel shows the lamp, an instrument or nothing, or is too far from any hole to matter.
    pub depth: f32,
}

/// The good pixels around the holes of one frame; keeps its memory.
#[derive(Debug, Default)]
pub struct Live {
    /// The small picture, row by row.
    pub pixels: Vec<LivePixel>,
    /// 1 for every cell with a pixel that may be replaced.
    pub holes: Vec<u8>,
    /// 1 for every cell with good pixels.
    pub good: Vec<u8>,
    /// Per cell, smoothed: weight, brightness, squared detail (both relative).
    pub detail: Vec<Sums>,
    means: Vec<Sums>,
    smoother: Smoother,
}

impl Live {
    /// Look at a frame.
    pub fn look(&mut self, scene: &Scene<'_>) {
        let grid = scene.grid;
        let (width, height) = grid.small();
        self.pixels.clear();
        self.pixels.resize(width * height, LivePixel::default());
        self.holes.clear();
        self.holes.resize(grid.count(), 0);
        self.pixels
            .par_chunks_mut(width * SMALL_PER_CELL)
            .zip(self.holes.par_chunks_mut(grid.across))
            .enumerate()
            .for_each(|(row, (pixels, holes))| {
                look_at_row(scene, row, pixels, holes);
            });
        self.measure_detail(grid);
    }

    /// How much the tissue differs from its own mean, cell by cell.
    fn measure_detail(&mut self, grid: Grid) {
        let width = grid.small().0;
        // First the mean, then the deviation from it.
        self.means.clear();
        self.means.resize(grid.count(), [0.0; 8]);
        let all = Span {
            left: 0,
            top: 0,
            right: grid.across,
            bottom: grid.down,
        };
        self.good.clear();
        for deviation in [false, true] {
            self.detail.clear();
            for cell in 0..grid.count() {
                let mut sums = [0.0; 8];
                let mean = self.means[cell][1] / self.means[cell][0].max(1e-6);
                let begin = (cell / grid.across) * SMALL_PER_CELL * width + (cell % grid.across) * SMALL_PER_CELL;
                for y in 0..SMALL_PER_CELL {
                    let row = &self.pixels[begin + y * width..][..SMALL_PER_CELL];
                    for pixel in row.iter().filter(|p| p.depth > 0.0) {
                        sums[0] += 1.0;
                        sums[1] += pixel.brightness;
                        if deviation {
                            sums[2] += (pixel.brightness / mean.max(1.0) - 1.0).powi(2);
                        }
                    }
                }
                self.detail.push(sums);
                if !deviation {
                    self.good.push(u8::from(sums[0] > 0.0));
                }
            }
            self.smoother.smooth(grid, all, &mut self.detail);
            std::mem::swap(&mut self.means, &mut self.detail);
        }
        std::mem::swap(&mut self.means, &mut self.detail);
    }
}

/// One row of cells.
fn look_at_row(scene: &Scene<'_>, row: usize, pixels: &mut [LivePixel], holes: &mut [u8]) {
    let grid = scene.grid;
    let width = grid.small().0;
    for y in row * grid.cell..((row + 1) * grid.cell).min(grid.height) {
        let distances = scene.distance.row(y);
        for (column, hole) in holes.iter_mut().enumerate() {
            let columns = column * grid.cell..((column + 1) * grid.cell).min(grid.width);
            let near = distances[columns].iter().any(|&d| d <= scene.reach);
            *hole |= u8::from(near);
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
        pixel.brightness = luma(pixel.color) + DARK_LEVELS;
        if pixel.color.iter().any(|&c| c < 250.0) {
            pixel.depth = scene.depth_at(x, y);
        }
    }
}
