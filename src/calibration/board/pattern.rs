//! The boards that cameras are calibrated with: what a user types, and where each corner lies.
//!
//! Written `KIND:COLUMNSxROWS[:…]`:
//! - `checkerboard:9x6` counts *inner* corners, as OpenCV does: where four squares meet.
//! - `charuco:19x26:4[:4x4_250[:legacy]]` counts *squares*; the number is the side of a marker in mm, then the dictionary. The first
//!   square is black; on OpenCV's "legacy" boards of an even number of rows it bears the first marker.
//! - `circles:7x5[:2.5]` is a grid of dots; the number is a dot's diameter in mm (measured from the picture if left out).
//! - `acircles:4x11[:2.5]` is OpenCV's asymmetric grid: 11 rows of 4 dots, every other row shifted by half a distance. The square is
//!   half the distance of two dots in a row: dot j of row i lies at ((2j + i mod 2)·S, i·S).
//!
//! Board space: x along the columns, y along the rows, z away from the camera that sees the printed side; the origin is the first inner
//! corner or dot. A picture shows a checkerboard turned by a half as the same board if its columns and rows are both odd or both even
//! in number; else the origin is the one whose outer square is black.

use std::collections::BTreeSet;
use std::str::FromStr;

use crate::calibration::board::marker::Dictionary;

/// Most columns or rows.
const MOST: usize = 200;

/// What is printed on a board.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pattern {
    /// Black and white squares.
    Checkerboard,
    /// Black squares, and white ones with a marker each.
    Charuco {
        /// Side of a marker, mm.
        marker_mm: f64,
        /// Which markers.
        dictionary: Dictionary,
        /// Printed by OpenCV before 4.6 (or with its legacy pattern): an even number of rows begins with a marker.
        legacy: bool,
    },
    /// Dots in rows and columns.
    Circles {
        /// Diameter of a dot, mm.
        diameter_mm: Option<f64>,
    },
    /// Dots in rows, every other one shifted.
    AsymmetricCircles {
        /// Diameter of a dot, mm.
        diameter_mm: Option<f64>,
    },
}

/// A board's pattern and measure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardLayout {
    /// What is printed.
    pub pattern: Pattern,
    /// Inner corners, squares (ChArUco) or dots along x.
    pub columns: usize,
    /// The same along y.
    pub rows: usize,
    /// Side of a square or distance of dots, mm.
    pub square_mm: f64,
}

/// One corner or dot of a board.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Site {
    /// Its place on the lattice of nearest neighbours.
    pub lattice: [i32; 2],
    /// Its place on the board, mm.
    pub board_mm: [f64; 2],
}

/// Why a text names no board.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{0}; examples: checkerboard:9x6, charuco:19x26:4:4x4_250, circles:7x5, acircles:4x11")]
pub struct BoardError(String);

impl BoardLayout {
    /// From what a user types, and the measure of a square.
    pub fn new(text: &str, square_mm: f64) -> Result<Self, BoardError> {
        if !(square_mm.is_finite() && square_mm > 0.0) {
            return Err(BoardError(format!("expected a square of more than 0 mm, found {square_mm}")));
        }
        let mut parts = text.split(':');
        let kind = parts.next().unwrap_or_default();
        let size = parts
            .next()
            .ok_or_else(|| BoardError(format!("expected KIND:COLUMNSxROWS, found `{text}`")))?;
        let (columns, rows) = size
            .split_once(['x', 'X'])
            .and_then(|(c, r)| Some((c.parse::<usize>().ok()?, r.parse::<usize>().ok()?)))
            .ok_or_else(|| BoardError(format!("expected COLUMNSxROWS such as 9x6, found `{size}`")))?;
        let fewest = if kind == "acircles" { 1 } else { 2 };
        if columns < fewest || rows < 2 || columns > MOST || rows > MOST || columns * rows < 6 {
            return Err(BoardError(format!(
                "expected at least six corners and at most {MOST} columns and rows, found {columns}x{rows}"
            )));
        }
        let length = |part: Option<&str>, what: &str| -> Result<Option<f64>, BoardError> {
            part.map(|part| match part.parse::<f64>() {
                Ok(mm) if mm > 0.0 && mm < 2.0 * square_mm => Ok(mm),
                _ => Err(BoardError(format!(
                    "expected {what} in mm that fits the board, found `{part}`"
                ))),
            })
            .transpose()
        };
        let pattern = match kind {
            "checkerboard" | "chessboard" => Pattern::Checkerboard,
            "circles" => Pattern::Circles {
                diameter_mm: length(parts.next(), "a dot's diameter")?,
            },
            "acircles" => Pattern::AsymmetricCircles {
                diameter_mm: length(parts.next(), "a dot's diameter")?,
            },
            "charuco" => {
                let marker_mm = length(parts.next(), "a marker's side")?
                    .filter(|marker_mm| *marker_mm < square_mm)
                    .ok_or_else(|| {
                        BoardError(format!(
                            "a ChArUco board needs the side of its markers, smaller than a square of {square_mm} mm: \
                             charuco:{columns}x{rows}:MARKER_MM"
                        ))
                    })?;
                let dictionary = Dictionary::from_str(parts.next().unwrap_or("4x4_250")).map_err(BoardError)?;
                let markers = (columns * rows).div_ceil(2);
                if markers > dictionary.len() {
                    return Err(BoardError(format!(
                        "{columns}x{rows} squares need {markers} markers, the dictionary has {}",
                        dictionary.len()
                    )));
                }
                let legacy = match parts.next() {
                    None => false,
                    Some("legacy") => true,
                    Some(other) => {
                        return Err(BoardError(format!(
                            "expected `legacy` or nothing after the dictionary, found `{other}`"
                        )));
                    }
                };
                Pattern::Charuco {
                    marker_mm,
                    dictionary,
                    legacy,
                }
            }
            other => {
                return Err(BoardError(format!(
                    "expected checkerboard, charuco, circles or acircles, found `{other}`"
                )));
            }
        };
        if let Some(rest) = parts.next() {
            return Err(BoardError(format!(
                "expected the end after `{text}`'s known parts, found `{rest}`"
            )));
        }
        Ok(Self {
            pattern,
            columns,
            rows,
            square_mm,
        })
    }

    /// All corners or dots, row by row.
    pub fn sites(&self) -> Vec<Site> {
        let (columns, rows) = match self.pattern {
            Pattern::Charuco { .. } => (self.columns - 1, self.rows - 1),
            _ => (self.columns, self.rows),
        };
        let mut sites = Vec::with_capacity(columns * rows);
        for row in 0..rows as i32 {
            for column in 0..columns as i32 {
                let (x, y, lattice) = if matches!(self.pattern, Pattern::AsymmetricCircles { .. }) {
                    let x = 2 * column + row % 2;
                    // Nearest neighbours lie along the diagonals.
                    (x, row, [(x + row) / 2, (row - x).div_euclid(2)])
                } else {
                    (column, row, [column, row])
                };
                sites.push(Site {
                    lattice,
                    board_mm: [f64::from(x) * self.square_mm, f64::from(y) * self.square_mm],
                });
            }
        }
        sites
    }

    /// True if turning the board by a half gives the same corners, so that a picture does not tell which end is which.
    pub fn looks_the_same_upside_down(&self) -> bool {
        match self.pattern {
            Pattern::Charuco { .. } => false,
            Pattern::Checkerboard => (self.columns + self.rows).is_multiple_of(2),
            Pattern::Circles { .. } | Pattern::AsymmetricCircles { .. } => {
                let sites: BTreeSet<[i32; 2]> = self.sites().iter().map(|site| site.lattice).collect();
                let (Some(first), Some(last)) = (self.sites().first().copied(), self.sites().last().copied()) else {
                    return false;
                };
                let sum = [first.lattice[0] + last.lattice[0], first.lattice[1] + last.lattice[1]];
                sites.iter().all(|[u, v]| sites.contains(&[sum[0] - u, sum[1] - v]))
            }
        }
    }

    /// The middle of the board, mm.
    pub fn middle_mm(&self) -> [f64; 2] {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for site in self.sites() {
            for axis in 0..2 {
                low[axis] = low[axis].min(site.board_mm[axis]);
                high[axis] = high[axis].max(site.board_mm[axis]);
            }
        }
        [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_are_read_as_typed() {
        let board = BoardLayout::new("checkerboard:9x6", 4.0).unwrap();
        assert_eq!(board.sites().len(), 54);
        assert_eq!(board.sites()[10].board_mm, [4.0, 4.0]);
        let board = BoardLayout::new("charuco:19x26:4:4x4_250", 5.0).unwrap();
        assert_eq!(board.sites().len(), 18 * 25);
        let board = BoardLayout::new("acircles:4x11", 2.0).unwrap();
        assert_eq!(board.sites()[5].board_mm, [6.0, 2.0]);
        assert_eq!(board.sites().len(), 44);
        for wrong in [
            "checkerboard",
            "checkerboard:9",
            "chess:9x6",
            "charuco:5x7",
            "charuco:5x7:6",
            "charuco:90x90:1",
            "circles:4x4:x",
            "checkerboard:9x6:3",
            "checkerboard:1x99",
        ] {
            assert!(BoardLayout::new(wrong, 5.0).is_err(), "{wrong}");
        }
        assert!(BoardLayout::new("checkerboard:9x6", f64::NAN).is_err());
    }

    #[test]
    fn the_asymmetric_lattice_has_its_neighbours_one_step_away() {
        let sites = BoardLayout::new("acircles:3x11", 1.0).unwrap().sites();
        for a in &sites {
            for b in &sites {
                let far = (a.board_mm[0] - b.board_mm[0]).hypot(a.board_mm[1] - b.board_mm[1]);
                let steps = (a.lattice[0] - b.lattice[0]).abs() + (a.lattice[1] - b.lattice[1]).abs();
                assert_eq!(steps == 1, (far - 2.0_f64.sqrt()).abs() < 1e-9, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn half_turns_are_known() {
        let same = |text: &str| BoardLayout::new(text, 1.0).unwrap().looks_the_same_upside_down();
        assert!(same("checkerboard:14x10") && !same("checkerboard:9x6") && same("circles:7x5"));
        assert!(!same("acircles:4x11") && same("acircles:4x10") && !same("charuco:5x7:0.7"));
    }
}
