//! How a picture moved against the one before: shift, turn and growth of the whole.
//!
//! Coarse to fine, Gauss–Newton on a similarity (Lucas and Kanade 1981; Baker and Matthews 2004), on pictures without their slow
//! brightness (the lamp rides on the camera), without what is clipped or black, and with Huber's weights for what moves otherwise.

use nalgebra::{SMatrix, SVector};

use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::gradient::{gradient, gray_from_rgb};
use crate::image::patch::bilinear;
use crate::image::pyramid::{Pyramid, eroded};
use crate::image::reduction::{mean_of_squares, reduced_size, reduction_to};

/// Pictures are looked at about this wide, px.
const WIDTH_PX: f32 = 240.0;
/// What is wider than this is brightness, not detail, px.
const DETAIL_SIGMA_PX: f32 = 8.0;
/// Near what is not usable the slow part is one-sided: a rim that does not move along, px.
const MARGIN_PX: usize = 4;
/// Darker is the black surround, brighter the lamp, levels.
const USABLE_LEVELS: std::ops::Range<f32> = 12.0..236.0;
const LEVELS: usize = 4;
/// Ultrasound comes slowly and moves far in between: there, the shift is first looked for at this level, in shares of width and height.
const SEARCH_LEVEL: usize = 2;
const SEARCH_SHARE: [f32; 2] = [0.12, 0.3];
/// What a px more must gain in correlation.
const SHORTER_SHARE: f32 = 0.01;
/// Right, down, turn, growth, contrast.
const UNKNOWNS: usize = 5;
const ROUNDS: usize = 12;
/// Done when nothing in the picture moves farther than this, px.
const SETTLED_PX: f32 = 0.002;
/// At least this share of the picture must be usable.
const LEAST_SHARE: f32 = 0.02;
/// A picture with less that is usable and something this bright is no endoscope's: bright on black, as ultrasound is, and black is
/// part of it …
const BRIGHT_LEVEL: f32 = 30.0;
/// … as far as it lies near: where a blur of the detail's size still has this share of its peak. Far from all that is bright nothing can
/// move, and so much nothing would make everything else an outlier.
const NEAR_BRIGHT_SHARE: f32 = 0.04;
/// Steps are held back by this share of the slopes' squares, so that a direction without slopes (along a lone line) stays at rest.
const DAMPING: f64 = 1e-3;
/// So much more holds a number at rest altogether.
const LOCKED: f64 = 1e9;

/// How a picture moved against the one before, in shares of its width.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImageMotion {
    /// To the right, in widths.
    pub right: f64,
    /// Down, in widths.
    pub down: f64,
    /// Clockwise, rad.
    pub turn: f64,
    /// Logarithm of the growth.
    pub growth: f64,
}

impl ImageMotion {
    /// As a vector.
    pub fn components(&self) -> [f64; 4] {
        [self.right, self.down, self.turn, self.growth]
    }
}

/// Follows a video from picture to picture.
#[derive(Debug, Default)]
pub struct MotionTracker {
    previous: Option<Level0>,
    scratch: BlurScratch,
}

#[derive(Debug)]
struct Level0 {
    /// Bright on black.
    on_black: bool,
    pyramid: Pyramid,
    slopes: Vec<(Image<f32>, Image<f32>)>,
}

impl MotionTracker {
    /// One more picture: how it moved against the last one; `None` for the first, and where that cannot be told.
    pub fn next(&mut self, image: &Image<Rgb8>) -> Option<ImageMotion> {
        let current = self.prepared(image);
        let motion = self
            .previous
            .as_ref()
            .filter(|previous| previous.pyramid.levels[0].size() == current.pyramid.levels[0].size())
            .and_then(|previous| aligned(previous, &current.pyramid));
        self.previous = Some(current);
        motion
    }

    /// Forget the last picture.
    pub fn reset(&mut self) {
        self.previous = None;
    }

    fn prepared(&mut self, image: &Image<Rgb8>) -> Level0 {
        let reduction = reduction_to(image.width(), WIDTH_PX);
        let (width, height) = reduced_size(image.size(), reduction);
        let mut small = Image::filled(width, height, [0; 3]);
        mean_of_squares(image, reduction, &mut small);
        let mut gray = gray_from_rgb(&small);
        let mut valid: Mask = Image::filled(gray.width(), gray.height(), 0);
        for (valid, level) in valid.pixels_mut().iter_mut().zip(gray.pixels()) {
            *valid = if USABLE_LEVELS.contains(level) { 255 } else { 0 };
        }
        // What is half the lamp's is not usable either.
        let mut valid = eroded(&valid, 1);
        let usable = valid.pixels().iter().filter(|valid| **valid != 0).count() as f32;
        let on_black =
            usable < 2.0 * LEAST_SHARE * valid.pixels().len() as f32 && gray.pixels().iter().any(|level| *level > BRIGHT_LEVEL);
        if on_black {
            let mut near = gray.clone();
            gaussian_blur(&mut near, DETAIL_SIGMA_PX, &mut self.scratch);
            let most = near.pixels().iter().copied().fold(0.0, f32::max);
            for (valid, near) in valid.pixels_mut().iter_mut().zip(near.pixels()) {
                *valid = if *near > NEAR_BRIGHT_SHARE * most { 255 } else { 0 };
            }
        }
        // The lamp's image must not bleed into what is slow around it: only usable pixels are averaged (normalized convolution).
        let mut slow = gray.clone();
        let mut weight = Image::filled(gray.width(), gray.height(), 0.0);
        let weights = weight.pixels_mut().iter_mut().zip(valid.pixels());
        for (slow, (weight, &valid)) in slow.pixels_mut().iter_mut().zip(weights) {
            *weight = if valid == 0 { 0.0 } else { 1.0 };
            *slow *= *weight;
        }
        gaussian_blur(&mut slow, DETAIL_SIGMA_PX, &mut self.scratch);
        gaussian_blur(&mut weight, DETAIL_SIGMA_PX, &mut self.scratch);
        for (level, (slow, weight)) in gray.pixels_mut().iter_mut().zip(slow.pixels().iter().zip(weight.pixels())) {
            *level -= slow / weight.max(1e-3);
        }
        let mut trusted = eroded(&valid, MARGIN_PX);
        for y in 0..height {
            for x in (0..width).filter(|&x| x.min(y).min(width - 1 - x).min(height - 1 - y) < MARGIN_PX) {
                trusted.set(x, y, 0);
            }
        }
        let pyramid = Pyramid::new(gray, trusted, LEVELS);
        let slopes = pyramid.levels.iter().map(gradient).collect();
        Level0 {
            on_black,
            pyramid,
            slopes,
        }
    }
}

/// x' = x + shift + (growth, turn)·(x − centre), in px of a level.
#[derive(Clone, Copy, Debug, Default)]
struct Similarity {
    right: f32,
    down: f32,
    turn: f32,
    growth: f32,
}

fn aligned(previous: &Level0, current: &Pyramid) -> Option<ImageMotion> {
    let mut similarity = Similarity::default();
    let mut from = current.levels.len();
    if previous.on_black && SEARCH_LEVEL < from {
        similarity = searched(&previous.pyramid.levels[SEARCH_LEVEL], &current.levels[SEARCH_LEVEL]);
        from = SEARCH_LEVEL + 1;
    }
    for level in (0..from).rev() {
        let scale = 2.0_f32;
        if level + 1 < from {
            similarity.right *= scale;
            similarity.down *= scale;
        }
        for _ in 0..ROUNDS {
            let step = step(previous, current, level, &similarity)?;
            similarity.right -= step[0];
            similarity.down -= step[1];
            similarity.turn -= step[2];
            similarity.growth -= step[3];
            let reach = 0.5 * current.levels[level].width() as f32;
            if step[0].abs().max(step[1].abs()) + reach * step[2].abs().max(step[3].abs()) < SETTLED_PX {
                break;
            }
        }
    }
    let width = current.levels[0].width() as f64;
    let plausible = similarity.growth.abs() < 0.5 && similarity.turn.abs() < 0.5;
    plausible.then_some(ImageMotion {
        right: f64::from(similarity.right) / width,
        down: f64::from(similarity.down) / width,
        turn: f64::from(similarity.turn),
        growth: f64::from(similarity.growth),
    })
}

/// The whole shift, in px of the level, at which two pictures correlate best.
fn searched(before: &Image<f32>, after: &Image<f32>) -> Similarity {
    let (width, height) = before.size();
    let reach = [
        (SEARCH_SHARE[0] * width as f32) as isize,
        (SEARCH_SHARE[1] * height as f32) as isize,
    ];
    let correlation = |right: isize, down: isize| {
        let (mut product, mut square) = (0.0_f32, 1e-9_f32);
        for y in 0..height {
            let Some(row) = y.checked_add_signed(down).filter(|row| *row < after.height()) else {
                continue;
            };
            for x in 0..width {
                let Some(column) = x.checked_add_signed(right).filter(|column| *column < after.width()) else {
                    continue;
                };
                let level = after.at(column, row);
                product += before.at(x, y) * level;
                square += level * level;
            }
        }
        // Along a line all shifts are alike: the shortest is meant.
        product / square.sqrt() * (1.0 - SHORTER_SHARE * (right.abs() + down.abs()) as f32)
    };
    let shifts = (-reach[1]..=reach[1]).flat_map(|down| (-reach[0]..=reach[0]).map(move |right| (right, down)));
    let best = shifts
        .map(|(right, down)| (correlation(right, down), right, down))
        .max_by(|a, b| a.0.total_cmp(&b.0));
    let (_, right, down) = best.unwrap_or((0.0, 0, 0));
    Similarity {
        right: right as f32,
        down: down as f32,
        ..Similarity::default()
    }
}

/// A Gauss–Newton step: by how much the similarity overshoots. Slopes are the previous picture's, the same at every round; a change of
/// contrast is an unknown of its own, since it would pass for growth.
fn step(previous: &Level0, current: &Pyramid, level: usize, similarity: &Similarity) -> Option<SVector<f32, UNKNOWNS>> {
    let (template, valid) = (&previous.pyramid.levels[level], &previous.pyramid.valid[level]);
    let (slope_x, slope_y) = &previous.slopes[level];
    let (image, usable) = (&current.levels[level], &current.valid[level]);
    let (width, height) = template.size();
    let (cx, cy) = (0.5 * width as f32 - 0.5, 0.5 * height as f32 - 0.5);
    let mut rows = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            if valid.at(x, y) == 0 {
                continue;
            }
            let (u, v) = (x as f32 - cx, y as f32 - cy);
            let at_x = x as f32 + similarity.right + similarity.growth * u - similarity.turn * v;
            let at_y = y as f32 + similarity.down + similarity.growth * v + similarity.turn * u;
            let Some(level) = bilinear(image, at_x, at_y) else { continue };
            if usable.at((at_x + 0.5) as usize, (at_y + 0.5) as usize) == 0 {
                continue;
            }
            let (gx, gy) = (slope_x.at(x, y), slope_y.at(x, y));
            rows.push((
                SVector::<f32, UNKNOWNS>::from([gx, gy, gy * u - gx * v, gx * u + gy * v, template.at(x, y)]),
                level - template.at(x, y),
            ));
        }
    }
    if (rows.len() as f32) < (LEAST_SHARE * (width * height) as f32).max(40.0) {
        return None;
    }
    // Huber at 1.5 deviations, the deviation from the mean size of a Gaussian's residuals.
    let mean = rows.iter().map(|(_, r)| r.abs()).sum::<f32>() / rows.len() as f32;
    let limit = (1.5 * 1.2533 * mean).max(1e-3);
    let (mut normal, mut side) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros(), SVector::<f64, UNKNOWNS>::zeros());
    for (slope, residual) in &rows {
        let weight = f64::from((limit / residual.abs().max(1e-12)).min(1.0));
        let slope = slope.cast::<f64>();
        normal += weight * slope * slope.transpose();
        side += weight * f64::from(*residual) * slope;
    }
    let slopes = normal[(0, 0)] + normal[(1, 1)];
    let reach = 0.25 * (width as f64).powi(2);
    // What a lone line's shift and growth do to it is the same: on black, nothing grows.
    let growth = if previous.on_black { LOCKED * reach } else { reach };
    for (unknown, size) in [1.0, 1.0, reach, growth].into_iter().enumerate() {
        normal[(unknown, unknown)] += DAMPING * slopes * size;
    }
    let step = normal.cholesky()?.solve(&side);
    step.iter().all(|s| s.is_finite()).then(|| step.cast::<f32>())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (480, 270);

    /// Texture seen through a similarity about the middle, with a bright spot that does not move along.
    fn seen(right: f64, down: f64, turn: f64, growth: f64, brightness: f64) -> Image<Rgb8> {
        let (width, height) = SIZE;
        let mut image = Image::filled(width, height, [0; 3]);
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (x as f64 - 239.5 - right * 480.0, y as f64 - 134.5 - down * 480.0);
                let (a, b) = (1.0 + growth, turn);
                let s = 1.0 / (a * a + b * b);
                let (u, v) = (s * (a * u + b * v), s * (a * v - b * u));
                let wave = 20.0 * (0.11 * u + 0.03 * v).sin()
                    + 18.0 * (0.09 * v - 0.05 * u).cos()
                    + 14.0 * (0.23 * u).sin() * (0.19 * v).cos();
                let level = brightness * (110.0 + wave);
                let spot = (x as f64 - 200.0).hypot(y as f64 - 100.0) < 14.0;
                let level = if spot { 255 } else { level.clamp(0.0, 255.0) as u8 };
                image.set(x, y, [level, level, level]);
            }
        }
        image
    }

    #[test]
    fn shift_turn_and_growth_are_found_in_spite_of_the_lamp() {
        for (right, down, turn, growth) in [
            (0.0, 0.0, 0.0, 0.0),
            (0.012, -0.007, 0.0, 0.0),
            (0.002, 0.001, 0.02, -0.015),
            (-0.04, 0.03, -0.01, 0.02),
        ] {
            let mut tracker = MotionTracker::default();
            assert!(tracker.next(&seen(0.0, 0.0, 0.0, 0.0, 1.0)).is_none());
            let found = tracker.next(&seen(right, down, turn, growth, 1.08)).unwrap();
            // A hundredth of a working pixel in shift, and as much at the rim in turn and growth; twice that for rounding to levels.
            let wanted = [right, down, turn, growth];
            for (found, wanted) in found.components().into_iter().zip(wanted) {
                assert!(
                    (found - wanted).abs() < 2.0 * 0.01 / 120.0 + 0.01 * wanted.abs(),
                    "{found} for {wanted}"
                );
            }
        }
    }

    /// A thin bright line on black, as ultrasound shows the bottom of a tank; along the line nothing can be told, and nothing is made up.
    #[test]
    fn a_lone_line_moves_across_itself() {
        let line = |down: f64, turn: f64| {
            let (width, height) = SIZE;
            let mut image = Image::filled(width, height, [0; 3]);
            for x in 60..420 {
                for y in 0..height {
                    let away = y as f64 - 120.0 - down - (turn + 0.05) * (x as f64 - 239.5);
                    let level = (150.0 * (-0.5 * (away / 4.0).powi(2)).exp()) as u8;
                    image.set(x, y, [level; 3]);
                }
            }
            image
        };
        let mut tracker = MotionTracker::default();
        tracker.next(&line(0.0, 0.0));
        for (down, turn) in [(3.0, 0.0), (-8.0, 0.01), (0.0, 0.0), (55.0, 0.0)] {
            tracker.reset();
            tracker.next(&line(0.0, 0.0));
            let found = tracker.next(&line(down, turn)).unwrap();
            assert!((found.down - down / 480.0).abs() < 0.3 / 480.0, "{down} {turn}: {found:?}");
            assert!(
                (found.turn - turn).abs() < 0.002 && found.right.abs() < 1.0 / 480.0,
                "{down} {turn}: {found:?}"
            );
        }
    }

    #[test]
    fn black_pictures_tell_nothing_and_another_size_begins_anew() {
        let mut tracker = MotionTracker::default();
        tracker.next(&seen(0.0, 0.0, 0.0, 0.0, 1.0));
        assert!(tracker.next(&Image::filled(480, 270, [0; 3])).is_none());
        assert!(tracker.next(&Image::filled(240, 270, [90; 3])).is_none());
    }
}
