//! Finds the endoscope's image field: the bright disc, cropped by the frame or not, in a surround that stays dark.
//!
//! Of a few frames the brightest value each pixel ever had is kept: tissue that is dark in one frame is bright in another, the
//! surround never is. From each side of the frame the first bright pixel of every row and column is a point of the rim, or lies
//! inside it where the tissue is dark, or outside it where a device writes text. A circle through three points that agrees with
//! the most others is taken (RANSAC; Fischler and Bolles 1981), then fitted to all that agree (Kåsa 1976). A rim is a sharp step;
//! dark corners of a full frame fade over many pixels and are told apart by that.

use rand::{RngExt as _, SeedableRng as _};
use serde::{Deserialize, Serialize};

use crate::image::buffer::{Image, Mask, Rgb8};

/// How the field is looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A surround brighter than this is none, gray levels.
    pub darkest_surround_levels: u8,
    /// So much brighter than the surround is inside, gray levels.
    pub step_levels: u8,
    /// Share of the rim's points that must agree with the circle.
    pub min_agreement: f64,
    /// For the draws of RANSAC.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            darkest_surround_levels: 40,
            step_levels: 12,
            min_agreement: 0.35,
            seed: 1,
        }
    }
}

/// A circle of the picture, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Column of the centre.
    pub x: f64,
    /// Row of the centre.
    pub y: f64,
    /// Radius.
    pub radius: f64,
}

/// Where the endoscope's picture is.
#[derive(Clone, Debug)]
pub struct FieldOfView {
    /// 255 inside.
    pub mask: Mask,
    /// The rim; parts of it may lie outside the frame.
    pub circle: Circle,
}

/// Draws of three points.
const DRAWS: usize = 400;
/// A rim is as sharp as this, as a share of the radius.
const RIM_WIDTH: f64 = 0.012;

/// The image field that `frames`, all of one size, show; `None` when they fill the frame, or nothing can be told.
pub fn find(frames: &[&Image<Rgb8>], settings: &Settings) -> Option<FieldOfView> {
    let first = frames.first()?;
    let (width, height) = first.size();
    if width < 32 || height < 32 || frames.iter().any(|frame| frame.size() != (width, height)) {
        return None;
    }
    let brightest = brightest_of(frames);
    let surround = surround_level(&brightest);
    if surround > settings.darkest_surround_levels {
        return None;
    }
    let threshold = surround.saturating_add(settings.step_levels);
    let rim = rim_points(&brightest, threshold);
    let circle = circle_through(&rim, width.min(height) as f64, settings)?;
    let circle = sharp_rim(&brightest, circle, &rim, settings.step_levels)?;
    let mask = mask_of(&brightest, circle, threshold);
    let outside = mask.pixels().iter().filter(|value| **value == 0).count();
    // Less than this is a frame's own black border, or nothing.
    (outside * 200 > width * height).then_some(FieldOfView { mask, circle })
}

fn brightest_of(frames: &[&Image<Rgb8>]) -> Mask {
    let (width, height) = frames.first().map_or((0, 0), |frame| frame.size());
    let mut brightest = Mask::filled(width, height, 0);
    for frame in frames {
        for (value, pixel) in brightest.pixels_mut().iter_mut().zip(frame.pixels()) {
            *value = (*value).max(pixel[0]).max(pixel[1]).max(pixel[2]);
        }
    }
    brightest
}

/// The level of the second darkest corner: one may hold text.
fn surround_level(brightest: &Mask) -> u8 {
    let (width, height) = brightest.size();
    let side = (width.min(height) / 24).max(4);
    let mut levels = [(0, 0), (width - side, 0), (0, height - side), (width - side, height - side)].map(|(left, top)| {
        let mut values: Vec<u8> = (top..top + side)
            .flat_map(|y| brightest.row(y)[left..left + side].to_vec())
            .collect();
        values.sort_unstable();
        values[values.len() * 9 / 10]
    });
    levels.sort_unstable();
    levels[1]
}

/// The first bright pixel from each side of every row and column; not those at the frame's border, where the rim is cropped.
fn rim_points(brightest: &Mask, threshold: u8) -> Vec<(f64, f64)> {
    let (width, height) = brightest.size();
    let mut points = Vec::new();
    let step = (width.min(height) / 240).max(1);
    for y in (0..height).step_by(step) {
        let (a, b) = first_and_last_bright(width, |x| brightest.at(x, y) > threshold);
        points.extend([a, b].into_iter().flatten().map(|x| (x as f64, y as f64)));
    }
    for x in (0..width).step_by(step) {
        let (a, b) = first_and_last_bright(height, |y| brightest.at(x, y) > threshold);
        points.extend([a, b].into_iter().flatten().map(|y| (x as f64, y as f64)));
    }
    points
}

/// Bright means three in a row: a single one is noise.
fn first_and_last_bright(length: usize, bright: impl Fn(usize) -> bool) -> (Option<usize>, Option<usize>) {
    let three = |i: usize| bright(i) && bright(i + 1) && bright(i + 2);
    let first = (0..length.saturating_sub(2)).find(|i| three(*i));
    let last = (0..length.saturating_sub(2)).rev().find(|i| three(*i)).map(|i| i + 2);
    // Frames often have a dark line or two at their own border.
    (first.filter(|i| *i > 3), last.filter(|i| i + 4 < length))
}

fn circle_through(points: &[(f64, f64)], side: f64, settings: &Settings) -> Option<Circle> {
    if points.len() < 24 {
        return None;
    }
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(settings.seed);
    let reach = (0.004 * side).max(1.0);
    let agrees = |circle: &Circle, p: &(f64, f64)| ((p.0 - circle.x).hypot(p.1 - circle.y) - circle.radius).abs() < reach;
    let mut best: Option<(usize, Circle)> = None;
    for _ in 0..DRAWS {
        let mut draw = || points[rng.random_range(0..points.len())];
        let Some(circle) = circle_of_three(draw(), draw(), draw()) else {
            continue;
        };
        if !(0.3 * side..1.5 * side).contains(&circle.radius) {
            continue;
        }
        let count = points.iter().filter(|p| agrees(&circle, p)).count();
        if best.is_none_or(|(most, _)| count > most) {
            best = Some((count, circle));
        }
    }
    let mut circle = best?.1;
    for _ in 0..3 {
        let agreeing: Vec<(f64, f64)> = points.iter().filter(|p| agrees(&circle, p)).copied().collect();
        circle = fitted_circle(&agreeing)?;
    }
    let agreeing = points.iter().filter(|p| agrees(&circle, p)).count();
    (agreeing as f64 >= settings.min_agreement * points.len() as f64).then_some(circle)
}

fn circle_of_three(a: (f64, f64), b: (f64, f64), c: (f64, f64)) -> Option<Circle> {
    let (bx, by, cx, cy) = (b.0 - a.0, b.1 - a.1, c.0 - a.0, c.1 - a.1);
    let cross = 2.0 * (bx * cy - by * cx);
    if cross.abs() < 1.0 {
        return None;
    }
    let (bb, cc) = (bx * bx + by * by, cx * cx + cy * cy);
    let (x, y) = ((cy * bb - by * cc) / cross, (bx * cc - cx * bb) / cross);
    Some(Circle {
        x: a.0 + x,
        y: a.1 + y,
        radius: x.hypot(y),
    })
}

/// Least squares in x² + y² = 2 a x + 2 b y + c (Kåsa 1976).
fn fitted_circle(points: &[(f64, f64)]) -> Option<Circle> {
    let n = points.len() as f64;
    if n < 12.0 {
        return None;
    }
    let (mx, my) = (
        points.iter().map(|p| p.0).sum::<f64>() / n,
        points.iter().map(|p| p.1).sum::<f64>() / n,
    );
    let mut normal = nalgebra::Matrix3::zeros();
    let mut right = nalgebra::Vector3::zeros();
    for p in points {
        let (x, y) = (p.0 - mx, p.1 - my);
        let row = nalgebra::Vector3::new(2.0 * x, 2.0 * y, 1.0);
        normal += row * row.transpose();
        right += row * (x * x + y * y);
    }
    let s = normal.cholesky()?.solve(&right);
    let radius = (s.z + s.x * s.x + s.y * s.y).sqrt();
    radius.is_finite().then_some(Circle {
        x: s.x + mx,
        y: s.y + my,
        radius,
    })
}

/// The circle, if across its rim the picture steps up within a few pixels.
fn sharp_rim(brightest: &Mask, circle: Circle, rim: &[(f64, f64)], step_levels: u8) -> Option<Circle> {
    let half = (RIM_WIDTH * circle.radius).max(2.0);
    let at = |x: f64, y: f64| {
        let (x, y) = (x.round().max(0.0) as usize, y.round().max(0.0) as usize);
        (x < brightest.width() && y < brightest.height()).then(|| f64::from(brightest.at(x, y)))
    };
    let mut steps: Vec<f64> = rim
        .iter()
        .filter_map(|(x, y)| {
            let (dx, dy) = (x - circle.x, y - circle.y);
            let distance = dx.hypot(dy);
            if (distance - circle.radius).abs() > half {
                return None;
            }
            let along = |r: f64| at(circle.x + dx / distance * r, circle.y + dy / distance * r);
            Some(along(circle.radius - half)? - along(circle.radius + half)?)
        })
        .collect();
    steps.sort_unstable_by(f64::total_cmp);
    let median = *steps.get(steps.len() / 2)?;
    (median >= 2.0 * f64::from(step_levels)).then_some(circle)
}

/// The disc, cut where a straight edge (a rounded rectangle's side) ends it earlier than its rim.
fn mask_of(brightest: &Mask, circle: Circle, threshold: u8) -> Mask {
    let (width, height) = brightest.size();
    let mut mask = Mask::filled(width, height, 0);
    let inside = |x: usize, y: usize| (x as f64 - circle.x).hypot(y as f64 - circle.y) <= circle.radius;
    // A side is straight where a whole margin of the disc's rows (columns) never gets bright.
    let row_is_bright = |y: usize| has_bright((0..width).filter(|x| inside(*x, y)).map(|x| brightest.at(x, y)), threshold);
    let column_is_bright = |x: usize| has_bright((0..height).filter(|y| inside(x, *y)).map(|y| brightest.at(x, y)), threshold);
    let (top, bottom) = (
        (0..height).find(|y| row_is_bright(*y)),
        (0..height).rev().find(|y| row_is_bright(*y)),
    );
    let (left, right) = (
        (0..width).find(|x| column_is_bright(*x)),
        (0..width).rev().find(|x| column_is_bright(*x)),
    );
    if let (Some(top), Some(bottom), Some(left), Some(right)) = (top, bottom, left, right) {
        for y in top..=bottom {
            for x in (left..=right).filter(|x| inside(*x, y)) {
                mask.set(x, y, 255);
            }
        }
    }
    mask
}

fn has_bright(values: impl Iterator<Item = u8>, threshold: u8) -> bool {
    let (mut bright, mut all) = (0_usize, 0_usize);
    for value in values {
        all += 1;
        bright += usize::from(value > threshold);
    }
    bright > 0 && bright * 20 >= all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tissue with dark corners of its own inside a disc, noise in the surround, text in one corner.
    fn picture(disc: Option<Circle>, seed: u64) -> Image<Rgb8> {
        let (width, height) = (320_usize, 240_usize);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let mut image = Image::filled(width, height, [0; 3]);
        for y in 0..height {
            for x in 0..width {
                let noise: u8 = rng.random_range(0..6);
                let off = ((x as f64 - 160.0) / 160.0).hypot((y as f64 - 120.0) / 160.0);
                let tissue = (170.0 * (1.0 - 0.75 * off * off)).max(4.0) as u8;
                let text = x < 24 && y < 12 && (x + y) % 3 > 0;
                let inside = disc.is_none_or(|c| (x as f64 - c.x).hypot(y as f64 - c.y) <= c.radius);
                let value = if inside {
                    tissue.saturating_add(noise)
                } else if text {
                    200
                } else {
                    noise
                };
                image.set(x, y, [value, value / 2, value / 2]);
            }
        }
        image
    }

    #[test]
    fn a_disc_is_found_cropped_or_not() {
        for truth in [
            Circle {
                x: 158.0,
                y: 121.0,
                radius: 112.0,
            },
            Circle {
                x: 165.0,
                y: 118.0,
                radius: 139.0,
            },
        ] {
            let pictures: Vec<_> = (0..3).map(|seed| picture(Some(truth), seed)).collect();
            let found = find(&pictures.iter().collect::<Vec<_>>(), &Settings::default()).unwrap();
            assert!(
                (found.circle.x - truth.x).abs() < 1.0 && (found.circle.y - truth.y).abs() < 1.0,
                "{:?}",
                found.circle
            );
            assert!((found.circle.radius - truth.radius).abs() < 1.0, "{:?}", found.circle);
        }
    }

    #[test]
    fn full_frames_have_none() {
        let pictures: Vec<_> = (0..3).map(|seed| picture(None, seed)).collect();
        assert!(find(&pictures.iter().collect::<Vec<_>>(), &Settings::default()).is_none());
        let bright = Image::filled(320, 240, [120; 3]);
        let black = Image::filled(320, 240, [2; 3]);
        assert!(find(&[&bright], &Settings::default()).is_none());
        assert!(find(&[&black], &Settings::default()).is_none());
        assert!(find(&[], &Settings::default()).is_none());
    }
}
