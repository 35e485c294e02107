//! Finding a grid of dots: blobs of elliptic shape, grown to a lattice, put on the board.
//!
//! A dot's middle is that of the ellipse through its rim: on rays from the middle, the place of the steepest step from dot to paper,
//! to a part of a pixel; the first wave of those lengths around the dot shifts the ellipse, the second reshapes it, and rays that met
//! something else (a reflex, the edge of a neighbour) are left out. What happens inside the dot, a drilled hole's lit bottom for
//! example, does not matter, nor does the brightness of the paper.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use crate::calibration::board::detection::{BoardCorner, Detection};
use crate::calibration::board::lattice::{Cell, Lattice, Seed, grown};
use crate::calibration::board::pattern::{BoardLayout, Pattern};
use crate::calibration::board::placement::{Placed, placed};
use crate::calibration::board::saddle::bilinear;
use crate::calibration::board::stray::without_strays;
use crate::camera::intrinsics::Pixel;
use crate::geometry::point::Point;
use crate::image::blur::{BlurScratch, box_blur};
use crate::image::buffer::Image;
use crate::image::components::Components;
use crate::image::pyramid::smoothed;

/// Pixels differ by this much from the mean around to belong to a dot, gray levels.
const LEAST_DIFFERENCE: f32 = 4.0;
/// Windows of that mean, as shares of the picture's width.
const WINDOWS: [f64; 3] = [0.035, 0.08, 0.016];
/// Smallest blob, px.
const LEAST_AREA: u32 = 12;
/// Largest blob, as a share of the picture.
const MOST_AREA_SHARE: f64 = 0.02;
/// Area over that of the ellipse of the same moments.
const ELLIPTIC: std::ops::Range<f64> = 0.82..1.12;
/// The longer axis over the shorter.
const MOST_SLIM: f64 = 4.0;
/// Lattices tried per set of blobs.
const MOST_SEEDS: usize = 80;
/// A piece of fewer dots is no board.
const FEWEST_DOTS: usize = 10;
/// Rays from a dot's middle to its rim.
const RAYS: usize = 48;
/// Where on a ray the rim is looked for, in units of the dot's radius.
const NEAR: f64 = 0.5;
const FAR: f64 = 1.5;
/// Times that rim and ellipse are found from each other.
const ROUNDS: usize = 4;
/// A rim may be this rough, in units of the radius.
const MOST_ROUGHNESS: f64 = 0.2;

#[derive(Clone, Copy, Debug)]
struct Blob {
    middle: Pixel,
    /// Second moments, px².
    moments: Matrix2<f64>,
    area: f64,
    sigma_px: f64,
}

/// The grid in a gray picture (0–255), if it is seen.
pub fn detect(gray: &Image<f32>, layout: &BoardLayout, diameter_mm: Option<f64>) -> Option<Detection> {
    let soft = smoothed(gray);
    let whole = layout.sites().len();
    let mut best: Option<(Placed, Vec<Blob>, Lattice)> = None;
    'found: for window in WINDOWS {
        for dark in [true, false] {
            let blobs: Vec<Blob> = blobs(&soft, window, dark)
                .iter()
                .filter_map(|blob| rimmed(&soft, blob, dark))
                .collect();
            let Some((placed, lattice)) = largest(&blobs, layout) else {
                continue;
            };
            if best.as_ref().is_none_or(|(known, ..)| placed.pairs.len() > known.pairs.len()) {
                best = Some((placed, blobs, lattice));
            }
            if best.as_ref().is_some_and(|(known, ..)| known.pairs.len() == whole) {
                break 'found;
            }
        }
    }
    let (placed, blobs, lattice) = best?;
    let sites = layout.sites();
    let kept = without_strays(
        (placed.pairs.iter())
            .map(|(site, feature)| (sites[*site].lattice, blobs[*feature].middle))
            .collect(),
    );
    let measured_mm = || radius_mm(&lattice, &blobs, layout);
    Some(Detection {
        corners: placed
            .pairs
            .iter()
            .filter(|(site, _)| kept.contains_key(&sites[*site].lattice))
            .map(|(site, feature)| {
                let [x, y] = sites[*site].board_mm;
                BoardCorner {
                    site: *site,
                    board: Point::new(x, y, 0.0),
                    pixel: blobs[*feature].middle,
                    sigma_px: blobs[*feature].sigma_px,
                }
            })
            .collect(),
        naming: placed.naming,
        dot_radius_mm: diameter_mm.map(|diameter| diameter / 2.0).or_else(measured_mm),
    })
}

/// How many dots stand out.
pub fn dots(gray: &Image<f32>) -> usize {
    let soft = smoothed(gray);
    let count = |window: f64, dark: bool| {
        let found = blobs(&soft, window, dark);
        found.iter().filter(|blob| rimmed(&soft, blob, dark).is_some()).count()
    };
    let counts = WINDOWS
        .into_iter()
        .flat_map(|window| [true, false].map(|dark| count(window, dark)));
    counts.max().unwrap_or(0)
}

/// Elliptic regions darker (or brighter) than what is around.
fn blobs(soft: &Image<f32>, window: f64, dark: bool) -> Vec<Blob> {
    let (width, height) = soft.size();
    let mut mean = soft.clone();
    box_blur(
        &mut mean,
        ((width as f64 * window) as usize).max(4),
        &mut BlurScratch::default(),
    );
    let mut mask = Image::filled(width, height, 0_u8);
    for (out, (value, mean)) in mask.pixels_mut().iter_mut().zip(soft.pixels().iter().zip(mean.pixels())) {
        let difference = if dark { mean - value } else { value - mean };
        *out = u8::from(difference > LEAST_DIFFERENCE);
    }
    let mut components = Components::default();
    components.label(&mask);
    let most_area = (MOST_AREA_SHARE * (width * height) as f64) as u32;
    // Each row of a region from its first to its last pixel: a dot with a bright middle is whole again.
    let mut rows: Vec<Vec<(u32, u32, u32)>> = vec![Vec::new(); components.regions().len()];
    for run in components.runs() {
        let region = &components.regions()[run.label as usize];
        let at_border = region.left == 0 || region.top == 0 || region.right as usize == width || region.bottom as usize == height;
        let too_large = (region.right - region.left) * (region.bottom - region.top) > 2 * most_area;
        if at_border || too_large || region.area < LEAST_AREA {
            continue;
        }
        let rows = &mut rows[run.label as usize];
        match rows.last_mut() {
            Some((y, _, end)) if *y == run.y => *end = run.end,
            _ => rows.push((run.y, run.begin, run.end)),
        }
    }
    rows.iter().filter_map(|rows| elliptic(rows, f64::from(most_area))).collect()
}

fn elliptic(rows: &[(u32, u32, u32)], most_area: f64) -> Option<Blob> {
    let (mut area, mut sum, mut squares) = (0.0, Vector2::zeros(), Matrix2::zeros());
    for (y, begin, end) in rows {
        for x in *begin..*end {
            let at = Vector2::new(f64::from(x), f64::from(*y));
            area += 1.0;
            sum += at;
            squares += at * at.transpose();
        }
    }
    if area < f64::from(LEAST_AREA) || area > most_area {
        return None;
    }
    let middle = sum / area;
    // A pixel is a square of variance 1/12.
    let moments = squares / area - middle * middle.transpose() + Matrix2::identity() / 12.0;
    let of_ellipse = 4.0 * std::f64::consts::PI * moments.determinant().max(0.0).sqrt();
    let eigen = moments.symmetric_eigenvalues();
    let slim = (eigen.max() / eigen.min().max(1e-9)).sqrt();
    (ELLIPTIC.contains(&(area / of_ellipse)) && slim < MOST_SLIM).then(|| Blob {
        middle: Pixel {
            x: middle.x,
            y: middle.y,
        },
        moments,
        area,
        sigma_px: f64::NAN,
    })
}

/// The same dot by its rim; `None` where it has none.
fn rimmed(soft: &Image<f32>, blob: &Blob, dark: bool) -> Option<Blob> {
    let mut middle = Vector2::new(blob.middle.x, blob.middle.y);
    // Takes the unit circle to the rim: an ellipse's axes are twice the roots of its moments.
    let mut shape = blob.moments.cholesky()?.l() * 2.0;
    let mut sigma_px = f64::NAN;
    for round in 0..ROUNDS {
        let rim = rim(soft, middle, &shape, dark);
        let wave = wave(&rim)?;
        let size = shape.determinant().abs().sqrt();
        sigma_px = wave.deviation * size * (2.0 / rim.len() as f64).sqrt();
        middle += shape * Vector2::new(wave.along[1], wave.along[2]);
        let (a, b) = (wave.along[3], wave.along[4]);
        shape = shape * (1.0 + wave.along[0]) * Matrix2::new(1.0 + a, b, b, 1.0 - a);
        let ratio = shape.determinant() * std::f64::consts::PI / blob.area;
        let jumped = (middle - Vector2::new(blob.middle.x, blob.middle.y)).norm() > 0.5 * size;
        if jumped || !(0.4..2.5).contains(&ratio) || (round + 1 == ROUNDS && wave.deviation > MOST_ROUGHNESS) {
            return None;
        }
    }
    Some(Blob {
        middle: Pixel {
            x: middle.x,
            y: middle.y,
        },
        moments: shape * shape.transpose() / 4.0,
        area: std::f64::consts::PI * shape.determinant().abs(),
        sigma_px,
    })
}

/// Where each ray crosses the rim: its angle, and its length less one, on the unit circle that `shape` takes to the ellipse.
fn rim(soft: &Image<f32>, middle: Vector2<f64>, shape: &Matrix2<f64>, dark: bool) -> Vec<[f64; 2]> {
    let sign = if dark { 1.0 } else { -1.0 };
    let mut rim = Vec::with_capacity(RAYS);
    for ray in 0..RAYS {
        let angle = std::f64::consts::TAU * ray as f64 / RAYS as f64;
        let direction = shape * Vector2::new(angle.cos(), angle.sin());
        let step = 0.5 / direction.norm();
        let steps = ((FAR - NEAR) / step).ceil() as usize;
        let profile: Option<Vec<f64>> = (0..=steps)
            .map(|k| {
                let at = middle + direction * (NEAR + step * k as f64);
                bilinear(soft, at.x, at.y)
            })
            .collect();
        let Some(profile) = profile else { continue };
        let slopes: Vec<f64> = profile.windows(3).map(|w| sign * (w[2] - w[0])).collect();
        let Some(top) = (0..slopes.len()).max_by(|a, b| slopes[*a].total_cmp(&slopes[*b])) else {
            continue;
        };
        if top == 0 || top + 1 >= slopes.len() || slopes[top] < f64::from(LEAST_DIFFERENCE) * 0.3 {
            continue;
        }
        let bend = slopes[top - 1] + slopes[top + 1] - 2.0 * slopes[top];
        let offset = if bend < 0.0 {
            (slopes[top - 1] - slopes[top + 1]) / (2.0 * bend)
        } else {
            0.0
        };
        rim.push([angle, NEAR + step * (top as f64 + 1.0 + offset) - 1.0]);
    }
    rim
}

struct Wave {
    /// Of 1, cos, sin, cos 2, sin 2.
    along: SVector<f64, 5>,
    /// What is left, on the unit circle.
    deviation: f64,
}

/// The first two waves of the rim around the unit circle, without rays that went astray.
fn wave(rim: &[[f64; 2]]) -> Option<Wave> {
    let row = |angle: f64| {
        let (sin, cos) = angle.sin_cos();
        let (sin2, cos2) = (2.0 * angle).sin_cos();
        SVector::<f64, 5>::new(1.0, cos, sin, cos2, sin2)
    };
    let mut limit = f64::INFINITY;
    let mut wave = Wave {
        along: SVector::zeros(),
        deviation: f64::INFINITY,
    };
    for _ in 0..4 {
        let kept: Vec<&[f64; 2]> = rim
            .iter()
            .filter(|[angle, length]| (row(*angle).dot(&wave.along) - length).abs() <= limit)
            .collect();
        if kept.len() < RAYS * 3 / 5 {
            return None;
        }
        let (mut normal, mut slope) = (SMatrix::<f64, 5, 5>::zeros(), SVector::<f64, 5>::zeros());
        for [angle, length] in &kept {
            let row = row(*angle);
            normal += row * row.transpose();
            slope += row * *length;
        }
        wave.along = normal.cholesky()?.solve(&slope);
        let mut left: Vec<f64> = rim
            .iter()
            .map(|[angle, length]| (row(*angle).dot(&wave.along) - length).abs())
            .collect();
        left.sort_by(f64::total_cmp);
        // The median of a normal deviation's size is 0.6745 of it.
        wave.deviation = left[left.len() / 2] / 0.6745;
        limit = 2.5 * wave.deviation.max(1e-3);
    }
    Some(wave)
}

fn largest(blobs: &[Blob], layout: &BoardLayout) -> Option<(Placed, Lattice)> {
    let pixels: Vec<Pixel> = blobs.iter().map(|blob| blob.middle).collect();
    let whole = layout.sites().len();
    let mut best: Option<(Placed, Lattice)> = None;
    let mut in_a_lattice = vec![false; blobs.len()];
    let mut order: Vec<usize> = (0..blobs.len()).collect();
    order.sort_by(|a, b| blobs[*b].area.total_cmp(&blobs[*a].area));
    let mut seeds = 0;
    for first in order {
        if in_a_lattice[first] {
            continue;
        }
        let mut grown_from_here = Vec::new();
        for seed in seeds_at(blobs, first) {
            let fits = |feature: usize, _: Cell| (0.3..3.4).contains(&(blobs[feature].area / blobs[first].area));
            let lattice = grown(&pixels, seed, &fits);
            if lattice.len() < FEWEST_DOTS.min(whole) {
                continue;
            }
            if let Some(placed) = placed(&lattice, &pixels, layout) {
                grown_from_here.push((placed, lattice));
            }
        }
        let Some((placed, lattice)) = grown_from_here.into_iter().max_by_key(|(placed, _)| placed.pairs.len()) else {
            continue;
        };
        for feature in lattice.values() {
            in_a_lattice[*feature] = true;
        }
        let enough = placed.pairs.len() >= FEWEST_DOTS.min(whole);
        if enough && best.as_ref().is_none_or(|(known, _)| placed.pairs.len() > known.pairs.len()) {
            best = Some((placed, lattice));
        }
        seeds += 1;
        if seeds > MOST_SEEDS || best.as_ref().is_some_and(|(known, _)| known.pairs.len() == whole) {
            break;
        }
    }
    best
}

/// Pairs of short steps to neighbours, upright enough on each other to span a lattice; shortest first.
fn seeds_at(blobs: &[Blob], first: usize) -> Vec<Seed> {
    let start = &blobs[first];
    let mut near: Vec<[f64; 2]> = (blobs.iter().enumerate())
        .filter(|(index, other)| *index != first && (0.3..3.4).contains(&(other.area / start.area)))
        .map(|(_, other)| [other.middle.x - start.middle.x, other.middle.y - start.middle.y])
        .collect();
    near.sort_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])));
    near.truncate(8);
    let mut pairs = Vec::new();
    for (place, a) in near.iter().enumerate() {
        for b in &near[place + 1..] {
            let (la, lb) = (a[0].hypot(a[1]), b[0].hypot(b[1]));
            let cross = a[0] * b[1] - a[1] * b[0];
            if cross.abs() > 0.5 * la * lb {
                // Right-handed, as the board's axes are.
                let steps = if cross > 0.0 { [*a, *b] } else { [*b, *a] };
                pairs.push((la + lb, Seed { feature: first, steps }));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    pairs.truncate(3);
    pairs.into_iter().map(|(_, seed)| seed).collect()
}

/// The median radius that the dots' areas tell, against the cells of their lattice.
fn radius_mm(lattice: &Lattice, blobs: &[Blob], layout: &BoardLayout) -> Option<f64> {
    let cell_mm2 = match layout.pattern {
        Pattern::AsymmetricCircles { .. } => 2.0 * layout.square_mm * layout.square_mm,
        _ => layout.square_mm * layout.square_mm,
    };
    let mut radii: Vec<f64> = lattice
        .iter()
        .filter_map(|(cell, feature)| {
            let at = |du: i32, dv: i32| lattice.get(&[cell[0] + du, cell[1] + dv]).map(|f| blobs[*f].middle);
            let (right, left, below, above) = (at(1, 0)?, at(-1, 0)?, at(0, 1)?, at(0, -1)?);
            let a = [(right.x - left.x) / 2.0, (right.y - left.y) / 2.0];
            let b = [(below.x - above.x) / 2.0, (below.y - above.y) / 2.0];
            let cell_px2 = (a[0] * b[1] - a[1] * b[0]).abs();
            Some((blobs[*feature].area / cell_px2 * cell_mm2 / std::f64::consts::PI).sqrt())
        })
        .filter(|radius| radius.is_finite())
        .collect();
    radii.sort_by(f64::total_cmp);
    radii.get(radii.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibration::homography::mapped;

    /// Dots of radius 0.28 distances under a map from board to picture, 25 points a pixel, softened, with noise.
    fn picture(layout: &BoardLayout, map: &Matrix3<f64>, noise: f32, hollow: bool) -> Image<f32> {
        let back = map.try_inverse().unwrap();
        let sites = layout.sites();
        let mut image = Image::filled(420, 360, 0.0_f32);
        for y in 0..360 {
            for x in 0..420 {
                let mut sum = 0.0;
                for k in 0..25 {
                    let at = [
                        f64::from(x) + (f64::from(k % 5) - 2.0) / 5.0,
                        f64::from(y) + (f64::from(k / 5) - 2.0) / 5.0,
                    ];
                    let [u, v] = mapped(&back, at).unwrap();
                    let nearest = sites
                        .iter()
                        .map(|site| (site.board_mm[0] - u).hypot(site.board_mm[1] - v))
                        .fold(f64::INFINITY, f64::min);
                    let lit_bottom = hollow && nearest < 0.15 && u > v;
                    sum += if nearest < 0.28 && !lit_bottom { 50.0 } else { 150.0 };
                }
                image.set(x as usize, y as usize, sum / 25.0 * (1.0 - 0.001 * x as f32));
            }
        }
        let mut image = smoothed(&image);
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for pixel in image.pixels_mut() {
            *pixel += noise * random.sample::<f32, _>(StandardNormal);
        }
        image
    }

    /// The centre of the ellipse that a circle becomes: the pole of the line at infinity.
    fn ellipse_center(map: &Matrix3<f64>, at: [f64; 2], radius: f64) -> [f64; 2] {
        let [x, y] = at;
        // The dual conic of the circle, carried over by the map.
        let dual = Matrix3::new(
            x * x - radius * radius,
            x * y,
            x,
            x * y,
            y * y - radius * radius,
            y,
            x,
            y,
            1.0,
        );
        let pole = map * dual * map.transpose() * Vector3::z();
        [pole.x / pole.z, pole.y / pole.z]
    }

    #[test]
    fn tilted_dots_are_found_at_the_centres_of_their_ellipses() {
        let map = Matrix3::new(34.0, -6.0, 70.0, 5.0, 30.0, 60.0, 0.02, -0.015, 1.0);
        for (text, hollow) in [("circles:8x7", false), ("acircles:4x8", false), ("circles:8x7", true)] {
            let layout = BoardLayout::new(text, 1.0).unwrap();
            let image = picture(&layout, &map, 3.0, hollow);
            let detection = detect(&image, &layout, None).unwrap();
            assert_eq!(detection.corners.len(), layout.sites().len(), "{text}");
            // Seen the right way up, the labels are the board's own.
            let (mut squares, mut stated) = (0.0, 0.0);
            for corner in &detection.corners {
                let truth = ellipse_center(&map, [corner.board.coords.x, corner.board.coords.y], 0.28);
                squares += (corner.pixel.x - truth[0]).powi(2) + (corner.pixel.y - truth[1]).powi(2);
                stated += 2.0 * corner.sigma_px.powi(2);
            }
            let n = detection.corners.len() as f64;
            let (error, stated) = ((squares / n).sqrt(), (stated / n).sqrt());
            // What noise lets the rim waver, and a hundredth of a pixel for steps found on a grid.
            assert!(
                error < 1.6 * stated + 0.02 && error < 0.12,
                "{text}: {error} px, stated {stated} px"
            );
            let radius = detection.dot_radius_mm.unwrap();
            assert!((radius - 0.28).abs() < 0.015, "{text}: {radius}");
        }
    }
}
