//! Lens distortion: where a ideal (pinhole) image point really lands.
//!
//! A closed family, as in ROS `camera_info` and OpenCV. Points are on the normalized image plane (z = 1).
//!
//! - **Brown–Conrady** (Brown 1966; `plumb_bob`, 5 coefficients k1 k2 p1 p2 k3; `rational_polynomial`, 8, with k4 k5 k6 in the
//!   denominator): x_d = x·(1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2x²), y likewise.
//! - **Kannala–Brandt** (Kannala and Brandt 2006; `equidistant`, 4 coefficients): θ_d = θ·(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),
//!   θ the angle to the optical axis.

/// One of the lens models, with its coefficients in the order of its files.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// A pinhole.
    None,
    /// `plumb_bob` (last three zero) and `rational_polynomial`.
    BrownConrady {
        /// Radial coefficients k1…k6; k4…k6 stand in the denominator.
        k: [f64; 6],
        /// Tangential coefficients p1, p2.
        p: [f64; 2],
    },
    /// `equidistant` (OpenCV's fisheye).
    KannalaBrandt {
        /// Coefficients k1…k4 of θ³, θ⁵, θ⁷, θ⁹.
        k: [f64; 4],
    },
}

impl Distortion {
    /// Where the ideal point (x, y) lands, on the normalized image plane.
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match self {
            Self::None => (x, y),
            Self::BrownConrady { k, p } => {
                let r2 = x * x + y * y;
                let radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])));
                (
                    x * radial + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x),
                    y * radial + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * x * y,
                )
            }
            Self::KannalaBrandt { k } => {
                let r = x.hypot(y);
                if r < 1e-12 {
                    return (x, y);
                }
                let theta_d = bent_angle(k, r.atan());
                (x * theta_d / r, y * theta_d / r)
            }
        }
    }

    /// The ideal point whose image lands at (x, y); `None` where no ideal point does (outside the lens's field).
    pub fn undistort(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        match self {
            Self::None => Some((x, y)),
            Self::BrownConrady { .. } => self.inverted_by_newton(x, y),
            Self::KannalaBrandt { k } => {
                let theta_d = x.hypot(y);
                if theta_d < 1e-12 {
                    return Some((x, y));
                }
                let mut theta = theta_d;
                for _ in 0..20 {
                    let t2 = theta * theta;
                    let slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
                    if slope < 1e-6 {
                        return None;
                    }
                    theta -= (bent_angle(k, theta) - theta_d) / slope;
                }
                let converged = (bent_angle(k, theta) - theta_d).abs() < 1e-9;
                // A pinhole picture shows less than a half-space.
                (converged && theta > 0.0 && theta < 1.55).then(|| {
                    let r = theta.tan();
                    (x * r / theta_d, y * r / theta_d)
                })
            }
        }
    }

    fn inverted_by_newton(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let (mut u, mut v) = (x, y);
        for _ in 0..50 {
            let (fx, fy) = self.distort(u, v);
            let (ex, ey) = (fx - x, fy - y);
            if ex.abs() < 1e-12 && ey.abs() < 1e-12 {
                break;
            }
            // The Jacobian by central differences: this runs once per pixel of a table, not per frame.
            let h = 1e-6;
            let (ax, ay) = self.distort(u + h, v);
            let (bx, by) = self.distort(u - h, v);
            let (cx, cy) = self.distort(u, v + h);
            let (dx, dy) = self.distort(u, v - h);
            let (j00, j10) = ((ax - bx) / (2.0 * h), (ay - by) / (2.0 * h));
            let (j01, j11) = ((cx - dx) / (2.0 * h), (cy - dy) / (2.0 * h));
            let determinant = j00 * j11 - j01 * j10;
            // Where the map folds over, the lens model no longer describes a lens.
            if determinant <= 1e-9 || !determinant.is_finite() {
                return None;
            }
            u -= (j11 * ex - j01 * ey) / determinant;
            v -= (j00 * ey - j10 * ex) / determinant;
        }
        let (fx, fy) = self.distort(u, v);
        ((fx - x).hypot(fy - y) < 1e-8).then_some((u, v))
    }
}

fn bent_angle(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
}
