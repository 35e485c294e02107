//! Rotation first, translation after: Tsai–Lenz, Park–Martin, Horaud–Dornaika.

use nalgebra::{Matrix3, Matrix4, Quaternion, SymmetricEigen, UnitQuaternion, Vector3};

use crate::calibration::hand_eye::motion::Motion;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

/// Tsai and Lenz, "A new technique for fully autonomous and efficient 3D robotics hand/eye calibration", 1989, eqs. 10–15.
pub fn tsai_lenz(motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    let (mut normal, mut side) = (Matrix3::zeros(), Vector3::zeros());
    for motion in motions {
        let (a, b) = motion.aligned_rotations();
        // P = 2 sin(θ/2)·axis is twice the quaternion's vector.
        let (a, b) = (2.0 * a.imag(), 2.0 * b.imag());
        let skew = (a + b).cross_matrix();
        normal += skew.transpose() * skew;
        side += skew.transpose() * (b - a);
    }
    let p = normal.cholesky()?.solve(&side);
    let p = 2.0 * p / (1.0 + p.norm_squared()).sqrt();
    let vector = 0.5 * p;
    let scalar = (1.0 - vector.norm_squared()).max(0.0).sqrt();
    let rotation = UnitQuaternion::from_quaternion(Quaternion::from_parts(scalar, vector));
    with_translation(rotation, motions)
}

/// Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", 1994.
pub fn park_martin(motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    let mut m = Matrix3::zeros();
    for motion in motions {
        let (a, b) = motion.aligned_rotations();
        m += b.scaled_axis() * a.scaled_axis().transpose();
    }
    let eigen = SymmetricEigen::new(m.transpose() * m);
    if eigen
        .eigenvalues
        .iter()
        .any(|&value| value <= 1e-12 * eigen.eigenvalues.max())
    {
        // Axes in one plane still determine the rotation: the third axis is theirs crossed.
        return with_translation(rotation_between(m)?, motions);
    }
    let root = Matrix3::from_diagonal(&eigen.eigenvalues.map(|value| 1.0 / value.sqrt()));
    let rotation = eigen.eigenvectors * root * eigen.eigenvectors.transpose() * m.transpose();
    with_translation(proper(rotation)?, motions)
}

/// Horaud and Dornaika, "Hand-eye calibration", 1995: the unit quaternion that carries the axes of B onto those of A best.
pub fn horaud_dornaika(motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    let mut sum = Matrix4::zeros();
    for motion in motions {
        let (a, b) = motion.aligned_rotations();
        let difference = left_product(&a) - right_product(&b);
        sum += difference.transpose() * difference;
    }
    let eigen = SymmetricEigen::new(sum);
    let q = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let rotation = UnitQuaternion::try_new(Quaternion::new(q[0], q[1], q[2], q[3]), 1e-9)?;
    with_translation(rotation, motions)
}

/// q·x as a matrix times x, scalar first.
fn left_product(q: &Quaternion<f64>) -> Matrix4<f64> {
    let (w, x, y, z) = (q.w, q.i, q.j, q.k);
    Matrix4::new(w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w)
}

/// x·q as a matrix times x, scalar first.
fn right_product(q: &Quaternion<f64>) -> Matrix4<f64> {
    let (w, x, y, z) = (q.w, q.i, q.j, q.k);
    Matrix4::new(w, -x, -y, -z, x, w, z, -y, y, -z, w, x, z, y, -x, w)
}

/// The translation that fits a rotation: (I − R_A)·t = t_A − R·t_B, least squares.
pub fn with_translation(rotation: UnitQuaternion<f64>, motions: &[Motion]) -> Option<Transform<Hand, Camera>> {
    let (mut normal, mut side) = (Matrix3::zeros(), Vector3::zeros());
    for motion in motions {
        let left = Matrix3::identity() - motion.hand.rotation().to_rotation_matrix().into_inner();
        let right = motion.hand.translation() - rotation * motion.camera.translation();
        normal += left.transpose() * left;
        side += left.transpose() * right;
    }
    let transform = Transform::new(rotation, normal.cholesky()?.solve(&side));
    transform.is_finite().then_some(transform)
}

/// The rotation nearest to a matrix (Frobenius).
pub fn proper(matrix: Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let svd = matrix.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let sign = Vector3::new(1.0, 1.0, (u * v).determinant().signum());
    let rotation = u * Matrix3::from_diagonal(&sign) * v;
    let rotation = UnitQuaternion::from_matrix(&rotation);
    rotation.coords.iter().all(|v| v.is_finite()).then_some(rotation)
}

/// The rotation R with R·β = α for sums of β·αᵀ (Kabsch 1976).
fn rotation_between(beta_alpha: Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    proper(beta_alpha.transpose())
}
