//! Every pixel held against bounds that are interpolated between the centres of cells: along each row of cells once, then down to each
//! row of pixels.

use rayon::prelude::*;

use crate::image::buffer::Mask;
use crate::image::specularity::background::Bounds;
use crate::image::specularity::cells::Extremes;
use crate::image::wide::{self, Kernel};

/// In the darkest channel, clipped.
const CLIPPED_LEVEL: f32 = 250.0;
/// Pixels judged at a time.
const CHUNK: usize = 64;

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
    /// See [`Settings::core_whiteness`](crate::image::specularity::Settings::core_whiteness).
    pub core_whiteness: f32,
}

/// Holds pixels against bounds; owns its working memory.
#[derive(Debug, Default)]
pub(super) struct Classifier {
    /// For each pixel right of a cell's centre, how far it is on the way to the next.
    between: Vec<f32>,
    /// Per row of cells the bounds at every pixel column: core, halo, white, white of a core.
    along: Vec<[Vec<f32>; 4]>,
}

impl Classifier {
    /// 255 in `cores` and in `halos` where a pixel exceeds their bounds.
    pub fn classify(&mut self, extremes: &Extremes, rules: &Rules<'_>, cores: &mut Mask, halos: &mut Mask) {
        let width = cores.width();
        self.spread(rules, width);
        let (cells_down, step) = (self.along.len(), rules.step);
        let along = &self.along;
        let rows = cores
            .pixels_mut()
            .par_chunks_mut(width)
            .zip(halos.pixels_mut().par_chunks_mut(width));
        rows.enumerate().for_each(|(y, (cores, halos))| {
            let place = ((y as f32 + 0.5) / step as f32 - 0.5).clamp(0.0, cells_down as f32 - 1.0);
            let top = place as usize;
            let pixels = y * width..(y + 1) * width;
            wide::run(PixelRow {
                least: &extremes.least[pixels.clone()],
                most: &extremes.most[pixels],
                top: &along[top],
                bottom: &along[(top + 1).min(cells_down - 1)],
                part: place.fract(),
                whiteness: [rules.whiteness, rules.core_whiteness],
                cores,
                halos,
            });
            let steel = rules.steel.row((y / step).min(cells_down - 1));
            for (cell, _) in steel.iter().enumerate().filter(|(_, s)| **s != 0) {
                let end = if cell + 1 == steel.len() { width } else { (cell + 1) * step };
                cores[cell * step..end].fill(0);
                halos[cell * step..end].fill(0);
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

    /// Interpolate the bounds along the rows of cells.
    fn spread(&mut self, rules: &Rules<'_>, width: usize) {
        let (step, cells_down) = (rules.step, rules.steel.height());
        let first = (step / 2) as f32 + 0.5 - 0.5 * step as f32;
        self.between.clear();
        self.between
            .extend((0..step).map(|column| (column as f32 + first) / step as f32));
        self.along.resize_with(cells_down, <[Vec<f32>; 4]>::default);
        let between = &self.between;
        let Bounds {
            core,
            halo,
            white,
            core_white,
        } = rules.bounds;
        let bounds = [core, halo, white, core_white];
        self.along.par_iter_mut().enumerate().for_each(|(row, along)| {
            for (out, bound) in along.iter_mut().zip(bounds) {
                out.resize(width, 0.0);
                let cells = bound.row(row);
                let (half, last) = (step / 2, cells.len() - 1);
                out[..half].fill(cells[0]);
                let stretches = out[half..half + last * step].chunks_exact_mut(step);
                for (stretch, ends) in stretches.zip(cells.windows(2)) {
                    let slope = ends[1] - ends[0];
                    for (out, t) in stretch.iter_mut().zip(between) {
                        *out = ends[0] + slope * t;
                    }
                }
                out[half + last * step..].fill(cells[last]);
            }
        });
    }
}

struct PixelRow<'a> {
    least: &'a [u8],
    most: &'a [u8],
    /// Bounds along the rows of cells above and below.
    top: &'a [Vec<f32>; 4],
    bottom: &'a [Vec<f32>; 4],
    /// How far from the one to the other.
    part: f32,
    /// Of halos, of cores.
    whiteness: [f32; 2],
    cores: &'a mut [u8],
    halos: &'a mut [u8],
}

impl Kernel for PixelRow<'_> {
    #[inline(always)]
    fn run(mut self) {
        let n = self.cores.len();
        if n < CHUNK {
            (0..n).for_each(|at| self.judge::<1>(at));
            return;
        }
        for at in (0..n - CHUNK).step_by(CHUNK) {
            self.judge::<CHUNK>(at);
        }
        // The last chunk may judge some pixels again.
        self.judge::<CHUNK>(n - CHUNK);
    }
}

impl PixelRow<'_> {
    /// `N` pixels, a number known to the compiler. In floats, and without a decision before the end: in mixed widths it would not stay
    /// in vector registers.
    #[inline(always)]
    fn judge<const N: usize>(&mut self, at: usize) {
        let (part, whiteness) = (self.part, self.whiteness);
        let bounds = |k: usize| {
            Some((
                self.top[k].get(at..)?.first_chunk::<N>()?,
                self.bottom[k].get(at..)?.first_chunk::<N>()?,
            ))
        };
        let levels = (self.least[at..].first_chunk::<N>(), self.most[at..].first_chunk::<N>());
        let out = (
            self.cores[at..].first_chunk_mut::<N>(),
            self.halos[at..].first_chunk_mut::<N>(),
        );
        let (Some(core), Some(halo), Some(white), Some(core_white)) = (bounds(0), bounds(1), bounds(2), bounds(3)) else {
            return;
        };
        let ((Some(least), Some(most)), (Some(cores), Some(halos))) = (levels, out) else {
            return;
        };
        let lower = |a: f32, b: f32| if a < b { a } else { b };
        let higher = |a: f32, b: f32| if a > b { a } else { b };
        // 255 for all above zero: the sign spread over the number, where a comparison would be taken apart lane by lane.
        let met = |by: f32| (((0.0 - by).to_bits() as i32) >> 31) as u8;
        for i in 0..N {
            let bound = |(top, bottom): (&[f32; N], &[f32; N])| top[i] + (bottom[i] - top[i]) * part;
            let (value, brightest) = (f32::from(least[i]), f32::from(most[i]));
            // By how much each demand is met.
            let white = value - whiteness[0] * brightest - bound(white);
            let core_white = value - whiteness[1] * brightest - bound(core_white);
            let clipped = value - (CLIPPED_LEVEL - 0.5);
            cores[i] = met(higher(clipped, lower(core_white, value - bound(core))));
            halos[i] = met(higher(clipped, lower(white, value - bound(halo))));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::buffer::Image;
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
        let white = |share: f32, limit: f32| value - share * f32::from(most) >= limit;
        let beyond = |limit: f32, white: bool| free && (least >= 250 || white && value > limit);
        (
            beyond(
                bound(&rules.bounds.core),
                white(rules.core_whiteness, bound(&rules.bounds.core_white)),
            ),
            beyond(bound(&rules.bounds.halo), white(rules.whiteness, bound(&rules.bounds.white))),
        )
    }

    #[test]
    fn agrees_with_its_plain_twin() {
        for (width, height, step) in [(70, 44, 8), (67, 31, 5), (23, 19, 1), (100, 90, 16), (61, 50, 20)] {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(step as u64);
            let mut plane = || {
                (0..width * height)
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
                core_white: bound(-90, 0),
            };
            let mut steel = Image::filled(cells.0, cells.1, 0);
            steel.set(cells.0 - 1, 1, 255);
            let mut field = Image::filled(width, height, 255);
            field.set(3, 3, 0);
            let rules = Rules {
                bounds: &bounds,
                steel: &steel,
                field: Some(&field),
                step,
                whiteness: 0.72,
                core_whiteness: 1.0,
            };
            let (mut cores, mut halos) = (Image::filled(width, height, 7), Image::filled(width, height, 7));
            Classifier::default().classify(&extremes, &rules, &mut cores, &mut halos);
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
