//! The map from one plane to another, from pairs of points.
//!
//! The direct linear transformation (Hartley and Zisserman 2004, Multiple View Geometry, algorithm 4.2): both sides are moved to their
//! centre and scaled to a mean distance of √2, then the nine numbers are the eigenvector of least eigenvalue.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Maps (x, y, 1) to (u, v, 1) up to scale; `None` for fewer than four points or degenerate ones.
pub fn from_pairs(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let from = normalizing(pairs.iter().map(|(from, _)| *from))?;
    let to = normalizing(pairs.iter().map(|(_, to)| *to))?;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in pairs {
        let p = from * Vector3::new(a[0], a[1], 1.0);
        let q = to * Vector3::new(b[0], b[1], 1.0);
        let first = SVector::<f64, 9>::from_column_slice(&[p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x]);
        let second = SVector::<f64, 9>::from_column_slice(&[0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y]);
        normal += first * first.transpose() + second * second.transpose();
    }
    let eigen = normal.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    // A second vanishing eigenvalue: the points lie on a line.
    if eigen.eigenvalues[order[1]] < 1e-12 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let map = to.try_inverse()? * h * from;
    map.iter().all(|v| v.is_finite()).then_some(map)
}

/// Where a homography takes a point.
pub fn mapped(map: &Matrix3<f64>, at: [f64; 2]) -> Option<[f64; 2]> {
    let q = map * Vector3::new(at[0], at[1], 1.0);
    (q.z.abs() > 1e-12).then(|| [q.x / q.z, q.y / q.z])
}

fn normalizing(points: impl Iterator<Item = [f64; 2]> + Clone) -> Option<Matrix3<f64>> {
    let count = points.clone().count() as f64;
    let mean = points
        .clone()
        .fold([0.0; 2], |sum, p| [sum[0] + p[0] / count, sum[1] + p[1] / count]);
    let spread = points.map(|p| (p[0] - mean[0]).hypot(p[1] - mean[1])).sum::<f64>() / count;
    let scale = std::f64::consts::SQRT_2 / spread;
    scale
        .is_finite()
        .then(|| Matrix3::new(scale, 0.0, -scale * mean[0], 0.0, scale, -scale * mean[1], 0.0, 0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_map_is_found_and_a_line_refused() {
        let truth = Matrix3::new(300.0, 20.0, 100.0, -15.0, 280.0, 60.0, 0.1, -0.05, 1.0);
        let points: Vec<[f64; 2]> = (0..12).map(|i| [f64::from(i % 4), f64::from(i / 4) * 1.3]).collect();
        let pairs: Vec<_> = points.iter().map(|p| (*p, mapped(&truth, *p).unwrap())).collect();
        let found = from_pairs(&pairs).unwrap();
        for p in points {
            let (a, b) = (mapped(&truth, p).unwrap(), mapped(&found, p).unwrap());
            assert!((a[0] - b[0]).abs() < 1e-8 && (a[1] - b[1]).abs() < 1e-8);
        }
        let line: Vec<_> = (0..12).map(|i| ([f64::from(i), 0.0], [f64::from(2 * i), 1.0])).collect();
        assert!(from_pairs(&line).is_none());
    }
}
