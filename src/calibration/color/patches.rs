//! What the patches look like: each one's color, without glare, and how the light changes across it.
//!
//! A patch is of one color, so a change of brightness within it is a change of the light: the slope of ln(luminance) across each patch
//! tells the light field without knowing any color.

use nalgebra::{Matrix3, Vector3};

use crate::calibration::color::chart::{PATCHES, place};
use crate::calibration::homography;
use crate::image::buffer::{Image, Rgb8};
use crate::image::color::linear_from_srgb;

/// Half of the part of a patch that is measured, in distances of patches: blurred edges and a chart found a little beside do no harm.
const CORE: f64 = 0.28;
/// From this level on a channel is clipped.
const CLIPPED_LEVEL: u8 = 251;
/// Up to this mean level a channel is lost in black.
const BLACK_LEVEL: f64 = 2.5;
/// A patch of which a larger share is clipped is out of range.
const CLIPPED_SHARE: f64 = 0.03;
/// Pixels farther from the plane of brightness than so many deviations are glare or dust.
const OUTLIER_DEVIATIONS: f64 = 3.0;
/// A patch needs so many pixels.
const LEAST_PIXELS: usize = 12;
/// A slope is not known better than this, for prints and lacquer are not that even, per distance of patches.
const LEAST_SLOPE_SIGMA: f64 = 0.01;

/// One patch in one picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patch {
    /// Which patch of the chart.
    pub patch: usize,
    /// Which of the pictures.
    pub picture: usize,
    /// Mean linear light, by sRGB's curve.
    pub linear: [f64; 3],
    /// Change of ln(luminance) per distance of patches, along the chart's columns and rows.
    pub slope: [f64; 2],
    /// Its standard deviation.
    pub slope_sigma: f64,
    /// Share of its pixels left out as glare or dust.
    pub left_out: f64,
    /// Clipped or lost in black: its color is not known.
    pub out_of_range: bool,
}

/// Why patches could not be measured.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "expected patches of at least {LEAST_PIXELS} pixels each, found {found} in {name}; let the chart fill more of the picture"
)]
pub struct TooSmall {
    /// Of the patch.
    pub name: &'static str,
    /// Its pixels.
    pub found: usize,
}

/// Measure all patches of the chart that lies at `pixel_from_chart`.
pub fn measured(image: &Image<Rgb8>, pixel_from_chart: &Matrix3<f64>, picture: usize) -> Result<Vec<Patch>, TooSmall> {
    (0..PATCHES)
        .map(|patch| one(image, pixel_from_chart, picture, patch))
        .collect()
}

/// A pixel of a patch: place on the patch, color.
struct Sample {
    at: [f64; 2],
    linear: [f64; 3],
    log: f64,
}

fn one(image: &Image<Rgb8>, map: &Matrix3<f64>, picture: usize, patch: usize) -> Result<Patch, TooSmall> {
    let (mut samples, mut clipped, mut levels) = (Vec::new(), 0, [0.0; 3]);
    for (at, pixel) in pixels(image, map, place(patch)) {
        clipped += usize::from(pixel.iter().any(|level| *level >= CLIPPED_LEVEL));
        for (sum, level) in levels.iter_mut().zip(pixel) {
            *sum += f64::from(level);
        }
        let linear = pixel.map(|level| linear_from_srgb(f64::from(level) / 255.0));
        let log = luminance(linear).max(1e-4).ln();
        samples.push(Sample { at, linear, log });
    }
    let all = samples.len();
    if all < LEAST_PIXELS {
        return Err(TooSmall {
            name: super::chart::NAMES.get(patch).copied().unwrap_or("a patch"),
            found: all,
        });
    }
    let mut plane = flat(&samples);
    for _ in 0..5 {
        let off = |sample: &Sample| sample.log - (plane.x + plane.y * sample.at[0] + plane.z * sample.at[1]);
        let mut sizes: Vec<f64> = samples.iter().map(|sample| off(sample).abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let deviation = 1.4826 * sizes.get(sizes.len() / 2).copied().unwrap_or(0.0);
        let limit = OUTLIER_DEVIATIONS * deviation.max(0.004);
        let mut kept = samples.iter().filter(|sample| off(sample).abs() <= limit);
        let Some((next, _)) = fitted(&mut kept) else { break };
        plane = next;
    }
    let off = |sample: &Sample| sample.log - (plane.x + plane.y * sample.at[0] + plane.z * sample.at[1]);
    let mut sizes: Vec<f64> = samples.iter().map(|sample| off(sample).abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let limit = OUTLIER_DEVIATIONS * (1.4826 * sizes.get(sizes.len() / 2).copied().unwrap_or(0.0)).max(0.004);
    samples.retain(|sample| off(sample).abs() <= limit);
    let n = samples.len().max(1) as f64;
    let mut linear = [0.0; 3];
    for sample in &samples {
        for (mean, v) in linear.iter_mut().zip(sample.linear) {
            *mean += v / n;
        }
    }
    let sigma = fitted(&mut samples.iter()).map_or(1.0, |(_, sigma)| sigma);
    Ok(Patch {
        patch,
        picture,
        linear,
        slope: [plane.y, plane.z],
        slope_sigma: sigma.max(LEAST_SLOPE_SIGMA),
        left_out: 1.0 - n / all as f64,
        out_of_range: clipped as f64 > CLIPPED_SHARE * all as f64 && {
            // Glare is clipped too, but left out; what is left tells.
            let bright = samples.iter().filter(|s| s.linear.iter().any(|v| *v >= 0.965)).count();
            bright as f64 > CLIPPED_SHARE * n
        } || levels.iter().any(|sum| sum / all as f64 <= BLACK_LEVEL),
    })
}

fn luminance([r, g, b]: [f64; 3]) -> f64 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// The pixels of a patch's core, each with its place relative to the patch's middle.
fn pixels<'a>(image: &'a Image<Rgb8>, map: &Matrix3<f64>, [u, v]: [f64; 2]) -> impl Iterator<Item = ([f64; 2], Rgb8)> + use<'a> {
    let corners = [[-CORE, -CORE], [CORE, -CORE], [CORE, CORE], [-CORE, CORE]];
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for [x, y] in corners
        .iter()
        .filter_map(|[du, dv]| homography::mapped(map, [u + du, v + dv]))
    {
        low = [low[0].min(x), low[1].min(y)];
        high = [high[0].max(x), high[1].max(y)];
    }
    let back = map.try_inverse();
    let (left, top) = (low[0].max(0.0) as usize, low[1].max(0.0) as usize);
    let right = (high[0].ceil().max(0.0) as usize + 1).min(image.width());
    let bottom = (high[1].ceil().max(0.0) as usize + 1).min(image.height());
    (top..bottom).flat_map(move |y| {
        (left..right).filter_map(move |x| {
            let at = homography::mapped(&back?, [x as f64, y as f64])?;
            let at = [at[0] - u, at[1] - v];
            (at[0].abs() <= CORE && at[1].abs() <= CORE).then(|| (at, image.at(x, y)))
        })
    })
}

/// The median brightness, without slope: a start that glare cannot bend.
fn flat(samples: &[Sample]) -> Vector3<f64> {
    let mut logs: Vec<f64> = samples.iter().map(|sample| sample.log).collect();
    logs.sort_by(f64::total_cmp);
    Vector3::new(logs.get(logs.len() / 2).copied().unwrap_or(0.0), 0.0, 0.0)
}

/// ln(luminance) as a plane, and the standard deviation of its slopes.
fn fitted(samples: &mut dyn Iterator<Item = &Sample>) -> Option<(Vector3<f64>, f64)> {
    let (mut normal, mut right, mut squares, mut n) = (Matrix3::zeros(), Vector3::zeros(), 0.0, 0.0);
    for sample in samples {
        let row = Vector3::new(1.0, sample.at[0], sample.at[1]);
        normal += row * row.transpose();
        right += sample.log * row;
        squares += sample.log * sample.log;
        n += 1.0;
    }
    let inverse: Matrix3<f64> = normal.try_inverse()?;
    let plane = inverse * right;
    let variance = ((squares - plane.dot(&right)) / (n - 3.0_f64).max(1.0)).max(0.0);
    Some((plane, (variance * inverse[(1, 1)].max(inverse[(2, 2)])).sqrt()))
}
