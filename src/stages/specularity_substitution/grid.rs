//! The frame in cells: sums over cells, smoothed, are the fields that the substitution carries into its holes.

/// The ring around a hole is looked at in a picture of about this width, px.
const SMALL_WIDTH_PX: f32 = 480.0;
/// Pixels of that picture along a cell.
pub const SMALL_PER_CELL: usize = 4;
/// Cells along a block; views are chosen at the corners of blocks.
pub const CELLS_PER_BLOCK: usize = 2;

/// Numbers of a cell, summed and smoothed together.
pub type Sums = [f32; 8];

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

    /// Size of the small picture.
    pub fn small(&self) -> (usize, usize) {
        (self.across * SMALL_PER_CELL, self.down * SMALL_PER_CELL)
    }

    /// A field at a picture pixel, linear between the centres of cells.
    #[inline]
    pub fn between(&self, field: &[Sums], x: f32, y: f32) -> Sums {
        let pitch = 1.0 / self.cell as f32;
        let axis = |v: f32, count: usize| {
            let place = ((v + 0.5) * pitch - 0.5).clamp(0.0, count as f32 - 1.0);
            let first = place as usize;
            (first, (first + 1).min(count - 1), place - first as f32)
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (axis(x, self.across), axis(y, self.down));
        let (top, bottom) = (y0 * self.across, y1 * self.across);
        let (a, b, c, d) = (&field[top + x0], &field[top + x1], &field[bottom + x0], &field[bottom + x1]);
        let (wa, wb, wc, wd) = ((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy);
        std::array::from_fn(|i| wa * a[i] + wb * b[i] + wc * c[i] + wd * d[i])
    }
}

/// Pixels of a picture of this width along a pixel of its small one.
pub fn step_for(width: usize) -> usize {
    (width as f32 / SMALL_WIDTH_PX).round().max(1.0) as usize
}

/// Sums over the cells near and far, each a mean over about so many cells around.
#[derive(Debug, Default)]
pub struct Smoother {
    rows: Vec<Sums>,
    far: Vec<Sums>,
}

/// Two passes of a box this wide on each side: standard deviation 2 cells, about 15 px of a 960 px wide picture.
const NEAR_RADIUS: usize = 2;
/// The same for what counts where nothing is near.
const FAR_RADIUS: usize = 8;
/// Weight of the far mean against a cell full of good pixels.
const FAR_WEIGHT: f32 = 0.02;

impl Smoother {
    /// Replace every cell by a weighted sum over its surroundings; what is near outweighs what is far where there is something near.
    pub fn smooth(&mut self, grid: Grid, cells: &mut [Sums]) {
        self.far.resize(cells.len(), [0.0; 8]);
        self.rows.resize(cells.len(), [0.0; 8]);
        let (across, down) = (grid.across, grid.down);
        for _ in 0..2 {
            box_sum(cells, across, down, NEAR_RADIUS, &mut self.rows);
        }
        self.far.copy_from_slice(cells);
        for _ in 0..2 {
            box_sum(&mut self.far, across, down, FAR_RADIUS, &mut self.rows);
        }
        for (near, far) in cells.iter_mut().zip(&self.far) {
            for (near, far) in near.iter_mut().zip(far) {
                *near += FAR_WEIGHT * far;
            }
        }
    }
}

/// The mean over a square, cells outside counting as empty.
fn box_sum(cells: &mut [Sums], across: usize, down: usize, radius: usize, rows: &mut [Sums]) {
    let share = 1.0 / (2 * radius + 1) as f32;
    for (out, row) in rows.chunks_exact_mut(across).zip(cells.chunks_exact(across)) {
        let mut sum = [0.0_f32; 8];
        for cell in &row[..radius.min(across)] {
            add(&mut sum, cell, 1.0);
        }
        for x in 0..across {
            if x + radius < across {
                add(&mut sum, &row[x + radius], 1.0);
            }
            if x > radius {
                add(&mut sum, &row[x - radius - 1], -1.0);
            }
            out[x] = sum.map(|s| s * share);
        }
    }
    cells.fill([0.0; 8]);
    for y in 0..down {
        let (begin, end) = (y.saturating_sub(radius), (y + radius + 1).min(down));
        let out = &mut cells[y * across..(y + 1) * across];
        for v in begin..end {
            for (out, cell) in out.iter_mut().zip(&rows[v * across..(v + 1) * across]) {
                add(out, cell, share);
            }
        }
    }
}

#[inline]
fn add(sum: &mut Sums, cell: &Sums, factor: f32) {
    for (sum, value) in sum.iter_mut().zip(cell) {
        *sum += factor * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_is_linear_between_the_centres_of_cells() {
        let grid = Grid::over((96, 64));
        let field: Vec<Sums> = (0..grid.count())
            .map(|i| [((i % grid.across) * grid.cell) as f32 + 0.5 * grid.cell as f32 - 0.5; 8])
            .collect();
        for x in [10.0, 31.5, 60.0] {
            assert!((grid.between(&field, x, 20.0)[3] - x).abs() < 1e-3);
        }
    }

    #[test]
    fn smoothing_keeps_a_constant_ratio_and_fills_empty_cells_from_afar() {
        let grid = Grid::over((960, 540));
        let mut cells = vec![[0.0; 8]; grid.count()];
        for y in 20..24 {
            for x in 20..24 {
                cells[y * grid.across + x] = [2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            }
        }
        Smoother::default().smooth(grid, &mut cells);
        for (x, y) in [(21, 21), (26, 22), (34, 24)] {
            let cell = cells[y * grid.across + x];
            assert!(cell[0] > 0.0 && (cell[1] / cell[0] - 1.5).abs() < 1e-3, "{x} {y} {cell:?}");
        }
        assert!(cells[21 * grid.across + 21][0] > 100.0 * cells[24 * grid.across + 34][0]);
    }
}
