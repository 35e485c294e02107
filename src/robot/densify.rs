//! Poses known at a few instants, carried to those between them.
//!
//! A cubic through the two neighbours, with slopes from their neighbours (Catmull and Rom 1974, for uneven stamps); a rotation
//! goes as the rotation vector from the earlier neighbour, which is as good as exact over the few degrees between two samples. A
//! scope moved by hand speeds up and slows down within half a second: straight lines would miss it by more than the picture can mend.

use nalgebra::{UnitQuaternion, Vector6};

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::trajectory::TimedPose;
use crate::time::{Span, Timestamp};

/// A pose for each of `stamps` that lies on a known pose or between two no farther apart than `max_gap`; both in the order of time.
pub fn densified(known: &[TimedPose], stamps: &[Timestamp], max_gap: Span) -> Vec<TimedPose> {
    let pose_at = |&stamp: &Timestamp| {
        let right = known.partition_point(|pose| pose.stamp <= stamp);
        let left = right.checked_sub(1)?;
        let base_from_hand = if known[left].stamp == stamp {
            known[left].base_from_hand
        } else {
            let gap = known.get(right)?.stamp - known[left].stamp;
            (gap <= max_gap).then(|| between(known, left, stamp, max_gap))?
        };
        Some(TimedPose { stamp, base_from_hand })
    };
    stamps.iter().filter_map(pose_at).collect()
}

/// At `stamp`, between `known[left]` and the one after it.
fn between(known: &[TimedPose], left: usize, stamp: Timestamp, max_gap: Span) -> Transform<RobotBase, Hand> {
    let origin = &known[left];
    let seconds = |i: usize| (known[i].stamp - origin.stamp).seconds();
    let value = |i: usize| {
        let turned = (origin.base_from_hand.rotation().inverse() * known[i].base_from_hand.rotation()).scaled_axis();
        let moved = known[i].base_from_hand.translation() - origin.base_from_hand.translation();
        Vector6::new(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z)
    };
    // A neighbour beyond a gap says nothing about the speed here.
    let near = |i: usize, j: usize| known[j].stamp - known[i].stamp <= max_gap;
    let slope = |i: usize| {
        let from = i.checked_sub(1).filter(|&before| near(before, i)).unwrap_or(i);
        let to = Some(i + 1)
            .filter(|&after| after < known.len() && near(i, after))
            .unwrap_or(i);
        (value(to) - value(from)) / (seconds(to) - seconds(from)).max(f64::MIN_POSITIVE)
    };
    let span = seconds(left + 1);
    let t = (stamp - origin.stamp).seconds() / span;
    let (t2, t3) = (t * t, t * t * t);
    let v = value(left + 1) * (3.0 * t2 - 2.0 * t3) + (slope(left) * (t - 2.0 * t2 + t3) + slope(left + 1) * (t3 - t2)) * span;
    Transform::new(
        origin.base_from_hand.rotation() * UnitQuaternion::from_scaled_axis(v.fixed_rows::<3>(3).into_owned()),
        origin.base_from_hand.translation() + v.fixed_rows::<3>(0),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// A scope that swings and turns, as by hand.
    fn hand_at(t: f64) -> Transform<RobotBase, Hand> {
        Transform::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(0.2 * (2.0 * t).sin(), 0.1 * t, -0.15 * (1.5 * t).cos())),
            Vector3::new(20.0 * (1.7 * t).sin(), 5.0 * t, 60.0 + 8.0 * (2.5 * t).cos()),
        )
    }

    fn known(seconds: impl Iterator<Item = f64>) -> Vec<TimedPose> {
        seconds
            .map(|t| TimedPose {
                stamp: Timestamp::from_seconds(t),
                base_from_hand: hand_at(t),
            })
            .collect()
    }

    #[test]
    fn a_smooth_motion_is_met_between_its_samples() {
        let known = known((0..20).map(|i| 0.2 * f64::from(i)));
        let stamps: Vec<Timestamp> = (0..=110).map(|i| Timestamp::from_seconds(0.04 * f64::from(i))).collect();
        let dense = densified(&known, &stamps, Span::from_milliseconds(500.0));
        // 19 steps of five frames and the last one; beyond it nothing is known.
        assert_eq!(dense.len(), 96);
        let (mut worst_mm, mut worst_linear_mm) = (0.0_f64, 0.0_f64);
        for pose in dense.iter().filter(|pose| (0.2..3.6).contains(&pose.stamp.seconds())) {
            let t = pose.stamp.seconds();
            let away = hand_at(t).inverse() * pose.base_from_hand;
            worst_mm = worst_mm.max(away.translation().norm());
            assert!(away.rotation().angle() < 5e-4, "{t}: {} rad", away.rotation().angle());
            let left = (t / 0.2 + 1e-9).floor();
            let straight = hand_at(0.2 * left).interpolated(&hand_at(0.2 * (left + 1.0)), t / 0.2 - left);
            worst_linear_mm = worst_linear_mm.max((straight.translation() - hand_at(t).translation()).norm());
        }
        // Of sin(ωt) a cubic misses about (ωh)⁴/100 where a line misses (ωh)²/8.
        assert!(worst_mm < 0.03 && worst_linear_mm > 0.2, "{worst_mm} {worst_linear_mm}");
    }

    #[test]
    fn a_gap_stays_a_gap() {
        let known = known([0.0, 0.2, 1.0, 1.2].into_iter());
        let stamps: Vec<Timestamp> = (0..31).map(|i| Timestamp::from_seconds(0.04 * f64::from(i))).collect();
        let dense = densified(&known, &stamps, Span::from_milliseconds(500.0));
        let times: Vec<f64> = dense.iter().map(|pose| pose.stamp.seconds()).collect();
        assert!(times.iter().all(|t| *t < 0.21 || *t > 0.99), "{times:?}");
        assert_eq!(times.len(), 12);
        assert!(densified(&[], &stamps, Span(1)).is_empty());
    }
}
