//! Square markers: their dictionaries, and reading one from a picture.
//!
//! A marker is a black frame one cell wide around n × n cells of black or white (Garrido-Jurado et al. 2014). Two markers of a
//! dictionary differ in many cells in every turn, so that a few misread cells do no harm.

use std::str::FromStr;

use crate::calibration::board::marker_tables::{MARKERS_4X4, MARKERS_5X5, MARKERS_6X6, MARKERS_7X7};

/// The first so many markers of n × n cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Dictionary {
    cells: usize,
    len: usize,
}

/// A marker that was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reading {
    /// Its number in the dictionary.
    pub id: usize,
    /// Clockwise quarter turns of the picture against the dictionary.
    pub quarter_turns: usize,
    /// Cells misread.
    pub errors: u32,
}

impl FromStr for Dictionary {
    type Err = String;

    /// `4x4_250`, `DICT_6X6_100`, …
    fn from_str(text: &str) -> Result<Self, String> {
        let lower = text.to_ascii_lowercase();
        let name = lower.strip_prefix("dict_").unwrap_or(&lower);
        let known =
            || format!("expected a dictionary 4x4, 5x5, 6x6 or 7x7 of 50, 100, 250 or 1000 such as 4x4_250, found `{text}`");
        let (cells, len) = name.split_once('_').ok_or_else(known)?;
        let cells = match cells {
            "4x4" => 4,
            "5x5" => 5,
            "6x6" => 6,
            "7x7" => 7,
            _ => return Err(known()),
        };
        match len.parse() {
            Ok(len @ (50 | 100 | 250 | 1000)) => Ok(Self { cells, len }),
            _ => Err(known()),
        }
    }
}

impl Dictionary {
    /// Cells along a side, without the frame.
    pub fn cells(&self) -> usize {
        self.cells
    }

    /// How many markers.
    #[expect(clippy::len_without_is_empty, reason = "no dictionary is empty")]
    pub fn len(&self) -> usize {
        self.len
    }

    /// The cells of marker `id`, row by row, highest bit first, 1 = white.
    pub fn bits(&self, id: usize) -> Option<u64> {
        let table = match self.cells {
            4 => &MARKERS_4X4,
            5 => &MARKERS_5X5,
            6 => &MARKERS_6X6,
            _ => &MARKERS_7X7,
        };
        table.get(id).copied().filter(|_| id < self.len)
    }

    /// True if the cell in `column` of `row` of marker `id` is white.
    pub fn is_white(&self, id: usize, column: usize, row: usize) -> bool {
        let place = self.cells * self.cells - 1 - (row * self.cells + column);
        self.bits(id).is_some_and(|bits| bits >> place & 1 == 1)
    }

    /// The marker that looks most like `bits`, if no more than `most_errors` cells differ.
    pub fn read(&self, bits: u64, most_errors: u32) -> Option<Reading> {
        let mut turned = bits;
        let mut best: Option<Reading> = None;
        for quarter_turns in 0..4 {
            for id in 0..self.len {
                let errors = (self.bits(id)? ^ turned).count_ones();
                if errors <= most_errors && best.is_none_or(|best| errors < best.errors) {
                    best = Some(Reading {
                        id,
                        quarter_turns,
                        errors,
                    });
                }
            }
            turned = self.turned_back(turned);
        }
        best
    }

    /// The same cells turned anticlockwise by a quarter.
    fn turned_back(&self, bits: u64) -> u64 {
        let n = self.cells;
        let mut turned = 0;
        for row in 0..n {
            for column in 0..n {
                // What stands at (column, row) after an anticlockwise quarter stood at (n − 1 − row, column).
                let from = n * n - 1 - (column * n + (n - 1 - row));
                turned = turned << 1 | (bits >> from & 1);
            }
        }
        turned
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_marker_is_read_in_every_turn_with_an_error() {
        for name in ["4x4_50", "5x5_250", "6x6_1000", "DICT_7X7_100"] {
            let dictionary = Dictionary::from_str(name).unwrap();
            for id in (0..dictionary.len()).step_by(7) {
                let mut bits = dictionary.bits(id).unwrap();
                for back in 0..4 {
                    let quarter_turns = (4 - back) % 4;
                    let reading = dictionary.read(bits ^ 4, 1).unwrap();
                    assert_eq!((reading.id, reading.quarter_turns), (id, quarter_turns), "{name}");
                    bits = dictionary.turned_back(bits);
                }
            }
        }
        assert!(Dictionary::from_str("4x4_30").is_err() && Dictionary::from_str("aruco").is_err());
    }

    #[test]
    fn the_first_marker_is_opencvs() {
        // DICT_4X4_50, marker 0: 1011 / 0101 / 0011 / 0010.
        let dictionary = Dictionary::from_str("4x4_50").unwrap();
        assert_eq!(dictionary.bits(0), Some(0b1011_0101_0011_0010));
    }
}
