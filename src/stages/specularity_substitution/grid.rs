//! The frame in cells: sums over cells, smoothed, are the fields that the substitution carries into its holes.

use crate::image::reduction::reduction_to;
use crate::image::wide;

/// The ring around a hole is looked at in a picture of about this width, px.
const SMALL_WIDTH_PX: f32 = 480.0;
/// Pixels of that picture along a cell.
pub const SMALL_PER_CELL: usize = 4;
/// Cells along a block; views are chosen at the corners of blocks, and what is smooth is known block by block.
pub const CELLS_PER_BLOCK: usize = 2;
/// Pixels of the small picture along a block.
pub const SMALL_PER_BLOCK: usize = SMALL_PER_CELL * CELLS_PER_BLOCK;

/// Numbers of a block, summed and smoothed together.
pub type Sums = [f32; 8];

/// Division by a small number as a multiplication: exact for places in a picture up to 65 535 px wide.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Division {
    inverse: u64,
}

impl Division {
    /// By at least 1.
    pub fn by(divisor: usize) -> Self {
        Self {
            inverse: (1_u64 << 32).div_ceil(divisor.max(1) as u64),
        }
    }

    /// `place` divided, rounded down.
    #[inline(always)]
    pub fn of(self, place: usize) -> usize {
        ((place as u64 * self.inverse) >> 32) as usize
    }
}

/// How a picture is laid out in cells.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Grid {
    /// Width of the picture, px.
    pub width: usize,
    /// Height of the picture, px.
    pub height: usize,
    /// Picture pixels along a pixel of the small picture.
    pub step: usize,
    /// Picture pixels along a cell.
    pub cell: usize,
    /// Cells in a row.
    pub across: usize,
    /// Rows of cells.
    pub down: usize,
    by_cell: Division,
    by_block: Division,
}

impl Grid {
    /// Over a picture.
    pub fn over((width, height): (usize, usize)) -> Self {
        let step = step_for(width);
        let cell = step * SMALL_PER_CELL;
        Self {
            width,
            height,
            step,
            cell,
            across: width.div_ceil(cell),
            down: height.div_ceil(cell),
            by_cell: Division::by(cell),
            by_block: Division::by(cell * CELLS_PER_BLOCK),
        }
    }

    /// Number of cells.
    pub fn count(&self) -> usize {
        self.across * self.down
    }

    /// Picture pixels along a block.
    pub fn block(&self) -> usize {
        self.cell * CELLS_PER_BLOCK
    }

    /// Blocks in a row and rows of blocks.
    pub fn blocks(&self) -> (usize, usize) {
        (self.across.div_ceil(CELLS_PER_BLOCK), self.down.div_ceil(CELLS_PER_BLOCK))
    }

    /// All blocks.
    pub fn everywhere(&self) -> Span {
        let (right, bottom) = self.blocks();
        Span {
            left: 0,
            top: 0,
            right,
            bottom,
        }
    }

    /// Size of the small picture.
    pub fn small(&self) -> (usize, usize) {
        (self.across * SMALL_PER_CELL, self.down * SMALL_PER_CELL)
    }

    /// The block in which a picture pixel lies, row by row.
    #[inline]
    pub fn block_at(&self, x: usize, y: usize) -> usize {
        self.by_block.of(y) * self.blocks().0 + self.by_block.of(x)
    }

    /// The cell in which a picture pixel lies, row by row.
    #[inline]
    pub fn cell_at(&self, x: usize, y: usize) -> usize {
        self.by_cell.of(y) * self.across + self.by_cell.of(x)
    }

    /// A block and the eight around it; beyond the border the nearest one stands for what is missing.
    #[inline]
    pub fn blocks_around(&self, column: usize, row: usize) -> [[usize; 3]; 3] {
        let (across, down) = self.blocks();
        let near = |place: usize, step: usize, count: usize| (place + step).saturating_sub(1).min(count - 1);
        std::array::from_fn(|v| std::array::from_fn(|u| near(row, v, down) * across + near(column, u, across)))
    }

    /// A field at a picture pixel, linear between the centres of blocks.
    #[inline]
    pub fn between(&self, field: &[Sums], x: f32, y: f32) -> Sums {
        let pitch = 1.0 / self.block() as f32;
        let (across, down) = self.blocks();
        let axis = |v: f32, count: usize| between_centres((v + 0.5) * pitch, count);
        let ((x0, x1, fx), (y0, y1, fy)) = (axis(x, across), axis(y, down));
        let (top, bottom) = (y0 * across, y1 * across);
        let (a, b, c, d) = (&field[top + x0], &field[top + x1], &field[bottom + x0], &field[bottom + x1]);
        let (wa, wb, wc, wd) = ((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy);
        std::array::from_fn(|i| wa * a[i] + wb * b[i] + wc * c[i] + wd * d[i])
    }
}

/// Pixels of a picture of this width along a pixel of its small one.
pub fn step_for(width: usize) -> usize {
    reduction_to(width, SMALL_WIDTH_PX)
}

/// A rectangle of blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Span {
    /// First column.
    pub left: usize,
    /// First row.
    pub top: usize,
    /// One past the last column.
    pub right: usize,
    /// One past the last row.
    pub bottom: usize,
}

impl Span {
    /// The smallest rectangle around this one and another; an empty one counts for nothing.
    pub fn around(self, other: Self) -> Self {
        if self.right <= self.left {
            return other;
        }
        Self {
            left: self.left.min(other.left),
            top: self.top.min(other.top),
            right: self.right.max(other.right),
            bottom: self.bottom.max(other.bottom),
        }
    }

    /// The rectangle and so many blocks around it, within a lattice `across` × `down`.
    pub fn grown(self, by: usize, (across, down): (usize, usize)) -> Self {
        Self {
            left: self.left.saturating_sub(by),
            top: self.top.saturating_sub(by),
            right: (self.right + by).min(across),
            bottom: (self.bottom + by).min(down),
        }
    }

    /// True if there is nothing in it.
    pub fn is_empty(self) -> bool {
        self.right <= self.left || self.bottom <= self.top
    }

    /// True if the block lies in it.
    pub fn holds(self, column: usize, row: usize) -> bool {
        (self.left..self.right).contains(&column) && (self.top..self.bottom).contains(&row)
    }

    /// Rows of the rectangle.
    pub fn rows(self) -> std::ops::Range<usize> {
        self.top..self.bottom
    }

    /// Its blocks, row by row, as (column, row).
    #[inline(always)]
    pub fn places(self) -> impl Iterator<Item = (usize, usize)> {
        self.rows()
            .flat_map(move |row| (self.left..self.right).map(move |column| (column, row)))
    }

    /// The part of row `y` of a lattice `across` blocks wide that lies in the rectangle.
    pub fn row(self, y: usize, across: usize) -> std::ops::Range<usize> {
        y * across + self.left..y * across + self.right
    }
}

/// Adds up blocks over their surroundings; keeps its memory.
#[derive(Debug, Default)]
pub struct Smoother {
    rows: Vec<Sums>,
    coarse: Vec<Sums>,
}

/// Weights of a block and its neighbours along an axis: standard deviation 1 block, about 15 px of a 960 px wide picture.
const NEAR: [f32; 5] = [0.0625, 0.25, 0.375, 0.25, 0.0625];
/// The far mean is taken over blocks this many times as long …
const COARSER: usize = 2;
/// … by two passes of a box of this radius.
const RADIUS: usize = 2;
/// Weight of the far mean against a block full of good pixels.
const FAR_WEIGHT: f32 = 0.02;

impl Smoother {
    /// Replace every block of `span` by a weighted sum over its surroundings; what is near outweighs what is far where there is something
    /// near. Blocks out of `span` count as empty.
    pub fn smooth(&mut self, grid: Grid, span: Span, blocks: &mut [Sums]) {
        let (blocks_across, blocks_down) = grid.blocks();
        let (across, down) = (blocks_across.div_ceil(COARSER), blocks_down.div_ceil(COARSER));
        // Two passes carry a cell over twice the radius; what they leave farther out is not asked for.
        let coarse = Span {
            left: span.left / COARSER,
            top: span.top / COARSER,
            right: span.right.div_ceil(COARSER),
            bottom: span.bottom.div_ceil(COARSER),
        };
        let reached = coarse.grown(RADIUS, (across, down));
        self.coarse.resize(across * down, [0.0; 8]);
        for row in reached.rows() {
            self.coarse[reached.row(row, across)].fill([0.0; 8]);
        }
        for y in span.rows() {
            for (x, block) in (span.left..span.right).zip(&blocks[span.row(y, blocks_across)]) {
                add(&mut self.coarse[y / COARSER * across + x / COARSER], block, 1.0);
            }
        }
        self.rows.resize(blocks.len(), [0.0; 8]);
        for _ in 0..2 {
            box_mean(&mut self.coarse, across, reached, &mut self.rows);
        }
        wide::run(NearMean {
            blocks,
            across: blocks_across,
            span,
            rows: &mut self.rows,
        });
        for y in span.rows() {
            let (y0, y1, fy) = between_centres((y as f32 + 0.5) / COARSER as f32, down);
            for (x, block) in (span.left..span.right).zip(&mut blocks[span.row(y, blocks_across)]) {
                let (x0, x1, fx) = between_centres((x as f32 + 0.5) / COARSER as f32, across);
                let weight = FAR_WEIGHT / (COARSER * COARSER) as f32;
                for (row, wy) in [(y0, 1.0 - fy), (y1, fy)] {
                    add(block, &self.coarse[row * across + x0], weight * wy * (1.0 - fx));
                    add(block, &self.coarse[row * across + x1], weight * wy * fx);
                }
            }
        }
    }
}

/// The two of `count` blocks in a row between whose centres a place (in blocks, from the first one's edge) lies, and how near it is to the
/// second.
#[inline]
fn between_centres(place: f32, count: usize) -> (usize, usize, f32) {
    let place = (place - 0.5).clamp(0.0, count as f32 - 1.0);
    let first = place as usize;
    (first, (first + 1).min(count - 1), place - first as f32)
}

/// The mean over a square of cells within `span`, cells outside counting as empty.
fn box_mean(cells: &mut [Sums], across: usize, span: Span, rows: &mut [Sums]) {
    wide::run(BoxMean {
        cells,
        across,
        span,
        rows,
    });
}

struct BoxMean<'a> {
    cells: &'a mut [Sums],
    across: usize,
    span: Span,
    rows: &'a mut [Sums],
}

impl wide::Kernel for BoxMean<'_> {
    #[inline(always)]
    fn run(self) {
        let share = 1.0 / (2 * RADIUS + 1) as f32;
        for y in self.span.rows() {
            let source = &self.cells[self.span.row(y, self.across)];
            let out = &mut self.rows[self.span.row(y, self.across)];
            for x in 0..source.len() {
                let mut sum = [0.0_f32; 8];
                for cell in &source[x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(source.len())] {
                    for i in 0..8 {
                        sum[i] += cell[i];
                    }
                }
                for i in 0..8 {
                    out[x][i] = share * sum[i];
                }
            }
        }
        for y in self.span.rows() {
            let out = &mut self.cells[self.span.row(y, self.across)];
            let (begin, end) = (
                y.saturating_sub(RADIUS).max(self.span.top),
                (y + RADIUS + 1).min(self.span.bottom),
            );
            out.copy_from_slice(&self.rows[self.span.row(begin, self.across)]);
            for v in begin + 1..end {
                for (out, cell) in out.iter_mut().zip(&self.rows[self.span.row(v, self.across)]) {
                    for i in 0..8 {
                        out[i] += cell[i];
                    }
                }
            }
            for out in out {
                for value in out {
                    *value *= share;
                }
            }
        }
    }
}

/// The mean over the neighbourhood that [`NEAR`] weighs, within a span.
struct NearMean<'a> {
    blocks: &'a mut [Sums],
    across: usize,
    span: Span,
    rows: &'a mut [Sums],
}

impl wide::Kernel for NearMean<'_> {
    #[inline(always)]
    fn run(self) {
        for y in self.span.rows() {
            let source = &self.blocks[self.span.row(y, self.across)];
            let out = &mut self.rows[self.span.row(y, self.across)];
            for (x, out) in out.iter_mut().enumerate() {
                let mut sum = [0.0; 8];
                for (weight, place) in NEAR.iter().zip(x..) {
                    // Two to the left up to two to the right; what is left of the row wraps round and is not found.
                    if let Some(block) = source.get(place.wrapping_sub(2)) {
                        add(&mut sum, block, *weight);
                    }
                }
                *out = sum;
            }
        }
        for y in self.span.rows() {
            let out = &mut self.blocks[self.span.row(y, self.across)];
            out.fill([0.0; 8]);
            for (weight, place) in NEAR.iter().zip(y..) {
                let row = place.wrapping_sub(2);
                if self.span.rows().contains(&row) {
                    for (out, block) in out.iter_mut().zip(&self.rows[self.span.row(row, self.across)]) {
                        add(out, block, *weight);
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn add(sum: &mut Sums, cell: &Sums, factor: f32) {
    for (sum, value) in sum.iter_mut().zip(cell) {
        *sum += factor * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn division_is_exact() {
        for divisor in 1..70 {
            let division = Division::by(divisor);
            for place in (0..500).chain(65_000..65_536) {
                assert_eq!(division.of(place), place / divisor, "{place} / {divisor}");
            }
        }
    }

    #[test]
    fn a_field_is_linear_between_the_centres_of_blocks() {
        let grid = Grid::over((96, 64));
        let (across, down) = grid.blocks();
        let field: Vec<Sums> = (0..across * down)
            .map(|i| [((i % across) * grid.block()) as f32 + 0.5 * grid.block() as f32 - 0.5; 8])
            .collect();
        for x in [10.0, 31.5, 60.0] {
            assert!((grid.between(&field, x, 20.0)[3] - x).abs() < 1e-3);
        }
    }

    #[test]
    fn smoothing_keeps_a_constant_ratio_and_fills_empty_blocks_from_afar() {
        let grid = Grid::over((960, 540));
        let (across, down) = grid.blocks();
        let mut blocks = vec![[0.0; 8]; across * down];
        for y in 10..12 {
            for x in 10..12 {
                blocks[y * across + x] = [2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            }
        }
        Smoother::default().smooth(grid, grid.everywhere(), &mut blocks);
        for (x, y) in [(10, 10), (13, 11), (17, 12)] {
            let block = blocks[y * across + x];
            assert!(
                block[0] > 0.0 && (block[1] / block[0] - 1.5).abs() < 1e-3,
                "{x} {y} {block:?}"
            );
        }
        assert!(blocks[10 * across + 10][0] > 100.0 * blocks[12 * across + 17][0]);
    }

    /// The plainest possible mean near a block.
    fn reference_near(blocks: &[Sums], across: usize, span: Span, column: usize, row: usize) -> f32 {
        let mut sum = 0.0;
        for v in span.rows() {
            for u in span.left..span.right {
                if u.abs_diff(column) <= 2 && v.abs_diff(row) <= 2 {
                    sum += NEAR[u + 2 - column] * NEAR[v + 2 - row] * blocks[v * across + u][5];
                }
            }
        }
        sum
    }

    #[test]
    fn the_near_mean_equals_its_plain_twin() {
        let grid = Grid::over((480, 200));
        let (across, down) = grid.blocks();
        let span = Span {
            left: 3,
            top: 1,
            right: across - 2,
            bottom: down - 1,
        };
        let before: Vec<Sums> = (0..across * down).map(|i| [(i * 7919 % 101) as f32; 8]).collect();
        let (mut blocks, mut rows) = (before.clone(), before.clone());
        wide::run(NearMean {
            blocks: &mut blocks,
            across,
            span,
            rows: &mut rows,
        });
        for y in span.rows() {
            for x in span.left..span.right {
                let expected = reference_near(&before, across, span, x, y);
                assert!(
                    (blocks[y * across + x][5] - expected).abs() < 1e-3 * expected.max(1.0),
                    "({x}, {y})"
                );
            }
        }
    }
}
