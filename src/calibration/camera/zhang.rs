//! First intrinsics from a few views of a plane, in closed form.
//!
//! Each homography H = K [r₁ r₂ t] gives two equations on B = K⁻ᵀK⁻¹, because r₁ and r₂ are of one length and upright on each other
//! (Zhang 2000, "A flexible new technique for camera calibration", eqs. 3–9, doi:10.1109/34.888718). Without skew B has five numbers;
//! with the principal point in the picture's middle only two, which holds out when views are few or the lens bends the picture much.

use nalgebra::{Matrix3, SMatrix, SVector};

use crate::camera::intrinsics::Intrinsics;

/// Focal lengths and principal point, no skew (Zhang 2000, section 3.1); `None` where the views do not tell.
pub fn intrinsics(homographies: &[Matrix3<f64>]) -> Option<Intrinsics> {
    let mut normal = SMatrix::<f64, 5, 5>::zeros();
    for h in homographies {
        let scale = h.column(0).norm();
        for equation in equations(&(h / scale)) {
            // b = (B11, B22, B13, B23, B33); B12 = 0.
            let row = SVector::<f64, 5>::from_column_slice(&[equation[0], equation[2], equation[3], equation[4], equation[5]]);
            // Pixels squared against units: made alike, or the eigenvector drowns in rounding.
            let row = row.component_mul(&UNITS);
            let length = row.norm();
            if length > 0.0 {
                let row = row / length;
                normal += row * row.transpose();
            }
        }
    }
    let eigen = normal.symmetric_eigen();
    let least = (0..5).min_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]))?;
    let b = eigen.eigenvectors.column(least).component_mul(&UNITS);
    let (b11, b22, b13, b23, b33) = (b[0], b[1], b[2], b[3], b[4]);
    let (cx, cy) = (-b13 / b11, -b23 / b22);
    let lambda = b33 - b13 * b13 / b11 - b23 * b23 / b22;
    let (fx2, fy2) = (lambda / b11, lambda / b22);
    (fx2 > 0.0 && fy2 > 0.0 && cx.is_finite() && cy.is_finite()).then(|| Intrinsics {
        fx: fx2.sqrt(),
        fy: fy2.sqrt(),
        cx,
        cy,
    })
}

/// Typical sizes of B's numbers in px: 1/f², 1/f², c/f², c/f², 1.
const UNITS: SVector<f64, 5> = SVector::<f64, 5>::new(1e-6, 1e-6, 1e-3, 1e-3, 1.0);

/// One focal length, the principal point being known: the median over the views' equations.
pub fn focal_length(homographies: &[Matrix3<f64>], center: [f64; 2]) -> Option<f64> {
    let shift = Matrix3::new(1.0, 0.0, -center[0], 0.0, 1.0, -center[1], 0.0, 0.0, 1.0);
    let mut squares: Vec<f64> = homographies
        .iter()
        .flat_map(|h| {
            let h = shift * h;
            equations(&(h / h.column(0).norm()))
                .into_iter()
                .map(|e| -(e[0] + e[2]) / e[5])
                .collect::<Vec<f64>>()
        })
        .filter(|f2| f2.is_finite() && *f2 > 0.0)
        .collect();
    squares.sort_by(f64::total_cmp);
    squares.get(squares.len() / 2).map(|f2| f2.sqrt())
}

/// v₁₂ and v₁₁ − v₂₂ (Zhang 2000, eq. 8), in the order B11, B12, B22, B13, B23, B33.
fn equations(h: &Matrix3<f64>) -> [[f64; 6]; 2] {
    let v = |i: usize, j: usize| {
        let (a, b) = (h.column(i), h.column(j));
        [
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[1] * b[1],
            a[2] * b[0] + a[0] * b[2],
            a[2] * b[1] + a[1] * b[2],
            a[2] * b[2],
        ]
    };
    let (v12, v11, v22) = (v(0, 1), v(0, 0), v(1, 1));
    let mut difference = v11;
    for (difference, other) in difference.iter_mut().zip(v22) {
        *difference -= other;
    }
    [v12, difference]
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;

    #[test]
    fn exact_views_give_exact_intrinsics() {
        let truth = Intrinsics {
            fx: 820.0,
            fy: 815.0,
            cx: 470.0,
            cy: 280.0,
        };
        let homographies: Vec<Matrix3<f64>> = (0..5)
            .map(|i| {
                let i = f64::from(i);
                let turn = Rotation3::from_euler_angles(0.4 * (1.3 * i).sin() + 0.1, 0.5 * (2.1 * i).cos(), 0.3 * i);
                let r = turn.matrix();
                let t = Vector3::new(3.0 * i - 6.0, 4.0 - i, 80.0 + 5.0 * i);
                let rigid = Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), t]);
                truth.matrix() * rigid * 0.37
            })
            .collect();
        let found = intrinsics(&homographies).unwrap();
        for (a, b) in [
            (found.fx, truth.fx),
            (found.fy, truth.fy),
            (found.cx, truth.cx),
            (found.cy, truth.cy),
        ] {
            assert!((a - b).abs() < 1e-5, "{found:?}");
        }
        let f = focal_length(&homographies, [470.0, 280.0]).unwrap();
        // Pixels half a percent off square weigh heavy in views that are hardly tilted; it is a start, no more.
        assert!((f - 817.0).abs() < 40.0, "{f}");
    }
}
