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
use crate::stages::specularity_substitution::tile::{EMPTY, LANES, Plane, Tile, total};

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
/// The same for a warm view: the next frame goes on from here.
const STILL_WHEN_WARM: f32 = 0.35;
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
        let still = if self.is_warm(across) { STILL_WHEN_WARM } else { STILL };
        for round in 0..with.settings.ring_rounds.max(1) {
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
            if !with.settings.align_on_ring || self.shift(with, &bench.equations) < still {
                break;
            }
        }
        self.statistics = self.summed_up(across, with.live, &bench.equations);
    }

    /// True if most of what is looked at was looked at in the last frame too.
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
        for (column, row) in fit.span.places() {
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
    let (last_x, last_y) = with.view.last();
    let step = with.grid.step as f32;
    let middle = |at: usize| at as i32 as f32 * step + 0.5 * step - 0.5;
    let left = middle(column * SMALL_PER_BLOCK) + field[part::SHIFT];
    let (mut us, mut vs, mut farness) = (EMPTY, EMPTY, EMPTY);
    let rows = tile
        .depth
        .chunks_exact(SMALL_PER_BLOCK)
        .zip(us.chunks_exact_mut(SMALL_PER_BLOCK));
    let rows = rows
        .zip(vs.chunks_exact_mut(SMALL_PER_BLOCK))
        .zip(farness.chunks_exact_mut(SMALL_PER_BLOCK));
    for (y, (((depths, us), vs), farness)) in rows.enumerate() {
        let line = middle(row * SMALL_PER_BLOCK + y) + field[part::SHIFT + 1];
        with.mapping.apply_to_row(left, step, line, depths, [us, vs, farness]);
    }
    for &place in &tile.good[..tile.count] {
        let place = usize::from(place);
        let (u, v) = (us[place], vs[place]);
        let is_inside = (farness[place] > 0.0) & (u >= 0.0) & (v >= 0.0) & (u < last_x) & (v < last_y);
        if is_inside {
            with.view.fetch(u, v);
        } else {
            (us[place], vs[place], farness[place]) = (0.0, 0.0, 0.0);
        }
    }
    let mut color = [EMPTY; 3];
    let [red, green, blue] = &mut color;
    for &place in &tile.good[..tile.count] {
        let place = usize::from(place);
        let depth = farness[place];
        let sample = with.view.between(us[place], vs[place]);
        let is_good = (depth > 0.0) & (sample.confidence >= GOOD_CONFIDENCE) & is_unoccluded(sample.depth, depth);
        let [r, g, b, _] = sample.color;
        red[place] = if is_good { r + DARK_LEVELS } else { 0.0 };
        green[place] = if is_good { g + DARK_LEVELS } else { 0.0 };
        blue[place] = if is_good { b + DARK_LEVELS } else { 0.0 };
    }
    color
}

/// Colours of both pictures summed over a block, and what was seen of the view; outliers weigh less against a known `gain`.
#[inline(always)]
fn sum_up(tile: &Tile, color: &[Plane; 3], gain: Option<f32>, seen: &mut Plane) -> Sums {
    let [red, green, blue] = color;
    let mut weight = EMPTY;
    let gain = gain.unwrap_or(0.0);
    for i in 0..LANES {
        let luma = luma([red[i], green[i], blue[i]]);
        seen[i] = luma;
        let expected = (gain * luma).max(f32::MIN_POSITIVE);
        let residual = (tile.brightness[i] / expected - 1.0) * (0.5 / EXPECTED_RESIDUAL);
        let trust = if gain > 0.0 { 1.0 / (1.0 + residual * residual) } else { 1.0 };
        weight[i] = if luma > 0.0 { trust } else { 0.0 };
    }
    let mut sums = [0.0; 8];
    sums[0] = total(&weight);
    for (c, (live, view)) in tile.color.iter().zip(color).enumerate() {
        let (mut live_part, mut view_part) = (EMPTY, EMPTY);
        for i in 0..LANES {
            live_part[i] = weight[i] * live[i];
            view_part[i] = weight[i] * view[i];
        }
        (sums[1 + c], sums[4 + c]) = (total(&live_part), total(&view_part));
    }
    sums
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
        for (column, row) in fit.span.places() {
            let block = row * across + column;
            bench.equations[block] = [0.0; 8];
            if fit.context[block] == 0 || bench.sums[block][0] <= 0.0 {
                continue;
            }
            if let Some(tile) = with.live.tile(block) {
                // The factors of luma of the block and the eight around it.
                let around = with.grid.blocks_around(column, row);
                let gains = around.map(|row| row.map(|block| fit.field[block][part::BRIGHTNESS]));
                let around = fit.around(&bench.seen, across, column, row);
                bench.equations[block] = compare(tile, &bench.seen[block], &around, &between(&gains));
            }
        }
    }
}

/// What was seen left of each pixel of a block, right of it, above and below.
struct Around {
    left: Plane,
    right: Plane,
    above: Plane,
    below: Plane,
}

impl ViewFit {
    #[inline(always)]
    fn around(&self, seen: &[Plane], across: usize, column: usize, row: usize) -> Around {
        const SIDE: usize = SMALL_PER_BLOCK;
        let block = row * across + column;
        let (span, here) = (self.span, &seen[block]);
        // Beyond what was looked at nothing was seen.
        let at = |is_inside: bool, block: usize| {
            if is_inside && self.context[block] != 0 {
                &seen[block]
            } else {
                &EMPTY
            }
        };
        let above = at(row > span.top, block.wrapping_sub(across));
        let below = at(row + 1 < span.bottom, block + across);
        let left = at(column > span.left, block.wrapping_sub(1));
        let right = at(column + 1 < span.right, block + 1);
        let mut around = Around {
            left: EMPTY,
            right: EMPTY,
            above: EMPTY,
            below: EMPTY,
        };
        around.above[SIDE..].copy_from_slice(&here[..LANES - SIDE]);
        around.above[..SIDE].copy_from_slice(&above[LANES - SIDE..]);
        around.below[..LANES - SIDE].copy_from_slice(&here[SIDE..]);
        around.below[LANES - SIDE..].copy_from_slice(&below[..SIDE]);
        around.left[1..].copy_from_slice(&here[..LANES - 1]);
        around.right[..LANES - 1].copy_from_slice(&here[1..]);
        for begin in (0..LANES).step_by(SIDE) {
            around.left[begin] = left[begin + SIDE - 1];
            around.right[begin + SIDE - 1] = right[begin];
        }
        around
    }
}

/// The normal equations of a shift over a block, and its squared difference.
#[inline(always)]
fn compare(tile: &Tile, seen: &Plane, around: &Around, gain: &Plane) -> Sums {
    let Around {
        left,
        right,
        above,
        below,
    } = around;
    let mut parts = [EMPTY; 7];
    let [xx, xy, yy, xr, yr, rr, count] = &mut parts;
    for i in 0..LANES {
        let least = seen[i].min(left[i]).min(right[i]).min(above[i]).min(below[i]);
        let counts = if least > 0.0 { tile.inner[i] } else { 0.0 };
        let here = seen[i].max(f32::MIN_POSITIVE);
        let expected = gain[i] * here;
        let residual = if counts > 0.0 {
            tile.brightness[i] / expected - 1.0
        } else {
            0.0
        };
        // The mean of both gradients halves the bias of noise (efficient second order, Malis 2004).
        let share = if counts > 0.0 { 0.25 / here } else { 0.0 };
        let gx = share * (right[i] - left[i]) + tile.slope[0][i];
        let gy = share * (below[i] - above[i]) + tile.slope[1][i];
        let off = residual * (1.0 / EXPECTED_RESIDUAL);
        let weight = counts / (1.0 + off * off);
        let counted = residual.min(BRIGHTER_AT_MOST / expected);
        xx[i] = weight * gx * gx;
        xy[i] = weight * gx * gy;
        yy[i] = weight * gy * gy;
        xr[i] = weight * gx * residual;
        yr[i] = weight * gy * residual;
        rr[i] = counted * counted;
        count[i] = counts;
    }
    let mut sums = [0.0; 8];
    for (sum, part) in sums.iter_mut().zip(&parts) {
        *sum = total(part);
    }
    sums
}

/// Values at the small pixels of the middle one of 3 × 3 blocks, linear between their centres.
#[inline(always)]
fn between(blocks: &[[f32; 3]; 3]) -> Plane {
    const SIDE: usize = SMALL_PER_BLOCK;
    let mut plane = EMPTY;
    for (y, row) in plane.chunks_exact_mut(SIDE).enumerate() {
        let (j, fy) = axis(y);
        let mut line = [0.0; 3];
        for (i, value) in line.iter_mut().enumerate() {
            *value = blocks[j][i] + (blocks[j + 1][i] - blocks[j][i]) * fy;
        }
        for (x, value) in row.iter_mut().enumerate() {
            let (i, fx) = axis(x);
            *value = line[i] + (line[i + 1] - line[i]) * fx;
        }
    }
    plane
}

/// Between which of three blocks' centres a pixel of the middle block lies, and how near it is to the second.
#[inline(always)]
fn axis(at: usize) -> (usize, f32) {
    let place = 0.5 + (at as i32 as f32 + 0.5) / SMALL_PER_BLOCK as f32;
    if at < SMALL_PER_BLOCK / 2 {
        (0, place)
    } else {
        (1, place - 1.0)
    }
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
