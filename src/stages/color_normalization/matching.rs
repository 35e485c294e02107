//! The affine color map that brings one cluster of colors to another.
//!
//! - *Rotation*: Paulus, Csink, Niemann, Color cluster rotation, ICIP 1998, doi:10.1109/ICIP.1998.723522. With m the mean
//!   and e the principal axis of the cluster, f' = R (f − m) + m', R the smallest rotation that takes e to the reference's
//!   axis e'. The paper's reference is the gray diagonal; here it is the reference's own axis, because tissue is not gray,
//!   and the cluster is also scaled to the reference's length along the axis, because a lamp's brightness differs.
//! - *Statistics*: the linear map of optimal transport between Gaussians, T = S^-½ (S^½ S' S^½)^½ S^-½ (Pitié, Kokaram,
//!   2007), symmetric and positive: channel gains come back exactly.
//! - *Reinhard*: each channel's mean and deviation by itself (Reinhard et al. 2001, here in RGB).
//! - *Gray world*: gains that bring the mean to the reference's mean; with no reference, to gray.

use nalgebra::{Matrix3, Rotation3, SymmetricEigen, Unit, Vector3};

use crate::stages::color_normalization::affine::Affine;
use crate::stages::color_normalization::settings::Method;
use crate::stages::color_normalization::statistics::Statistics;

/// Scales and gains stay within these: beyond, the statistics are of something else.
const MIN_GAIN: f64 = 0.4;
const MAX_GAIN: f64 = 2.5;
/// A cluster rounder than this (principal over second deviation) has no axis to rotate.
const MIN_ELONGATION: f64 = 1.3;
/// Rotations beyond this are of something else, rad.
const MAX_ROTATION_RAD: f64 = 0.6;
/// Added to each variance, levels²: noise and rounding, keeps the roots well defined.
const VARIANCE_FLOOR: f64 = 4.0;

/// The map from colors with statistics `from` to colors with statistics `to`, `strength` of the way from 0 to 1.
pub fn affine_between(from: &Statistics, to: &Statistics, method: Method, strength: f64) -> Affine {
    let linear = match method {
        Method::None => return Affine::IDENTITY,
        Method::Rotation => rotation(&from.covariance, &to.covariance, strength),
        Method::Statistics => blend(transport(&from.covariance, &to.covariance), strength),
        Method::Reinhard => blend(Matrix3::from_diagonal(&deviations(from, to)), strength),
        Method::GrayWorld => {
            let gains = to
                .mean
                .component_div(&from.mean.map(|v| v.max(1.0)))
                .map(|v| v.clamp(MIN_GAIN, MAX_GAIN));
            return Affine::new(blend(Matrix3::from_diagonal(&gains), strength), Vector3::zeros());
        }
    };
    let target = from.mean + (to.mean - from.mean) * strength;
    Affine::new(linear, target - linear * from.mean)
}

/// What gray world takes for its reference when it has none: the frame's own mean, without its color.
pub fn gray_of(statistics: &Statistics) -> Statistics {
    let level = statistics.mean.mean();
    Statistics {
        mean: Vector3::repeat(level),
        covariance: statistics.covariance,
    }
}

fn blend(linear: Matrix3<f64>, strength: f64) -> Matrix3<f64> {
    Matrix3::identity() * (1.0 - strength) + linear * strength
}

fn floored(covariance: &Matrix3<f64>) -> Matrix3<f64> {
    covariance + Matrix3::identity() * VARIANCE_FLOOR
}

struct Axis {
    direction: Vector3<f64>,
    deviation: f64,
    elongation: f64,
}

/// The principal axis, pointing to the bright side.
fn axis(covariance: &Matrix3<f64>) -> Axis {
    let eigen = SymmetricEigen::new(floored(covariance));
    let first = eigen.eigenvalues.imax();
    let second = (0..3)
        .filter(|i| *i != first)
        .map(|i| eigen.eigenvalues[i])
        .fold(0.0, f64::max);
    let direction: Vector3<f64> = eigen.eigenvectors.column(first).into();
    let direction = if direction.sum() < 0.0 { -direction } else { direction };
    Axis {
        direction,
        deviation: eigen.eigenvalues[first].max(0.0).sqrt(),
        elongation: (eigen.eigenvalues[first] / second.max(1e-9)).sqrt(),
    }
}

fn rotation(from: &Matrix3<f64>, to: &Matrix3<f64>, strength: f64) -> Matrix3<f64> {
    let (from, to) = (axis(from), axis(to));
    let scale = (to.deviation / from.deviation.max(1e-9))
        .clamp(MIN_GAIN, MAX_GAIN)
        .powf(strength);
    if from.elongation < MIN_ELONGATION || to.elongation < MIN_ELONGATION {
        return Matrix3::identity() * scale;
    }
    let normal = from.direction.cross(&to.direction);
    let angle = normal.norm().atan2(from.direction.dot(&to.direction)).min(MAX_ROTATION_RAD) * strength;
    match Unit::try_new(normal, 1e-9) {
        Some(normal) => Rotation3::from_axis_angle(&normal, angle).into_inner() * scale,
        None => Matrix3::identity() * scale,
    }
}

fn root(symmetric: &Matrix3<f64>, power: f64) -> Matrix3<f64> {
    let eigen = SymmetricEigen::new(*symmetric);
    let powered = eigen.eigenvalues.map(|v| v.max(1e-9).powf(power));
    eigen.eigenvectors * Matrix3::from_diagonal(&powered) * eigen.eigenvectors.transpose()
}

fn transport(from: &Matrix3<f64>, to: &Matrix3<f64>) -> Matrix3<f64> {
    let (from, to) = (floored(from), floored(to));
    let half = root(&from, 0.5);
    let inverse_half = root(&from, -0.5);
    let map = inverse_half * root(&(half * to * half), 0.5) * inverse_half;
    let eigen = SymmetricEigen::new((map + map.transpose()) * 0.5);
    let gains = eigen.eigenvalues.map(|v| v.clamp(MIN_GAIN, MAX_GAIN));
    eigen.eigenvectors * Matrix3::from_diagonal(&gains) * eigen.eigenvectors.transpose()
}

fn deviations(from: &Statistics, to: &Statistics) -> Vector3<f64> {
    let deviation = |s: &Statistics| floored(&s.covariance).diagonal().map(|v| v.max(1e-9).sqrt());
    deviation(to)
        .component_div(&deviation(from))
        .map(|v| v.clamp(MIN_GAIN, MAX_GAIN))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tissue() -> Statistics {
        let covariance = Matrix3::new(900.0, 640.0, 520.0, 640.0, 560.0, 430.0, 520.0, 430.0, 410.0);
        Statistics {
            mean: Vector3::new(150.0, 88.0, 76.0),
            covariance,
        }
    }

    fn tinted(gains: [f64; 3]) -> Statistics {
        let gains = Matrix3::from_diagonal(&Vector3::from(gains));
        let tissue = tissue();
        Statistics {
            mean: gains * tissue.mean,
            covariance: gains * tissue.covariance * gains,
        }
    }

    #[test]
    fn statistics_transfer_takes_channel_gains_back() {
        let map = affine_between(&tinted([1.15, 1.0, 0.8]), &tissue(), Method::Statistics, 1.0);
        let expected = Matrix3::from_diagonal(&Vector3::new(1.0 / 1.15, 1.0, 1.0 / 0.8));
        // Only the variance floor keeps it from being exact.
        assert!((map.linear() - expected).norm() < 0.06, "{}", map.linear());
    }

    #[test]
    fn every_method_brings_the_mean_to_the_reference_and_strength_0_does_nothing() {
        let from = tinted([1.15, 1.0, 0.8]);
        for method in [Method::Rotation, Method::Statistics, Method::Reinhard, Method::GrayWorld] {
            let map = affine_between(&from, &tissue(), method, 1.0);
            let mean = map.linear() * from.mean + map.offset();
            assert!((mean - tissue().mean).norm() < 1e-3, "{method:?}: {mean}");
            let nothing = affine_between(&from, &tissue(), method, 0.0);
            assert!(
                (nothing.linear() - Matrix3::identity()).norm() < 1e-6 && nothing.offset().norm() < 1e-4,
                "{method:?}"
            );
        }
    }

    #[test]
    fn rotation_is_a_scaled_rotation_that_aligns_the_axes() {
        let from = tinted([1.15, 1.0, 0.8]);
        let map = affine_between(&from, &tissue(), Method::Rotation, 1.0).linear();
        let scale = map.determinant().cbrt();
        assert!((map * map.transpose() / (scale * scale) - Matrix3::identity()).norm() < 1e-6);
        let turned = (map * axis(&from.covariance).direction).normalize();
        assert!(turned.dot(&axis(&tissue().covariance).direction) > 1.0 - 1e-6);
    }
}
