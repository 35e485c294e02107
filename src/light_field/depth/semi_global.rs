//! Semi-global matching (Hirschmüller, "Stereo Processing by Semiglobal Matching and Mutual Information", PAMI 2008,
//! doi:10.1109/TPAMI.2007.1166): each pixel's costs are joined by those of the best paths that lead to it from four sides, where
//! a step of one hypothesis costs P1 and a jump P2. Tissue has little texture in places; there the neighbours decide.

use crate::image::buffer::Image;

/// Prices of a path.
#[derive(Clone, Copy, Debug)]
pub struct Smoothness {
    /// Of a step of one hypothesis between neighbouring pixels.
    pub step: f32,
    /// Of any larger jump.
    pub jump: f32,
}

/// Working memory of [`aggregate`].
#[derive(Debug, Default)]
pub struct Paths {
    previous: Vec<f32>,
    current: Vec<f32>,
    least: Vec<f32>,
}

/// Sums of path costs, as many as `costs`, into `out`.
pub fn aggregate(
    costs: &[f32],
    width: usize,
    height: usize,
    count: usize,
    smoothness: Smoothness,
    paths: &mut Paths,
    out: &mut Vec<f32>,
) {
    out.clear();
    out.resize(costs.len(), 0.0);
    paths.previous.resize(width.max(1) * count, 0.0);
    paths.current.resize(width.max(1) * count, 0.0);
    paths.least.resize(width.max(1), 0.0);
    for reversed in [false, true] {
        // Along rows.
        let (previous, current) = (&mut paths.previous[..count], &mut paths.current[..count]);
        for y in 0..height {
            let mut least = 0.0;
            previous.fill(0.0);
            for step in 0..width {
                let x = if reversed { width - 1 - step } else { step };
                let at = (y * width + x) * count;
                least = advance(
                    &costs[at..at + count],
                    previous,
                    least,
                    smoothness,
                    current,
                    &mut out[at..at + count],
                );
                previous.copy_from_slice(current);
            }
        }
        // Along columns, all of a row at once.
        paths.previous.fill(0.0);
        paths.least.fill(0.0);
        for step in 0..height {
            let y = if reversed { height - 1 - step } else { step };
            for x in 0..width {
                let at = (y * width + x) * count;
                let span = x * count..(x + 1) * count;
                paths.least[x] = advance(
                    &costs[at..at + count],
                    &paths.previous[span.clone()],
                    paths.least[x],
                    smoothness,
                    &mut paths.current[span],
                    &mut out[at..at + count],
                );
            }
            std::mem::swap(&mut paths.previous, &mut paths.current);
        }
    }
}

/// One pixel of a path: L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min L(q) + P2) − min L(q); returns min L(p).
#[inline]
fn advance(costs: &[f32], previous: &[f32], least: f32, smoothness: Smoothness, current: &mut [f32], sum: &mut [f32]) -> f32 {
    let count = costs.len();
    let ceiling = least + smoothness.jump;
    let mut lowest = f32::INFINITY;
    for d in 0..count {
        let mut best = previous[d].min(ceiling);
        if d > 0 {
            best = best.min(previous[d - 1] + smoothness.step);
        }
        if d + 1 < count {
            best = best.min(previous[d + 1] + smoothness.step);
        }
        let value = costs[d] + best - least;
        current[d] = value;
        sum[d] += value;
        lowest = lowest.min(value);
    }
    lowest
}

/// A winner and how sure it is.
#[derive(Clone, Debug)]
pub struct Winners {
    /// Hypothesis, with fraction.
    pub index: Image<f32>,
    /// Curvature of the cost at the winner; 0 where it lies at an end of the range.
    pub sharpness: Image<f32>,
}

/// The least sum per pixel, refined by a parabola through it and its neighbours.
pub fn winners(sums: &[f32], width: usize, height: usize, count: usize) -> Winners {
    let mut index = Image::filled(width, height, 0.0_f32);
    let mut sharpness = Image::filled(width, height, 0.0_f32);
    for (i, sums) in sums.chunks_exact(count).enumerate() {
        let mut best = 0;
        for d in 1..count {
            if sums[d] < sums[best] {
                best = d;
            }
        }
        index.pixels_mut()[i] = best as f32;
        if best > 0 && best + 1 < count {
            let (left, middle, right) = (sums[best - 1], sums[best], sums[best + 1]);
            let curvature = left - 2.0 * middle + right;
            if curvature > 1e-9 {
                index.pixels_mut()[i] += (0.5 * (left - right) / curvature).clamp(-0.5, 0.5);
                sharpness.pixels_mut()[i] = curvature;
            }
        }
    }
    Winners { index, sharpness }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_without_evidence_follows_its_neighbours() {
        let (width, height, count) = (9, 7, 6);
        let mut costs = vec![1.0; width * height * count];
        for pixel in costs.chunks_exact_mut(count) {
            pixel[3] = 0.0;
        }
        for d in 0..count {
            costs[(3 * width + 4) * count + d] = 0.5;
        }
        let mut sums = Vec::new();
        aggregate(
            &costs,
            width,
            height,
            count,
            Smoothness { step: 0.1, jump: 0.6 },
            &mut Paths::default(),
            &mut sums,
        );
        let found = winners(&sums, width, height, count);
        assert!(
            found.index.pixels().iter().all(|&d| (d - 3.0).abs() < 1e-3),
            "{:?}",
            found.index
        );
    }

    #[test]
    fn the_parabola_finds_the_fraction() {
        let count = 7;
        let sums: Vec<f32> = (0..count).map(|d| (d as f32 - 3.3).powi(2)).collect();
        let found = winners(&sums, 1, 1, count);
        assert!((found.index.at(0, 0) - 3.3).abs() < 1e-5);
    }
}
