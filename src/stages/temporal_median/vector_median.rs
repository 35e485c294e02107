//! The median of 3, 5 or 7 colors per pixel.
//!
//! The vector median of colors x_1 … x_n is the x_i with the smallest Σ_j ‖x_i − x_j‖ (Astola, Haavisto, Neuvo, Vector
//! median filters, Proc. IEEE 78(4), 1990, doi:10.1109/5.54807): it is always one of the colors that were seen. Of equal
//! sums the newest wins.
//!
//! Everything is computed in one width and chosen by selection instead of branches, so that the compiler keeps the whole competition
//! in vector registers (in mixed widths it was ten times slower). The sum of absolute differences is first tried in u8, 32 pixels at a
//! time, with additions that stop at 255: where the winner's sum stays below, it is exact and so is the choice. Colors that lie so far
//! apart that it does not are rare; their tile is done again in i16, as are the other medians.

use crate::image::buffer::Rgb8;
use crate::image::wide::Kernel;
use crate::stages::temporal_median::history::{Planes, TILE, Tile};
use crate::stages::temporal_median::settings::{Distance, Method};

/// A color, widened.
pub type Wide = [i16; 3];

/// One run of consecutive pixels.
#[derive(Debug)]
pub struct Run<'a, const N: usize> {
    /// The window, newest first.
    pub window: [&'a Planes; N],
    /// Index of the run's first pixel.
    pub start: usize,
    /// The median.
    pub median: &'a mut [Rgb8],
    /// 255 where the newest color departs from the median by more than `threshold` in some channel.
    pub departs: &'a mut [u8],
    /// Gray levels.
    pub threshold: u8,
    /// Which median.
    pub method: Method,
    /// Which distance.
    pub distance: Distance,
}

impl<const N: usize> Kernel for Run<'_, N>
where
    [Wide; N]: Colors<N>,
{
    #[inline(always)]
    fn run(self) {
        match (self.method, self.distance) {
            (Method::Marginal, _) => self.by::<Marginal>(),
            (Method::Vector, Distance::L1) => self.by::<VectorL1>(),
            (Method::Vector, Distance::L2) => self.by::<VectorL2>(),
        }
    }
}

impl<const N: usize> Run<'_, N>
where
    [Wide; N]: Colors<N>,
{
    #[inline(always)]
    fn by<M: Median>(self) {
        let Self {
            window,
            start,
            mut median,
            mut departs,
            threshold,
            ..
        } = self;
        let mut at = start;
        let mut results = [[0; TILE]; 4];
        while !median.is_empty() && !departs.is_empty() {
            // Before the run's start and past its end the neighbours are computed along.
            let skipped = at % TILE;
            let n = median.len().min(departs.len()).min(TILE - skipped);
            let mut colors = [&NO_TILE; N];
            for (colors, planes) in colors.iter_mut().zip(&window) {
                if let Some(tile) = planes.color.get(at / TILE) {
                    *colors = tile;
                }
            }
            if !M::narrow(&colors, threshold, &mut results) {
                wide_tile::<N, M>(&colors, threshold, &mut results);
            }
            let (to, to_departs);
            (to, median) = median.split_at_mut(n);
            (to_departs, departs) = departs.split_at_mut(n);
            match (to.first_chunk_mut::<TILE>(), to_departs.first_chunk_mut::<TILE>()) {
                (Some(to), Some(to_departs)) => {
                    join(&results, to);
                    *to_departs = results[3];
                }
                _ => {
                    let mut pixels = [[0; 3]; TILE];
                    join(&results, &mut pixels);
                    to.copy_from_slice(&pixels[skipped..skipped + n]);
                    to_departs.copy_from_slice(&results[3][skipped..skipped + n]);
                }
            }
            at += n;
        }
    }
}

/// Stands in for tiles past the picture's end.
static NO_TILE: Tile = [[0; TILE]; 3];

/// Red, green and blue of a tile's median, and 255 where the newest color departs from it.
type Results = [[u8; TILE]; 4];

#[inline(always)]
fn join([red, green, blue, _]: &Results, pixels: &mut [Rgb8; TILE]) {
    for i in 0..TILE {
        pixels[i] = [red[i], green[i], blue[i]];
    }
}

/// The median of a tile in i16.
#[inline(always)]
fn wide_tile<const N: usize, M: Median>(colors: &[&Tile; N], threshold: u8, results: &mut Results)
where
    [Wide; N]: Colors<N>,
{
    // The window and the results lie in local arrays of fixed length: nothing else can point to them and no index can
    // leave them, so the compiler vectorizes without asking.
    let mut wide = [[[0_i16; TILE]; 3]; N];
    for (wide, colors) in wide.iter_mut().zip(colors) {
        for (wide, levels) in wide.iter_mut().zip(colors.iter()) {
            *wide = widened(levels);
        }
    }
    let mut wide_results = [[0_i16; TILE]; 4];
    let threshold = i16::from(threshold);
    let [red, green, blue, far] = &mut wide_results;
    for i in 0..TILE {
        let pixel = <[Wide; N]>::gather(&wide, i);
        let [r, g, b] = M::of(pixel);
        let [now_r, now_g, now_b] = pixel[0];
        let apart = |a: i16, b: i16| a.wrapping_sub(b).wrapping_abs();
        let apart = apart(r, now_r).max(apart(g, now_g)).max(apart(b, now_b));
        far[i] = if apart > threshold { 255 } else { 0 };
        red[i] = r;
        green[i] = g;
        blue[i] = b;
    }
    *results = [narrowed(red), narrowed(green), narrowed(blue), narrowed(far)];
}

/// The same as [`wide_tile`] for sums of absolute differences, in u8; false where that is too narrow.
#[inline(always)]
fn narrow_tile<const N: usize>(colors: &[&Tile; N], threshold: u8, results: &mut Results) -> bool
where
    [Wide; N]: Colors<N>,
{
    let mut sums = [0_u8; TILE];
    let [red, green, blue, far] = results;
    for i in 0..TILE {
        let ([r, g, b], sum) = <[Wide; N]>::narrow_vector_median(colors, i);
        let [now_r, now_g, now_b] = [colors[0][0][i], colors[0][1][i], colors[0][2][i]];
        let apart = r.abs_diff(now_r).max(g.abs_diff(now_g)).max(b.abs_diff(now_b));
        far[i] = if apart > threshold { 255 } else { 0 };
        red[i] = r;
        green[i] = g;
        blue[i] = b;
        sums[i] = sum;
    }
    let largest = sums.iter().fold(0, |largest: u8, sum| largest.max(*sum));
    largest < u8::MAX
}

#[inline(always)]
fn widened(levels: &[u8; TILE]) -> [i16; TILE] {
    let mut wide = [0; TILE];
    for i in 0..TILE {
        wide[i] = i16::from(levels[i]);
    }
    wide
}

/// One of the medians. A closure would do, but cannot be forced inline: where the compiler leaves it outside, the loop is scalar and
/// ten times slower.
trait Median {
    fn of<const N: usize>(colors: [Wide; N]) -> Wide
    where
        [Wide; N]: Colors<N>;

    /// See [`narrow_tile`].
    #[inline(always)]
    fn narrow<const N: usize>(_colors: &[&Tile; N], _threshold: u8, _results: &mut Results) -> bool
    where
        [Wide; N]: Colors<N>,
    {
        false
    }
}

struct Marginal;
struct VectorL1;
struct VectorL2;

impl Median for Marginal {
    #[inline(always)]
    fn of<const N: usize>(colors: [Wide; N]) -> Wide
    where
        [Wide; N]: Colors<N>,
    {
        colors.marginal_median()
    }
}

impl Median for VectorL1 {
    #[inline(always)]
    fn of<const N: usize>(colors: [Wide; N]) -> Wide
    where
        [Wide; N]: Colors<N>,
    {
        colors.vector_median(l1)
    }

    #[inline(always)]
    fn narrow<const N: usize>(colors: &[&Tile; N], threshold: u8, results: &mut Results) -> bool
    where
        [Wide; N]: Colors<N>,
    {
        narrow_tile(colors, threshold, results)
    }
}

impl Median for VectorL2 {
    #[inline(always)]
    fn of<const N: usize>(colors: [Wide; N]) -> Wide
    where
        [Wide; N]: Colors<N>,
    {
        colors.vector_median(l2)
    }
}

#[inline(always)]
fn narrowed(levels: &[i16; TILE]) -> [u8; TILE] {
    let mut narrow = [0; TILE];
    for i in 0..TILE {
        narrow[i] = levels[i] as u8;
    }
    narrow
}

#[inline(always)]
fn l1(a: Wide, b: Wide) -> i16 {
    // Nothing can overflow; wrapping arithmetic says so to builds that check, which could not vectorize otherwise.
    let apart = |c: usize| a[c].wrapping_sub(b[c]).wrapping_abs();
    apart(0).wrapping_add(apart(1)).wrapping_add(apart(2))
}

/// Euclidean distance in units of 1/8 level: six of them still fit into 16 bits (6 · 441.7 · 8 = 21 200).
#[inline(always)]
fn l2(a: Wide, b: Wide) -> i16 {
    let [r, g, b] = [0, 1, 2].map(|c| f32::from(a[c].wrapping_sub(b[c])));
    // The integer in the low bits, as a plain conversion would give, but with a vector instruction.
    ((r * r + g * g + b * b).sqrt() * 8.0 + 8_388_608.0).to_bits() as i16
}

/// The colors one pixel had, newest first.
pub trait Colors<const N: usize> {
    /// Pixel `at` of each frame.
    fn gather(planes: &[[[i16; TILE]; 3]; N], at: usize) -> Self;
    /// Of pixel `at` of each frame the color with the smallest summed L1 distance to the others, and that sum, at most 255: only below
    /// are both exact.
    fn narrow_vector_median(planes: &[&Tile; N], at: usize) -> (Rgb8, u8);
    /// The color with the smallest summed distance to the others.
    fn vector_median(self, distance: impl Fn(Wide, Wide) -> i16) -> Wide;
    /// The median of each channel.
    fn marginal_median(self) -> Wide;
}

/// Written out for each length: loops over so few colors, left to the compiler, keep it from vectorizing over the pixels.
/// The last list is an exchange network that leaves the median in the middle (Paeth, Graphics Gems I, 1990; Devillard 1998).
macro_rules! colors {
    ($n:literal, $middle:literal; [$($all:literal)*]; [$($later:literal)*]; [$(($i:literal, $j:literal)),*];
        [$(($low:literal, $high:literal)),*]) => {
        impl Colors<$n> for [Wide; $n] {
            #[inline(always)]
            fn gather(planes: &[[[i16; TILE]; 3]; $n], at: usize) -> Self {
                [$([planes[$all][0][at], planes[$all][1][at], planes[$all][2][at]]),*]
            }

            #[inline(always)]
            fn narrow_vector_median(planes: &[&Tile; $n], at: usize) -> (Rgb8, u8) {
                let colors = [$([planes[$all][0][at], planes[$all][1][at], planes[$all][2][at]]),*];
                let mut sums = [0_u8; $n];
                $(
                    let (a, b) = (colors[$i], colors[$j]);
                    let apart = a[0].abs_diff(b[0]).saturating_add(a[1].abs_diff(b[1])).saturating_add(a[2].abs_diff(b[2]));
                    sums[$i] = sums[$i].saturating_add(apart);
                    sums[$j] = sums[$j].saturating_add(apart);
                )*
                let mut least = sums[0];
                let [mut r, mut g, mut b] = colors[0];
                $(
                    let better = sums[$later] < least;
                    least = if better { sums[$later] } else { least };
                    r = if better { colors[$later][0] } else { r };
                    g = if better { colors[$later][1] } else { g };
                    b = if better { colors[$later][2] } else { b };
                )*
                ([r, g, b], least)
            }

            #[inline(always)]
            fn vector_median(self, distance: impl Fn(Wide, Wide) -> i16) -> Wide {
                let mut sums = [0_i16; $n];
                $(
                    let apart = distance(self[$i], self[$j]);
                    sums[$i] = sums[$i].wrapping_add(apart);
                    sums[$j] = sums[$j].wrapping_add(apart);
                )*
                let mut least = sums[0];
                let [mut r, mut g, mut b] = self[0];
                $(
                    let better = sums[$later] < least;
                    least = if better { sums[$later] } else { least };
                    r = if better { self[$later][0] } else { r };
                    g = if better { self[$later][1] } else { g };
                    b = if better { self[$later][2] } else { b };
                )*
                let _ = least;
                [r, g, b]
            }

            #[inline(always)]
            fn marginal_median(mut self) -> Wide {
                $(
                    let (a, b) = (self[$low], self[$high]);
                    self[$low] = [a[0].min(b[0]), a[1].min(b[1]), a[2].min(b[2])];
                    self[$high] = [a[0].max(b[0]), a[1].max(b[1]), a[2].max(b[2])];
                )*
                self[$middle]
            }
        }
    };
}

colors!(3, 1; [0 1 2]; [1 2]; [(0, 1), (0, 2), (1, 2)];
    [(0, 1), (1, 2), (0, 1)]);
colors!(5, 2; [0 1 2 3 4]; [1 2 3 4]; [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)];
    [(0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)]);
colors!(7, 3; [0 1 2 3 4 5 6]; [1 2 3 4 5 6]; [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (0, 6), (1, 2), (1, 3), (1, 4), (1, 5), (1, 6), (2, 3), (2, 4), (2, 5), (2, 6), (3, 4), (3, 5), (3, 6), (4, 5), (4, 6), (5, 6)];
    [(0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3), (3, 4)]);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::wide;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    fn reference_vector<const N: usize>(colors: &[Rgb8; N], distance: Distance) -> Rgb8 {
        let mut best = (u32::MAX, [0; 3]);
        for a in colors {
            let sum: u32 = colors
                .iter()
                .map(|b| {
                    let d = [0, 1, 2].map(|c| u32::from(a[c].abs_diff(b[c])));
                    match distance {
                        Distance::L1 => d.iter().sum(),
                        Distance::L2 => (d.map(|d| (d * d) as f32).iter().sum::<f32>().sqrt() * 8.0).round_ties_even() as u32,
                    }
                })
                .sum();
            if sum < best.0 {
                best = (sum, *a);
            }
        }
        best.1
    }

    fn reference_marginal<const N: usize>(colors: &[Rgb8; N]) -> Rgb8 {
        [0, 1, 2].map(|c| {
            let mut values = colors.map(|color| color[c]);
            values.sort_unstable();
            values[N / 2]
        })
    }

    fn agrees<const N: usize>(spread: u8, pixels: usize, seed: u64)
    where
        [Wide; N]: Colors<N>,
    {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let planes: [Planes; N] = std::array::from_fn(|_| Planes {
            color: (0..pixels.div_ceil(TILE))
                .map(|_| std::array::from_fn(|_| std::array::from_fn(|_| random.random_range(0..=spread))))
                .collect(),
            gray: Vec::new(),
        });
        for (method, distance) in [
            (Method::Vector, Distance::L1),
            (Method::Vector, Distance::L2),
            (Method::Marginal, Distance::L1),
        ] {
            let start = 3;
            let mut median = vec![[0; 3]; pixels - start];
            let mut departs = vec![7; pixels - start];
            let window = std::array::from_fn(|i| &planes[i]);
            wide::run(Run::<N> {
                window,
                start,
                median: &mut median,
                departs: &mut departs,
                threshold: 9,
                method,
                distance,
            });
            for i in 0..pixels - start {
                let colors: [Rgb8; N] =
                    std::array::from_fn(|k| [0, 1, 2].map(|c| planes[k].color[(start + i) / TILE][c][(start + i) % TILE]));
                let expected = match method {
                    Method::Vector => reference_vector(&colors, distance),
                    Method::Marginal => reference_marginal(&colors),
                };
                assert_eq!(median[i], expected, "{method:?} {distance:?} of {colors:?}");
                let far = (0..3).any(|c| expected[c].abs_diff(colors[0][c]) > 9);
                assert_eq!(departs[i] == 255, far);
            }
        }
    }

    #[test]
    fn the_kernel_agrees_with_the_plain_median() {
        for (seed, (spread, pixels)) in [(255, 999), (3, 500), (255, 37), (40, 64 + 3)].into_iter().enumerate() {
            agrees::<3>(spread, pixels, seed as u64);
            agrees::<5>(spread, pixels, seed as u64);
            agrees::<7>(spread, pixels, seed as u64);
        }
    }
}
