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
    /// Per good pixel: luma of the view with [`DARK_LEVELS`] added, 0 where it does not see it; one more at the end.
    seen: Vec<f32>,
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
        for (row, blocks) in self.field.chunks_mut(across).enumerate() {
            for (column, field) in blocks.iter_mut().enumerate() {
                if !self.former.holds(column, row) {
                    *field = UNKNOWN;
                }
            }
        }
        for sums in [&mut bench.sums, &mut bench.equations] {
            sums.clear();
            sums.resize(across * down, [0.0; 8]);
        }
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
            if !with.settings.align_on_ring || self.shift(with, &bench.equations) < STILL && round > 0 {
                break;
            }
        }
        self.statistics = self.summed_up(with.live, &bench.equations);
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

    fn summed_up(&self, live: &Live, equations: &[Sums]) -> Statistics {
        let mut sums = Statistics::default();
        let blocks = self.field.iter().zip(equations).zip(&live.hole_blocks).zip(&self.context);
        for (((field, equations), &hole), &context) in blocks {
            if hole != 0 && context != 0 && field[part::FIT] > 0.5 {
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
        let mapping = with.mapping;
        let (last_x, last_y) = with.view.last();
        bench.seen.clear();
        bench.seen.resize(with.live.good.len() + 1, 0.0);
        for (row, column) in fit
            .span
            .rows()
            .flat_map(|row| (fit.span.left..fit.span.right).map(move |column| (row, column)))
        {
            let block = row * across + column;
            let mut sums = [0.0_f32; 8];
            if fit.context[block] != 0 {
                let field = fit.field[block];
                let again = again || fit.former.holds(column, row);
                let gain = field[part::BRIGHTNESS];
                let (first, good) = with.live.good_of(block);
                for (good, seen) in good.iter().zip(&mut bench.seen[first..]) {
                    let (u, v, depth) = mapping.apply(good.x + field[part::SHIFT], good.y + field[part::SHIFT + 1], good.depth);
                    if !(depth > 0.0 && u >= 0.0 && v >= 0.0 && u < last_x && v < last_y) {
                        continue;
                    }
                    let sample = with.view.between(u, v);
                    if sample.confidence < GOOD_CONFIDENCE || !is_unoccluded(sample.depth, depth) {
                        continue;
                    }
                    let color = sample.color.map(|c| c + DARK_LEVELS);
                    *seen = luma(color);
                    let weight = if again {
                        let residual = good.brightness / (gain * *seen) - 1.0;
                        1.0 / (1.0 + (residual / (2.0 * EXPECTED_RESIDUAL)).powi(2))
                    } else {
                        1.0
                    };
                    sums[0] += weight;
                    for c in 0..3 {
                        sums[1 + c] += weight * good.color[c];
                        sums[4 + c] += weight * color[c];
                    }
                }
            }
            bench.sums[block] = sums;
        }
    }
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
        let seen = &bench.seen;
        for (row, column) in fit
            .span
            .rows()
            .flat_map(|row| (fit.span.left..fit.span.right).map(move |column| (row, column)))
        {
            let block = row * across + column;
            let mut sums = [0.0_f32; 8];
            if fit.context[block] != 0 && bench.sums[block][0] > 0.0 {
                // The factors of luma of the block and the eight around it.
                let around = with.grid.blocks_around(column, row);
                let gains = around.map(|row| row.map(|block| fit.field[block][part::BRIGHTNESS]));
                let (first, good) = with.live.good_of(block);
                for (good, &here) in good.iter().zip(&seen[first..]) {
                    let (Some(slope), true) = (good.slope, here > 0.0) else {
                        continue;
                    };
                    let [left, right, above, below] = good.around.map(|place| seen[place as usize]);
                    if left.min(right).min(above).min(below) <= 0.0 {
                        continue;
                    }
                    let expected = between(&gains, good.within[0], good.within[1]) * here;
                    let residual = good.brightness / expected - 1.0;
                    // The mean of both gradients halves the bias of noise (efficient second order, Malis 2004).
                    let share = 0.25 / here;
                    let (gx, gy) = (share * (right - left) + slope[0], share * (below - above) + slope[1]);
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
            bench.equations[block] = sums;
        }
    }
}

/// A value at small pixel (x, y) of the middle of 3 × 3 blocks, linear between their centres.
#[inline(always)]
fn between(blocks: &[[f32; 3]; 3], x: u8, y: u8) -> f32 {
    let axis = |v: u8| {
        let place = 0.5 + (f32::from(v) + 0.5) / SMALL_PER_BLOCK as f32;
        (usize::from(place >= 1.0), place - if place >= 1.0 { 1.0 } else { 0.0 })
    };
    let ((i, fx), (j, fy)) = (axis(x), axis(y));
    let across = |row: &[f32; 3]| row[i] + (row[i + 1] - row[i]) * fx;
    let (top, bottom) = (across(&blocks[j]), across(&blocks[j + 1]));
    top + (bottom - top) * fy
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
