//! The surface of the scene as a height over a plane: exact depth and continuous normals, fast.
//!
//! Heights are the control values of a biquadratic B-spline on a regular grid (de Boor 1978): C¹, so a highlight runs over it
//! without breaks, and a tilted plane is reproduced exactly. The surface *is* the spline; depth and normals of the truth are
//! those of the spline, not approximations to what the control values were sampled from.
//!
//! A ray is first marched with steps that cannot jump through the surface (height above it over the largest closing speed that
//! the steepest slope allows, as in sphere tracing: Hart 1996, DOI 10.1007/s003710050084) and then polished by Newton's method.

use nalgebra::Vector3;

/// Grid of heights z(x, y), mm; beyond its border the height goes on as it is there.
#[derive(Clone, Debug)]
pub struct Relief {
    pitch_mm: f64,
    origin: [f64; 2],
    columns: usize,
    rows: usize,
    heights: Vec<f32>,
    max_slope: f64,
    highest_mm: f64,
    lowest_mm: f64,
}

/// Where a ray meets the surface.
#[derive(Clone, Copy, Debug)]
pub struct ReliefHit {
    /// Ray parameter.
    pub t: f64,
    /// Slope dz/dx of the surface there.
    pub dx: f64,
    /// Slope dz/dy of the surface there.
    pub dy: f64,
}

/// The surface over one place.
#[derive(Clone, Copy, Debug)]
pub struct Height {
    /// z, mm.
    pub z: f64,
    /// dz/dx.
    pub dx: f64,
    /// dz/dy.
    pub dy: f64,
}

impl Relief {
    /// Sample `height` over ±`half_width_mm` × ±`half_height_mm` around the origin.
    pub fn from_function(
        half_width_mm: f64,
        half_height_mm: f64,
        pitch_mm: f64,
        height: impl Fn(f64, f64) -> f64 + Sync,
    ) -> Self {
        use rayon::prelude::*;
        let columns = (2.0 * half_width_mm / pitch_mm).ceil() as usize + 3;
        let rows = (2.0 * half_height_mm / pitch_mm).ceil() as usize + 3;
        let origin = [-half_width_mm - pitch_mm, -half_height_mm - pitch_mm];
        let heights: Vec<f32> = (0..columns * rows)
            .into_par_iter()
            .map(|i| {
                let (column, row) = (i % columns, i / columns);
                height(origin[0] + column as f64 * pitch_mm, origin[1] + row as f64 * pitch_mm) as f32
            })
            .collect();
        let mut max_step = 0.0_f32;
        for row in heights.chunks_exact(columns) {
            for pair in row.windows(2) {
                max_step = max_step.max((pair[1] - pair[0]).abs());
            }
        }
        for (above, below) in heights.iter().zip(&heights[columns..]) {
            max_step = max_step.max((below - above).abs());
        }
        let highest = heights.iter().copied().fold(f32::MIN, f32::max);
        let lowest = heights.iter().copied().fold(f32::MAX, f32::min);
        Self {
            pitch_mm,
            origin,
            columns,
            rows,
            heights,
            // A spline's slope along an axis is a mean of its control values' steps; across both axes √2 of that.
            max_slope: f64::from(max_step) / pitch_mm * std::f64::consts::SQRT_2,
            highest_mm: f64::from(highest),
            lowest_mm: f64::from(lowest),
        }
    }

    /// Height and slopes over (x, y).
    pub fn height(&self, x: f64, y: f64) -> Height {
        let u = ((x - self.origin[0]) / self.pitch_mm).clamp(1.0, (self.columns - 2) as f64);
        let v = ((y - self.origin[1]) / self.pitch_mm).clamp(1.0, (self.rows - 2) as f64);
        let (i, j) = ((u + 0.5) as usize, (v + 0.5) as usize);
        let (fu, fv) = (u - i as f64, v - j as f64);
        let (wu, du) = (weights(fu), slopes(fu));
        let (wv, dv) = (weights(fv), slopes(fv));
        let start = (j - 1) * self.columns + i - 1;
        let (mut z, mut dx, mut dy) = (0.0, 0.0, 0.0);
        for k in 0..3 {
            let at = start + k * self.columns;
            let Some(&[a, b, c]) = self.heights[at..].first_chunk::<3>() else {
                break;
            };
            let (a, b, c) = (f64::from(a), f64::from(b), f64::from(c));
            let along = a * wu[0] + b * wu[1] + c * wu[2];
            z += wv[k] * along;
            dy += dv[k] * along;
            dx += wv[k] * (a * du[0] + b * du[1] + c * du[2]);
        }
        Height {
            z,
            dx: dx / self.pitch_mm,
            dy: dy / self.pitch_mm,
        }
    }

    /// Where the ray `origin + t·direction` first meets the surface from above; t in units of `direction`.
    pub fn first_hit(&self, origin: Vector3<f64>, direction: Vector3<f64>) -> Option<ReliefHit> {
        if direction.z > -1e-6 {
            return None;
        }
        let closing_speed = -direction.z + self.max_slope * direction.xy().norm();
        let last = (self.lowest_mm - 1.0 - origin.z) / direction.z;
        let mut t = ((self.highest_mm - origin.z) / direction.z).max(0.0);
        for _ in 0..400 {
            let p = origin + direction * t;
            let height = self.height(p.x, p.y);
            let gap = p.z - height.z;
            if gap < 2e-3 {
                let grazing = ReliefHit { t, dx: height.dx, dy: height.dy };
                return self.polished_hit(origin, direction, t).or(Some(grazing));
            }
            t += gap / closing_speed;
            if t > last {
                return None;
            }
        }
        None
    }

    /// Newton's method from the guess `t`; `None` if it does not settle or the ray would leave the surface there.
    pub fn polished_hit(&self, origin: Vector3<f64>, direction: Vector3<f64>, t: f64) -> Option<ReliefHit> {
        /// A step this short leaves an error of its square times half the curvature, 1e-6 mm.
        const SETTLED_MM: f64 = 1e-3;
        let mut t = t;
        for _ in 0..6 {
            let p = origin + direction * t;
            let height = self.height(p.x, p.y);
            let closing_speed = height.dx * direction.x + height.dy * direction.y - direction.z;
            if closing_speed < 0.05 {
                return None;
            }
            let step = (p.z - height.z) / closing_speed;
            t += step;
            if step.abs() < SETTLED_MM {
                return Some(ReliefHit { t, dx: height.dx, dy: height.dy });
            }
        }
        None
    }
}

fn weights(f: f64) -> [f64; 3] {
    [0.5 * (0.5 - f) * (0.5 - f), 0.75 - f * f, 0.5 * (0.5 + f) * (0.5 + f)]
}

fn slopes(f: f64) -> [f64; 3] {
    [f - 0.5, -2.0 * f, f + 0.5]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_is_exact() {
        let relief = Relief::from_function(40.0, 30.0, 0.5, |x, y| 0.25 * x - 0.125 * y + 3.0);
        let (origin, direction) = (Vector3::new(1.0, 2.0, 80.0), Vector3::new(0.2, -0.1, -1.0));
        let t = relief.first_hit(origin, direction).unwrap().t;
        // z = 0.25 x − 0.125 y + 3 met analytically.
        let expected = (80.0 - 0.25 * 1.0 + 0.125 * 2.0 - 3.0) / (1.0 + 0.25 * 0.2 + 0.125 * 0.1);
        assert!((t - expected).abs() < 1e-4, "{t} {expected}");
    }

    #[test]
    fn the_first_of_several_crossings_is_found() {
        let relief = Relief::from_function(40.0, 30.0, 0.25, |x, _| 4.0 * (x * 0.8).sin());
        for k in 0..200 {
            let origin = Vector3::new(-30.0 + f64::from(k) * 0.1, 0.0, 30.0);
            let direction = Vector3::new(0.9, 0.05, -1.0);
            let t = relief.first_hit(origin, direction).unwrap().t;
            let above = |t: f64| {
                let p = origin + direction * t;
                p.z - relief.height(p.x, p.y).z
            };
            assert!(above(t).abs() < 2e-3);
            let mut s = 20.0;
            while s < t - 0.02 {
                assert!(above(s) > 0.0, "ray {k} crosses at {s}, found {t}");
                s += 0.005;
            }
        }
    }
}
