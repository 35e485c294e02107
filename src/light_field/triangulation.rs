//! Where rays meet: the point with the least squared distance to all of them.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::light_field::tracking::Views;

/// The place of a track in the world; `None` if its rays are near parallel.
pub(crate) fn triangulated(views: &Views<'_>, observations: &[(usize, Vector2<f64>)]) -> Option<Vector3<f64>> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (view, pixel) in observations {
        let pose = &views.poses[*view];
        let ray = (pose.rotation * views.ray(pixel)).normalize();
        let across = Matrix3::identity() - ray * ray.transpose();
        normal += across;
        right += across * pose.translation.vector;
    }
    // Eigenvalues are sums of squared sines: the least one tells the parallax.
    let parallax = normal.symmetric_eigenvalues().min() / observations.len().max(1) as f64;
    (parallax > 1e-5)
        .then(|| normal.try_inverse().map(|inverse| inverse * right))
        .flatten()
}
