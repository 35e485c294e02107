//! One block of the small live picture: 8 × 8 pixels in planes, so that a row fills a vector register.

use crate::stages::specularity_substitution::grid::SMALL_PER_BLOCK;

/// A row of a block's pixels.
pub type Row = [f32; SMALL_PER_BLOCK];
/// A number for each pixel of a block, row by row.
pub type Plane = [Row; SMALL_PER_BLOCK];

/// A plane of zeros.
pub const EMPTY: Plane = [[0.0; SMALL_PER_BLOCK]; SMALL_PER_BLOCK];

/// The good pixels of a block; every plane is 0 where a pixel is not good.
#[derive(Clone, Copy, Debug)]
pub struct Tile {
    /// mm.
    pub depth: Plane,
    /// Mean colours with [`super::live::DARK_LEVELS`] added.
    pub color: [Plane; 3],
    /// Their luma.
    pub brightness: Plane,
    /// Half the relative slope of brightness, a small px, right and down; 0 where a neighbour is not good.
    pub slope: [Plane; 2],
    /// 1 where all four neighbours are good.
    pub inner: Plane,
}

impl Tile {
    /// Without a good pixel.
    pub const EMPTY: Self = Self {
        depth: EMPTY,
        color: [EMPTY; 3],
        brightness: EMPTY,
        slope: [EMPTY; 2],
        inner: EMPTY,
    };
}

/// Sums that are gathered lane by lane and added up at the end.
#[derive(Clone, Copy, Debug)]
pub struct LaneSums<const N: usize>([Row; N]);

impl<const N: usize> LaneSums<N> {
    /// All zero.
    pub const ZERO: Self = Self([[0.0; SMALL_PER_BLOCK]; N]);

    /// Add a row to sum `i`.
    #[inline(always)]
    pub fn add(&mut self, i: usize, row: Row) {
        for (sum, value) in self.0[i].iter_mut().zip(row) {
            *sum += value;
        }
    }

    /// Sum `i` over its lanes.
    #[inline(always)]
    pub fn total(&self, i: usize) -> f32 {
        self.0[i].iter().sum()
    }
}

/// A value for every lane.
#[inline(always)]
pub fn lanes(value: impl Fn(usize) -> f32) -> Row {
    std::array::from_fn(value)
}
