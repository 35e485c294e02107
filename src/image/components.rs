//! Connected components of a mask (8-neighbourhood), labelled by runs without allocation once warm.

use std::ops::Range;

use crate::image::buffer::{Image, Mask};

/// A horizontal run of set pixels, and the component it belongs to.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// Row.
    pub y: u32,
    /// First column.
    pub begin: u32,
    /// One past the last column.
    pub end: u32,
    /// Index into [`Components::regions`].
    pub label: u32,
}

/// A connected set of pixels.
#[derive(Clone, Copy, Debug)]
pub struct Region {
    /// Number of pixels.
    pub area: u32,
    /// Bounding box: first column.
    pub left: u32,
    /// Bounding box: first row.
    pub top: u32,
    /// Bounding box: one past the last column.
    pub right: u32,
    /// Bounding box: one past the last row.
    pub bottom: u32,
}

/// The components of one mask.
#[derive(Debug, Default)]
pub struct Components {
    runs: Vec<Run>,
    parents: Vec<u32>,
    numbers: Vec<u32>,
    regions: Vec<Region>,
}

impl Components {
    /// Find the components of the non-zero pixels.
    pub fn label(&mut self, mask: &Mask) {
        self.runs.clear();
        self.parents.clear();
        let mut previous = 0..0;
        for y in 0..mask.height() {
            let first = self.runs.len();
            self.collect_runs(mask.row(y), y as u32);
            let mut above = previous.start;
            for current in first..self.runs.len() {
                let run = self.runs[current];
                // Runs touch when they overlap or meet at a corner.
                while above < previous.end && self.runs[above].end < run.begin {
                    above += 1;
                }
                let mut touching = above;
                while touching < previous.end && self.runs[touching].begin <= run.end {
                    self.join(self.runs[touching].label, run.label);
                    touching += 1;
                }
            }
            previous = first..self.runs.len();
        }
        self.number();
    }

    /// The regions found, in the order of their first pixel.
    pub fn regions(&self) -> &[Region] {
        &self.regions
    }

    /// The runs of all regions, row by row.
    pub fn runs(&self) -> &[Run] {
        &self.runs
    }

    /// Paint into `out` the regions that `keep` accepts with `value`; other pixels stay.
    pub fn paint(&self, out: &mut Image<u8>, value: u8, keep: impl Fn(usize, &Region) -> bool) {
        for run in &self.runs {
            if keep(run.label as usize, &self.regions[run.label as usize]) {
                out.row_mut(run.y as usize)[run.begin as usize..run.end as usize].fill(value);
            }
        }
    }

    fn collect_runs(&mut self, row: &[u8], y: u32) {
        for run in set_runs(row) {
            let label = self.parents.len() as u32;
            self.parents.push(label);
            self.runs.push(Run {
                y,
                begin: run.start as u32,
                end: run.end as u32,
                label,
            });
        }
    }

    fn root(&mut self, mut label: u32) -> u32 {
        while self.parents[label as usize] != label {
            let grandparent = self.parents[self.parents[label as usize] as usize];
            self.parents[label as usize] = grandparent;
            label = grandparent;
        }
        label
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        let (low, high) = (a.min(b), a.max(b));
        self.parents[high as usize] = low;
    }

    fn number(&mut self) {
        self.regions.clear();
        self.numbers.clear();
        self.numbers.resize(self.parents.len(), u32::MAX);
        for index in 0..self.runs.len() {
            let run = self.runs[index];
            let root = self.root(run.label) as usize;
            if self.numbers[root] == u32::MAX {
                self.numbers[root] = self.regions.len() as u32;
                self.regions.push(Region {
                    area: 0,
                    left: run.begin,
                    top: run.y,
                    right: run.end,
                    bottom: run.y + 1,
                });
            }
            let number = self.numbers[root];
            let region = &mut self.regions[number as usize];
            region.area += run.end - run.begin;
            region.left = region.left.min(run.begin);
            region.right = region.right.max(run.end);
            region.bottom = run.y + 1;
            self.runs[index].label = number;
        }
    }
}

/// The runs of set pixels of a row.
pub(crate) fn set_runs(row: &[u8]) -> impl Iterator<Item = Range<usize>> {
    let mut from = 0;
    std::iter::from_fn(move || {
        let begin = next_set(row, from)?;
        from = next_clear(row, begin);
        Some(begin..from)
    })
}

/// Bytes looked at in one step.
const WORD: usize = size_of::<u64>();

/// The first set pixel from `from` on.
fn next_set(row: &[u8], mut from: usize) -> Option<usize> {
    while let Some(word) = row.get(from..).and_then(|rest| rest.first_chunk::<WORD>()) {
        let word = u64::from_le_bytes(*word);
        if word != 0 {
            return Some(from + word.trailing_zeros() as usize / 8);
        }
        from += WORD;
    }
    let rest = row.get(from..)?;
    rest.iter().position(|&value| value != 0).map(|gap| from + gap)
}

/// The first pixel from `from` on that is not set, or the row's end.
fn next_clear(row: &[u8], mut from: usize) -> usize {
    while let Some(word) = row[from..].first_chunk::<WORD>() {
        let word = u64::from_le_bytes(*word);
        // Borrows reach beyond a zero byte only upward, so the lowest bit found is right (Mycroft 1987).
        let zeros = word.wrapping_sub(0x0101_0101_0101_0101) & !word & 0x8080_8080_8080_8080;
        if zeros != 0 {
            return from + zeros.trailing_zeros() as usize / 8;
        }
        from += WORD;
    }
    let rest = &row[from..];
    from + rest.iter().position(|&value| value == 0).unwrap_or(rest.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> Mask {
        let pixels = rows
            .iter()
            .flat_map(|r| r.bytes().map(|b| if b == b'#' { 255 } else { 0 }))
            .collect();
        Image::from_vec(rows[0].len(), rows.len(), pixels).unwrap()
    }

    #[test]
    fn corners_join_and_a_u_shape_is_one() {
        let mut components = Components::default();
        components.label(&mask(&["#..#..", "#..#.#", "####..", "......", ".#....", "..#..#"]));
        let areas: Vec<u32> = components.regions().iter().map(|r| r.area).collect();
        assert_eq!(areas, [8, 1, 2, 1]);
        let first = components.regions()[0];
        assert_eq!((first.left, first.top, first.right, first.bottom), (0, 0, 4, 3));
    }

    #[test]
    fn every_set_pixel_lies_in_one_region() {
        let pixels: Vec<u8> = (0..64 * 48)
            .map(|i| {
                if ((i * 2_654_435_761_usize) >> 7).is_multiple_of(3) {
                    255
                } else {
                    0
                }
            })
            .collect();
        let noisy = Image::from_vec(64, 48, pixels).unwrap();
        let mut components = Components::default();
        components.label(&noisy);
        let mut painted = Image::filled(64, 48, 0);
        components.paint(&mut painted, 255, |_, _| true);
        assert_eq!(painted, noisy);
        for y in 0..48 {
            for x in 0..64 {
                let plain = |wanted: fn(u8) -> bool| (x..64).find(|&u| wanted(noisy.at(u, y)));
                assert_eq!(next_set(noisy.row(y), x), plain(|v| v != 0));
                assert_eq!(next_clear(noisy.row(y), x), plain(|v| v == 0).unwrap_or(64));
            }
        }
        let area: u32 = components.regions().iter().map(|r| r.area).sum();
        assert_eq!(area as usize, noisy.pixels().iter().filter(|&&v| v != 0).count());
    }
}
