//! A corner of a printed pattern to a few hundredths of a pixel, where more than four squares meet the eye.
//!
//! Around a ChArUco corner the white squares are but thin lines about their markers; a model of crossing edges would not fit. So the
//! print itself, markers and all, is blurred as the picture is and laid over the pixels; place, the four numbers of the local affine
//! map, gain and offset are fitted to them by Gauss–Newton steps (Lucas and Kanade 1981; Baker and Matthews 2004,
//! doi:10.1023/B:VISI.0000011205.11775.fd).

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use crate::calibration::board::charuco::Print;
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::Image;

/// A fitted corner.
#[derive(Clone, Copy, Debug)]
pub struct FittedSite {
    /// Where.
    pub pixel: Pixel,
    /// Standard deviation along x and y, px.
    pub sigma_px: f64,
    /// How alike print and picture are, −1…1.
    pub likeness: f64,
}

/// The patch of print laid over the picture reaches so many squares to each side.
const REACH: f64 = 0.46;
/// The blurred print is known over a little more.
const KNOWN_REACH: f64 = 0.85;
/// Points of it across.
const POINTS: usize = 65;
/// Points of print per point, to soften its steps.
const FINER: usize = 3;
/// Below this the pixels show something else.
const LEAST_LIKENESS: f64 = 0.8;
const MOST_STEPS: usize = 25;
/// Squares smaller than this cannot be told from noise, px.
const LEAST_SQUARE_PX: f64 = 6.0;
/// Pixels looked at across a patch; of larger ones some are passed over.
const MOST_SAMPLES_ACROSS: f64 = 36.0;
/// Blurs tried, px.
const BLURS_PX: [f64; 6] = [0.6, 0.9, 1.3, 1.8, 2.5, 3.5];
/// Corners that the blur is judged by.
const BLUR_SAMPLES: usize = 15;

const PARAMETERS: usize = 8;
type Parameters = SVector<f64, PARAMETERS>;

/// The print around a corner, blurred: 0 black, 1 white.
struct Patch {
    values: Vec<f64>,
    step_mm: f64,
}

impl Patch {
    fn new(print: &Print, center_mm: [f64; 2], square_mm: f64, blur_mm: f64) -> Self {
        let step_mm = 2.0 * KNOWN_REACH * square_mm / (POINTS - 1) as f64;
        let start = -KNOWN_REACH * square_mm;
        let mut values = vec![0.0; POINTS * POINTS];
        for (place, value) in values.iter_mut().enumerate() {
            let (u, v) = (place % POINTS, place / POINTS);
            let mut white = 0;
            for k in 0..FINER * FINER {
                let offset = |i: usize| ((i as f64 + 0.5) / FINER as f64 - 0.5) * step_mm;
                let x = center_mm[0] + start + u as f64 * step_mm + offset(k % FINER);
                let y = center_mm[1] + start + v as f64 * step_mm + offset(k / FINER);
                white += usize::from(print.is_white(x, y));
            }
            *value = white as f64 / (FINER * FINER) as f64;
        }
        blur(&mut values, blur_mm / step_mm);
        Self { values, step_mm }
    }

    /// Value and slope per mm at a place, mm from the corner.
    fn at(&self, x: f64, y: f64) -> Option<(f64, Vector2<f64>)> {
        let half = (POINTS - 1) as f64 / 2.0;
        let (u, v) = (x / self.step_mm + half, y / self.step_mm + half);
        let last = (POINTS - 2) as f64;
        if !(u >= 0.0 && v >= 0.0 && u < last && v < last) {
            return None;
        }
        let (i, j) = (u as usize, v as usize);
        let (a, b) = (u - i as f64, v - j as f64);
        let p = |du: usize, dv: usize| self.values[(j + dv) * POINTS + i + du];
        let value = (p(0, 0) * (1.0 - a) + p(1, 0) * a) * (1.0 - b) + (p(0, 1) * (1.0 - a) + p(1, 1) * a) * b;
        let across = (p(1, 0) - p(0, 0)) * (1.0 - b) + (p(1, 1) - p(0, 1)) * b;
        let down = (p(0, 1) - p(0, 0)) * (1.0 - a) + (p(1, 1) - p(1, 0)) * a;
        Some((value, Vector2::new(across, down) / self.step_mm))
    }
}

fn blur(values: &mut [f64], sigma: f64) {
    let reach = (3.0 * sigma).ceil().clamp(1.0, POINTS as f64) as isize;
    let kernel: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let pass = |values: &mut [f64], stride: usize, other: usize| {
        let mut line = vec![0.0; POINTS];
        for start in 0..POINTS {
            for (i, out) in line.iter_mut().enumerate() {
                *out = (-reach..=reach)
                    .zip(&kernel)
                    .map(|(k, weight)| {
                        let at = (i as isize + k).clamp(0, POINTS as isize - 1) as usize;
                        weight * values[start * other + at * stride]
                    })
                    .sum::<f64>()
                    / total;
            }
            for (i, value) in line.iter().enumerate() {
                values[start * other + i * stride] = *value;
            }
        }
    };
    pass(values, 1, POINTS);
    pass(values, POINTS, 1);
}

/// The blur under which print and picture are most alike at some of the starts (place, px per mm, place on the board).
pub fn typical_blur_px(
    gray: &Image<f32>,
    print: &Print,
    square_mm: f64,
    starts: &[(Pixel, Matrix2<f64>, [f64; 2])],
) -> Option<f64> {
    let every = starts.len().div_ceil(BLUR_SAMPLES).max(1);
    let mut best: Vec<f64> = starts
        .iter()
        .step_by(every)
        .filter_map(|(pixel, frame, place)| {
            BLURS_PX
                .into_iter()
                .filter_map(|blur_px| {
                    Some((
                        fitted(gray, print, square_mm, *place, *pixel, frame, blur_px)?.likeness,
                        blur_px,
                    ))
                })
                .max_by(|a, b| a.0.total_cmp(&b.0))
        })
        .map(|(_, blur_px)| blur_px)
        .collect();
    best.sort_by(f64::total_cmp);
    best.get(best.len() / 2).copied()
}

/// The corner at `center_mm` of the board, from a start in the picture and the local map `frame` (px per mm).
pub fn fitted(
    gray: &Image<f32>,
    print: &Print,
    square_mm: f64,
    center_mm: [f64; 2],
    start: Pixel,
    frame: &Matrix2<f64>,
    blur_px: f64,
) -> Option<FittedSite> {
    let px_per_mm = frame.determinant().abs().sqrt();
    let square_px = px_per_mm * square_mm;
    if !(square_px > LEAST_SQUARE_PX && square_px < gray.width() as f64) {
        return None;
    }
    let patch = Patch::new(print, center_mm, square_mm, blur_px / px_per_mm);
    let every = (2.0 * REACH * square_px / MOST_SAMPLES_ACROSS).ceil().max(1.0) as usize;
    let (mut at, mut frame) = (Vector2::new(start.x, start.y), *frame);
    let (mut gain, mut offset) = (0.0, 0.0);
    let mut sums = None;
    for step in 0..MOST_STEPS {
        let inverse = frame.try_inverse()?;
        let reach = REACH * square_mm;
        // The corners of the patch bound the pixels that may lie in it.
        let wide = reach * (frame[(0, 0)].abs() + frame[(0, 1)].abs());
        let high = reach * (frame[(1, 0)].abs() + frame[(1, 1)].abs());
        let (left, right) = ((at.x - wide).floor(), (at.x + wide).ceil());
        let (top, bottom) = ((at.y - high).floor(), (at.y + high).ceil());
        if !(left >= 0.0 && top >= 0.0 && right < gray.width() as f64 && bottom < gray.height() as f64) {
            return None;
        }
        let mut samples = Vec::new();
        for y in (top as usize..=bottom as usize).step_by(every) {
            // Every other row begins elsewhere, so that no cell of the print is passed over.
            let shift = if y / every % 2 == 1 { every / 2 } else { 0 };
            for x in (left as usize + shift..=right as usize).step_by(every) {
                let q = inverse * (Vector2::new(x as f64, y as f64) - at);
                if q.amax() < reach
                    && let Some((value, slope)) = patch.at(q.x, q.y)
                {
                    samples.push((f64::from(gray.at(x, y)), value, slope, q));
                }
            }
        }
        let n = samples.len() as f64;
        if n < 3.0 * PARAMETERS as f64 {
            return None;
        }
        let (mean_i, mean_t) = samples.iter().fold((0.0, 0.0), |(i, t), s| (i + s.0 / n, t + s.1 / n));
        let (mut ii, mut tt, mut it) = (0.0, 0.0, 0.0);
        for (i, t, ..) in &samples {
            ii += (i - mean_i).powi(2);
            tt += (t - mean_t).powi(2);
            it += (i - mean_i) * (t - mean_t);
        }
        if step == 0 {
            gain = it / tt.max(1e-9);
            offset = mean_i - gain * mean_t;
            if gain <= 0.0 {
                return None;
            }
        }
        let (mut normal, mut slope, mut cost) = (SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros(), Parameters::zeros(), 0.0);
        for (i, t, gradient, q) in &samples {
            // q = F⁻¹(p − c): dq = −F⁻¹(dc + dF q).
            let by_place = -(inverse.transpose() * gradient) * gain;
            let row = Parameters::from_column_slice(&[
                by_place.x,
                by_place.y,
                by_place.x * q.x,
                by_place.x * q.y,
                by_place.y * q.x,
                by_place.y * q.y,
                *t,
                1.0,
            ]);
            let residual = offset + gain * t - i;
            normal += row * row.transpose();
            slope += row * residual;
            cost += residual * residual;
        }
        // Flat directions stay where they are.
        for k in 0..PARAMETERS {
            normal[(k, k)] *= 1.0 + 1e-4;
            normal[(k, k)] += 1e-9;
        }
        let cholesky = normal.cholesky()?;
        let d = -cholesky.solve(&slope);
        let longest = 0.15 * square_px;
        let shorten = (longest / d[0].hypot(d[1]).max(1e-12)).min(1.0);
        at += Vector2::new(d[0], d[1]) * shorten;
        frame += Matrix2::new(d[2], d[3], d[4], d[5]) * shorten;
        gain += d[6] * shorten;
        offset += d[7] * shorten;
        sums = Some((
            it / (ii * tt).sqrt().max(1e-12),
            cost / (n - PARAMETERS as f64),
            cholesky.inverse(),
        ));
        if (at - Vector2::new(start.x, start.y)).norm() > 0.6 * square_px || gain <= 0.0 {
            return None;
        }
        if shorten == 1.0 && d[0].hypot(d[1]) < 1e-3 {
            break;
        }
    }
    let (likeness, variance, covariance) = sums?;
    let sigma_px = (variance * (covariance[(0, 0)] + covariance[(1, 1)]) / 2.0).sqrt();
    let size = frame.determinant().abs().sqrt() / px_per_mm;
    (likeness > LEAST_LIKENESS && sigma_px < 0.5 && (0.7..1.4).contains(&size)).then_some(FittedSite {
        pixel: Pixel { x: at.x, y: at.y },
        sigma_px,
        likeness,
    })
}
