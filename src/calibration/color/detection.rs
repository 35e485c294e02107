//! The chart in the picture, however it is turned: even areas are joined to a lattice, and the colors tell which patch is which.
//!
//! From each area and two of its neighbours a lattice is grown ([`crate::calibration::board::lattice`]); every place of a chart of 6 × 4
//! patches on it, in its four rotations, is a hypothesis, the homography from chart to picture being fitted to the areas' centres. The
//! colors decide: for the right hypothesis the logarithms of the colors seen follow those of the chart,
//!
//! ln seen = γ · ln reference + gain of the channel + light (second degree in place),
//!
//! and the share of the variation so explained is the hypothesis's [`Found::agreement`]. A checkerboard or tissue reaches little; a wrong
//! rotation of a chart is explained far worse than the right one.

use nalgebra::{DMatrix, DVector, Matrix3};

use crate::calibration::board::lattice::{Cell, Lattice, Seed, grown};
use crate::calibration::color::chart::{COLUMNS, PATCHES, ROWS, Reference, place};
use crate::calibration::color::regions::{Region, regions};
use crate::calibration::homography;
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};
use crate::image::color::linear_from_srgb;
use crate::image::reduction::{mean_of_squares, reduced_size};

/// Widths at which the picture is looked at, px: coarse first.
const WIDTHS: [usize; 3] = [480, 960, 1920];
/// Patches that must be seen as such.
const LEAST_PATCHES: usize = 9;
/// A chart explains at least so much of the colors' variation. Charts under a scope's light reach 0.9, other pictures stay below 0.5.
pub const LEAST_AGREEMENT: f64 = 0.75;
/// And leaves at most so much, relative to the next best rotation.
const MOST_AMBIGUITY: f64 = 0.6;
/// A lattice that agrees so well ends the search.
const CERTAIN: f64 = 0.9;
/// Distance to the next patch in units of its own deviation, squared: 12 were patches side by side.
const NEIGHBOUR: [f64; 2] = [10.0, 40.0];
/// Lattices tried at most at one size of the picture.
const MOST_LATTICES: usize = 400;
/// Half of the part of a patch that is sampled, in distances of patches.
const CORE: f64 = 0.2;

/// A chart in a picture.
#[derive(Clone, Debug)]
pub struct Found {
    /// Takes (column, row, 1) of a patch's centre to the picture's pixels.
    pub pixel_from_chart: Matrix3<f64>,
    /// Patches seen as even areas; 0 if the corners were given.
    pub patches_seen: usize,
    /// Share of the colors' variation that the chart explains.
    pub agreement: f64,
}

/// Why there is no chart.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoChart {
    /// No lattice of even areas.
    #[error(
        "expected a chart of 24 patches, found at most {0} areas in rows like its patches; let the chart fill more of the picture, with \
         less glare, or give the middles of its corner patches (--corners)"
    )]
    NoLattice(usize),
    /// A lattice, but not of these colors.
    #[error(
        "expected the colors of a 24-patch chart, found areas in rows whose colors agree by only {0:.2} with them (a chart: above {least}); \
         is it another chart, or clipped?",
        least = LEAST_AGREEMENT
    )]
    OtherColors(f64),
    /// Corners that span no chart.
    #[error(
        "expected the corners of a chart seen from its front, found points that span none; give dark skin, bluish green, black, white"
    )]
    NoQuadrilateral,
}

/// Find the chart.
pub fn find(image: &Image<Rgb8>, references: &[Reference; PATCHES]) -> Result<Found, NoChart> {
    let mut best: Option<Found> = None;
    let mut most = 0;
    let mut tried_steps = Vec::new();
    for width in WIDTHS {
        let longest = image.width().max(image.height());
        let step = longest.div_ceil(width).max(1);
        if tried_steps.contains(&step) {
            continue;
        }
        tried_steps.push(step);
        let (columns, rows) = reduced_size(image.size(), step);
        let mut reduced = Image::filled(columns, rows, [0; 3]);
        mean_of_squares(image, step, &mut reduced);
        let (found, seen) = search(&reduced, references);
        most = most.max(seen);
        if let Some(found) = found
            && best.as_ref().is_none_or(|best| best.agreement < found.agreement)
        {
            let s = step as f64;
            let enlarge = Matrix3::new(s, 0.0, (s - 1.0) / 2.0, 0.0, s, (s - 1.0) / 2.0, 0.0, 0.0, 1.0);
            best = Some(Found {
                pixel_from_chart: enlarge * found.pixel_from_chart,
                ..found
            });
        }
        if best.as_ref().is_some_and(|best| best.agreement > CERTAIN) {
            break;
        }
    }
    match best {
        Some(best) if best.agreement >= LEAST_AGREEMENT => Ok(best),
        Some(best) => Err(NoChart::OtherColors(best.agreement)),
        None => Err(NoChart::NoLattice(most)),
    }
}

/// The chart whose corner patches' middles are given: dark skin, bluish green, black, white.
pub fn with_corners(image: &Image<Rgb8>, corners: [Pixel; 4], references: &[Reference; PATCHES]) -> Result<Found, NoChart> {
    let (right, low) = ((COLUMNS - 1) as f64, (ROWS - 1) as f64);
    let at = [[0.0, 0.0], [right, 0.0], [right, low], [0.0, low]];
    let pairs: Vec<_> = at.iter().zip(corners).map(|(at, c)| (*at, [c.x, c.y])).collect();
    let map = homography::from_pairs(&pairs).ok_or(NoChart::NoQuadrilateral)?;
    if !faces_the_camera(&map) {
        return Err(NoChart::NoQuadrilateral);
    }
    Ok(Found {
        pixel_from_chart: map,
        patches_seen: 0,
        agreement: agreement(image, &map, references).unwrap_or(0.0),
    })
}

/// The best chart and the largest number of areas in a lattice.
fn search(image: &Image<Rgb8>, references: &[Reference; PATCHES]) -> (Option<Found>, usize) {
    let regions = regions(image);
    let centers: Vec<Pixel> = regions.iter().map(|region| region.center).collect();
    let mut best: Option<Found> = None;
    let (mut most, mut lattices) = (0, 0);
    let mut covered = vec![0_usize; regions.len()];
    for first in 0..regions.len() {
        // Two lattices that went through this area were enough.
        if covered[first] >= 2 {
            continue;
        }
        for steps in seeds(&regions, first) {
            let own = regions[first].area;
            let alike = |feature: usize, _: Cell| (0.2..5.0).contains(&(regions[feature].area / own));
            let lattice = grown(&centers, Seed { feature: first, steps }, &alike);
            most = most.max(lattice.len().min(PATCHES));
            if lattice.len() < LEAST_PATCHES {
                continue;
            }
            for feature in lattice.values() {
                covered[*feature] += 1;
            }
            lattices += 1;
            for found in charts_on(image, &lattice, &centers, references) {
                if best.as_ref().is_none_or(|best| best.agreement < found.agreement) {
                    best = Some(found);
                }
            }
            if lattices >= MOST_LATTICES || best.as_ref().is_some_and(|best| best.agreement > CERTAIN) {
                return (best, most);
            }
        }
    }
    (best, most)
}

/// Pairs of steps from an area to two neighbours, as a right-handed lattice (x right, y down) may have them.
fn seeds(regions: &[Region], first: usize) -> Vec<[[f64; 2]; 2]> {
    let own = &regions[first];
    let Some(inverse) = own.moments.try_inverse() else {
        return Vec::new();
    };
    let mut near: Vec<(f64, [f64; 2])> = (0..regions.len())
        .filter(|other| *other != first)
        .filter_map(|other| {
            let step = [regions[other].center.x - own.center.x, regions[other].center.y - own.center.y];
            let d = nalgebra::Vector2::from(step);
            let far = d.dot(&(inverse * d));
            let alike = (0.3..3.3).contains(&(regions[other].area / own.area));
            (alike && (NEIGHBOUR[0]..NEIGHBOUR[1]).contains(&far)).then_some((far, step))
        })
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.truncate(8);
    let mut seeds = Vec::new();
    for (i, (far_a, a)) in near.iter().enumerate() {
        for (j, (far_b, b)) in near.iter().enumerate() {
            if i == j || far_a / far_b > 1.7 || far_b / far_a > 1.7 {
                continue;
            }
            let cosine = nalgebra::Vector2::from(*a).dot(&(inverse * nalgebra::Vector2::from(*b))) / (far_a * far_b).sqrt();
            let right_handed = a[0] * b[1] - a[1] * b[0] > 0.0;
            // One of the four rotations is enough: the first step points right, more or less.
            let upright = a[0] >= a[1].abs() || (a[0] > 0.0 && a[0].abs() >= b[0].abs());
            if cosine.abs() < 0.4 && right_handed && upright {
                seeds.push([*a, *b]);
            }
        }
    }
    seeds.truncate(4);
    seeds
}

/// Every place of a chart on a lattice that covers nearly as many of its cells as the best.
fn charts_on(image: &Image<Rgb8>, lattice: &Lattice, centers: &[Pixel], references: &[Reference; PATCHES]) -> Vec<Found> {
    let mut windows: Vec<(usize, Cell, [i32; 2])> = Vec::new();
    let (mut low, mut high) = ([i32::MAX; 2], [i32::MIN; 2]);
    for cell in lattice.keys() {
        for axis in 0..2 {
            low[axis] = low[axis].min(cell[axis]);
            high[axis] = high[axis].max(cell[axis]);
        }
    }
    // A lattice of many more cells than a chart has is a board or a weave.
    if high[0] - low[0] > 12 || high[1] - low[1] > 12 {
        return Vec::new();
    }
    let (long, short) = (COLUMNS as i32, ROWS as i32);
    for size in [[long, short], [short, long]] {
        for x in low[0] - size[0] + 1..=high[0] {
            for y in low[1] - size[1] + 1..=high[1] {
                let inside = |cell: &&Cell| (x..x + size[0]).contains(&cell[0]) && (y..y + size[1]).contains(&cell[1]);
                windows.push((lattice.keys().filter(inside).count(), [x, y], size));
            }
        }
    }
    let fullest = windows.iter().map(|(count, ..)| *count).max().unwrap_or(0);
    windows.retain(|(count, ..)| *count >= LEAST_PATCHES && *count + 2 >= fullest);
    let mut found: Vec<Found> = Vec::new();
    for (_, corner, size) in windows {
        // The chart's columns and rows in lattice cells, turned by half turns.
        let turns: [&dyn Fn(f64, f64) -> [f64; 2]; 2] = if size[0] == long {
            [&|u, v| [u, v], &|u, v| [5.0 - u, 3.0 - v]]
        } else {
            [&|u, v| [v, 3.0 - u], &|u, v| [5.0 - v, u]]
        };
        for turn in turns {
            let pairs: Vec<([f64; 2], [f64; 2])> = (lattice.iter())
                .filter_map(|(cell, feature)| {
                    let (u, v) = (cell[0] - corner[0], cell[1] - corner[1]);
                    let inside = (0..size[0]).contains(&u) && (0..size[1]).contains(&v);
                    let at = centers.get(*feature)?;
                    inside.then(|| (turn(f64::from(u), f64::from(v)), [at.x, at.y]))
                })
                .collect();
            let Some((map, patches_seen)) = fitted(&pairs) else {
                continue;
            };
            if let Some(agreement) = agreement(image, &map, references) {
                found.push(Found {
                    pixel_from_chart: map,
                    patches_seen,
                    agreement,
                });
            }
        }
    }
    found.sort_by(|a, b| b.agreement.total_cmp(&a.agreement));
    // The second best of another place must be clearly worse.
    if let [first, second, ..] = found.as_slice()
        && 1.0 - first.agreement > MOST_AMBIGUITY * (1.0 - second.agreement)
    {
        return Vec::new();
    }
    found.truncate(1);
    found
}

/// The homography to the centres, without those that lie off; and how many lie on it.
fn fitted(pairs: &[([f64; 2], [f64; 2])]) -> Option<(Matrix3<f64>, usize)> {
    let mut kept = pairs.to_vec();
    for _ in 0..3 {
        let map = homography::from_pairs(&kept)?;
        let before = kept.len();
        let off = |(chart, pixel): &([f64; 2], [f64; 2])| {
            let back = map.try_inverse().and_then(|back| homography::mapped(&back, *pixel));
            back.is_none_or(|at| (at[0] - chart[0]).hypot(at[1] - chart[1]) > 0.15)
        };
        kept.retain(|pair| !off(pair));
        if kept.len() < LEAST_PATCHES {
            return None;
        }
        if kept.len() == before {
            return faces_the_camera(&map).then_some((map, kept.len()));
        }
    }
    None
}

/// The whole chart lies before the camera, and is not seen mirrored.
fn faces_the_camera(map: &Matrix3<f64>) -> bool {
    let depth = |u: f64, v: f64| map[(2, 0)] * u + map[(2, 1)] * v + map[(2, 2)];
    let ends = [depth(-0.6, -0.6), depth(5.6, -0.6), depth(5.6, 3.6), depth(-0.6, 3.6)];
    let (least, most) = ends.iter().fold((f64::INFINITY, 0.0_f64), |(least, most), d| {
        let d = d * map.determinant().signum();
        (least.min(d), most.max(d))
    });
    // A depth ratio of three across the chart is more than any picture of it has.
    least > 0.0 && most < 3.0 * least
}

/// The share of the variation of the colors that the chart explains; none where it reaches out of the picture.
fn agreement(image: &Image<Rgb8>, map: &Matrix3<f64>, references: &[Reference; PATCHES]) -> Option<f64> {
    let mut rows: Vec<([f64; 9], f64, f64)> = Vec::with_capacity(3 * PATCHES);
    for (patch, reference) in references.iter().enumerate() {
        let at = place(patch);
        let seen = sampled(image, map, at)?;
        let (u, v) = (at[0] / 2.5 - 1.0, at[1] / 1.5 - 1.0);
        for channel in 0..3 {
            if !(3.0..250.0).contains(&seen[channel]) {
                continue;
            }
            let x = reference.linear[channel].max(0.015).ln();
            let mut row = [x, 0.0, 0.0, 0.0, u, v, u * u, u * v, v * v];
            row[1 + channel] = 1.0;
            rows.push((row, linear_from_srgb(seen[channel] / 255.0).max(1e-4).ln(), 1.0));
        }
    }
    if rows.len() < PATCHES {
        return None;
    }
    // Glare on a patch is an outlier.
    for _ in 0..3 {
        let solved = solved(&rows, 0)?;
        let mut residuals: Vec<f64> = rows.iter().map(|row| (row.1 - dot(&row.0, &solved)).abs()).collect();
        let each = residuals.clone();
        residuals.sort_by(f64::total_cmp);
        let width = 2.0 * residuals.get(residuals.len() / 2).copied()?.max(0.02);
        for (row, r) in rows.iter_mut().zip(each) {
            row.2 = if r > width { width / r } else { 1.0 };
        }
    }
    let (with, without) = (solved(&rows, 0)?, solved(&rows, 1)?);
    let left = |solution: &DVector<f64>| -> f64 { rows.iter().map(|row| row.2 * (row.1 - dot(&row.0, solution)).powi(2)).sum() };
    let spread: f64 = left(&without) / rows.len() as f64;
    // Gray all over has nothing to agree with.
    (spread > 0.02 && with[0] > 0.3 && with[0] < 3.0).then(|| 1.0 - left(&with) / left(&without))
}

fn dot(row: &[f64; 9], solution: &DVector<f64>) -> f64 {
    row.iter().zip(solution.iter()).map(|(a, b)| a * b).sum()
}

/// Weighted least squares, the first `held` numbers held at zero.
fn solved(rows: &[([f64; 9], f64, f64)], held: usize) -> Option<DVector<f64>> {
    let n = 9 - held;
    let mut normal = DMatrix::zeros(n, n);
    let mut right = DVector::zeros(n);
    for (row, y, weight) in rows {
        let row = DVector::from_column_slice(row.get(held..)?);
        normal += *weight * &row * row.transpose();
        right += *weight * y * row;
    }
    let solution = normal.cholesky()?.solve(&right);
    let mut full = DVector::zeros(9);
    full.rows_mut(held, n).copy_from(&solution);
    Some(full)
}

/// The median color of a patch's core, levels.
fn sampled(image: &Image<Rgb8>, map: &Matrix3<f64>, [u, v]: [f64; 2]) -> Option<[f64; 3]> {
    let mut samples: [Vec<u8>; 3] = Default::default();
    for j in -2..=2 {
        for i in -2..=2 {
            let at = [u + CORE * f64::from(i) / 2.0, v + CORE * f64::from(j) / 2.0];
            let [x, y] = homography::mapped(map, at)?;
            let inside = x > -0.5 && y > -0.5 && x < image.width() as f64 - 0.5 && y < image.height() as f64 - 0.5;
            if !inside {
                return None;
            }
            let pixel = image.at(x.round().max(0.0) as usize, y.round().max(0.0) as usize);
            for (samples, level) in samples.iter_mut().zip(pixel) {
                samples.push(level);
            }
        }
    }
    Some(samples.map(|mut samples| {
        samples.sort_unstable();
        samples.get(samples.len() / 2).copied().map_or(0.0, f64::from)
    }))
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;
    use crate::calibration::color::chart::{Edition, references};
    use crate::calibration::color::example::{Setting, taken};

    /// Largest distance of a patch's middle from the truth, in distances of patches.
    fn off(found: &Matrix3<f64>, truth: &Matrix3<f64>) -> f64 {
        let back = truth.try_inverse().unwrap();
        (0..PATCHES)
            .map(|patch| {
                let at = place(patch);
                let pixel = homography::mapped(found, at).unwrap();
                let there = homography::mapped(&back, pixel).unwrap();
                (there[0] - at[0]).hypot(there[1] - at[1])
            })
            .fold(0.0, f64::max)
    }

    #[test]
    fn charts_are_found_however_they_lie() {
        let references = references(Edition::Since2014);
        let faults: Vec<String> = (0..100_u64)
            .into_par_iter()
            .filter_map(|seed| {
                let example = taken(
                    480,
                    360,
                    &Setting {
                        seed,
                        ..Setting::default()
                    },
                );
                let found = match find(&example.image, &references) {
                    Ok(found) => found,
                    Err(error) => return Some(format!("{seed}, {:?}: {error}", example.ground)),
                };
                // Patches are measured within 0.28 of a distance, and are 0.44 wide: a tenth does no harm.
                let off = off(&found.pixel_from_chart, &example.pixel_from_chart);
                (off > 0.12 || found.agreement < 0.85).then(|| format!("{seed}, {:?}: {off} {found:?}", example.ground))
            })
            .collect();
        assert!(faults.is_empty(), "{faults:#?}");
    }

    #[test]
    fn other_pictures_are_no_charts() {
        let references = references(Edition::Since2014);
        let boards = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/boards");
        let mut seen = 0;
        for entry in std::fs::read_dir(boards).unwrap().flatten() {
            if crate::media::image_files::is_picture(&entry.path()) {
                let image = crate::media::image_files::read(&entry.path()).unwrap();
                let found = find(&image, &references);
                assert!(found.is_err(), "{}: {found:?}", entry.path().display());
                seen += 1;
            }
        }
        assert!(seen >= 5);
        // Patches in rows, of other colors: a chart whose rows are shifted by one.
        for seed in 0..20 {
            let example = taken(
                640,
                480,
                &Setting {
                    seed,
                    glare: false,
                    ..Setting::default()
                },
            );
            let mut other = references;
            other.rotate_right(7);
            let found = find(&example.image, &other);
            assert!(found.is_err(), "{seed}: {found:?}");
        }
    }
}
