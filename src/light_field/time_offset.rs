//! By how much the arm's clock differs from the camera's, told by how the two move.
//!
//! The camera's path from the pictures is laid over the arm's path read at shifted times (a similarity is free, because the
//! pictures know neither place nor scale); the shift that leaves the least difference is the offset. A camera that rests or moves evenly along a line
//! fits at any shift: then the valley is flat, the standard deviation large, and the offset is reported as not observed.

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
    let steps = (range_ms / STEP_MS).ceil().max(2.0) as i32;
    let cost = |ms: f64| mismatch(poses, prior, smoothing_ms, Span::from_milliseconds(ms));
    let costs: Vec<Option<f64>> = {
        use rayon::prelude::*;
        (-steps..=steps)
            .into_par_iter()
            .map(|k| cost(f64::from(k) * STEP_MS))
            .collect()
    };
    let (best, least) = costs
        .iter()
        .enumerate()
        .filter_map(|(i, c)| Some((i, (*c)?)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    // A parabola through a few costs around the least, wide enough not to ride on noise.
    let reach = 4;
    if best < reach || best + reach >= costs.len() {
        return None;
    }
    let (mut s0, mut s1, mut s2, mut s4, mut s2y) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let mut sy = 0.0;
    for k in -(reach as i32)..=reach as i32 {
        let y = costs[(best as i32 + k) as usize]?;
        let x = f64::from(k);
        s0 += 1.0;
        s1 += x * y;
        s2 += x * x;
        s4 += x.powi(4);
        sy += y;
        s2y += x * x * y;
    }
    let curvature = (s0 * s2y - s2 * sy) / (s0 * s4 - s2 * s2);
    let slope = s1 / s2;
    if !(curvature > 0.0) {
        return None;
    }
    let shift = (-0.5 * slope / curvature).clamp(-(reach as f64), reach as f64);
    // Chi-square with 6 numbers a pose; its least value tells the true noise. ½·∂²χ²/∂τ² = 1/σ².
    let noise = (least / (6.0 * poses.len() as f64)).max(1e-12);
    let sigma_ms = STEP_MS * (noise / curvature).sqrt();
    let offset_ms = (f64::from(best as i32 - steps) + shift) * STEP_MS;
    Some(TimeOffset {
        offset: Span::from_milliseconds(offset_ms),
        sigma_ms,
    })
}

/// Mean robust squared difference after the best similarity, times the number of poses.
fn mismatch(
    poses: &[(Timestamp, Transform<World, Camera>)],
    prior: &dyn PosePrior,
    smoothing_ms: f64,
    offset: Span,
) -> Option<f64> {
    let per_mm2 = prior.sigma_mm().max(1e-9).powi(-2);
    let per_rad2 = prior.sigma_rad().max(1e-9).powi(-2);
    let mut pairs: Vec<PosePair> = poses
        .iter()
        .filter_map(|(at, pose)| {
            let fixed = *smoothed_pose(prior, *at - offset, smoothing_ms)?.isometry();
            Some(PosePair {
                fixed,
                moving: *pose.isometry(),
                per_mm2,
                per_rad2,
            })
        })
        .collect();
    if pairs.len() * 10 < poses.len() * 8 {
        return None;
    }
    let squares = |pairs: &[PosePair], gauge: &Similarity| -> Vec<f64> {
        pairs
            .iter()
            .map(|p| {
                let moved = gauge.moved(&p.moving);
                let apart = (moved.translation.vector - p.fixed.translation.vector).norm_squared();
                apart * per_mm2 + moved.rotation.angle_to(&p.fixed.rotation).powi(2) * per_rad2
            })
            .collect()
    };
    let mut found = Vec::new();
    for _ in 0..3 {
        let gauge = Similarity::between(&pairs, Scale::Free)?;
        found = squares(&pairs, &gauge);
        let mut sorted = found.clone();
        sorted.sort_by(f64::total_cmp);
        let typical = sorted[sorted.len() / 2].max(1e-12);
        for (pair, s) in pairs.iter_mut().zip(&found) {
            let weight = 1.0 / (1.0 + s / (ROBUST_WIDTH * ROBUST_WIDTH * typical));
            pair.per_mm2 = per_mm2 * weight;
            pair.per_rad2 = per_rad2 * weight;
        }
    }
    let mut sorted = found.clone();
    sorted.sort_by(f64::total_cmp);
    // The worst tenth may be anything.
    let kept = &sorted[..sorted.len() - sorted.len() / 10];
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
