//! Even areas of a picture that may be patches: little changes within, and the outline is about a parallelogram.
//!
//! What counts is the change from pixel to pixel relative to the brightness around, so that a patch in the dim border of the field is as
//! even as one in the middle. Several limits are tried, because noise asks for a high one and dark patches on a dark frame for a low one.
//! A parallelogram of area A has second moments with A² = 144 det C (an ellipse 16π² det C), whatever its slant.

use nalgebra::Matrix2;

use crate::camera::intrinsics::Pixel;
use crate::image::blur::{BlurScratch, gaussian_blur};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::Components;
use crate::image::pyramid::eroded;

/// Largest changes a pixel, relative to the brightness.
const LIMITS: [f32; 5] = [0.012, 0.02, 0.035, 0.06, 0.1];
/// Levels added to the brightness, so that noise in the dark is no edge.
const DARK_LEVELS: f32 = 12.0;
/// Pixels that a region has at least.
const LEAST_AREA: f64 = 20.0;
/// Share of the picture that it has at most.
const LARGEST_SHARE: f64 = 0.12;
/// A² / (144 det C), least and most.
const SHAPE: [f64; 2] = [0.8, 1.12];
/// Length over width at most, by the moments.
const MOST_STRETCH: f64 = 4.0;

/// An even area.
#[derive(Clone, Copy, Debug)]
pub struct Region {
    /// Its centre.
    pub center: Pixel,
    /// Its second moments, px².
    pub moments: Matrix2<f64>,
    /// Pixels.
    pub area: f64,
}

/// All regions of a picture; of several that lie on one another the most even one.
pub fn regions(image: &Image<Rgb8>) -> Vec<Region> {
    let change = change(image);
    let mut found: Vec<Region> = Vec::new();
    let mut components = Components::default();
    for limit in LIMITS {
        let even: Vec<u8> = change.pixels().iter().map(|c| u8::from(*c < limit) * 255).collect();
        let Some(even) = Mask::from_vec(image.width(), image.height(), even) else {
            continue;
        };
        // What hangs together by a pixel at a corner does not belong together.
        components.label(&eroded(&even, 1));
        for region in shaped(&components, image.width() * image.height()) {
            let known = found.iter_mut().find(|known| {
                let far = (known.center.x - region.center.x).hypot(known.center.y - region.center.y);
                far < 0.3 * known.area.max(region.area).sqrt()
            });
            match known {
                Some(known) if known.area < region.area => *known = region,
                Some(_) => {}
                None => found.push(region),
            }
        }
    }
    found
}

/// The largest change of any channel to the next pixels, relative to the brightness.
fn change(image: &Image<Rgb8>) -> Image<f32> {
    let (width, height) = image.size();
    let mut scratch = BlurScratch::default();
    let planes: [Image<f32>; 3] = std::array::from_fn(|c| {
        let mut plane = Image::filled(width, height, 0.0);
        for (out, pixel) in plane.pixels_mut().iter_mut().zip(image.pixels()) {
            *out = f32::from(pixel[c]);
        }
        gaussian_blur(&mut plane, 1.0, &mut scratch);
        plane
    });
    let mut out = Image::filled(width, height, f32::INFINITY);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let (mut steepest, mut brightest) = (0.0_f32, 0.0_f32);
            for plane in &planes {
                let across = plane.at(x + 1, y) - plane.at(x - 1, y);
                let down = plane.at(x, y + 1) - plane.at(x, y - 1);
                steepest = steepest.max(across * across + down * down);
                brightest = brightest.max(plane.at(x, y));
            }
            out.set(x, y, 0.5 * steepest.sqrt() / (brightest + DARK_LEVELS));
        }
    }
    out
}

#[derive(Clone, Copy, Default)]
struct Sums {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
}

/// The components that look like patches.
fn shaped(components: &Components, pixels: usize) -> Vec<Region> {
    let mut sums = vec![Sums::default(); components.regions().len()];
    for run in components.runs() {
        let Some(sum) = sums.get_mut(run.label as usize) else {
            continue;
        };
        let y = f64::from(run.y);
        for x in run.begin..run.end {
            let x = f64::from(x);
            sum.n += 1.0;
            sum.x += x;
            sum.y += y;
            sum.xx += x * x;
            sum.xy += x * y;
            sum.yy += y * y;
        }
    }
    let largest = LARGEST_SHARE * pixels as f64;
    (sums.iter())
        .filter(|sum| sum.n >= LEAST_AREA && sum.n <= largest)
        .filter_map(|sum| {
            let (x, y) = (sum.x / sum.n, sum.y / sum.n);
            // 1/12: a pixel is a square, not a point.
            let (xx, yy) = (sum.xx / sum.n - x * x + 1.0 / 12.0, sum.yy / sum.n - y * y + 1.0 / 12.0);
            let xy = sum.xy / sum.n - x * y;
            let moments = Matrix2::new(xx, xy, xy, yy);
            let shape = sum.n * sum.n / (144.0 * moments.determinant());
            let axes = moments.symmetric_eigenvalues();
            let stretch = (axes.max() / axes.min().max(1e-9)).sqrt();
            ((SHAPE[0]..SHAPE[1]).contains(&shape) && stretch < MOST_STRETCH).then_some(Region {
                center: Pixel { x, y },
                moments,
                area: sum.n,
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parallelograms_are_found_and_rings_are_not() {
        let mut image = Image::filled(200, 150, [30, 30, 30]);
        for y in 0..150_i32 {
            for x in 0..200_i32 {
                // A slanted patch around (50, 60), a ring around (140, 70).
                let (u, v) = (x - 50 + (y - 60) / 3, y - 60);
                if u.abs() < 18 && v.abs() < 14 {
                    image.set(x as usize, y as usize, [200, 120, 60]);
                }
                let r = f64::from(x - 140).hypot(f64::from(y - 70));
                if (18.0..30.0).contains(&r) {
                    image.set(x as usize, y as usize, [90, 150, 60]);
                }
            }
        }
        let found = regions(&image);
        assert!(found.iter().any(|r| (r.center.x - 50.0).hypot(r.center.y - 60.0) < 1.0));
        // Within the ring lies a disk, the ring itself is none.
        for r in &found {
            let middle = (r.center.x - 140.0).hypot(r.center.y - 70.0) < 5.0;
            assert!(!middle || r.area < 900.0, "{r:?}");
        }
    }
}
