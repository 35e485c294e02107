//! Rotation and translation at once, linear: Andreff, Horaud and Espiau, "Robot hand-eye calibration using structure-from-motion", 2001.
//!
//! Row-major vec(R) and t of X obey \[I₉ − R_A ⊗ R_B, 0; I₃ ⊗ t_Bᵀ, I₃ − R_A\]·(vec R; t) = (0; t_A). With camera poses known only up to
//! a scale, as structure from motion gives them, the scale is one more unknown of the translation's equations.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix4, Vector4};

use crate::calibration::hand_eye::motion::Motion;
use crate::calibration::hand_eye::rotation_first::{park_martin, proper, with_translation};
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

/// All twelve numbers of X in one linear system, the rotation made proper afterwards and the translation fitted to it.
pub fn andreff(motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    // In units of the motions' own length, so that rows of rotation and of translation weigh alike.
    let length = motions.iter().map(|m| m.camera.translation().norm()).sum::<f64>() / motions.len().max(1) as f64;
    let unit = if length > 1e-9 { 1.0 / length } else { 1.0 };
    let mut matrix = DMatrix::zeros(12 * motions.len(), 12);
    let mut side = DVector::zeros(12 * motions.len());
    for (index, motion) in motions.iter().enumerate() {
        let a = motion.hand.rotation().to_rotation_matrix().into_inner();
        let b = motion.camera.rotation().to_rotation_matrix().into_inner();
        let row = 12 * index;
        let rotations =
            nalgebra::Matrix::<f64, _, _, _>::identity_generic(nalgebra::Const::<9>, nalgebra::Const::<9>) - a.kronecker(&b);
        matrix.view_mut((row, 0), (9, 9)).copy_from(&rotations);
        let t = motion.camera.translation() * unit;
        for i in 0..3 {
            matrix.view_mut((row + 9 + i, 3 * i), (1, 3)).copy_from(&t.transpose());
        }
        matrix.view_mut((row + 9, 9), (3, 3)).copy_from(&(Matrix3::identity() - a));
        side.rows_mut(row + 9, 3).copy_from(&(motion.hand.translation() * unit));
    }
    let solution = matrix.svd(true, true).solve(&side, 1e-12).ok()?;
    let rotation = Matrix3::from_row_slice(&solution.as_slice()[..9]);
    let rotation = if rotation.determinant() < 0.0 { -rotation } else { rotation };
    with_translation(proper(rotation)?, motions)
}

/// X, and how many mm the unit of the camera's poses is.
#[derive(Clone, Copy, Debug)]
pub struct Scaled {
    /// How the camera sits on the hand.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// mm per unit of the camera's translations.
    pub scale: f64,
}

/// X from camera motions whose scale is unknown: (I − R_A)·t + s·R·t_B = … with t and s unknown. `None` if the scale is not positive.
pub fn with_unknown_scale(motions: &[Motion]) -> Option<Scaled> {
    let rotation = park_martin(motions)?.rotation();
    let (mut normal, mut side) = (Matrix4::zeros(), Vector4::zeros());
    for motion in motions {
        let left = Matrix3::identity() - motion.hand.rotation().to_rotation_matrix().into_inner();
        let moved = rotation * motion.camera.translation();
        for row in 0..3 {
            let equation = Vector4::new(left[(row, 0)], left[(row, 1)], left[(row, 2)], moved[row]);
            normal += equation * equation.transpose();
            side += equation * motion.hand.translation()[row];
        }
    }
    // The scale's column is in other units than the translation's.
    let units = normal.diagonal().map(|d| 1.0 / d.sqrt());
    let scaled = Matrix4::from_fn(|i, j| normal[(i, j)] * units[i] * units[j]);
    let solution = scaled.cholesky()?.solve(&side.component_mul(&units)).component_mul(&units);
    let hand_from_camera = Transform::new(rotation, solution.xyz());
    (solution[3] > 0.0 && hand_from_camera.is_finite()).then_some(Scaled {
        hand_from_camera,
        scale: solution[3],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::hand_eye::example::{Example, Noise};
    use crate::calibration::hand_eye::motion::motions;

    #[test]
    fn an_unknown_scale_is_found_with_the_rest() {
        let example = Example::new(5, 10, Noise::NONE);
        let mut motions = motions(&example.stations);
        for motion in &mut motions {
            motion.camera = Transform::new(motion.camera.rotation(), motion.camera.translation() / 7.5);
        }
        let found = with_unknown_scale(&motions).unwrap();
        assert!((found.scale - 7.5).abs() < 1e-9);
        assert!((found.hand_from_camera.translation() - example.hand_from_camera.translation()).norm() < 1e-8);
    }
}
