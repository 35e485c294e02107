//! One block of the small live picture: 8 × 8 pixels in planes, row by row.
//!
//! What is computed for a whole plane is written as plain loops over arrays, without closures that build arrays: the compiler then fills
//! vector registers with it.

use crate::stages::specularity_substitution::grid::SMALL_PER_BLOCK;

/// Pixels of a block.
pub const LANES: usize = SMALL_PER_BLOCK * SMALL_PER_BLOCK;
/// A number for each pixel of a block, row by row.
pub type Plane = [f32; LANES];

/// A plane of zeros.
pub const EMPTY: Plane = [0.0; LANES];

/// The good pixels of a block; planes are 0 where a pixel is not good.
#[derive(Clone, Copy, Debug)]
pub struct Tile {
    /// How many pixels are good.
    pub count: usize,
    /// Which ones.
    pub good: [u8; LANES],
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
        count: 0,
        good: [0; LANES],
        depth: EMPTY,
        color: [EMPTY; 3],
        brightness: EMPTY,
        slope: [EMPTY; 2],
        inner: EMPTY,
    };
}

/// The sum of a plane.
#[inline(always)]
pub fn total(plane: &Plane) -> f32 {
    let mut lanes = [0.0_f32; 8];
    for values in plane.chunks_exact(8) {
        for (lane, value) in lanes.iter_mut().zip(values) {
            *lane += value;
        }
    }
    lanes.iter().sum()
}
