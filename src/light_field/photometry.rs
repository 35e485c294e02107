//! One brightness for all views: an exposure gain per view and the lamp's share, from surface points that several views saw.
//!
//! A surface point p of unknown reflectance shows in view i as log I_i(p) = a(p) − e_i + θ·x_i(p): e_i undoes the view's
//! exposure, and x holds what the lamp's model depends on (−log distance, ρ², ρ⁴; see [`LampShading`]). The a(p) are eliminated
//! by taking each point's mean out of its equations; the rest is a small linear system, solved with Huber weights. Moving the
//! camera away and opening the exposure look alike only if all points did so equally, so e and θ separate where the survey
//! varies distance within pictures; a weak prior decides where it does not.

use nalgebra::{DMatrix, DVector, Vector3};

use crate::camera::intrinsics::Pixel;
use crate::geometry::mesh::Mesh;
use crate::geometry::space::World;
use crate::light_field::renderer::bilinear_rgb;
use crate::light_field::view::{LampShading, View};

/// Surface points used.
const POINTS: usize = 3000;
/// Residuals beyond this are outliers (a specularity's haze, a shadow); log units.
const HUBER: f64 = 0.06;
/// Values beyond these say little: noise below, clipping above.
const USABLE: std::ops::RangeInclusive<f32> = 18.0..=238.0;

/// What was found.
#[derive(Clone, Debug)]
pub struct Photometry {
    /// Per view and channel, to be multiplied with sRGB values.
    pub gains: Vec<[f32; 3]>,
    /// The lamp's model.
    pub shading: LampShading,
    /// Median absolute difference between views of one point before, log units.
    pub spread_before: f64,
    /// The same after.
    pub spread_after: f64,
}

struct Observation {
    view: usize,
    /// Log of red, green, blue.
    log: [f64; 3],
    x: Vector3<f64>,
}

/// Gains and lamp model of the views; their depth maps must be filled in.
pub fn estimate(views: &[View], surface: &Mesh<World>) -> Photometry {
    let points = observed(views, surface);
    let everything = |_: &Observation, log: [f64; 3]| (log[0] + log[1] + log[2]) / 3.0;
    let before = spread(&points, |o| everything(o, o.log));
    let n = views.len();
    let (mut exposure, mut theta) = solve(&points, n, None, |o| everything(o, o.log));
    // Outside these bounds it is no lamp but the scene's own shading.
    if !(0.0..=1.6).contains(&theta.x) {
        theta.x = theta.x.clamp(0.0, 1.6);
        (exposure, theta) = solve(&points, n, Some(theta.x), |o| everything(o, o.log));
    }
    let shading = LampShading {
        falloff: theta.x as f32,
        vignetting: [theta.y as f32, theta.z as f32],
    };
    let mut gains = vec![[1.0_f32; 3]; n];
    for channel in 0..3 {
        // What the channel deviates from the mean, with the lamp's part known and gains shrunk to the common one.
        let (deviation, _) = solve(&points, n, Some(0.0), |o| o.log[channel] - everything(o, o.log));
        for (view, gain) in gains.iter_mut().enumerate() {
            gain[channel] = (exposure[view] + deviation[view]).exp() as f32;
        }
    }
    let after = spread(&points, |o| everything(o, o.log) + exposure[o.view] - theta.dot(&o.x));
    Photometry {
        gains,
        shading,
        spread_before: before,
        spread_after: after,
    }
}

fn observed(views: &[View], surface: &Mesh<World>) -> Vec<Vec<Observation>> {
    let step = (surface.vertices.len() / POINTS).max(1);
    let cameras: Vec<_> = views.iter().map(|view| view.world_from_camera.inverse()).collect();
    let mut points = Vec::new();
    for vertex in surface.vertices.iter().step_by(step) {
        let mut seen = Vec::new();
        for (index, (view, camera_from_world)) in views.iter().zip(&cameras).enumerate() {
            let local = *camera_from_world * *vertex;
            let Some(pixel) = view.camera.project(local).filter(|&p| view.camera.contains(p, 3.0)) else {
                continue;
            };
            let (x, y) = (pixel.x.round() as usize, pixel.y.round() as usize);
            let depth = f64::from(view.depth.at(x, y));
            if view.confidence.at(x, y) < 250 || depth <= 0.0 || local.coords.z > depth * 1.01 {
                continue;
            }
            let color = mean_color(view, pixel);
            if !color.iter().all(|v| USABLE.contains(v)) {
                continue;
            }
            let rho2 = (local.coords.x / local.coords.z).powi(2) + (local.coords.y / local.coords.z).powi(2);
            seen.push(Observation {
                view: index,
                log: color.map(|v| f64::from(v).ln()),
                x: Vector3::new(-local.coords.norm().ln(), rho2, rho2 * rho2),
            });
        }
        if seen.len() >= 2 {
            points.push(seen);
        }
    }
    points
}

/// Over a small cross, so that a misfit of a pixel matters less.
fn mean_color(view: &View, pixel: Pixel) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for (dx, dy) in [(0.0, 0.0), (1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)] {
        let color = bilinear_rgb(&view.image, (pixel.x + dx) as f32, (pixel.y + dy) as f32);
        for (s, v) in sum.iter_mut().zip(color) {
            *s += 0.2 * v;
        }
    }
    sum
}

/// Exposures e (mean 0) and lamp parameters θ; with `fixed` the falloff is given and, when 0, the whole lamp is left out.
fn solve(
    points: &[Vec<Observation>],
    views: usize,
    fixed: Option<f64>,
    value: impl Fn(&Observation) -> f64,
) -> (Vec<f64>, Vector3<f64>) {
    let unknowns = views + 3;
    let mut solution = DVector::<f64>::zeros(unknowns);
    if let Some(falloff) = fixed {
        solution[views] = falloff;
    }
    for round in 0..6 {
        // Prior: gains near 1 (0.5 log units), lamp near none; both far weaker than the data where there are any.
        let mut normal = DMatrix::<f64>::from_diagonal(&DVector::from_fn(unknowns, |i, _| if i < views { 4.0 } else { 1.0 }));
        let mut right = DVector::<f64>::zeros(unknowns);
        for i in views..unknowns {
            if let Some(falloff) = fixed.filter(|f| i == views || *f == 0.0) {
                normal[(i, i)] = 1e12;
                right[i] = if i == views { 1e12 * falloff } else { 0.0 };
            }
        }
        for seen in points {
            // Row of an observation: +1 at its view, −x at the lamp; value y: e − θx + y = a.
            let rest: Vec<f64> = seen
                .iter()
                .map(|o| {
                    value(o) + solution[o.view]
                        - Vector3::new(solution[views], solution[views + 1], solution[views + 2]).dot(&o.x)
                })
                .collect();
            let center = median(rest.clone());
            let weight: Vec<f64> = rest
                .iter()
                .map(|r| {
                    if round == 0 {
                        1.0
                    } else {
                        (HUBER / (r - center).abs().max(1e-12)).min(1.0)
                    }
                })
                .collect();
            let total: f64 = weight.iter().sum();
            let mean_y: f64 = seen.iter().zip(&weight).map(|(o, w)| w * value(o)).sum::<f64>() / total;
            let mean_x: Vector3<f64> = seen.iter().zip(&weight).map(|(o, w)| o.x * *w).sum::<Vector3<f64>>() / total;
            for (o, &w) in seen.iter().zip(&weight) {
                let (y, x) = (value(o) - mean_y, o.x - mean_x);
                normal[(o.view, o.view)] += w;
                for (other, &v) in seen.iter().zip(&weight) {
                    normal[(o.view, other.view)] -= w * v / total;
                }
                right[o.view] -= w * y;
                for i in 0..3 {
                    normal[(o.view, views + i)] -= w * x[i];
                    normal[(views + i, o.view)] -= w * x[i];
                    right[views + i] += w * x[i] * y;
                    for j in 0..3 {
                        normal[(views + i, views + j)] += w * x[i] * x[j];
                    }
                }
            }
        }
        let Some(factor) = normal.cholesky() else { break };
        solution = factor.solve(&right);
    }
    let mean = solution.rows(0, views).sum() / views.max(1) as f64;
    let exposure = (0..views).map(|i| solution[i] - mean).collect();
    (
        exposure,
        Vector3::new(solution[views], solution[views + 1], solution[views + 2]),
    )
}

fn spread(points: &[Vec<Observation>], value: impl Fn(&Observation) -> f64) -> f64 {
    let mut apart = Vec::new();
    for seen in points {
        let values: Vec<f64> = seen.iter().map(&value).collect();
        let center = median(values.clone());
        apart.extend(values.iter().map(|v| (v - center).abs()));
    }
    median(apart)
}

fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn exposures_and_falloff_come_back() {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        let views = 12;
        let exposure: Vec<f64> = (0..views).map(|_| random.random_range(-0.2..0.2)).collect();
        let mean = exposure.iter().sum::<f64>() / views as f64;
        let theta = Vector3::new(0.9, -0.4, 0.1);
        let points: Vec<Vec<Observation>> = (0..800)
            .map(|_| {
                let albedo: f64 = random.random_range(3.5..4.8);
                let mut seen = Vec::new();
                for (view, e) in exposure.iter().enumerate() {
                    if random.random_range(0.0..1.0) < 0.5 {
                        continue;
                    }
                    let distance: f64 = random.random_range(50.0..110.0);
                    let rho2: f64 = random.random_range(0.0..0.35);
                    let x = Vector3::new(-distance.ln(), rho2, rho2 * rho2);
                    let outlier = if random.random_range(0.0..1.0) < 0.05 { 0.5 } else { 0.0 };
                    let log = albedo - e + theta.dot(&x) + random.random_range(-0.02..0.02) + outlier;
                    seen.push(Observation { view, log: [log; 3], x });
                }
                seen
            })
            .filter(|seen| seen.len() >= 2)
            .collect();
        let (found, lamp) = solve(&points, views, None, |o| o.log[0]);
        for (f, e) in found.iter().zip(&exposure) {
            // 0.02 uniform noise over about 400 points a view, and the weak prior's pull.
            assert!((f - (e - mean)).abs() < 0.01, "{f} {}", e - mean);
        }
        assert!((lamp.x - 0.9).abs() < 0.02, "{lamp}");
    }
}
