//! The median of 3, 5 or 7 colors per pixel.
//!
//! The vector median of colors x_1 … x_n is the x_i with the smallest Σ_j ‖x_i − x_j‖ (Astola, Haavisto, Neuvo, Vector
//! median filters, Proc. IEEE 78(4), 1990, doi:10.1109/5.54807): it is always one of the colors that were seen. Of equal
//! sums the newest wins.
//!
//! The kernel works on 32 pixels at a time: differences in u8, sums in u16, the choice by selection instead of branches,
//! so that the compiler keeps the whole competition in vector registers.

use crate::image::buffer::Rgb8;
use crate::image::wide::Kernel;
use crate::stages::temporal_median::history::Planes;
use crate::stages::temporal_median::settings::{Distance, Method};

const LANES: usize = 32;
type Lane = [u8; LANES];

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

impl<const N: usize> Kernel for Run<'_, N> {
    #[inline(always)]
    fn run(self) {
        match (self.method, self.distance) {
            (Method::Marginal, _) => self.with(marginal),
            (Method::Vector, Distance::L1) => self.with(|window| vector(window, l1)),
            (Method::Vector, Distance::L2) => self.with(|window| vector(window, l2)),
        }
    }
}

impl<const N: usize> Run<'_, N> {
    #[inline(always)]
    fn with(self, choose: impl Fn(&[[Lane; 3]; N]) -> [Lane; 3]) {
        let Self {
            window,
            start,
            median,
            departs,
            threshold,
            ..
        } = self;
        let count = median.len();
        let mut done = 0;
        while done < count {
            let length = LANES.min(count - done);
            let at = start + done;
            let mut colors = [[[0_u8; LANES]; 3]; N];
            for (lanes, planes) in colors.iter_mut().zip(&window) {
                for (lane, plane) in lanes.iter_mut().zip(&planes.color) {
                    if let Some(whole) = plane.get(at..at + LANES) {
                        lane.copy_from_slice(whole);
                    } else {
                        lane[..length].copy_from_slice(&plane[at..at + length]);
                    }
                }
            }
            let [red, green, blue] = choose(&colors);
            let mut far = [0_u8; LANES];
            for i in 0..LANES {
                let [r, g, b] = [
                    red[i].abs_diff(colors[0][0][i]),
                    green[i].abs_diff(colors[0][1][i]),
                    blue[i].abs_diff(colors[0][2][i]),
                ];
                far[i] = if r.max(g).max(b) > threshold { 255 } else { 0 };
            }
            let target = &mut median[done..done + length];
            if let Ok(target) = <&mut [Rgb8; LANES]>::try_from(&mut *target) {
                for i in 0..LANES {
                    target[i] = [red[i], green[i], blue[i]];
                }
            } else {
                for (i, pixel) in target.iter_mut().enumerate() {
                    *pixel = [red[i], green[i], blue[i]];
                }
            }
            departs[done..done + length].copy_from_slice(&far[..length]);
            done += length;
        }
    }
}

#[inline(always)]
fn l1(a: &[Lane; 3], b: &[Lane; 3]) -> [u16; LANES] {
    let mut sum = [0_u16; LANES];
    for i in 0..LANES {
        sum[i] =
            u16::from(a[0][i].abs_diff(b[0][i])) + u16::from(a[1][i].abs_diff(b[1][i])) + u16::from(a[2][i].abs_diff(b[2][i]));
    }
    sum
}

/// Euclidean distance in units of 1/16 level: six of them still fit into 16 bits (6 · 441.7 · 16 = 42 400).
#[inline(always)]
fn l2(a: &[Lane; 3], b: &[Lane; 3]) -> [u16; LANES] {
    let mut sum = [0_u16; LANES];
    for i in 0..LANES {
        let mut squares = 0_i32;
        for channel in 0..3 {
            let difference = i32::from(a[channel][i]) - i32::from(b[channel][i]);
            squares += difference * difference;
        }
        sum[i] = ((squares as f32).sqrt() * 16.0) as i32 as u16;
    }
    sum
}

#[inline(always)]
fn vector<const N: usize>(window: &[[Lane; 3]; N], distance: impl Fn(&[Lane; 3], &[Lane; 3]) -> [u16; LANES]) -> [Lane; 3] {
    let mut sums = [[0_u16; LANES]; N];
    for i in 0..N {
        for j in i + 1..N {
            let apart = distance(&window[i], &window[j]);
            for lane in 0..LANES {
                sums[i][lane] += apart[lane];
                sums[j][lane] += apart[lane];
            }
        }
    }
    let mut least = sums[0];
    let mut chosen = [0_u16; LANES];
    for i in 1..N {
        for lane in 0..LANES {
            let better = sums[i][lane] < least[lane];
            chosen[lane] = if better { i as u16 } else { chosen[lane] };
            least[lane] = if better { sums[i][lane] } else { least[lane] };
        }
    }
    let mut index = [0_u8; LANES];
    for lane in 0..LANES {
        index[lane] = chosen[lane] as u8;
    }
    let mut median = window[0];
    for i in 1..N {
        for channel in 0..3 {
            for lane in 0..LANES {
                let this = index[lane] == i as u8;
                median[channel][lane] = if this {
                    window[i][channel][lane]
                } else {
                    median[channel][lane]
                };
            }
        }
    }
    median
}

/// Exchange networks that leave the median in the middle (Paeth, Graphics Gems I, 1990; Devillard 1998).
const NETWORK_3: &[(usize, usize)] = &[(0, 1), (1, 2), (0, 1)];
const NETWORK_5: &[(usize, usize)] = &[(0, 1), (3, 4), (0, 3), (1, 4), (1, 2), (2, 3), (1, 2)];
const NETWORK_7: &[(usize, usize)] = &[
    (0, 5),
    (0, 3),
    (1, 6),
    (2, 4),
    (0, 1),
    (3, 5),
    (2, 6),
    (2, 3),
    (3, 6),
    (4, 5),
    (1, 4),
    (1, 3),
    (3, 4),
];

#[inline(always)]
fn marginal<const N: usize>(window: &[[Lane; 3]; N]) -> [Lane; 3] {
    let network = match N {
        3 => NETWORK_3,
        5 => NETWORK_5,
        _ => NETWORK_7,
    };
    let mut sorted = *window;
    for &(low, high) in network {
        for channel in 0..3 {
            for lane in 0..LANES {
                let (a, b) = (sorted[low][channel][lane], sorted[high][channel][lane]);
                sorted[low][channel][lane] = a.min(b);
                sorted[high][channel][lane] = a.max(b);
            }
        }
    }
    sorted[N / 2]
}

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
                        Distance::L2 => (d.map(|d| (d * d) as f32).iter().sum::<f32>().sqrt() * 16.0) as u32,
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

    fn agrees<const N: usize>(spread: u8, pixels: usize, seed: u64) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let planes: [Planes; N] = std::array::from_fn(|_| Planes {
            color: std::array::from_fn(|_| (0..pixels).map(|_| random.random_range(0..=spread)).collect()),
            gray: vec![0; pixels],
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
                let colors: [Rgb8; N] = std::array::from_fn(|k| [0, 1, 2].map(|c| planes[k].color[c][start + i]));
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
