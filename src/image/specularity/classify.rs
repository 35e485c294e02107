//! Every pixel held against bounds that are interpolated between the centres of cells.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask};
use crate::image::specularity::background::Bounds;
use crate::image::specularity::cells::{Extremes, LANES};
use crate::image::wide::{self, Kernel};

/// In the darkest channel, clipped.
const CLIPPED_LEVEL: f32 = 250.0;
/// Pixels on the stack at a time: one stretch between centres is written through here, and what it writes too much is written over.
const STRETCH: usize = 512;

/// What decides about a pixel beside its color.
#[derive(Debug)]
pub(super) struct Rules<'a> {
    /// Per cell.
    pub bounds: &'a Bounds,
    /// Per cell: 255 where nothing shines.
    pub steel: &'a Mask,
    /// Per pixel: 0 where nothing shines.
    pub field: Option<&'a Mask>,
    /// Edge of a cell, px.
    pub step: usize,
    /// See [`Settings::whiteness`](crate::image::specularity::Settings::whiteness).
    pub whiteness: f32,
    /// Filled by [`place_between_centres`].
    pub between: &'a [f32],
}

/// For each pixel right of a cell's centre, how far it is on the way to the next; longer than a cell, as a stretch at the border may be.
pub(super) fn place_between_centres(step: usize, out: &mut Vec<f32>) {
    let first = (step / 2) as f32 + 0.5 - 0.5 * step as f32;
    out.clear();
    out.extend((0..2 * step + LANES).map(|column| (column as f32 + first) / step as f32));
}

/// 255 in `cores` and in `halos` where a pixel exceeds their bounds.
pub(super) fn classify(extremes: &Extremes, rules: &Rules<'_>, cores: &mut Mask, halos: &mut Mask) {
    let width = cores.width();
    let steel_rows = rules.steel.height();
    let rows = cores
        .pixels_mut()
        .par_chunks_mut(width)
        .zip(halos.pixels_mut().par_chunks_mut(width));
    rows.enumerate().for_each(|(y, (cores, halos))| {
        let at = y * width;
        wide::run(PixelRow {
            least: &extremes.least[at..at + width + LANES],
            most: &extremes.most[at..at + width + LANES],
            y,
            rules,
            cores,
            halos,
        });
        let steel = rules.steel.row((y / rules.step).min(steel_rows - 1));
        if steel.iter().any(|&s| s != 0) {
            for (cell, _) in steel.iter().enumerate().filter(|(_, s)| **s != 0) {
                let end = if cell + 1 == steel.len() {
                    width
                } else {
                    (cell + 1) * rules.step
                };
                cores[cell * rules.step..end].fill(0);
                halos[cell * rules.step..end].fill(0);
            }
        }
        if let Some(field) = rules.field {
            for ((core, halo), inside) in cores.iter_mut().zip(halos.iter_mut()).zip(field.row(y)) {
                let outside = *inside == 0;
                *core = if outside { 0 } else { *core };
                *halo = if outside { 0 } else { *halo };
            }
        }
    });
}

struct PixelRow<'a> {
    /// With [`LANES`] more.
    least: &'a [u8],
    most: &'a [u8],
    y: usize,
    rules: &'a Rules<'a>,
    cores: &'a mut [u8],
    halos: &'a mut [u8],
}

/// Bounds along a row between two centres: the first centre's, and the difference to the second.
#[derive(Clone, Copy)]
struct Slopes {
    core: (f32, f32),
    halo: (f32, f32),
    white: (f32, f32),
}

impl Kernel for PixelRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Rules {
            bounds,
            step,
            whiteness,
            between,
            ..
        } = *self.rules;
        let (across, down) = bounds.core.size();
        let place = ((self.y as f32 + 0.5) / step as f32 - 0.5).clamp(0.0, down as f32 - 1.0);
        let (top, part) = (place as usize, place.fract());
        let bottom = (top + 1).min(down - 1);
        let along = |bound: &Image<f32>, a: usize, b: usize| {
            let (top, bottom) = (bound.row(top), bound.row(bottom));
            let (a, b) = (top[a] + (bottom[a] - top[a]) * part, top[b] + (bottom[b] - top[b]) * part);
            (a, b - a)
        };
        let width = self.cores.len();
        let mut begin = 0;
        // Between the centres of two cells all bounds are linear.
        for right in 0..=across {
            let end = if right == across {
                width
            } else {
                (right * step + step / 2).min(width)
            };
            let (a, b) = (right.max(1) - 1, right.min(across - 1));
            let slopes = Slopes {
                core: along(&bounds.core, a, b),
                halo: along(&bounds.halo, a, b),
                white: along(&bounds.white, a, b),
            };
            let n = end.saturating_sub(begin);
            let (mut cores, mut halos) = ([0; STRETCH], [0; STRETCH]);
            for lane in (0..n).step_by(LANES) {
                let at = begin + lane;
                let lanes = (self.least[at..].first_chunk(), self.most[at..].first_chunk());
                let lanes = (lanes.0, lanes.1, between[lane..].first_chunk());
                if let (Some(least), Some(most), Some(between)) = lanes {
                    let found = judge(least, most, between, &slopes, whiteness);
                    cores[lane..lane + LANES].copy_from_slice(&found.0);
                    halos[lane..lane + LANES].copy_from_slice(&found.1);
                }
            }
            self.cores[begin..begin + n].copy_from_slice(&cores[..n]);
            self.halos[begin..begin + n].copy_from_slice(&halos[..n]);
            begin = end.max(begin);
        }
    }
}

/// Everything in 32 bits until the end: in mixed widths the compiler would not stay in vector registers.
#[inline(always)]
fn judge(
    least: &[u8; LANES],
    most: &[u8; LANES],
    between: &[f32; LANES],
    slopes: &Slopes,
    whiteness: f32,
) -> ([u8; LANES], [u8; LANES]) {
    let (mut cores, mut halos) = ([0_u32; LANES], [0_u32; LANES]);
    for i in 0..LANES {
        let (value, brightest, t) = (f32::from(least[i]), f32::from(most[i]), between[i]);
        let bound = |(start, slope): (f32, f32)| start + slope * t;
        let white = value - whiteness * brightest >= bound(slopes.white);
        let clipped = value >= CLIPPED_LEVEL;
        cores[i] = u32::from(clipped | (white & (value > bound(slopes.core)))) * 255;
        halos[i] = u32::from(clipped | (white & (value > bound(slopes.halo)))) * 255;
    }
    (cores.map(|v| v as u8), halos.map(|v| v as u8))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};

    /// One pixel, the plainest way; `t` is found anew for every pixel.
    fn reference(extremes: &Extremes, rules: &Rules<'_>, (width, x, y): (usize, usize, usize)) -> (bool, bool) {
        let (across, down) = rules.bounds.core.size();
        let place = |i: usize, count: usize| ((i as f32 + 0.5) / rules.step as f32 - 0.5).clamp(0.0, count as f32 - 1.0);
        let (u, v) = (place(x, across), place(y, down));
        let bound = |bound: &Image<f32>| {
            let (left, top) = (u as usize, v as usize);
            let (right, bottom) = ((left + 1).min(across - 1), (top + 1).min(down - 1));
            let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
            let down = |x: usize| mix(bound.at(x, top), bound.at(x, bottom), v.fract());
            mix(down(left), down(right), u.fract())
        };
        let cell = ((x / rules.step).min(across - 1), (y / rules.step).min(down - 1));
        let free = rules.steel.at(cell.0, cell.1) == 0 && rules.field.is_none_or(|field| field.at(x, y) != 0);
        let (least, most) = (extremes.least[y * width + x], extremes.most[y * width + x]);
        let value = f32::from(least);
        let white = value - rules.whiteness * f32::from(most) >= bound(&rules.bounds.white);
        let beyond = |limit: f32| free && (least >= 250 || white && value > limit);
        (beyond(bound(&rules.bounds.core)), beyond(bound(&rules.bounds.halo)))
    }

    #[test]
    fn agrees_with_its_plain_twin() {
        for (width, height, step) in [(70, 44, 8), (67, 31, 5), (23, 19, 1), (100, 90, 16), (61, 50, 20)] {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(step as u64);
            let mut plane = || {
                (0..width * height + LANES)
                    .map(|_| random.random_range(60..=255))
                    .collect::<Vec<u8>>()
            };
            let (a, b) = (plane(), plane());
            let extremes = Extremes {
                least: a.iter().zip(&b).map(|(a, b)| *a.min(b)).collect(),
                most: a.iter().zip(&b).map(|(a, b)| *a.max(b)).collect(),
            };
            let cells = (width / step, height / step);
            // Away from whole levels, so that rounding decides nothing.
            let mut bound = |low: i32, high: i32| {
                let pixels = (0..cells.0 * cells.1)
                    .map(|_| random.random_range(low..high) as f32 + 0.497)
                    .collect();
                Image::from_vec(cells.0, cells.1, pixels).unwrap()
            };
            let bounds = Bounds {
                core: bound(100, 240),
                halo: bound(80, 200),
                white: bound(-60, 0),
            };
            let mut steel = Image::filled(cells.0, cells.1, 0);
            steel.set(cells.0 - 1, 1, 255);
            let mut field = Image::filled(width, height, 255);
            field.set(3, 3, 0);
            let mut between = Vec::new();
            place_between_centres(step, &mut between);
            let rules = Rules {
                bounds: &bounds,
                steel: &steel,
                field: Some(&field),
                step,
                whiteness: 0.72,
                between: &between,
            };
            let (mut cores, mut halos) = (Image::filled(width, height, 7), Image::filled(width, height, 7));
            classify(&extremes, &rules, &mut cores, &mut halos);
            let mut differing = 0;
            for y in 0..height {
                for x in 0..width {
                    let (core, halo) = reference(&extremes, &rules, (width, x, y));
                    let found = (cores.at(x, y), halos.at(x, y));
                    differing += usize::from(found != (u8::from(core) * 255, u8::from(halo) * 255));
                }
            }
            assert!(
                differing * 1000 <= width * height,
                "{differing} of {width}x{height} in cells of {step}"
            );
        }
    }
}
