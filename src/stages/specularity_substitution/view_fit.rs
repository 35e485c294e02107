//! One view against the live picture around the holes: how bright, how far shifted, how well it fits.
//!
//! All three are fields over the frame's cells. Brightness is the ratio of sums of live and view over good pixels, per channel; the
//! shift solves two unknowns of Gauss–Newton from normal equations summed over the surroundings (Lucas and Kanade 1981), with a prior
//! around zero, because a ring without texture must not invent a shift; the fit is what difference remains.

use crate::image::buffer::Image;
use crate::image::color::luma;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Grid, SMALL_PER_CELL, Smoother, Span, Sums, step_for};
use crate::stages::specularity_substitution::live::{DARK_LEVELS, Live};
use crate::stages::specularity_substitution::lookup::bilinear_with_confidence;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::settings::Settings;

/// A shift is expected to be about this long, small px.
const EXPECTED_SHIFT: f32 = 0.35;
/// Relative difference of tissue and noise left after a good fit.
const EXPECTED_RESIDUAL: f32 = 0.03;
/// The prior's information against that of the sums: they are means over some 50 cells, and neighbouring pixels tell much the same.
const PRIOR: f32 = 3.0 / 50.0 * (EXPECTED_RESIDUAL / EXPECTED_SHIFT) * (EXPECTED_RESIDUAL / EXPECTED_SHIFT);
/// A good pixel of a view has at least this confidence.
const GOOD_CONFIDENCE: u8 = 128;
/// Live pixels count as at most this much brighter than what was measured, levels: haze that no detector saw must not condemn a fit.
const BRIGHTER_AT_MOST: f32 = 4.0;
/// Rounds end when no shift changes by more, small px.
const STILL: f32 = 0.12;
/// Cells around its blocks that a view is looked at, about the width of the ring.
const CONTEXT_CELLS: usize = 3;
/// It is looked at farther where fewer cells than this have good pixels …
const FEWEST_GOOD_CELLS: usize = 24;
/// … but no farther than this.
const FARTHEST_CELLS: usize = 16;
/// Ratios of brightness beyond this are not lighting.
const MAX_GAIN: f32 = 3.0;

/// Where the parts of a field stand.
pub mod part {
    /// Three factors of brightness, red first; they apply to levels with [`super::DARK_LEVELS`] added.
    pub const GAIN: usize = 0;
    /// By how much the live pixel is moved before it is looked up, px, right and down.
    pub const SHIFT: usize = 3;
    /// How well the view fits, 0…1.
    pub const FIT: usize = 5;
    /// What difference is left around the hole, root mean square, levels.
    pub const RESIDUAL: usize = 6;
}

/// A view's fields; keeps its memory.
#[derive(Debug, Default)]
pub struct ViewFit {
    /// Index of the view.
    pub view: usize,
    /// Per cell: see [`part`].
    pub field: Vec<Sums>,
    context: Vec<u8>,
    span: Span,
    brightness: Vec<f32>,
    sums: Vec<Sums>,
    equations: Vec<Sums>,
    smoother: Smoother,
}

/// A view small enough that looking at every cell's few pixels does not alias: colours, and the least confidence of the pixels averaged.
pub fn small_copy(view: &View) -> Image<[u8; 4]> {
    let step = step_for(view.image.width());
    let (width, height) = ((view.image.width() / step).max(1), (view.image.height() / step).max(1));
    let mut small = Image::filled(width, height, [0; 4]);
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut confidence, mut count) = ([0_u32; 3], 255, 0);
            for v in y * step..((y + 1) * step).min(view.image.height()) {
                for u in x * step..((x + 1) * step).min(view.image.width()) {
                    for (sum, channel) in sum.iter_mut().zip(view.image.at(u, v)) {
                        *sum += u32::from(channel);
                    }
                    confidence = view.confidence.at(u, v).min(confidence);
                    count += 1;
                }
            }
            let [r, g, b] = sum.map(|s| ((s + count / 2) / count.max(1)) as u8);
            small.set(x, y, [r, g, b, confidence]);
        }
    }
    small
}

impl ViewFit {
    /// Begin with a view that is needed nowhere yet.
    pub fn begin(&mut self, view: usize, cells: usize) {
        self.view = view;
        self.context.clear();
        self.context.resize(cells, 0);
        self.span = Span::default();
    }

    /// The view is needed in the blocks that meet at corner (i, j): it is looked at there and as far around as there are good pixels.
    pub fn need_around(&mut self, scene: &Scene<'_>, live: &Live, i: usize, j: usize) {
        let grid = scene.grid;
        let around = |reach: usize| Span {
            left: (i * CELLS_PER_BLOCK).saturating_sub(reach),
            top: (j * CELLS_PER_BLOCK).saturating_sub(reach),
            right: (i * CELLS_PER_BLOCK + reach).min(grid.across),
            bottom: (j * CELLS_PER_BLOCK + reach).min(grid.down),
        };
        let good = |span: Span| -> usize {
            let count = |row: usize| live.good[span.row(row, grid.across)].iter().filter(|&&g| g != 0).count();
            span.rows().map(count).sum()
        };
        let mut reach = CELLS_PER_BLOCK + CONTEXT_CELLS;
        let mut span = around(reach);
        // Deep inside a wide hole nothing good is near.
        while reach < FARTHEST_CELLS && good(span) < FEWEST_GOOD_CELLS {
            reach += CONTEXT_CELLS;
            span = around(reach);
        }
        for row in span.rows() {
            self.context[span.row(row, grid.across)].fill(1);
        }
        self.span = self.span.around(span);
    }

    /// Find the fields. `small` is the view's [`small_copy`].
    pub fn measure(&mut self, scene: &Scene<'_>, live: &Live, small: &Image<[u8; 4]>, mapping: &Mapping, settings: &Settings) {
        let cells = scene.grid.count();
        self.field.clear();
        self.field.resize(cells, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        for round in 0..settings.ring_rounds.max(1) {
            self.draw(scene, live, small, mapping, round > 0);
            self.smoother.smooth(scene.grid, self.span, &mut self.sums);
            self.match_brightness();
            self.compare(scene, live);
            self.smoother.smooth(scene.grid, self.span, &mut self.equations);
            self.judge(live, settings);
            if !settings.align_on_ring {
                break;
            }
            if self.shift(scene.grid.step as f32, settings.max_shift_px * scene.scale) < STILL && round > 0 {
                break;
            }
        }
    }

    /// Look the good pixels up in the view; sum colours of both. Once there is a field, outliers weigh less.
    fn draw(&mut self, scene: &Scene<'_>, live: &Live, small: &Image<[u8; 4]>, mapping: &Mapping, again: bool) {
        let grid = scene.grid;
        let width = grid.small().0;
        let view = &scene.light_field.views[self.view];
        let view_step = step_for(view.image.width()) as f32;
        let (last_x, last_y) = (small.width() as f32 - 1.0, small.height() as f32 - 1.0);
        self.brightness.clear();
        self.brightness.resize(live.pixels.len(), 0.0);
        self.sums.clear();
        self.sums.resize(grid.count(), [0.0; 8]);
        let middle = 0.5 * grid.step as f32 - 0.5;
        for cell in 0..grid.count() {
            if self.context[cell] == 0 {
                continue;
            }
            let field = self.field[cell];
            let gain = mean_gain(&field);
            let begin = (cell / grid.across) * SMALL_PER_CELL * width + (cell % grid.across) * SMALL_PER_CELL;
            let mut sums = [0.0; 8];
            for row in 0..SMALL_PER_CELL {
                for index in begin + row * width..begin + row * width + SMALL_PER_CELL {
                    let pixel = &live.pixels[index];
                    if pixel.depth <= 0.0 {
                        continue;
                    }
                    let x = (index % width * grid.step) as f32 + middle + field[part::SHIFT];
                    let y = (index / width * grid.step) as f32 + middle + field[part::SHIFT + 1];
                    let (u, v, depth) = mapping.apply(x, y, pixel.depth);
                    let (us, vs) = ((u + 0.5) / view_step - 0.5, (v + 0.5) / view_step - 0.5);
                    if !(depth > 0.0 && us >= 0.0 && vs >= 0.0 && us < last_x && vs < last_y) {
                        continue;
                    }
                    let (x0, y0) = (us as usize, vs as usize);
                    let (color, confidence) = bilinear_with_confidence(small, x0, y0, us - x0 as f32, vs - y0 as f32);
                    if confidence < GOOD_CONFIDENCE
                        || !is_unoccluded(view.depth.at(u.max(0.0) as usize, v.max(0.0) as usize), depth)
                    {
                        continue;
                    }
                    let seen = luma(color) + DARK_LEVELS;
                    self.brightness[index] = seen;
                    let weight = if again {
                        let residual = pixel.brightness / (gain * seen) - 1.0;
                        1.0 / (1.0 + (residual / (2.0 * EXPECTED_RESIDUAL)).powi(2))
                    } else {
                        1.0
                    };
                    sums[0] += weight;
                    for c in 0..3 {
                        sums[1 + c] += weight * (pixel.color[c] + DARK_LEVELS);
                        sums[4 + c] += weight * (color[c] + DARK_LEVELS);
                    }
                }
            }
            self.sums[cell] = sums;
        }
    }

    fn match_brightness(&mut self) {
        for (field, sums) in self.field.iter_mut().zip(&self.sums) {
            for c in 0..3 {
                field[part::GAIN + c] = if sums[4 + c] > 0.0 {
                    (sums[1 + c] / sums[4 + c]).clamp(1.0 / MAX_GAIN, MAX_GAIN)
                } else {
                    1.0
                };
            }
        }
    }

    /// Sum, cell by cell, the normal equations of a shift and the squared difference.
    fn compare(&mut self, scene: &Scene<'_>, live: &Live) {
        let grid = scene.grid;
        let (width, height) = grid.small();
        self.equations.clear();
        self.equations.resize(grid.count(), [0.0; 8]);
        for cell in 0..grid.count() {
            let (row, column) = (cell / grid.across, cell % grid.across);
            if self.context[cell] == 0 || self.sums[cell][0] <= 0.0 {
                continue;
            }
            let gains = self.gains_around(grid, column, row);
            let mut sums = [0.0_f32; 8];
            for y in (row * SMALL_PER_CELL).max(1)..((row + 1) * SMALL_PER_CELL).min(height - 1) {
                for x in (column * SMALL_PER_CELL).max(1)..((column + 1) * SMALL_PER_CELL).min(width - 1) {
                    let i = y * width + x;
                    let seen = &self.brightness;
                    let around = [seen[i - 1], seen[i + 1], seen[i - width], seen[i + width]];
                    if seen[i] <= 0.0 || around.iter().any(|&b| b <= 0.0) {
                        continue;
                    }
                    let at = |i: usize| live.pixels[i].brightness;
                    let expected = between(&gains, x % SMALL_PER_CELL, y % SMALL_PER_CELL) * seen[i];
                    let shown = at(i);
                    let residual = shown / expected - 1.0;
                    // The mean of both gradients halves the bias of noise (efficient second order, Malis 2004).
                    let gx = 0.25 * ((around[1] - around[0]) / seen[i] + (at(i + 1) - at(i - 1)) / shown);
                    let gy = 0.25 * ((around[3] - around[2]) / seen[i] + (at(i + width) - at(i - width)) / shown);
                    let weight = 1.0 / (1.0 + (residual / EXPECTED_RESIDUAL).powi(2));
                    let counted = residual.min(BRIGHTER_AT_MOST / expected);
                    sums[0] += weight * gx * gx;
                    sums[1] += weight * gx * gy;
                    sums[2] += weight * gy * gy;
                    sums[3] += weight * gx * residual;
                    sums[4] += weight * gy * residual;
                    sums[5] += counted * counted;
                    sums[6] += 1.0;
                }
            }
            self.equations[cell] = sums;
        }
    }

    /// The mean gains of a cell and the eight around it, row by row.
    fn gains_around(&self, grid: Grid, column: usize, row: usize) -> [[f32; 3]; 3] {
        let near = |place: usize, step: usize, count: usize| (place + step).saturating_sub(1).min(count - 1);
        std::array::from_fn(|j| {
            let begin = near(row, j, grid.down) * grid.across;
            std::array::from_fn(|i| mean_gain(&self.field[begin + near(column, i, grid.across)]))
        })
    }

    /// How well the view fits, from the difference that is left.
    fn judge(&mut self, live: &Live, settings: &Settings) {
        for ((field, sums), detail) in self.field.iter_mut().zip(&self.equations).zip(&live.detail) {
            field[part::FIT] = if sums[6] > 1e-4 && detail[0] > 1e-6 {
                let (difference, brightness) = ((sums[5] / sums[6]).sqrt(), detail[1] / detail[0]);
                let own = (detail[2] / detail[0]).sqrt();
                let bound = (settings.max_ring_levels / brightness).max(settings.max_ring_share * own);
                field[part::RESIDUAL] = difference * brightness;
                (2.0 - difference / bound).clamp(0.0, 1.0)
            } else {
                0.0
            };
        }
    }

    /// Move the field by one step of Gauss–Newton; the longest step, small px.
    fn shift(&mut self, step: f32, limit: f32) -> f32 {
        let mut longest = 0.0_f32;
        for (field, sums) in self.field.iter_mut().zip(&self.equations) {
            let (xx, yy) = (sums[0] + PRIOR, sums[2] + PRIOR);
            let determinant = xx * yy - sums[1] * sums[1];
            if determinant <= 0.0 {
                continue;
            }
            let x = (yy * sums[3] - sums[1] * sums[4]) / determinant;
            let y = (xx * sums[4] - sums[1] * sums[3]) / determinant;
            longest = longest.max(x.abs()).max(y.abs());
            field[part::SHIFT] = (field[part::SHIFT] + step * x).clamp(-limit, limit);
            field[part::SHIFT + 1] = (field[part::SHIFT + 1] + step * y).clamp(-limit, limit);
        }
        longest
    }

    /// Summed squared shift (px²), squared relative difference and number of cells, over the cells of `holes` where it fits.
    pub fn statistics(&self, holes: &[u8]) -> [f32; 3] {
        let mut sums = [0.0_f32; 3];
        for (((field, equations), &hole), &context) in self.field.iter().zip(&self.equations).zip(holes).zip(&self.context) {
            if hole != 0 && context != 0 && field[part::FIT] > 0.5 {
                sums[0] += field[part::SHIFT].powi(2) + field[part::SHIFT + 1].powi(2);
                sums[1] += equations[5] / equations[6].max(1e-6);
                sums[2] += 1.0;
            }
        }
        sums
    }
}

/// A value at small pixel (x, y) of the middle of 3 × 3 cells, linear between their centres.
#[inline]
fn between(cells: &[[f32; 3]; 3], x: usize, y: usize) -> f32 {
    let axis = |v: usize| {
        let place = 0.5 + (v as f32 + 0.5) / SMALL_PER_CELL as f32;
        (place as usize, place - (place as usize) as f32)
    };
    let ((i, fx), (j, fy)) = (axis(x), axis(y));
    let across = |row: &[f32; 3]| row[i] + (row[i + 1] - row[i]) * fx;
    let (top, bottom) = (across(&cells[j]), across(&cells[j + 1]));
    top + (bottom - top) * fy
}

fn mean_gain(field: &Sums) -> f32 {
    luma([field[part::GAIN], field[part::GAIN + 1], field[part::GAIN + 2]])
}
