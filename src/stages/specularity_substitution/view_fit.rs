//! One view against the live picture around the holes: how bright, how far shifted, how well it fits.
//!
//! All three are fields over the frame's cells. Brightness is the ratio of sums of live and view over good pixels, per channel; the
//! shift solves two unknowns of Gauss–Newton from normal equations summed over the surroundings (Lucas and Kanade 1981), with a prior
//! around zero, because a ring without texture must not invent a shift; the fit is what difference remains.

use crate::image::color::luma;
use crate::image::wide;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::stages::specularity_substitution::grid::{Grid, SMALL_PER_BLOCK, Smoother, Span, Sums};
use crate::stages::specularity_substitution::live::{DARK_LEVELS, Live};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::settings::Settings;
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::tile::{EMPTY, LaneSums, Plane, Row, Tile, lanes};

/// A shift is expected to be about this long, small px.
const EXPECTED_SHIFT: f32 = 0.35;
/// Relative difference of tissue and noise left after a good fit.
const EXPECTED_RESIDUAL: f32 = 0.03;
/// The prior's information against that of the sums: they are means over some 12 blocks, and neighbouring pixels tell much the same.
const PRIOR: f32 = 3.0 / 12.5 * (EXPECTED_RESIDUAL / EXPECTED_SHIFT) * (EXPECTED_RESIDUAL / EXPECTED_SHIFT);
/// A good pixel of a view has at least this confidence.
const GOOD_CONFIDENCE: u8 = 128;
/// Live pixels count as at most this much brighter than what was measured, levels: haze that no detector saw must not condemn a fit.
const BRIGHTER_AT_MOST: f32 = 4.0;
/// A view is warm when it was looked at in this share of its blocks in the last frame already.
const WARM_SHARE: f32 = 0.7;
/// Rounds end when no shift changes by more, small px.
const STILL: f32 = 0.12;
/// Blocks around a corner that a view is looked at, about the width of the ring.
const CONTEXT_BLOCKS: usize = 2;
/// It is looked at farther where there are fewer good pixels than this …
const FEWEST_GOOD: usize = 200;
/// … but no farther than this.
const FARTHEST_BLOCKS: usize = 8;
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
    /// The factor of luma: not the luma of the three factors, for tissue is not gray.
    pub const BRIGHTNESS: usize = 7;
}

/// What a field says of a view that was not looked at.
const UNKNOWN: Sums = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

/// A view's fields, from frame to frame.
#[derive(Debug, Default)]
pub struct ViewFit {
    /// Per block: see [`part`].
    pub field: Vec<Sums>,
    /// 1 for every block in which the view is looked at.
    context: Vec<u8>,
    span: Span,
    /// The last frame's span: there the field is a good start.
    former: Span,
    statistics: Statistics,
}

/// How a view fits at the holes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Statistics {
    /// Summed squared shift, px².
    pub shift: f32,
    /// Summed squared relative difference.
    pub difference: f32,
    /// Blocks over which it was summed.
    pub count: f32,
}

/// Working memory of one fit at a time.
#[derive(Debug, Default)]
pub struct Workbench {
    /// Per block: luma of the view with [`DARK_LEVELS`] added at each good pixel, 0 where it does not see it. Only where it is looked at.
    seen: Vec<Plane>,
    sums: Vec<Sums>,
    equations: Vec<Sums>,
    smoother: Smoother,
}

/// What a view is compared with.
#[derive(Clone, Copy, Debug)]
pub struct Comparison<'a> {
    /// The frame's cells and blocks.
    pub grid: Grid,
    /// Width of the picture over the width for which lengths are given.
    pub scale: f32,
    /// The good pixels.
    pub live: &'a Live,
    /// The view, small.
    pub view: &'a SmallView,
    /// From pixels of the live picture to those of the small view.
    pub mapping: &'a Mapping,
    /// Lengths in px of a picture of the usual width.
    pub settings: &'a Settings,
}

impl ViewFit {
    /// Begin a frame in which the view is needed nowhere yet.
    pub fn begin(&mut self, grid: Grid) {
        let (across, down) = grid.blocks();
        if self.field.len() != across * down {
            self.field.clear();
            self.field.resize(across * down, UNKNOWN);
            self.context.clear();
            self.context.resize(across * down, 0);
            self.span = Span::default();
        }
        self.former = self.span;
        for row in self.span.rows() {
            self.context[self.span.row(row, across)].fill(0);
        }
        self.span = Span::default();
    }

    /// Forget the last frame.
    pub fn forget(&mut self) {
        self.context.fill(0);
        self.span = Span::default();
        self.former = Span::default();
    }

    /// True if the view speaks in this frame.
    pub fn is_needed(&self) -> bool {
        !self.span.is_empty()
    }

    /// The view is needed in the blocks that meet at corner (i, j): it is looked at there and as far around as there are good pixels.
    pub fn need_around(&mut self, scene: &Scene<'_>, live: &Live, i: usize, j: usize) {
        let (across, down) = scene.grid.blocks();
        let around = |reach: usize| Span {
            left: i.saturating_sub(reach),
            top: j.saturating_sub(reach),
            right: (i + reach).min(across),
            bottom: (j + reach).min(down),
        };
        let mut reach = CONTEXT_BLOCKS;
        let mut span = around(reach);
        // Deep inside a wide hole nothing good is near.
        while reach < FARTHEST_BLOCKS && live.good_in(scene.grid, span) < FEWEST_GOOD {
            reach += 1;
            span = around(reach);
        }
        for row in span.rows() {
            self.context[span.row(row, across)].fill(1);
        }
        self.span = self.span.around(span);
    }

    /// Find the fields. A view that spoke in the last frame goes on from there.
    pub fn measure(&mut self, with: &Comparison<'_>, bench: &mut Workbench) {
        let (across, down) = with.grid.blocks();
        // Between the centres of blocks those around the span are asked too.
        let asked = self.span.grown(1, (across, down));
        for row in asked.rows() {
            for (column, field) in (asked.left..).zip(&mut self.field[asked.row(row, across)]) {
                if !self.former.holds(column, row) {
                    *field = UNKNOWN;
                }
            }
        }
        // What is out of the span is not read.
        bench.sums.resize(across * down, [0.0; 8]);
        bench.equations.resize(across * down, [0.0; 8]);
        bench.seen.resize(across * down, EMPTY);
        let rounds = if self.is_warm(across) { 1 } else { with.settings.ring_rounds.max(1) };
        for round in 0..rounds {
            wide::run(Draw {
                fit: self,
                with,
                bench,
                again: round > 0,
            });
            bench.smoother.smooth(with.grid, self.span, &mut bench.sums);
            self.match_brightness(across, &bench.sums);
            wide::run(Compare { fit: self, with, bench });
            bench.smoother.smooth(with.grid, self.span, &mut bench.equations);
            self.judge(with, &bench.equations);
            if !with.settings.align_on_ring || self.shift(with, &bench.equations) < STILL {
                break;
            }
        }
        self.statistics = self.summed_up(across, with.live, &bench.equations);
    }

    /// True if most of what is looked at was looked at in the last frame too: one more round is enough then, the next frame goes on.
    fn is_warm(&self, across: usize) -> bool {
        let (mut known, mut all) = (0, 0);
        for row in self.span.rows() {
            for (column, &context) in (self.span.left..).zip(&self.context[self.span.row(row, across)]) {
                all += usize::from(context);
                known += usize::from(context != 0 && self.former.holds(column, row));
            }
        }
        known as f32 >= WARM_SHARE * all as f32
    }

    fn match_brightness(&mut self, across: usize, sums: &[Sums]) {
        for row in self.span.rows() {
            let blocks = self.span.row(row, across);
            for (field, sums) in self.field[blocks.clone()].iter_mut().zip(&sums[blocks]) {
                let ratio = |live: f32, view: f32| {
                    if view > 0.0 {
                        (live / view).clamp(1.0 / MAX_GAIN, MAX_GAIN)
                    } else {
                        1.0
                    }
                };
                for c in 0..3 {
                    field[part::GAIN + c] = ratio(sums[1 + c], sums[4 + c]);
                }
                field[part::BRIGHTNESS] = ratio(luma([sums[1], sums[2], sums[3]]), luma([sums[4], sums[5], sums[6]]));
            }
        }
    }

    /// How well the view fits, from the difference that is left.
    fn judge(&mut self, with: &Comparison<'_>, equations: &[Sums]) {
        for row in self.span.rows() {
            let blocks = self.span.row(row, with.grid.blocks().0);
            let parts = self.field[blocks.clone()].iter_mut().zip(&equations[blocks.clone()]);
            for ((field, sums), detail) in parts.zip(&with.live.detail[blocks]) {
                field[part::FIT] = if sums[6] > 1e-4 && detail[0] > 1e-6 {
                    let (difference, brightness) = ((sums[5] / sums[6]).sqrt(), detail[1] / detail[0]);
                    let own = (detail[2] / detail[0]).sqrt();
                    let bound = (with.settings.max_ring_levels / brightness).max(with.settings.max_ring_share * own);
                    field[part::RESIDUAL] = difference * brightness;
                    (2.0 - difference / bound).clamp(0.0, 1.0)
                } else {
                    0.0
                };
            }
        }
    }

    /// Move the field by one step of Gauss–Newton; the longest step, small px.
    fn shift(&mut self, with: &Comparison<'_>, equations: &[Sums]) -> f32 {
        let (step, limit) = (with.grid.step as f32, with.settings.max_shift_px * with.scale);
        let mut longest = 0.0_f32;
        for row in self.span.rows() {
            let blocks = self.span.row(row, with.grid.blocks().0);
            for (field, sums) in self.field[blocks.clone()].iter_mut().zip(&equations[blocks]) {
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
        }
        longest
    }

    /// How the view fitted at the holes of the last frame that was measured.
    pub fn statistics(&self) -> Statistics {
        self.statistics
    }

    fn summed_up(&self, across: usize, live: &Live, equations: &[Sums]) -> Statistics {
        let mut sums = Statistics::default();
        for block in self.span.rows().flat_map(|row| self.span.row(row, across)) {
            let (field, equations) = (&self.field[block], &equations[block]);
            if live.hole_blocks[block] != 0 && self.context[block] != 0 && field[part::FIT] > 0.5 {
                sums.shift += field[part::SHIFT].powi(2) + field[part::SHIFT + 1].powi(2);
                sums.difference += equations[5] / equations[6].max(1e-6);
                sums.count += 1.0;
            }
        }
        sums
    }
}

/// The good pixels looked up in the view; colours of both summed. Once there is a field, outliers weigh less.
struct Draw<'a> {
    fit: &'a ViewFit,
    with: &'a Comparison<'a>,
    bench: &'a mut Workbench,
    again: bool,
}

impl wide::Kernel for Draw<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { fit, with, bench, again } = self;
        let across = with.grid.blocks().0;
        for (row, column) in fit.span.rows().flat_map(|row| (fit.span.left..fit.span.right).map(move |column| (row, column))) {
            let block = row * across + column;
            bench.sums[block] = [0.0; 8];
            if fit.context[block] == 0 {
                continue;
            }
            bench.seen[block] = EMPTY;
            if let Some(tile) = with.live.tile(block) {
                let field = &fit.field[block];
                let again = again || fit.former.holds(column, row);
                let color = look_up(with, tile, field, (column, row));
                let gain = again.then_some(field[part::BRIGHTNESS]);
                bench.sums[block] = sum_up(tile, &color, gain, &mut bench.seen[block]);
            }
        }
    }
}

/// The view's colours at the good pixels of a block, with [`DARK_LEVELS`] added; 0 where it does not see them.
#[inline(always)]
fn look_up(with: &Comparison<'_>, tile: &Tile, field: &Sums, (column, row): (usize, usize)) -> [Plane; 3] {
    let mut found = [[0.0_f32; 4]; SMALL_PER_BLOCK * SMALL_PER_BLOCK];
    let (last_x, last_y) = with.view.last();
    let step = with.grid.step as f32;
    let middle = |at: usize| at as f32 * step + 0.5 * step - 0.5;
    let left = middle(column * SMALL_PER_BLOCK) + field[part::SHIFT];
    for (y, (depths, found)) in tile.depth.iter().zip(found.chunks_exact_mut(SMALL_PER_BLOCK)).enumerate() {
        let line = middle(row * SMALL_PER_BLOCK + y) + field[part::SHIFT + 1];
        let [us, vs, farness] = with.mapping.apply_to_row(left, step, line, depths);
        for (x, found) in found.iter_mut().enumerate() {
            let (u, v, depth) = (us[x], vs[x], farness[x]);
            if !(depths[x] > 0.0 && depth > 0.0 && u >= 0.0 && v >= 0.0 && u < last_x && v < last_y) {
                continue;
            }
            let sample = with.view.between(u, v);
            if sample.confidence >= GOOD_CONFIDENCE && is_unoccluded(sample.depth, depth) {
                *found = sample.color.map(|c| c + DARK_LEVELS);
            }
        }
    }
    std::array::from_fn(|c| std::array::from_fn(|y| lanes(|x| found[y * SMALL_PER_BLOCK + x][c])))
}

/// Colours of both pictures summed over a block, and what was seen of the view; outliers weigh less against a known `gain`.
#[inline(always)]
fn sum_up(tile: &Tile, color: &[Plane; 3], gain: Option<f32>, seen: &mut Plane) -> Sums {
    let mut sums = LaneSums::<7>::ZERO;
    for (y, seen) in seen.iter_mut().enumerate() {
        let [red, green, blue] = [&color[0][y], &color[1][y], &color[2][y]];
        *seen = lanes(|x| luma([red[x], green[x], blue[x]]));
        let weight = match gain {
            Some(gain) => lanes(|x| {
                let expected = gain * if seen[x] > 0.0 { seen[x] } else { f32::MIN_POSITIVE };
                let residual = (tile.brightness[y][x] / expected - 1.0) * (0.5 / EXPECTED_RESIDUAL);
                let weight = 1.0 / (1.0 + residual * residual);
                if seen[x] > 0.0 { weight } else { 0.0 }
            }),
            None => lanes(|x| if seen[x] > 0.0 { 1.0 } else { 0.0 }),
        };
        sums.add(0, weight);
        for c in 0..3 {
            sums.add(1 + c, lanes(|x| weight[x] * tile.color[c][y][x]));
            sums.add(4 + c, lanes(|x| weight[x] * color[c][y][x]));
        }
    }
    std::array::from_fn(|i| if i < 7 { sums.total(i) } else { 0.0 })
}

/// Block by block, the normal equations of a shift and the squared difference.
struct Compare<'a> {
    fit: &'a ViewFit,
    with: &'a Comparison<'a>,
    bench: &'a mut Workbench,
}

impl wide::Kernel for Compare<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { fit, with, bench } = self;
        let across = with.grid.blocks().0;
        for (row, column) in fit.span.rows().flat_map(|row| (fit.span.left..fit.span.right).map(move |column| (row, column))) {
            let block = row * across + column;
            bench.equations[block] = [0.0; 8];
            if fit.context[block] == 0 || bench.sums[block][0] <= 0.0 {
                continue;
            }
            if let Some(tile) = with.live.tile(block) {
                // The factors of luma of the block and the eight around it.
                let around = with.grid.blocks_around(column, row);
                let gains = around.map(|row| row.map(|block| fit.field[block][part::BRIGHTNESS]));
                bench.equations[block] = compare(tile, &fit.bordered(&bench.seen, across, column, row), &gains);
            }
        }
    }
}

/// What was seen in a block and along its borders.
struct Bordered {
    rows: [[f32; SMALL_PER_BLOCK + 2]; SMALL_PER_BLOCK + 2],
}

impl ViewFit {
    #[inline(always)]
    fn bordered(&self, seen: &[Plane], across: usize, column: usize, row: usize) -> Bordered {
        let mut rows = [[0.0; SMALL_PER_BLOCK + 2]; SMALL_PER_BLOCK + 2];
        let block = row * across + column;
        let last = SMALL_PER_BLOCK - 1;
        let looked_at = |is_inside: bool, block: usize| (is_inside && self.context[block] != 0).then(|| &seen[block]);
        for (row, seen) in rows[1..].iter_mut().zip(&seen[block]) {
            row[1..=SMALL_PER_BLOCK].copy_from_slice(seen);
        }
        if let Some(left) = looked_at(column > self.span.left, block.wrapping_sub(1)) {
            for (row, seen) in rows[1..].iter_mut().zip(left) {
                row[0] = seen[last];
            }
        }
        if let Some(right) = looked_at(column + 1 < self.span.right, block + 1) {
            for (row, seen) in rows[1..].iter_mut().zip(right) {
                row[SMALL_PER_BLOCK + 1] = seen[0];
            }
        }
        if let Some(above) = looked_at(row > self.span.top, block.wrapping_sub(across)) {
            rows[0][1..=SMALL_PER_BLOCK].copy_from_slice(&above[last]);
        }
        if let Some(below) = looked_at(row + 1 < self.span.bottom, block + across) {
            rows[SMALL_PER_BLOCK + 1][1..=SMALL_PER_BLOCK].copy_from_slice(&below[0]);
        }
        Bordered { rows }
    }
}

/// The normal equations of a shift over a block, and its squared difference.
#[inline(always)]
fn compare(tile: &Tile, seen: &Bordered, gains: &[[f32; 3]; 3]) -> Sums {
    let mut sums = LaneSums::<7>::ZERO;
    for y in 0..SMALL_PER_BLOCK {
        let [above, row, below] = [&seen.rows[y], &seen.rows[y + 1], &seen.rows[y + 2]];
        let gain = between(gains, y);
        let counts = lanes(|x| {
            let least = row[x].min(row[x + 1]).min(row[x + 2]).min(above[x + 1]).min(below[x + 1]);
            if least > 0.0 { tile.inner[y][x] } else { 0.0 }
        });
        let here = lanes(|x| if counts[x] > 0.0 { row[x + 1] } else { 1.0 });
        let expected = lanes(|x| gain[x] * here[x]);
        let residual = lanes(|x| {
            let residual = tile.brightness[y][x] / expected[x] - 1.0;
            if counts[x] > 0.0 { residual } else { 0.0 }
        });
        // The mean of both gradients halves the bias of noise (efficient second order, Malis 2004).
        let gx = lanes(|x| 0.25 * (row[x + 2] - row[x]) / here[x] + tile.slope[0][y][x]);
        let gy = lanes(|x| 0.25 * (below[x + 1] - above[x + 1]) / here[x] + tile.slope[1][y][x]);
        let weight = lanes(|x| {
            let share = residual[x] * (1.0 / EXPECTED_RESIDUAL);
            counts[x] / (1.0 + share * share)
        });
        let counted = lanes(|x| residual[x].min(BRIGHTER_AT_MOST / expected[x]));
        sums.add(0, lanes(|x| weight[x] * gx[x] * gx[x]));
        sums.add(1, lanes(|x| weight[x] * gx[x] * gy[x]));
        sums.add(2, lanes(|x| weight[x] * gy[x] * gy[x]));
        sums.add(3, lanes(|x| weight[x] * gx[x] * residual[x]));
        sums.add(4, lanes(|x| weight[x] * gy[x] * residual[x]));
        sums.add(5, lanes(|x| counted[x] * counted[x]));
        sums.add(6, counts);
    }
    std::array::from_fn(|i| if i < 7 { sums.total(i) } else { 0.0 })
}

/// Values along row `y` of small pixels of the middle one of 3 × 3 blocks, linear between their centres.
#[inline(always)]
fn between(blocks: &[[f32; 3]; 3], y: usize) -> Row {
    let axis = |at: usize| {
        let place = 0.5 + (at as f32 + 0.5) / SMALL_PER_BLOCK as f32;
        (usize::from(place >= 1.0), place - if place >= 1.0 { 1.0 } else { 0.0 })
    };
    let (j, fy) = axis(y);
    let line: [f32; 3] = std::array::from_fn(|i| blocks[j][i] + (blocks[j + 1][i] - blocks[j][i]) * fy);
    lanes(|x| {
        let (i, fx) = axis(x);
        line[i] + (line[i + 1] - line[i]) * fx
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{Example, HOLE};

    /// The field in the middle of the hole after so many frames.
    fn measured(example: &Example, frames: usize) -> Sums {
        let (scene, vantages, settings) = (example.scene(), example.vantages(), Settings::default());
        let mut live = Live::default();
        live.look(&scene);
        let (mut fit, mut bench) = (ViewFit::default(), Workbench::default());
        for _ in 0..frames {
            fit.begin(scene.grid);
            let block = scene.grid.block();
            for (i, j) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                fit.need_around(&scene, &live, HOLE.0 / block + i, HOLE.1 / block + j);
            }
            let comparison = Comparison {
                grid: scene.grid,
                scale: scene.scale,
                live: &live,
                view: &example.small_views[0],
                mapping: &vantages[0].unwrap().small,
                settings: &settings,
            };
            fit.measure(&comparison, &mut bench);
        }
        assert!(fit.is_needed() && fit.statistics().count > 0.0);
        scene.grid.between(&fit.field, HOLE.0 as f32, HOLE.1 as f32)
    }

    #[test]
    fn a_known_brightness_is_found_around_a_hole() {
        let gain = [0.8, 1.1, 0.95];
        let field = measured(&Example::new(&[(3.0, 1.0)], gain, (0.0, 0.0)), 2);
        // Gains apply with the dark levels added; pictures are rounded to whole levels, which some hundred pixels average out.
        for (c, gain) in gain.into_iter().enumerate() {
            let level = [140.0, 90.0, 80.0][c];
            let expected = (gain * level + DARK_LEVELS) / (level + DARK_LEVELS);
            let found = field[part::GAIN + c];
            assert!((found / expected - 1.0).abs() < 0.01, "{c}: {found} for {expected}");
        }
        assert!(field[part::FIT] > 0.9, "{field:?}");
    }

    #[test]
    fn a_known_shift_is_found_from_frame_to_frame() {
        let shift = (0.7, -0.5);
        let example = Example::new(&[(3.0, 1.0)], [0.9; 3], shift);
        // Each frame goes on from the last; the prior holds every step back.
        let field = measured(&example, 8);
        assert!((field[part::SHIFT] - shift.0).abs() < 0.15, "{field:?}");
        assert!((field[part::SHIFT + 1] - shift.1).abs() < 0.15, "{field:?}");
        let first = measured(&example, 1);
        assert!(
            first[part::SHIFT] > 0.0 && first[part::SHIFT] < field[part::SHIFT],
            "{first:?}"
        );
    }

    #[test]
    fn without_texture_no_shift_is_invented() {
        let mut example = Example::new(&[(3.0, 1.0)], [1.0; 3], (0.0, 0.0));
        for view in &mut example.light_field.views {
            view.image.fill([120, 80, 70]);
        }
        example.image.fill([120, 80, 70]);
        example.look_again();
        let field = measured(&example, 3);
        assert!(
            field[part::SHIFT].abs() < 1e-3 && field[part::SHIFT + 1].abs() < 1e-3,
            "{field:?}"
        );
    }

    #[test]
    fn another_tissue_does_not_fit() {
        let mut example = Example::new(&[(3.0, 1.0)], [1.0; 3], (0.0, 0.0));
        // Turned upside down.
        let turned = example.light_field.views[0].image.pixels().iter().rev().copied().collect();
        let (width, height) = example.light_field.views[0].image.size();
        example.light_field.views[0].image = crate::image::buffer::Image::from_vec(width, height, turned).unwrap();
        example.look_again();
        let field = measured(&example, 1);
        assert!(field[part::FIT] < 0.9 && field[part::RESIDUAL] > 6.0, "{field:?}");
    }
}
