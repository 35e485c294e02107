//! Rotations as files hold them: four numbers that ought to have length 1.

use nalgebra::{Quaternion, UnitQuaternion};

/// Files round; a length farther from 1 than this is no rounding but another number.
const LARGEST_LENGTH_ERROR: f64 = 0.1;

/// Why four numbers are no rotation.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum QuaternionFault {
    /// NaN or infinite.
    #[error("the quaternion holds a number that is not finite")]
    NotFinite,
    /// All zero.
    #[error("the quaternion has length 0: it is no rotation (expected length 1)")]
    Zero,
    /// Neither 1 nor nearly so.
    #[error("the quaternion has length {0:.6}: it is no rotation (expected length 1)")]
    Length(f64),
}

/// The rotation of `x y z w`; a length that is slightly off is set right.
pub fn rotation_from_xyzw([x, y, z, w]: [f64; 4]) -> Result<UnitQuaternion<f64>, QuaternionFault> {
    let quaternion = Quaternion::new(w, x, y, z);
    let length = quaternion.norm();
    if !length.is_finite() {
        return Err(QuaternionFault::NotFinite);
    }
    if length < 1e-9 {
        return Err(QuaternionFault::Zero);
    }
    if (length - 1.0).abs() > LARGEST_LENGTH_ERROR {
        return Err(QuaternionFault::Length(length));
    }
    Ok(UnitQuaternion::from_quaternion(quaternion))
}

/// `x y z w` with w ≥ 0, as files hold them.
pub fn xyzw_from_rotation(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    let sign = if rotation.w < 0.0 { -1.0 } else { 1.0 };
    [rotation.i * sign, rotation.j * sign, rotation.k * sign, rotation.w * sign]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_judged() {
        assert_eq!(rotation_from_xyzw([0.0; 4]), Err(QuaternionFault::Zero));
        assert_eq!(rotation_from_xyzw([f64::NAN, 0.0, 0.0, 1.0]), Err(QuaternionFault::NotFinite));
        assert_eq!(rotation_from_xyzw([0.0, 0.0, 0.0, 2.0]), Err(QuaternionFault::Length(2.0)));
        let slightly_off = rotation_from_xyzw([0.0, 0.0, 0.6001, 0.8001]).unwrap();
        assert!((slightly_off.norm() - 1.0).abs() < 1e-12);
        assert!((xyzw_from_rotation(&slightly_off)[2] - 0.6).abs() < 1e-3);
    }
}
