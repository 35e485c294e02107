//! How far each pixel is from a mask, as the 3–4 chamfer distance (Borgefors 1986): two passes, within 8 % of Euclid.
//!
//! The pass along a row hands the distance on from pixel to pixel, which a processor does one by one. Up to [`LARGEST_FAST_LIMIT`] it
//! is done by doubling instead: after rounds with the neighbours 1, 2, 4, … px away every pixel knows all as far as the limit reaches.

use std::ops::Range;

use crate::image::buffer::{Image, Mask};
use crate::image::components::set_runs;
use crate::image::wide::{self, Kernel};

/// Chamfer units a pixel: a horizontal step costs 3, a diagonal one 4.
pub const UNITS_PER_PX: u16 = 3;
const DIAGONAL: u16 = 4;

/// So many pixels before a stretch are looked at with it.
const CONTEXT: usize = 96;
/// Pixels of a row treated at a time.
const STRETCH: usize = 448;
const BUFFER: usize = CONTEXT + STRETCH;
/// Six rounds of doubling hand a distance on to the 63 px beside it; the 64th is at this limit.
const SIX_ROUNDS_LIMIT: u16 = 64 * UNITS_PER_PX;
/// What is farther than the context is beyond this limit.
const LARGEST_FAST_LIMIT: u16 = CONTEXT as u16 * UNITS_PER_PX;

/// For each pixel the distance to the nearest non-zero pixel of `mask`, in thirds of a pixel, at most `limit`.
pub fn chamfer_distance(mask: &Mask, limit: u16, out: &mut Image<u16>) {
    if out.size() != mask.size() {
        out.resize(mask.width(), mask.height(), limit);
    }
    if mask.width() > 0 {
        wide::run(TwoPasses {
            cells: None,
            mask,
            limit,
            out,
        });
    }
}

/// The same for the pixels of the set cells, of `step` px; other pixels of `out` must hold `limit` or more and are left as they are.
/// Distances are right where every shortest way to the mask stays inside the set cells, and the mask must do so too. `out` must be of the
/// mask's size.
pub fn chamfer_distance_within((cells, step): (&Mask, usize), mask: &Mask, limit: u16, out: &mut Image<u16>) {
    if mask.width() > 0 && out.size() == mask.size() {
        wide::run(TwoPasses {
            cells: Some((cells, step)),
            mask,
            limit,
            out,
        });
    }
}

struct TwoPasses<'a> {
    /// Where, and the size of a cell; everywhere if `None`.
    cells: Option<(&'a Mask, usize)>,
    mask: &'a Mask,
    limit: u16,
    out: &'a mut Image<u16>,
}

impl TwoPasses<'_> {
    /// Where row `y` is looked at.
    #[inline(always)]
    fn stretches(cells: Option<(&Mask, usize)>, width: usize, y: usize) -> impl Iterator<Item = Range<usize>> {
        let everywhere = if cells.is_none() { Some(0..width) } else { None };
        let some = cells.into_iter().flat_map(move |(cells, step)| {
            let row = cells.row((y / step).min(cells.height() - 1));
            set_runs(row).map(move |run| run.start * step..if run.end == row.len() { width } else { run.end * step })
        });
        everywhere.into_iter().chain(some)
    }
}

impl Kernel for TwoPasses<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { cells, mask, limit, out } = self;
        let (width, height) = mask.size();
        let mut pass = Pass {
            limit,
            buffers: [[limit; BUFFER]; 2],
        };
        // A row far from everything is all limit, and so tells its neighbour nothing.
        let mut above_tells = false;
        for y in 0..height {
            let (before, rest) = out.pixels_mut().split_at_mut(y * width);
            let mut tells = false;
            for stretch in Self::stretches(cells, width, y) {
                let row = &mut rest[stretch.clone()];
                let mut set = 0;
                for (distance, &value) in row.iter_mut().zip(&mask.row(y)[stretch.clone()]) {
                    *distance = if value != 0 { 0 } else { limit };
                    set |= value;
                }
                if above_tells {
                    from_neighbour(row, &before[(y - 1) * width..], stretch);
                }
                if set != 0 || above_tells {
                    pass.rightward(row);
                    tells |= row.iter().fold(limit, |least, d| least.min(*d)) < limit;
                }
            }
            above_tells = tells;
        }
        let mut below_tells = false;
        for y in (0..height).rev() {
            let (before, rest) = out.pixels_mut().split_at_mut((y + 1) * width);
            let mut row_tells = false;
            for stretch in Self::stretches(cells, width, y) {
                let row = &mut before[y * width..][stretch.clone()];
                if below_tells {
                    from_neighbour(row, &rest[..width], stretch);
                }
                let tells = row.iter().fold(limit, |least, d| least.min(*d)) < limit;
                if tells {
                    pass.leftward(row);
                }
                row_tells |= tells;
            }
            below_tells = row_tells;
        }
    }
}

/// The steps down (or up) and diagonally, to a stretch of a row from the whole row `other`. Distances are at most the limit, so that
/// adding does not overflow unless the limit is next to the largest number there is.
#[inline(always)]
fn from_neighbour(row: &mut [u16], other: &[u16], stretch: Range<usize>) {
    for (distance, other) in row.iter_mut().zip(&other[stretch.clone()]) {
        *distance = (*distance).min(other.saturating_add(UNITS_PER_PX));
    }
    let first = usize::from(stretch.start == 0);
    for (distance, other) in row[first..].iter_mut().zip(&other[stretch.start + first - 1..]) {
        *distance = (*distance).min(other.saturating_add(DIAGONAL));
    }
    for (distance, other) in row.iter_mut().zip(&other[stretch.start + 1..]) {
        *distance = (*distance).min(other.saturating_add(DIAGONAL));
    }
}

/// The pass along a row.
struct Pass {
    limit: u16,
    buffers: [[u16; BUFFER]; 2],
}

impl Pass {
    #[inline(always)]
    fn rightward(&mut self, row: &mut [u16]) {
        if self.limit > LARGEST_FAST_LIMIT {
            for x in 1..row.len() {
                row[x] = row[x].min(row[x - 1].saturating_add(UNITS_PER_PX));
            }
            return;
        }
        for begin in (0..row.len()).step_by(STRETCH) {
            let end = (begin + STRETCH).min(row.len());
            let context = begin.min(CONTEXT);
            let source = &row[begin - context..end];
            if source.iter().fold(self.limit, |least, d| least.min(*d)) == self.limit {
                continue;
            }
            let [buffer, _] = &mut self.buffers;
            buffer[..CONTEXT - context].fill(self.limit);
            buffer[CONTEXT - context..CONTEXT + end - begin].copy_from_slice(source);
            buffer[CONTEXT + end - begin..].fill(self.limit);
            let [a, b] = &mut self.buffers;
            onto_right::<1>(a, b);
            onto_right::<2>(b, a);
            onto_right::<4>(a, b);
            onto_right::<8>(b, a);
            onto_right::<16>(a, b);
            onto_right::<32>(b, a);
            let result = if self.limit > SIX_ROUNDS_LIMIT {
                onto_right::<64>(a, b);
                b
            } else {
                a
            };
            row[begin..end].copy_from_slice(&result[CONTEXT..CONTEXT + end - begin]);
        }
    }

    #[inline(always)]
    fn leftward(&mut self, row: &mut [u16]) {
        if self.limit > LARGEST_FAST_LIMIT {
            for x in (1..row.len()).rev() {
                row[x - 1] = row[x - 1].min(row[x].saturating_add(UNITS_PER_PX));
            }
            return;
        }
        let mut end = row.len();
        while end > 0 {
            let begin = end.saturating_sub(STRETCH);
            let context = (row.len() - end).min(CONTEXT);
            let source = &row[begin..end + context];
            if source.iter().fold(self.limit, |least, d| least.min(*d)) < self.limit {
                let [buffer, _] = &mut self.buffers;
                buffer[..source.len()].copy_from_slice(source);
                buffer[source.len()..].fill(self.limit);
                let [a, b] = &mut self.buffers;
                onto_left::<1>(a, b);
                onto_left::<2>(b, a);
                onto_left::<4>(a, b);
                onto_left::<8>(b, a);
                onto_left::<16>(a, b);
                onto_left::<32>(b, a);
                let result = if self.limit > SIX_ROUNDS_LIMIT {
                    onto_left::<64>(a, b);
                    b
                } else {
                    a
                };
                row[begin..end].copy_from_slice(&result[..end - begin]);
            }
            end = begin;
        }
    }
}

/// Every pixel learns what the one `K` px left of it knows.
#[inline(always)]
fn onto_right<const K: usize>(from: &[u16; BUFFER], to: &mut [u16; BUFFER]) {
    to[..K].copy_from_slice(&from[..K]);
    for i in K..BUFFER {
        to[i] = from[i].min(from[i - K].wrapping_add(K as u16 * UNITS_PER_PX));
    }
}

/// Every pixel learns what the one `K` px right of it knows.
#[inline(always)]
fn onto_left<const K: usize>(from: &[u16; BUFFER], to: &mut [u16; BUFFER]) {
    for i in 0..BUFFER - K {
        to[i] = from[i].min(from[i + K].wrapping_add(K as u16 * UNITS_PER_PX));
    }
    to[BUFFER - K..].copy_from_slice(&from[BUFFER - K..]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_near_the_euclidean_distance() {
        let mut mask = Image::filled(41, 31, 0);
        mask.set(20, 15, 255);
        mask.set(3, 28, 255);
        let mut out = Image::filled(0, 0, 0);
        chamfer_distance(&mask, 3000, &mut out);
        for y in 0..31 {
            for x in 0..41 {
                let euclid = [(20.0, 15.0), (3.0, 28.0)]
                    .iter()
                    .map(|&(u, v): &(f64, f64)| (x as f64 - u).hypot(y as f64 - v))
                    .fold(f64::MAX, f64::min);
                let found = f64::from(out.at(x, y)) / f64::from(UNITS_PER_PX);
                assert!(
                    (found - euclid).abs() <= 0.081 * euclid + 1e-9,
                    "({x}, {y}): {found} against {euclid}"
                );
            }
        }
    }

    /// The chamfer distance between two pixels has a closed form.
    fn reference(mask: &Mask, limit: u16, x: usize, y: usize) -> u16 {
        let set = (0..mask.height()).flat_map(|v| (0..mask.width()).map(move |u| (u, v)));
        set.filter(|&(u, v)| mask.at(u, v) != 0)
            .map(|(u, v)| {
                let (dx, dy) = (x.abs_diff(u), y.abs_diff(v));
                (3 * dx.max(dy) + dx.min(dy)) as u16
            })
            .fold(limit, u16::min)
    }

    #[test]
    fn equals_its_plain_twin() {
        for (width, height, limit, places) in [
            (1100, 9, 180, 7),
            (450, 25, 55, 5),
            (1, 40, 30, 2),
            (900, 3, 192, 1),
            (900, 3, 193, 1),
            (1920, 5, 241, 3),
            (1100, 4, 288, 2),
            (600, 4, 289, 2),
            (70, 60, 500, 3),
            (30, 20, 55, 0),
        ] {
            let mut mask = Image::filled(width, height, 0);
            for i in 0..places {
                mask.set((i * 7919 + 446) % width, (i * 104_729) % height, 1);
            }
            let mut out = Image::filled(0, 0, 0);
            // Twice, as what an image held before must not matter.
            chamfer_distance(&mask, 9, &mut out);
            chamfer_distance(&mask, limit, &mut out);
            for y in 0..height {
                for x in 0..width {
                    assert_eq!(out.at(x, y), reference(&mask, limit, x, y), "({x}, {y}) of {width}x{height}");
                }
            }
        }
    }

    #[test]
    fn within_cells_agrees_with_everywhere() {
        let (width, height, step) = (150, 61, 7);
        let mut mask = Image::filled(width, height, 0);
        for (x, y) in [(3, 2), (80, 30), (84, 31), (149, 60)] {
            mask.set(x, y, 255);
        }
        let (limit, reach) = (31, 11);
        let mut everywhere = Image::filled(0, 0, 0);
        chamfer_distance(&mask, limit, &mut everywhere);
        let (across, down) = (width / step, height / step);
        let mut cells = Image::filled(across, down, 0);
        for y in 0..height {
            for x in 0..width {
                let near = |x: usize, y: usize| x < width && y < height && mask.at(x, y) != 0;
                let reached =
                    (y.saturating_sub(reach)..=y + reach).any(|v| (x.saturating_sub(reach)..=x + reach).any(|u| near(u, v)));
                if reached {
                    cells.set((x / step).min(across - 1), (y / step).min(down - 1), 255);
                }
            }
        }
        let mut within = Image::filled(width, height, u16::MAX);
        chamfer_distance_within((&cells, step), &mask, limit, &mut within);
        for (found, expected) in within.pixels().iter().zip(everywhere.pixels()) {
            assert_eq!((*found).min(limit), *expected);
        }
        assert!(within.pixels().contains(&u16::MAX));
    }
}
