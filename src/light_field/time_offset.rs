//! By how much the arm's clock differs from the camera's, told by how the two move.
//!
//! The camera's path from the pictures is laid over the arm's path read at shifted times (a similarity is free, because the
//! pictures know neither place nor scale); the shift that leaves the least difference is the offset. A camera that rests or moves evenly along a line
//! fits at any shift: then the valley is flat, the standard deviation large, and the offset is reported as not observed.

use rayon::prelude::*;

use crate::geometry::alignment::{PosePair, Scale, Similarity};
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::prior::{PosePrior, smoothed_pose};
use crate::time::{Span, Timestamp};

/// Coarse search step, ms.
const STEP_MS: f64 = 4.0;
/// Pairs farther apart than this many standard deviations lose weight.
const ROBUST_WIDTH: f64 = 3.0;

/// An offset and how sure it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeOffset {
    /// Add to a pose stamp to get the camera's clock.
    pub offset: Span,
    /// Standard deviation, ms.
    pub sigma_ms: f64,
}

/// The offset in ±`range_ms` at which the arm's path looks most like `poses`; `None` if none stands out.
pub(crate) fn estimate(
    poses: &[(Timestamp, Transform<World, Camera>)],
    prior: &dyn PosePrior,
    smoothing_ms: f64,
    range_ms: f64,
) -> Option<TimeOffset> {
    if poses.len() < 8 {
        return None;
    }
    let weights = Weights {
        per_mm2: prior.sigma_mm().max(1e-9).powi(-2),
        per_rad2: prior.sigma_rad().max(1e-9).powi(-2),
    };
    let steps = (range_ms / STEP_MS).ceil().max(2.0) as i32;
    let costs: Vec<Option<f64>> = (-steps..=steps)
        .into_par_iter()
        .map(|k| {
            let offset = Span::from_milliseconds(f64::from(k) * STEP_MS);
            mismatch(poses, weights, |at| smoothed_pose(prior, at - offset, smoothing_ms))
        })
        .collect();
    let (best, least) = costs
        .iter()
        .enumerate()
        .filter_map(|(i, c)| Some((i, (*c)?)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    let shift = valley(&costs, best)?;
    // The valley's own steepness would be that of the noise where the camera rests: the motion's is that of the pictures'
    // path against itself, shifted. The least mismatch tells the arm's noise.
    let shift_ms = 10.0 * STEP_MS;
    let [later, earlier] =
        [shift_ms, -shift_ms].map(|ms| mismatch(poses, weights, |at| interpolated(poses, at + Span::from_milliseconds(ms))));
    let steepness = 0.5 * (later? + earlier?) / (shift_ms * shift_ms);
    let noise = (least / (6.0 * poses.len() as f64)).max(1e-12);
    let sigma_ms = (noise / steepness.max(1e-300)).sqrt();
    let offset_ms = (f64::from(best as i32 - steps) + shift) * STEP_MS;
    Some(TimeOffset {
        offset: Span::from_milliseconds(offset_ms),
        sigma_ms,
    })
}

/// Where the bottom of the valley around `best` lies, in steps from it: of a parabola through a few costs to either side,
/// wide enough not to ride on noise.
fn valley(costs: &[Option<f64>], best: usize) -> Option<f64> {
    const REACH: usize = 4;
    let near = costs.get(best.checked_sub(REACH)?..=best + REACH)?;
    let (mut s2, mut s4, mut sy, mut sxy, mut sxxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (i, cost) in near.iter().enumerate() {
        let (x, y) = (i as f64 - REACH as f64, (*cost)?);
        s2 += x * x;
        s4 += x.powi(4);
        sy += y;
        sxy += x * y;
        sxxy += x * x * y;
    }
    let n = near.len() as f64;
    let curvature = (n * sxxy - s2 * sy) / (n * s4 - s2 * s2);
    (curvature > 0.0).then(|| (-0.5 * sxy / s2 / curvature).clamp(-(REACH as f64), REACH as f64))
}

/// The pictures' own path between its poses.
fn interpolated(poses: &[(Timestamp, Transform<World, Camera>)], at: Timestamp) -> Option<Transform<World, Camera>> {
    let i = poses.partition_point(|p| p.0 <= at);
    let (a, b) = (poses.get(i.checked_sub(1)?)?, poses.get(i)?);
    Some(a.1.interpolated(&b.1, (at - a.0).seconds() / (b.0 - a.0).seconds().max(1e-9)))
}

#[derive(Clone, Copy)]
struct Weights {
    per_mm2: f64,
    per_rad2: f64,
}

/// Mean robust squared difference to the other path after the best similarity, times the number of poses.
fn mismatch(
    poses: &[(Timestamp, Transform<World, Camera>)],
    weights: Weights,
    other: impl Fn(Timestamp) -> Option<Transform<World, Camera>>,
) -> Option<f64> {
    let Weights { per_mm2, per_rad2 } = weights;
    let mut pairs: Vec<PosePair> = poses
        .iter()
        .filter_map(|(at, pose)| {
            Some(PosePair {
                fixed: *other(*at)?.isometry(),
                moving: *pose.isometry(),
                per_mm2,
                per_rad2,
            })
        })
        .collect();
    if pairs.len() * 10 < poses.len() * 8 {
        return None;
    }
    let mut squares: Vec<f64> = Vec::new();
    for _ in 0..3 {
        let gauge = Similarity::between(&pairs, Scale::Free)?;
        squares.clear();
        squares.extend(pairs.iter().map(|p| {
            let moved = gauge.moved(&p.moving);
            let apart = (moved.translation.vector - p.fixed.translation.vector).norm_squared();
            apart * per_mm2 + moved.rotation.angle_to(&p.fixed.rotation).powi(2) * per_rad2
        }));
        let mut sorted = squares.clone();
        sorted.sort_by(f64::total_cmp);
        let typical = sorted[sorted.len() / 2].max(1e-12);
        for (pair, s) in pairs.iter_mut().zip(&squares) {
            let weight = 1.0 / (1.0 + s / (ROBUST_WIDTH * ROBUST_WIDTH * typical));
            pair.per_mm2 = per_mm2 * weight;
            pair.per_rad2 = per_rad2 * weight;
        }
    }
    squares.sort_by(f64::total_cmp);
    // The worst tenth may be anything.
    let kept = &squares[..squares.len() - squares.len() / 10];
    Some(kept.iter().sum::<f64>() / kept.len() as f64 * poses.len() as f64)
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution as _, StandardNormal};

    use super::*;

    struct Samples(Vec<(f64, Transform<World, Camera>)>);

    impl PosePrior for Samples {
        fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>> {
            let t = at.seconds();
            let i = self.0.partition_point(|s| s.0 <= t);
            let (a, b) = (self.0.get(i.checked_sub(1)?)?, self.0.get(i)?);
            Some(a.1.interpolated(&b.1, (t - a.0) / (b.0 - a.0)))
        }
        fn sigma_mm(&self) -> f64 {
            0.3
        }
        fn sigma_rad(&self) -> f64 {
            0.0014
        }
    }

    fn path(t: f64, speed: f64) -> Transform<World, Camera> {
        let a = speed * (t + 0.15 * (2.1 * t).sin());
        let turn = UnitQuaternion::from_euler_angles(0.2 * a.sin(), -0.2 * a.cos(), 0.08 * (1.3 * a).sin());
        Transform::new(turn, Vector3::new(15.0 * a.cos(), 15.0 * a.sin(), 6.0 * (0.7 * a).cos()))
    }

    fn arm(speed: f64, late: f64) -> Samples {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let mut noise = |sigma: f64| {
            Vector3::from_fn(|_, _| {
                let n: f64 = StandardNormal.sample(&mut rng);
                n * sigma
            })
        };
        let sample = |i: i32, noise: &mut dyn FnMut(f64) -> Vector3<f64>| {
            let t = f64::from(i) * 0.02 - 0.6;
            let pose = path(t - late, speed);
            let turn = UnitQuaternion::from_scaled_axis(noise(0.0014));
            (t, Transform::new(pose.rotation() * turn, pose.translation() + noise(0.3)))
        };
        Samples((0..300).map(|i| sample(i, &mut noise)).collect())
    }

    /// 70 poses, 20 mm/s and 0.3 rad/s, 0.3 mm and 0.0014 rad noise: 0.3/20/√(2·70) ≈ 1.3 ms from either half of the pose;
    /// 4 ms is three of those.
    #[test]
    fn a_late_clock_is_found() {
        let prior = arm(1.4, 0.043);
        let poses: Vec<_> = (0..70)
            .map(|i| 0.04 * f64::from(i))
            .map(|t| (Timestamp::from_seconds(t), path(t, 1.4)))
            .collect();
        let found = estimate(&poses, &prior, 25.0, 150.0).unwrap();
        assert!((found.offset.milliseconds() + 43.0).abs() < 4.0, "{found:?}");
        assert!(found.sigma_ms < 4.0, "{found:?}");
    }

    #[test]
    fn a_resting_arm_tells_nothing() {
        let prior = arm(0.001, 0.043);
        let poses: Vec<_> = (0..70)
            .map(|i| 0.04 * f64::from(i))
            .map(|t| (Timestamp::from_seconds(t), path(t, 0.001)))
            .collect();
        assert!(estimate(&poses, &prior, 25.0, 150.0).is_none_or(|f| f.sigma_ms > 25.0));
    }
}
