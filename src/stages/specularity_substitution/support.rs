//! Where the surface is known well enough to be carried on: inside what was measured, not beyond it.
//!
//! A hole in the measured surface is bridged by what lies around it. Past the surface's own rim nothing says how it goes on; there stands
//! an instrument's jaw, an organ nearer to the scope, or the edge of the image field. The known part is the measured one closed (dilated,
//! then eroded: Serra 1982) over cells of the depth picture.

use crate::image::buffer::{Image, Mask};
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};

/// Edge of a cell, px of the depth's picture.
const CELL_PX: usize = 4;
/// A cell is measured where at least this share of its pixels is.
const MEASURED_SHARE: f32 = 0.1;
/// Gaps up to twice this are closed, cells.
const CLOSING_CELLS: u16 = 12;

/// The part of a depth picture that may be filled; keeps its memory.
#[derive(Debug)]
pub struct Support {
    known: Mask,
    distance: Image<u16>,
}

impl Default for Support {
    fn default() -> Self {
        Self {
            known: Image::filled(0, 0, 0),
            distance: Image::filled(0, 0, 0),
        }
    }
}

impl Support {
    /// See which part of `depth` (0 where nothing was measured) may be filled.
    pub fn learn(&mut self, depth: &Image<f32>) {
        let (width, height) = depth.size();
        self.known.resize(width.div_ceil(CELL_PX), height.div_ceil(CELL_PX), 0);
        let across = self.known.width();
        for (row, known) in self.known.pixels_mut().chunks_exact_mut(across).enumerate() {
            let lines = row * CELL_PX..((row + 1) * CELL_PX).min(height);
            for (column, known) in known.iter_mut().enumerate() {
                let columns = column * CELL_PX..((column + 1) * CELL_PX).min(width);
                let pixels = lines.len() * columns.len();
                let measured = (lines.clone())
                    .map(|y| depth.row(y)[columns.clone()].iter().filter(|d| **d > 0.0).count())
                    .sum::<usize>();
                *known = if measured as f32 >= MEASURED_SHARE * pixels as f32 {
                    255
                } else {
                    0
                };
            }
        }
        let limit = CLOSING_CELLS * UNITS_PER_PX;
        // First what is far from everything measured, then what is far from that.
        for _ in 0..2 {
            chamfer_distance(&self.known, limit + 1, &mut self.distance);
            for (known, &distance) in self.known.pixels_mut().iter_mut().zip(self.distance.pixels()) {
                *known = if distance > limit { 255 } else { 0 };
            }
        }
    }

    /// Forget the filled depth beyond the rim.
    pub fn restrict(&self, depth: &mut Image<f32>) {
        let width = depth.width();
        for (y, row) in depth.pixels_mut().chunks_exact_mut(width.max(1)).enumerate() {
            for (cell, &known) in row.chunks_mut(CELL_PX).zip(self.known.row(y / CELL_PX)) {
                if known == 0 {
                    cell.fill(0.0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_are_closed_and_rims_are_not_extended() {
        let (width, height) = (320, 240);
        let mut depth = Image::filled(width, height, 0.0);
        for y in 0..height {
            for x in 0..160 {
                let in_hole = (40..100).contains(&x) && (100..160).contains(&y);
                depth.set(x, y, if in_hole { 0.0 } else { 70.0 });
            }
        }
        let mut support = Support::default();
        support.learn(&depth);
        let mut filled = Image::filled(width, height, 70.0);
        support.restrict(&mut filled);
        for y in 0..height {
            for x in 0..width {
                assert_eq!(filled.at(x, y) > 0.0, x < 160, "at {x}, {y}");
            }
        }
    }

    #[test]
    fn nothing_measured_nothing_known() {
        let mut support = Support::default();
        let mut depth = Image::filled(33, 17, 0.0);
        support.learn(&depth);
        depth.fill(1.0);
        support.restrict(&mut depth);
        assert!(depth.pixels().iter().all(|d| *d == 0.0));
    }
}
