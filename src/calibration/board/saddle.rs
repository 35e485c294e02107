//! Where four squares of a checkerboard may meet: saddles of the brightness.
//!
//! At such a place the Hessian of the smoothed picture has one positive and one negative eigenvalue, so −det H is large (Lucchese and
//! Mitra 2002, "Using saddle points for subpixel feature detection in camera calibration targets"). Measured in units of the contrast
//! around, it does not care for vignetting. On a ring around a true one, bright and dark alternate twice and opposite sides look alike
//! (Bennett and Lasenby 2014, "ChESS", doi:10.1016/j.cviu.2013.10.008); where they change, an edge leaves the corner.

use std::f64::consts::{PI, TAU};

use crate::camera::intrinsics::Pixel;
use crate::image::buffer::Image;
use crate::image::pyramid::smoothed;

/// A place where four squares may meet.
#[derive(Clone, Copy, Debug)]
pub struct Saddle {
    /// Where, to about a pixel.
    pub pixel: Pixel,
    /// Directions of its two edges, rad in 0…π from x to y: turning from the first to the second, one passes over a bright square.
    pub edges: [f64; 2],
    /// Half the difference of bright and dark, gray levels.
    pub contrast: f64,
}

/// −det H in units of squared contrast, for the smoothing used: 0.4 at an ideal corner.
const LEAST_RESPONSE: f32 = 0.08;
/// Half the difference of bright and dark, gray levels.
const LEAST_CONTRAST: f64 = 3.0;
/// Samples on the ring.
const RING: usize = 32;
/// Radii of the ring, px; a small board has room only for the first.
const RING_RADII_PX: [f64; 2] = [3.5, 5.0];
/// How much of the ring's variance may differ between opposite sides.
const MOST_ODD_SHARE: f64 = 0.25;
/// Two edges closer than this are one, rad.
const LEAST_ANGLE_RAD: f64 = 0.26;

/// All saddles of a gray picture (0–255), strongest contrast first.
pub fn saddles(gray: &Image<f32>) -> Vec<Saddle> {
    let (width, height) = gray.size();
    if width < 16 || height < 16 {
        return Vec::new();
    }
    // Two binomials: a Gaussian of σ = √2 px.
    let soft = smoothed(&smoothed(gray));
    let response = response(&soft);
    let mut found = Vec::new();
    for y in 6..height - 6 {
        for x in 6..width - 6 {
            let value = response.at(x, y);
            if value < LEAST_RESPONSE || !is_peak(&response, x, y, value) {
                continue;
            }
            let Some(center) = peak(&response, x, y) else { continue };
            if let Some(saddle) = RING_RADII_PX.iter().find_map(|radius| ringed(&soft, center, *radius)) {
                found.push(saddle);
            }
        }
    }
    found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
    found
}

/// −det H · σ⁴ over the variance around.
fn response(soft: &Image<f32>) -> Image<f32> {
    const RADIUS: usize = 4;
    const SIGMA4: f32 = 4.0;
    let (width, height) = soft.size();
    let variance = local_variance(soft, RADIUS);
    let mut out = Image::filled(width, height, 0.0);
    for y in 1..height - 1 {
        let (above, here, below) = (soft.row(y - 1), soft.row(y), soft.row(y + 1));
        for (x, out) in out.row_mut(y).iter_mut().enumerate().take(width - 1).skip(1) {
            let xx = here[x - 1] + here[x + 1] - 2.0 * here[x];
            let yy = above[x] + below[x] - 2.0 * here[x];
            let xy = (below[x + 1] - below[x - 1] - above[x + 1] + above[x - 1]) / 4.0;
            *out = (xy * xy - xx * yy) * SIGMA4 / (variance.at(x, y) + 2.0);
        }
    }
    out
}

fn local_variance(image: &Image<f32>, radius: usize) -> Image<f32> {
    use crate::image::blur::{BlurScratch, box_blur};
    let mut scratch = BlurScratch::default();
    let mut mean = image.clone();
    box_blur(&mut mean, radius, &mut scratch);
    let mut square = image.clone();
    for value in square.pixels_mut() {
        *value *= *value;
    }
    box_blur(&mut square, radius, &mut scratch);
    for (square, mean) in square.pixels_mut().iter_mut().zip(mean.pixels()) {
        *square = (*square - mean * mean).max(0.0);
    }
    square
}

fn is_peak(image: &Image<f32>, x: usize, y: usize, value: f32) -> bool {
    (y - 2..=y + 2).all(|v| {
        (x - 2..=x + 2).all(|u| (u, v) == (x, y) || image.at(u, v) < value || (image.at(u, v) == value && (v, u) > (y, x)))
    })
}

/// The top of the parabola through a peak's neighbours.
fn peak(image: &Image<f32>, x: usize, y: usize) -> Option<Pixel> {
    let top = |a: f32, b: f32, c: f32| {
        let bend = a + c - 2.0 * b;
        if bend < 0.0 {
            ((a - c) / (2.0 * bend)).clamp(-0.5, 0.5)
        } else {
            0.0
        }
    };
    let b = image.at(x, y);
    Some(Pixel {
        x: x as f64 + f64::from(top(image.at(x - 1, y), b, image.at(x + 1, y))),
        y: y as f64 + f64::from(top(image.at(x, y - 1), b, image.at(x, y + 1))),
    })
}

/// The value between pixels; `None` outside the picture.
pub(crate) fn bilinear(image: &Image<f32>, x: f64, y: f64) -> Option<f64> {
    let (width, height) = image.size();
    if !(x >= 0.0 && y >= 0.0 && x <= width as f64 - 1.001 && y <= height as f64 - 1.001) {
        return None;
    }
    let (u, v) = (x as usize, y as usize);
    let (fx, fy) = (x - u as f64, y - v as f64);
    let at = |u: usize, v: usize| f64::from(image.at(u, v));
    Some((at(u, v) * (1.0 - fx) + at(u + 1, v) * fx) * (1.0 - fy) + (at(u, v + 1) * (1.0 - fx) + at(u + 1, v + 1) * fx) * fy)
}

/// The saddle at `center` if the ring around it is that of a corner.
fn ringed(soft: &Image<f32>, center: Pixel, radius: f64) -> Option<Saddle> {
    let mut ring = [0.0; RING];
    for (k, value) in ring.iter_mut().enumerate() {
        let angle = TAU * k as f64 / RING as f64;
        *value = bilinear(soft, center.x + radius * angle.cos(), center.y + radius * angle.sin())?;
    }
    const HALF: usize = RING / 2;
    let mut even = [0.0; HALF];
    let (mut odd_energy, mut low, mut high) = (0.0, f64::INFINITY, f64::NEG_INFINITY);
    for k in 0..HALF {
        even[k] = (ring[k] + ring[k + HALF]) / 2.0;
        odd_energy += (ring[k] - ring[k + HALF]).powi(2) / 4.0;
        low = low.min(even[k]);
        high = high.max(even[k]);
    }
    let middle = (low + high) / 2.0;
    let contrast = (high - low) / 2.0;
    let even_energy: f64 = even.iter().map(|v| (v - middle).powi(2)).sum();
    if contrast < LEAST_CONTRAST || odd_energy > MOST_ODD_SHARE * even_energy {
        return None;
    }
    let (mut rising, mut falling, mut changes) = (0.0, 0.0, 0);
    for k in 0..HALF {
        let (a, b) = (even[k] - middle, even[(k + 1) % HALF] - middle);
        if (a >= 0.0) == (b >= 0.0) {
            continue;
        }
        changes += 1;
        let angle = ((k as f64 + a / (a - b)) / HALF as f64 * PI).rem_euclid(PI);
        if b > a {
            rising = angle;
        } else {
            falling = angle;
        }
    }
    let between = (falling - rising).rem_euclid(PI);
    if changes != 2 || !(LEAST_ANGLE_RAD..=PI - LEAST_ANGLE_RAD).contains(&between) {
        return None;
    }
    Some(Saddle {
        pixel: center,
        edges: [rising, falling],
        contrast,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corner_is_found_with_its_edges() {
        // Bright where the angle from the first edge to the second lies, both ways.
        let (first, second) = (0.3_f64, 1.7_f64);
        let mut image = Image::filled(40, 40, 0.0_f32);
        for y in 0..40 {
            for x in 0..40 {
                let angle = (f64::from(y as u32) - 20.3).atan2(f64::from(x as u32) - 19.6).rem_euclid(PI);
                image.set(x, y, if angle > first && angle < second { 200.0 } else { 30.0 });
            }
        }
        let found = saddles(&image);
        assert_eq!(found.len(), 1, "{found:?}");
        let saddle = found[0];
        assert!(
            (saddle.pixel.x - 19.6).abs() < 0.5 && (saddle.pixel.y - 20.3).abs() < 0.5,
            "{saddle:?}"
        );
        assert!(
            (saddle.edges[0] - first).abs() < 0.1 && (saddle.edges[1] - second).abs() < 0.1,
            "{saddle:?}"
        );
    }

    #[test]
    fn an_edge_and_a_dot_are_no_corners() {
        let mut image = Image::filled(60, 40, 30.0_f32);
        for y in 0..40 {
            for x in 0..60 {
                let dot = (x as f64 - 44.0).hypot(y as f64 - 20.0) < 5.0;
                if x < 20 || dot {
                    image.set(x, y, 200.0);
                }
            }
        }
        assert!(saddles(&image).is_empty());
    }
}
