//! Pixels held against bounds that are interpolated between the centres of cells, in those cells alone whose brightest pixel could
//! exceed them: in most pictures few.

use std::ops::Range;

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::set_runs;
use crate::image::specularity::background::{extreme_over_square, lower};
use crate::image::specularity::cells::Cells;
use crate::image::wide::{self, Kernel};

/// In the darkest channel, clipped.
const CLIPPED_LEVEL: u8 = 250;
/// Pixels judged at a time.
const CHUNK: usize = 32;
/// An interpolated bound may lie this far below the cells' through rounding, levels.
const ROUNDING_LEVELS: f32 = 0.01;

/// What a pixel must exceed to be a core, or to be a halo.
#[derive(Clone, Copy, Debug)]
pub(super) struct Demand<'a> {
    /// Per cell: in the darkest channel.
    pub level: &'a Image<f32>,
    /// Per cell: in darkest − whiteness · brightest.
    pub white: &'a Image<f32>,
    /// See [`Settings::whiteness`](crate::image::specularity::Settings::whiteness).
    pub whiteness: f32,
}

/// Between which cells' centres a column of pixels lies.
#[derive(Clone, Copy, Debug)]
struct Column {
    left: usize,
    right: usize,
    /// How far on the way from the one to the other.
    part: f32,
}

/// Holds pixels against bounds; owns its working memory.
#[derive(Debug)]
pub(super) struct Classifier {
    columns: Vec<Column>,
    lowest: Image<f32>,
    scratch: Image<f32>,
}

impl Classifier {
    pub fn new() -> Self {
        Self {
            columns: Vec::new(),
            lowest: Image::filled(0, 0, 0.0),
            scratch: Image::filled(0, 0, 0.0),
        }
    }

    /// 255 in `out` for each cell that is no `steel` and in which a pixel could meet the demand.
    pub fn candidates(&mut self, demand: &Demand<'_>, cells: &Cells, steel: &Mask, out: &mut Mask) {
        self.lowest.copy_from(demand.level);
        // Bounds are interpolated between a cell and its neighbours.
        extreme_over_square(&mut self.lowest, 1, lower, f32::INFINITY, &mut self.scratch);
        out.copy_from(steel);
        let found = cells.peak.pixels().iter().zip(self.lowest.pixels());
        for (out, (&peak, lowest)) in out.pixels_mut().iter_mut().zip(found) {
            let exceeds = peak >= CLIPPED_LEVEL || f32::from(peak) > lowest - ROUNDING_LEVELS;
            *out = if *out == 0 && exceeds { 255 } else { 0 };
        }
    }

    /// In the set `cells`, of `step` px, `out` becomes 255 where a pixel meets the demand and lies inside `field`, 0 elsewhere; in other
    /// cells it is left as it is.
    pub fn classify(
        &mut self,
        (image, field): (&Image<Rgb8>, Option<&Mask>),
        demand: &Demand<'_>,
        (cells, step): (&Mask, usize),
        out: &mut Mask,
    ) {
        let width = image.width();
        self.set_columns(width, cells.width(), step);
        let columns = &self.columns;
        let bands = out.pixels_mut().par_chunks_mut(step * width).enumerate();
        bands.for_each(|(band, out)| {
            // What is left over at the bottom belongs to the last row of cells.
            let row = band.min(cells.height() - 1);
            for run in set_runs(cells.row(row)) {
                let end = if run.end == cells.width() { width } else { run.end * step };
                wide::run(Stretch {
                    image,
                    field,
                    demand,
                    step,
                    row,
                    top: band * step,
                    columns: &columns[..end],
                    first: run.start * step,
                    out,
                });
            }
        });
    }

    fn set_columns(&mut self, width: usize, cells_across: usize, step: usize) {
        let half = step / 2;
        let first = half as f32 + 0.5 - 0.5 * step as f32;
        let last = cells_across - 1;
        self.columns.clear();
        self.columns.extend((0..width).map(|x| match x.checked_sub(half) {
            Some(from_centre) if from_centre / step < last => Column {
                left: from_centre / step,
                right: from_centre / step + 1,
                part: ((from_centre % step) as f32 + first) / step as f32,
            },
            beyond => {
                let end = if beyond.is_some() { last } else { 0 };
                Column {
                    left: end,
                    right: end,
                    part: 0.0,
                }
            }
        }));
    }
}

/// Neighbouring cells of one row.
struct Stretch<'a> {
    image: &'a Image<Rgb8>,
    field: Option<&'a Mask>,
    demand: &'a Demand<'a>,
    step: usize,
    /// Of cells.
    row: usize,
    /// First row of pixels.
    top: usize,
    /// Up to the end of the cells.
    columns: &'a [Column],
    /// First column of pixels.
    first: usize,
    /// Whole rows of pixels, from `top` on.
    out: &'a mut [u8],
}

impl Kernel for Stretch<'_> {
    #[inline(always)]
    fn run(mut self) {
        for left in (self.first..self.columns.len()).step_by(CHUNK) {
            self.chunk(left..(left + CHUNK).min(self.columns.len()));
        }
    }
}

impl Stretch<'_> {
    #[inline(always)]
    fn chunk(&mut self, range: Range<usize>) {
        let (width, n) = (self.image.width(), range.len());
        let last_row = self.demand.level.height() - 1;
        // The bounds at these columns along the row of cells above, this one and the one below.
        let mut along = [[[0.0_f32; CHUNK]; 2]; 3];
        for (offset, along) in along.iter_mut().enumerate() {
            let row = (self.row + offset).saturating_sub(1).min(last_row);
            for (along, bound) in along.iter_mut().zip([self.demand.level, self.demand.white]) {
                let cells = bound.row(row);
                for (along, column) in along.iter_mut().zip(&self.columns[range.clone()]) {
                    let (left, right) = (cells[column.left], cells[column.right]);
                    *along = left + (right - left) * column.part;
                }
            }
        }
        for (line, out) in self.out.chunks_exact_mut(width).enumerate() {
            let y = self.top + line;
            let place = ((y as f32 + 0.5) / self.step as f32 - 0.5).clamp(0.0, last_row as f32);
            let upper = place as usize + 1 - self.row;
            let (Some([upper_level, upper_white]), Some([lower_level, lower_white])) = (along.get(upper), along.get(upper + 1))
            else {
                continue;
            };
            let mut padded = [[0; 3]; CHUNK];
            let from = &self.image.pixels()[y * width + range.start..];
            let pixels = from.first_chunk::<CHUNK>().unwrap_or_else(|| {
                padded[..n].copy_from_slice(&from[..n]);
                &padded
            });
            let (mut least, mut most) = ([0_u8; CHUNK], [0_u8; CHUNK]);
            for i in 0..CHUNK {
                let [r, g, b] = pixels[i];
                least[i] = r.min(g).min(b);
                most[i] = r.max(g).max(b);
            }
            let (part, whiteness) = (place.fract(), self.demand.whiteness);
            let higher = |a: f32, b: f32| if a > b { a } else { b };
            // 255 for all above zero: the sign spread over the number, where a comparison would be taken apart lane by lane.
            let met = |by: f32| (((0.0 - by).to_bits() as i32) >> 31) as u8;
            let mut marks = [0_u8; CHUNK];
            for i in 0..CHUNK {
                let (value, brightest) = (f32::from(least[i]), f32::from(most[i]));
                let level = upper_level[i] + (lower_level[i] - upper_level[i]) * part;
                let white = upper_white[i] + (lower_white[i] - upper_white[i]) * part;
                // By how much each demand is met.
                let clipped = value - (f32::from(CLIPPED_LEVEL) - 0.5);
                let white = value - whiteness * brightest - white;
                marks[i] = met(higher(clipped, lower(white, value - level)));
            }
            let out = &mut out[range.clone()];
            out.copy_from_slice(&marks[..n]);
            if let Some(field) = self.field {
                for (out, inside) in out.iter_mut().zip(&field.row(y)[range.clone()]) {
                    *out = if *inside == 0 { 0 } else { *out };
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};

    /// One pixel, the plainest way; `t` is found anew for every pixel.
    fn reference((image, field): (&Image<Rgb8>, &Mask), demand: &Demand<'_>, step: usize, (x, y): (usize, usize)) -> bool {
        let (across, down) = demand.level.size();
        let place = |i: usize, count: usize| ((i as f32 + 0.5) / step as f32 - 0.5).clamp(0.0, count as f32 - 1.0);
        let (u, v) = (place(x, across), place(y, down));
        let bound = |bound: &Image<f32>| {
            let (left, top) = (u as usize, v as usize);
            let (right, bottom) = ((left + 1).min(across - 1), (top + 1).min(down - 1));
            let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
            let down = |x: usize| mix(bound.at(x, top), bound.at(x, bottom), v.fract());
            mix(down(left), down(right), u.fract())
        };
        let [r, g, b] = image.at(x, y);
        let (least, most) = (r.min(g).min(b), r.max(g).max(b));
        let value = f32::from(least);
        let white = value - demand.whiteness * f32::from(most) >= bound(demand.white);
        field.at(x, y) != 0 && (least >= 250 || white && value > bound(demand.level))
    }

    #[test]
    fn agrees_with_its_plain_twin() {
        for (width, height, step) in [(70, 44, 8), (67, 31, 5), (23, 19, 1), (100, 90, 16), (61, 50, 20)] {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(step as u64);
            // Levels that differ from place to place, so that some cells are no candidates.
            let pixels = (0..width * height).map(|i| {
                let base = random.random_range(0..=1) * 60 + (i % width / (2 * step) % 3) as u8 * 60;
                std::array::from_fn(|_| base + random.random_range(0..=75))
            });
            let image = Image::from_vec(width, height, pixels.collect()).unwrap();
            let across_down = (width / step, height / step);
            // Away from whole levels, so that rounding decides nothing.
            let mut bound = |low: i32, high: i32| {
                let pixels = (0..across_down.0 * across_down.1)
                    .map(|_| random.random_range(low..high) as f32 + 0.497)
                    .collect();
                Image::from_vec(across_down.0, across_down.1, pixels).unwrap()
            };
            let (level, white) = (bound(100, 240), bound(-60, 0));
            let demand = Demand {
                level: &level,
                white: &white,
                whiteness: 0.72,
            };
            let mut steel = Image::filled(across_down.0, across_down.1, 0);
            steel.set(across_down.0 - 1, 1, 255);
            let mut field = Image::filled(width, height, 255);
            field.set(3, 3, 0);
            let mut cells = Cells::new();
            cells.average(&image, None, step);
            let mut classifier = Classifier::new();
            let (mut candidates, mut out) = (Image::filled(0, 0, 0), Image::filled(width, height, 0));
            classifier.candidates(&demand, &cells, &steel, &mut candidates);
            classifier.classify((&image, Some(&field)), &demand, (&candidates, step), &mut out);
            let mut differing = 0;
            for y in 0..height {
                for x in 0..width {
                    let cell = ((x / step).min(across_down.0 - 1), (y / step).min(across_down.1 - 1));
                    let expected = steel.at(cell.0, cell.1) == 0 && reference((&image, &field), &demand, step, (x, y));
                    differing += usize::from(out.at(x, y) != u8::from(expected) * 255);
                }
            }
            assert!(
                differing * 1000 <= width * height,
                "{differing} of {width}x{height} in cells of {step}"
            );
        }
    }
}
