//! The rigid motion (and, if asked, scale) that best lays one set of poses on another.
//!
//! Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991 (doi:10.1109/34.88573), with
//! the poses' rotations as further evidence: ½‖R_fixed − R·R_moving‖² is the squared angle between them to first order, and
//! adds R_fixed·R_movingᵀ to the cross-covariance whose singular vectors give the rotation.

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

/// Two estimates of the same pose, and how much they count.
#[derive(Clone, Copy, Debug)]
pub struct PosePair {
    /// Laid upon.
    pub fixed: Isometry3<f64>,
    /// Moved.
    pub moving: Isometry3<f64>,
    /// Weight of its squared position error, 1/mm².
    pub per_mm2: f64,
    /// Weight of its squared angle, 1/rad².
    pub per_rad2: f64,
}

/// x ↦ scale · rotation · x + translation.
#[derive(Clone, Copy, Debug)]
pub struct Similarity {
    /// Rotation.
    pub rotation: UnitQuaternion<f64>,
    /// Shift, mm.
    pub translation: Vector3<f64>,
    /// Scale; 1 for a rigid motion.
    pub scale: f64,
}

/// Whether the scale is free.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Kept at 1.
    Rigid,
    /// Estimated.
    Free,
}

impl Similarity {
    /// A pose moved along.
    pub fn moved(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let position = self.scale * (self.rotation * pose.translation.vector) + self.translation;
        Isometry3::from_parts(position.into(), self.rotation * pose.rotation)
    }

    /// Laying `moving` on `fixed` with the least weighted squared error; `None` for fewer than two pairs or no weight.
    pub fn between(pairs: &[PosePair], scale: Scale) -> Option<Self> {
        let total: f64 = pairs.iter().map(|p| p.per_mm2).sum();
        if pairs.len() < 2 || !(total > 0.0 && total.is_finite()) {
            return None;
        }
        let mean = |f: fn(&PosePair) -> Vector3<f64>| pairs.iter().map(|p| f(p) * p.per_mm2).sum::<Vector3<f64>>() / total;
        let (fixed_mean, moving_mean) = (mean(|p| p.fixed.translation.vector), mean(|p| p.moving.translation.vector));
        let mut by_position = Matrix3::zeros();
        let mut by_rotation = Matrix3::zeros();
        let mut spread = 0.0;
        for p in pairs {
            let moving = p.moving.translation.vector - moving_mean;
            by_position += (p.fixed.translation.vector - fixed_mean) * moving.transpose() * p.per_mm2;
            by_rotation += (p.fixed.rotation * p.moving.rotation.inverse())
                .to_rotation_matrix()
                .into_inner()
                * (p.per_rad2 * 0.5);
            spread += p.per_mm2 * moving.norm_squared();
        }
        let mut factor = 1.0;
        let mut rotation = UnitQuaternion::identity();
        for _ in 0..if scale == Scale::Free { 3 } else { 1 } {
            rotation = nearest_rotation(&(by_position * factor + by_rotation))?;
            if scale == Scale::Free && spread > 0.0 {
                factor = (rotation.to_rotation_matrix().matrix().transpose() * by_position).trace() / spread;
            }
        }
        Some(Self {
            rotation,
            translation: fixed_mean - factor * (rotation * moving_mean),
            scale: factor,
        })
    }
}

/// The rotation R with the largest tr(Rᵀ M).
fn nearest_rotation(m: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let svd = m.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    // Umeyama 1991, eq. 39: no mirror images.
    let sign = if (u * v).determinant() < 0.0 { -1.0 } else { 1.0 };
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v;
    Some(UnitQuaternion::from_rotation_matrix(
        &nalgebra::Rotation3::from_matrix_unchecked(rotation),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_similarity_comes_back() {
        let truth = Similarity {
            rotation: UnitQuaternion::from_euler_angles(0.3, -1.1, 2.0),
            translation: Vector3::new(10.0, -40.0, 7.0),
            scale: 1.7,
        };
        let pairs: Vec<PosePair> = (0..6)
            .map(|i| {
                let a = f64::from(i);
                let turn = UnitQuaternion::from_euler_angles(0.1 * a, 0.05, -0.2 * a);
                let moving = Isometry3::from_parts(Vector3::new(a, a * a, (3.0 * a).sin()).into(), turn);
                PosePair {
                    fixed: truth.moved(&moving),
                    moving,
                    per_mm2: 4.0,
                    per_rad2: 1e4,
                }
            })
            .collect();
        let found = Similarity::between(&pairs, Scale::Free).unwrap();
        assert!((found.scale - 1.7).abs() < 1e-9 && (found.translation - truth.translation).norm() < 1e-6);
        assert!(found.rotation.angle_to(&truth.rotation) < 1e-9);
        let rigid = Similarity::between(&pairs, Scale::Rigid).unwrap();
        assert!(rigid.scale == 1.0 && rigid.rotation.angle_to(&truth.rotation) < 1e-9);
    }
}
