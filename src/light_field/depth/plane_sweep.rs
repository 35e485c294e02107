//! How well views agree at each of a pixel's depths: plane sweep (Collins 1996) with zero-mean normalised correlation.
//!
//! Hypotheses are steps of *inverse* depth around a base surface: for the pixel u with inverse depth w, the homogeneous place in
//! a neighbour is A·u + b·w, with A = K′RK⁻¹ and b = K′t, so that equal steps of w are equal steps along the epipolar line. On a
//! base that follows the scene, all pixels of a window move together as the slanted surface does, and the correlation is free
//! of the fronto-parallel bias of a sweep of true planes.
//!
//! Correlation is weighted by confidence: a specularity moves unlike the tissue below it and must not vote.

use nalgebra::{Matrix3, Vector3};

use crate::camera::intrinsics::Intrinsics;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};

/// Variance of sensor and coding noise that a window must rise above to count as texture, levels².
const NOISE_VARIANCE: f32 = 2.0;
/// A window must have this share of its pixels confident in both pictures.
const MIN_SUPPORT: f32 = 0.35;
/// The cost of a place about which nobody can say anything.
pub const UNKNOWN_COST: f32 = 0.7;

/// One view at one scale.
#[derive(Clone, Debug)]
pub struct Plane {
    /// Gray, mean removed.
    pub gray: Image<f32>,
    /// 1 where confident, else 0.
    pub weight: Image<f32>,
    /// For this scale.
    pub intrinsics: Intrinsics,
    /// Where the camera was.
    pub world_from_camera: Transform<World, Camera>,
}

impl Plane {
    /// The view at full size.
    pub fn new(
        image: &Image<Rgb8>,
        confidence: &Mask,
        intrinsics: Intrinsics,
        world_from_camera: Transform<World, Camera>,
    ) -> Self {
        let (width, height) = image.size();
        let mut gray = Image::filled(width, height, 0.0_f32);
        let mut weight = Image::filled(width, height, 0.0_f32);
        let (mut sum, mut count) = (0.0_f64, 0.0_f64);
        for (i, pixel) in image.pixels().iter().enumerate() {
            // Green twice: tissue's texture is haemoglobin's, which absorbs green; red is nearly flat.
            let value = 0.2 * f32::from(pixel[0]) + 0.6 * f32::from(pixel[1]) + 0.2 * f32::from(pixel[2]);
            gray.pixels_mut()[i] = value;
            if confidence.pixels()[i] >= 128 {
                weight.pixels_mut()[i] = 1.0;
                sum += f64::from(value);
                count += 1.0;
            }
        }
        let mean = if count > 0.0 { (sum / count) as f32 } else { 0.0 };
        gray.pixels_mut().iter_mut().for_each(|v| *v -= mean);
        Self {
            gray,
            weight,
            intrinsics,
            world_from_camera,
        }
    }

    /// Half the size; confident pixels count, others do not.
    pub fn halved(&self) -> Self {
        let (width, height) = (self.gray.width() / 2, self.gray.height() / 2);
        let mut gray = Image::filled(width, height, 0.0_f32);
        let mut weight = Image::filled(width, height, 0.0_f32);
        for y in 0..height {
            for x in 0..width {
                let (mut sum, mut total, mut plain) = (0.0, 0.0, 0.0);
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let (g, w) = (self.gray.at(2 * x + dx, 2 * y + dy), self.weight.at(2 * x + dx, 2 * y + dy));
                    sum += g * w;
                    total += w;
                    plain += g;
                }
                gray.set(x, y, if total > 0.0 { sum / total } else { 0.25 * plain });
                weight.set(x, y, if total >= 2.0 { 1.0 } else { 0.0 });
            }
        }
        Self {
            gray,
            weight,
            intrinsics: self.intrinsics.scaled(0.5),
            world_from_camera: self.world_from_camera,
        }
    }
}

/// Hypotheses of inverse depth around a base.
#[derive(Clone, Copy, Debug)]
pub struct Sweep {
    /// Between neighbours, 1/mm.
    pub step: f32,
    /// How many; the middle one is the base itself when odd.
    pub count: usize,
    /// Half the side of the correlation window, px.
    pub radius: usize,
}

impl Sweep {
    /// What hypothesis `index` adds to the base's inverse depth.
    pub fn offset(&self, index: f32) -> f32 {
        (index - (self.count as f32 - 1.0) * 0.5) * self.step
    }
}

/// Working memory of [`costs`].
#[derive(Debug, Default)]
pub struct Scratch {
    sums: [Vec<f32>; 6],
    columns: Vec<f32>,
    seen: Vec<f32>,
}

/// Matching cost (0 good … 1 bad) per pixel and hypothesis, pixel-major, averaged over the neighbours that see the place.
/// `base` is inverse depth per pixel of `reference`.
pub fn costs(
    reference: &Plane,
    neighbours: &[&Plane],
    base: &Image<f32>,
    sweep: Sweep,
    scratch: &mut Scratch,
    out: &mut Vec<f32>,
) {
    let (width, height) = reference.gray.size();
    let pixels = width * height;
    out.clear();
    out.resize(pixels * sweep.count, 0.0);
    scratch.seen.clear();
    scratch.seen.resize(pixels * sweep.count, 0.0);
    for sum in &mut scratch.sums {
        sum.resize(pixels, 0.0);
    }
    for neighbour in neighbours {
        let motion = neighbour.world_from_camera.inverse() * reference.world_from_camera;
        let k = matrix(&neighbour.intrinsics);
        let map: Matrix3<f32> =
            k * motion.rotation().to_rotation_matrix().matrix().cast::<f32>() * inverse_matrix(&reference.intrinsics);
        let shift: Vector3<f32> = k * motion.translation().cast::<f32>();
        for index in 0..sweep.count {
            warp(
                reference,
                neighbour,
                &map,
                &shift,
                base,
                sweep.offset(index as f32),
                &mut scratch.sums,
            );
            for sum in &mut scratch.sums {
                box_sum(sum, width, height, sweep.radius, &mut scratch.columns);
            }
            let full = ((2 * sweep.radius + 1) * (2 * sweep.radius + 1)) as f32;
            let [n, a, b, aa, bb, ab] = &scratch.sums;
            for i in 0..pixels {
                if n[i] < MIN_SUPPORT * full {
                    continue;
                }
                let inverse = 1.0 / n[i];
                let floor = NOISE_VARIANCE * n[i];
                let va = aa[i] - a[i] * a[i] * inverse + floor;
                let vb = bb[i] - b[i] * b[i] * inverse + floor;
                let correlation = (ab[i] - a[i] * b[i] * inverse) / (va * vb).max(1e-6).sqrt();
                out[i * sweep.count + index] += 1.0 - correlation.clamp(0.0, 1.0);
                scratch.seen[i * sweep.count + index] += 1.0;
            }
        }
    }
    for (cost, &seen) in out.iter_mut().zip(&scratch.seen) {
        *cost = if seen > 0.0 { *cost / seen } else { UNKNOWN_COST };
    }
}

/// Per pixel: weight, and weighted a, b, a², b², ab; a the reference's gray, b the neighbour's where the hypothesis puts it.
fn warp(
    reference: &Plane,
    neighbour: &Plane,
    map: &Matrix3<f32>,
    shift: &Vector3<f32>,
    base: &Image<f32>,
    offset: f32,
    sums: &mut [Vec<f32>; 6],
) {
    let (width, height) = reference.gray.size();
    let (right, bottom) = (neighbour.gray.width() as f32 - 1.001, neighbour.gray.height() as f32 - 1.001);
    let stride = neighbour.gray.width();
    let (gray, weight) = (neighbour.gray.pixels(), neighbour.weight.pixels());
    let [n, sa, sb, saa, sbb, sab] = sums;
    for y in 0..height {
        let start = map.column(1) * y as f32 + map.column(2);
        for x in 0..width {
            let i = y * width + x;
            let w = base.pixels()[i] + offset;
            let z = start.z + map[(2, 0)] * x as f32 + shift.z * w;
            let inverse = 1.0 / z;
            let u = (start.x + map[(0, 0)] * x as f32 + shift.x * w) * inverse;
            let v = (start.y + map[(1, 0)] * x as f32 + shift.y * w) * inverse;
            let inside = z > 0.0 && w > 0.0 && u >= 0.0 && v >= 0.0 && u <= right && v <= bottom;
            let mut confidence = 0.0;
            let mut b = 0.0;
            if inside {
                let (left, top) = (u as usize, v as usize);
                let (fx, fy) = (u - left as f32, v - top as f32);
                let at = top * stride + left;
                let near = if fx > 0.5 { 1 } else { 0 } + if fy > 0.5 { stride } else { 0 };
                confidence = reference.weight.pixels()[i] * weight[at + near];
                let upper = gray[at] + fx * (gray[at + 1] - gray[at]);
                let lower = gray[at + stride] + fx * (gray[at + stride + 1] - gray[at + stride]);
                b = upper + fy * (lower - upper);
            }
            let a = reference.gray.pixels()[i];
            n[i] = confidence;
            sa[i] = confidence * a;
            sb[i] = confidence * b;
            saa[i] = confidence * a * a;
            sbb[i] = confidence * b * b;
            sab[i] = confidence * a * b;
        }
    }
}

/// Sums over a square window, cut at the border, in place.
fn box_sum(values: &mut [f32], width: usize, height: usize, radius: usize, columns: &mut Vec<f32>) {
    columns.clear();
    columns.resize(width * (2 * radius + 1) + width, 0.0);
    let (lines, sums) = columns.split_at_mut(width * (2 * radius + 1));
    // Down: a running sum per column over a ring of the last 2r+1 input lines.
    let ring = 2 * radius + 1;
    for y in 0..height + radius {
        let slot = (y % ring) * width;
        if y >= ring {
            for (sum, old) in sums.iter_mut().zip(&lines[slot..slot + width]) {
                *sum -= old;
            }
        }
        if y < height {
            let row = &values[y * width..(y + 1) * width];
            lines[slot..slot + width].copy_from_slice(row);
            for (sum, new) in sums.iter_mut().zip(row) {
                *sum += new;
            }
        } else {
            lines[slot..slot + width].fill(0.0);
        }
        if y >= radius {
            values[(y - radius) * width..(y - radius + 1) * width].copy_from_slice(sums);
        }
    }
    // Across: the same along each line.
    let line = &mut lines[..width];
    for row in values.chunks_exact_mut(width) {
        line.copy_from_slice(row);
        let mut sum: f32 = line[..radius.min(width)].iter().sum();
        for x in 0..width {
            if x + radius < width {
                sum += line[x + radius];
            }
            if x > radius {
                sum -= line[x - radius - 1];
            }
            row[x] = sum;
        }
    }
}

fn matrix(k: &Intrinsics) -> Matrix3<f32> {
    k.matrix().cast()
}

fn inverse_matrix(k: &Intrinsics) -> Matrix3<f32> {
    Matrix3::new(1.0 / k.fx, 0.0, -k.cx / k.fx, 0.0, 1.0 / k.fy, -k.cy / k.fy, 0.0, 0.0, 1.0).cast()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn window_sums_agree_with_the_plain_ones() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let (width, height) = (13, 9);
        for radius in [1, 2, 3] {
            let values: Vec<f32> = (0..width * height).map(|_| random.random_range(-5.0..5.0)).collect();
            let mut fast = values.clone();
            box_sum(&mut fast, width, height, radius, &mut Vec::new());
            for y in 0..height {
                for x in 0..width {
                    let mut sum = 0.0;
                    for v in y.saturating_sub(radius)..(y + radius + 1).min(height) {
                        for u in x.saturating_sub(radius)..(x + radius + 1).min(width) {
                            sum += values[v * width + u];
                        }
                    }
                    assert!((fast[y * width + x] - sum).abs() < 1e-3, "{radius} {x} {y}");
                }
            }
        }
    }
}
