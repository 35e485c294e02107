//! Rotation and translation at once, as a unit dual quaternion: Daniilidis, "Hand-eye calibration using dual quaternions", 1999.

use nalgebra::{DMatrix, Matrix3, Quaternion, SymmetricEigen, UnitQuaternion, Vector3, Vector4};

use crate::calibration::hand_eye::motion::{Motion, upright};
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

/// A screw as a unit dual quaternion.
struct Screw {
    real: Quaternion<f64>,
    dual: Quaternion<f64>,
}

impl Screw {
    /// With the sign that makes the scalar part positive: those of A and of B must be equal.
    fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        let real = upright(rotation).into_inner();
        Self {
            real,
            dual: Quaternion::from_parts(0.0, translation) * real * 0.5,
        }
    }
}

/// By how much the hand's and the camera's screw of one motion differ in what no X can change: angle (rad) and pitch (mm). Both are the
/// scalar parts of the dual quaternions, and zero without noise (Daniilidis 1999, section 3).
pub fn incongruence(motion: &Motion) -> [f64; 2] {
    let (a, b) = motion.aligned_rotations();
    let pitch =
        |rotation: UnitQuaternion<f64>, translation: Vector3<f64>| rotation.axis().map_or(0.0, |axis| axis.dot(&translation));
    [
        a.angle() - b.angle(),
        pitch(a, motion.hand.translation()) - pitch(b, motion.camera.translation()),
    ]
}

/// Daniilidis 1999, eqs. 31–35.
pub fn daniilidis(motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    // In units of the motions' own length: the rows of the dual part then weigh like those of the real part.
    let length = motions.iter().map(|m| m.hand.translation().norm()).sum::<f64>() / motions.len().max(1) as f64;
    let unit = if length > 1e-9 { 1.0 / length } else { 1.0 };
    let mut normal = DMatrix::zeros(8, 8);
    for motion in motions {
        let a = Screw::new(motion.hand.rotation(), motion.hand.translation() * unit);
        let b = Screw::new(motion.camera.rotation(), motion.camera.translation() * unit);
        let mut rows = DMatrix::zeros(6, 8);
        let real = [a.real.imag() - b.real.imag(), a.real.imag() + b.real.imag()];
        let dual = [a.dual.imag() - b.dual.imag(), a.dual.imag() + b.dual.imag()];
        let mut put = |row: usize, column: usize, [difference, sum]: &[Vector3<f64>; 2]| {
            rows.view_mut((row, column), (3, 1)).copy_from(difference);
            let skew: Matrix3<f64> = sum.cross_matrix();
            rows.view_mut((row, column + 1), (3, 3)).copy_from(&skew);
        };
        put(0, 0, &real);
        put(3, 0, &dual);
        put(3, 4, &real);
        normal += rows.transpose() * rows;
    }
    let eigen = SymmetricEigen::new(normal);
    let mut order: Vec<usize> = (0..8).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let half = |vector: usize, first: usize| -> Vector4<f64> {
        eigen.eigenvectors.fixed_view::<4, 1>(first, order[vector]).into_owned()
    };
    let (u1, v1, u2, v2) = (half(0, 0), half(0, 4), half(1, 0), half(1, 4));
    // λ₁, λ₂ such that the sum is a unit dual quaternion: real part of length one and across the dual part.
    let (a, b, c) = (u1.dot(&v1), u1.dot(&v2) + u2.dot(&v1), u2.dot(&v2));
    let length_of = |l1: f64, l2: f64| l1 * l1 * u1.dot(&u1) + 2.0 * l1 * l2 * u1.dot(&u2) + l2 * l2 * u2.dot(&u2);
    // Both as a share of the other, whichever is the better conditioned.
    let ratios: Vec<(f64, f64)> = if a.abs() >= c.abs() {
        roots(a, b, c).into_iter().map(|s| (s, 1.0)).collect()
    } else {
        roots(c, b, a).into_iter().map(|s| (1.0, s)).collect()
    };
    let normed = |(l1, l2): (f64, f64)| {
        let scale = 1.0 / l1.hypot(l2);
        (l1 * scale, l2 * scale)
    };
    let (l1, l2) = (ratios.into_iter().map(normed)).max_by(|a, b| length_of(a.0, a.1).total_cmp(&length_of(b.0, b.1)))?;
    let scale = 1.0 / length_of(l1, l2).sqrt();
    let real = (u1 * l1 + u2 * l2) * scale;
    let dual = (v1 * l1 + v2 * l2) * scale;
    let quaternion = |v: Vector4<f64>| Quaternion::new(v[0], v[1], v[2], v[3]);
    let translation = 2.0 * (quaternion(dual) * quaternion(real).conjugate()).imag() / unit;
    let rotation = UnitQuaternion::try_new(quaternion(real), 1e-9)?;
    let transform = Transform::new(rotation, translation);
    transform.is_finite().then_some(transform)
}

/// Real roots of a·s² + b·s + c, a pair of complex ones as their real part: noise may have driven them off the axis.
fn roots(a: f64, b: f64, c: f64) -> Vec<f64> {
    if a.abs() < 1e-300 {
        return if b.abs() < 1e-300 { vec![0.0] } else { vec![-c / b] };
    }
    let root = (b * b - 4.0 * a * c).max(0.0).sqrt();
    let q = -0.5 * (b + b.signum() * root);
    if q.abs() < 1e-300 { vec![0.0] } else { vec![q / a, c / q] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::hand_eye::example::{Example, Noise};
    use crate::calibration::hand_eye::motion::motions;

    #[test]
    fn screws_of_one_motion_are_congruent_and_a_wrong_pose_breaks_that() {
        let mut example = Example::new(8, 8, Noise::NONE);
        for motion in motions(&example.stations) {
            let [angle, pitch] = incongruence(&motion);
            assert!(angle.abs() < 1e-9 && pitch.abs() < 1e-6, "{angle} {pitch}");
        }
        example.disturb(3, Vector3::new(8.0, 0.0, 3.0), Vector3::new(0.0, 0.1, 0.05));
        let worst = (motions(&example.stations).iter())
            .map(|motion| incongruence(motion)[1].abs())
            .fold(0.0, f64::max);
        assert!(worst > 1.0, "{worst}");
    }

    #[test]
    fn roots_are_roots() {
        for (a, b, c) in [(1.0, -3.0, 2.0), (2.0, 0.0, -8.0), (1e-12, 1.0, -1.0), (0.0, 2.0, -4.0)] {
            for s in roots(a, b, c) {
                assert!(
                    (a * s * s + b * s + c).abs() < 1e-6 * (1.0 + (b * s).abs()),
                    "{a} {b} {c}: {s}"
                );
            }
        }
    }
}
