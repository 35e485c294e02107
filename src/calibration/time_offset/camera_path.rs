//! Where the camera was between the pictures whose poses are known.

use nalgebra::{UnitQuaternion, Vector3};

use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::time::{Span, Timestamp};

/// A camera's pose at the exposure of a picture.
#[derive(Clone, Copy, Debug)]
pub struct PosedPicture {
    /// On the camera's clock.
    pub at: Timestamp,
    /// Up to a similarity of the world, where the pictures alone tell it.
    pub world_from_camera: Transform<World, Camera>,
}

/// A smooth path through known poses: a cubic whose slopes come from the neighbours (Catmull and Rom 1974, for uneven stamps), of the
/// place and of the rotation vector from the earlier pose.
#[derive(Clone, Debug)]
pub struct CameraPath {
    poses: Vec<PosedPicture>,
    slopes: Vec<[Vector3<f64>; 2]>,
    max_gap: Span,
}

impl CameraPath {
    /// Through `poses`, in the order of time; steps longer than `max_gap` are not bridged.
    pub fn new(mut poses: Vec<PosedPicture>, max_gap: Span) -> Self {
        poses.sort_by_key(|pose| pose.at);
        poses.dedup_by_key(|pose| pose.at);
        let near = |a: usize, b: usize| poses[b].at - poses[a].at <= max_gap;
        let slopes = (0..poses.len())
            .map(|i| {
                let from = i.checked_sub(1).filter(|&before| near(before, i)).unwrap_or(i);
                let to = Some(i + 1)
                    .filter(|&after| after < poses.len() && near(i, after))
                    .unwrap_or(i);
                let seconds = (poses[to].at - poses[from].at).seconds();
                if seconds <= 0.0 {
                    return [Vector3::zeros(); 2];
                }
                let (a, b) = (&poses[from].world_from_camera, &poses[to].world_from_camera);
                let turned = (a.rotation().inverse() * b.rotation()).scaled_axis();
                [(b.translation() - a.translation()) / seconds, turned / seconds]
            })
            .collect();
        Self { poses, slopes, max_gap }
    }

    /// The poses it goes through.
    pub fn poses(&self) -> &[PosedPicture] {
        &self.poses
    }

    /// The pose at `instant`; `None` before the first, after the last, and in a gap.
    pub fn at(&self, instant: Timestamp) -> Option<Transform<World, Camera>> {
        let right = self.poses.partition_point(|pose| pose.at <= instant);
        let left = right.checked_sub(1)?;
        let a = self.poses.get(left)?;
        if a.at == instant {
            return Some(a.world_from_camera);
        }
        let b = self.poses.get(right)?;
        let step = b.at - a.at;
        if step > self.max_gap {
            return None;
        }
        let (whole, t) = (step.seconds(), (instant - a.at).seconds() / step.seconds());
        let (t2, t3) = (t * t, t * t * t);
        let hermite = |end: Vector3<f64>, slope_a: Vector3<f64>, slope_b: Vector3<f64>| {
            end * (3.0 * t2 - 2.0 * t3) + (slope_a * (t - 2.0 * t2 + t3) + slope_b * (t3 - t2)) * whole
        };
        let (from, to) = (&a.world_from_camera, &b.world_from_camera);
        let (slopes_a, slopes_b) = (self.slopes.get(left)?, self.slopes.get(right)?);
        let moved = hermite(to.translation() - from.translation(), slopes_a[0], slopes_b[0]);
        let turned = hermite(
            (from.rotation().inverse() * to.rotation()).scaled_axis(),
            slopes_a[1],
            slopes_b[1],
        );
        Some(Transform::new(
            from.rotation() * UnitQuaternion::from_scaled_axis(turned),
            from.translation() + moved,
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(t: f64) -> Transform<World, Camera> {
        Transform::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(0.2 * (3.0 * t).sin(), 0.1 * t, 0.0)),
            Vector3::new(20.0 * (4.0 * t).sin(), 5.0 * t, 60.0),
        )
    }

    /// Of sin(ωt) a cubic misses at most about (ωh)⁴/100: here 0.32⁴/100·20 mm ≈ 2 µm, and the slopes' error as much again.
    #[test]
    fn a_smooth_path_is_met_between_its_poses_and_a_gap_stays_one() {
        let poses = (0..50).filter(|i| !(20..25).contains(i)).map(|i| PosedPicture {
            at: Timestamp::from_seconds(0.08 * f64::from(i)),
            world_from_camera: pose(0.08 * f64::from(i)),
        });
        let path = CameraPath::new(poses.collect(), Span::from_milliseconds(200.0));
        for i in 5..300 {
            let t = 0.013 * f64::from(i);
            let found = path.at(Timestamp::from_seconds(t));
            if t > 19.0 * 0.08 + 1e-9 && t < 25.0 * 0.08 - 1e-9 || t > 49.0 * 0.08 {
                assert!(found.is_none(), "{t}");
            } else if (0.08..18.0 * 0.08).contains(&t) || (26.0 * 0.08..48.0 * 0.08).contains(&t) {
                let away = pose(t).inverse() * found.unwrap();
                assert!(
                    away.translation().norm() < 0.02 && away.rotation().angle() < 2e-4,
                    "{t}: {away:?}"
                );
            }
        }
        assert!(path.at(Timestamp::from_seconds(-0.01)).is_none());
    }
}
