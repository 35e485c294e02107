//! How far each pixel is from a mask, as the 3–4 chamfer distance (Borgefors 1986): two passes, within 8 % of Euclid.
//!
//! The pass along a row hands the distance on from pixel to pixel, which a processor does one by one. Up to [`LARGEST_FAST_LIMIT`] it
//! is done by doubling instead: after rounds with the neighbours 1, 2, 4, … px away every pixel knows all as far as the limit reaches.

use crate::image::buffer::{Image, Mask};
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
        wide::run(TwoPasses { mask, limit, out });
    }
}

struct TwoPasses<'a> {
    mask: &'a Mask,
    limit: u16,
    out: &'a mut Image<u16>,
}

impl Kernel for TwoPasses<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { mask, limit, out } = self;
        let (width, height) = mask.size();
        let mut pass = Pass {
            limit,
            buffers: [[limit; BUFFER]; 2],
        };
        // A row far from everything is all limit, and so tells its neighbour nothing.
        let mut above_tells = false;
        for y in 0..height {
            let (before, rest) = out.pixels_mut().split_at_mut(y * width);
            let row = &mut rest[..width];
            let mut set = 0;
            for (distance, &value) in row.iter_mut().zip(mask.row(y)) {
                *distance = if value != 0 { 0 } else { limit };
                set |= value;
            }
            if above_tells {
                from_neighbour(row, &before[(y - 1) * width..]);
            }
            if set != 0 || above_tells {
                pass.rightward(row);
                above_tells = row.iter().fold(limit, |least, d| least.min(*d)) < limit;
            }
        }
        let mut below_tells = false;
        for y in (0..height).rev() {
            let (before, rest) = out.pixels_mut().split_at_mut((y + 1) * width);
            let row = &mut before[y * width..];
            if below_tells {
                from_neighbour(row, &rest[..width]);
            }
            let tells = row.iter().fold(limit, |least, d| least.min(*d)) < limit;
            if tells {
                pass.leftward(row);
            }
            below_tells = tells;
        }
    }
}

/// The steps down (or up) and diagonally. Distances are at most the limit, so that adding does not overflow unless the limit is
/// next to the largest number there is.
#[inline(always)]
fn from_neighbour(row: &mut [u16], other: &[u16]) {
    for (distance, other) in row.iter_mut().zip(other) {
        *distance = (*distance).min(other.saturating_add(UNITS_PER_PX));
    }
    for (distance, other) in row[1..].iter_mut().zip(other) {
        *distance = (*distance).min(other.saturating_add(DIAGONAL));
    }
    for (distance, other) in row.iter_mut().zip(&other[1..]) {
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
}
