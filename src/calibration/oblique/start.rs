//! A start for axis and angles, from how the board moves before the camera when the telescope is turned.
//!
//! camera_r ← camera_0 = Rz(θ) R(axis, point, θ)⁻¹ for every rotation r. Its rotation has three numbers and asks for three, θ and the axis;
//! several rotations share the axis. So axes are tried all over the half-space before the camera, with the best angle for each rotation,
//! and the axis that leaves least is taken; the point follows by linear least squares from the translations.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Unit, UnitQuaternion, Vector3};

use crate::camera::intrinsics::Pixel;
use crate::camera::oblique::Oblique;
use crate::geometry::space::Camera;
use crate::geometry::transform::Transform;

/// Axes are tried every so many rad.
const AXIS_STEP: f64 = 0.07;
/// Angles likewise.
const ANGLE_STEP: f64 = 0.05;
/// Axes farther than this from the line of sight are no scope's, rad.
const MOST_TILT: f64 = 1.9;
/// Down to so little, rad.
const FINEST_STEP: f64 = 1e-4;
/// How strongly a given angle draws, rad of misfit per rad.
const GIVEN_WEIGHT: f64 = 0.5;

/// A rotation of the telescope.
#[derive(Clone, Debug)]
pub struct Turned {
    /// Camera at this rotation from camera at the reference, one for each station that has both.
    pub motions: Vec<Transform<Camera, Camera>>,
    /// As told, relative to the reference, rad.
    pub given_rad: Option<f64>,
}

/// Axis and angles (0 for the reference is not among them) that explain the motions best; the misfit, rad, says how well.
#[derive(Clone, Debug)]
pub struct Start {
    /// The joint.
    pub oblique: Oblique,
    /// One for each rotation given.
    pub angles_rad: Vec<f64>,
    /// Root mean square of the rotations' misfit, rad.
    pub misfit_rad: f64,
}

/// Search it.
pub fn searched(turned: &[Turned], center: Pixel) -> Option<Start> {
    let means: Option<Vec<UnitQuaternion<f64>>> = turned.iter().map(|turned| mean_rotation(&turned.motions)).collect();
    let means = means?;
    if means.is_empty() {
        return None;
    }
    let misfit_of = |axis: &Unit<Vector3<f64>>| -> f64 {
        (means.iter().zip(turned))
            .map(|(mean, turned)| best_angle(mean, axis, turned.given_rad).1)
            .sum()
    };
    let mut best: Option<(f64, Unit<Vector3<f64>>)> = None;
    let rings = (MOST_TILT / AXIS_STEP) as usize;
    for ring in 0..=rings {
        let tilt = ring as f64 * AXIS_STEP;
        let around = ((TAU * tilt.sin() / AXIS_STEP) as usize).max(1);
        for step in 0..around {
            let toward = TAU * step as f64 / around as f64;
            let axis = Unit::new_normalize(Vector3::new(tilt.sin() * toward.cos(), tilt.sin() * toward.sin(), tilt.cos()));
            let misfit = misfit_of(&axis);
            if best.as_ref().is_none_or(|(least, _)| misfit < *least) {
                best = Some((misfit, axis));
            }
        }
    }
    let (mut least, mut axis) = best?;
    // The grid is coarse: the neighbours of the best, ever nearer.
    let mut reach = AXIS_STEP / 2.0;
    while reach > FINEST_STEP {
        let around = (0..6).map(|step| f64::from(step) * PI / 3.0).map(|toward| {
            let across = UnitQuaternion::rotation_between(&Vector3::z(), &axis).unwrap_or_else(UnitQuaternion::identity);
            Unit::new_normalize(axis.into_inner() + across * Vector3::new(reach * toward.cos(), reach * toward.sin(), 0.0))
        });
        let better = (around.map(|axis| (misfit_of(&axis), axis)))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .filter(|(misfit, _)| *misfit < least);
        match better {
            Some((misfit, nearer)) => (least, axis) = (misfit, nearer),
            None => reach /= 2.0,
        }
    }
    let angles_rad: Vec<f64> = (means.iter().zip(turned))
        .map(|(mean, turned)| best_angle(mean, &axis, turned.given_rad).0)
        .collect();
    let misfit = (means.iter().zip(&angles_rad))
        .map(|(mean, angle)| predicted(&axis, *angle).angle_to(mean).powi(2))
        .sum::<f64>();
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (turned, angle) in turned.iter().zip(&angles_rad) {
        let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), *angle).to_rotation_matrix();
        let back = UnitQuaternion::from_axis_angle(&axis, -angle).to_rotation_matrix();
        let a = roll.matrix() * (Matrix3::identity() - back.matrix());
        for motion in &turned.motions {
            normal += a.transpose() * a;
            right += a.transpose() * motion.translation();
        }
    }
    // Along the axis nothing is told, and nothing needed: the nearest point.
    normal += 1e-3 * axis.into_inner() * axis.transpose();
    let point = normal.try_inverse()? * right;
    Some(Start {
        oblique: Oblique {
            axis,
            point_mm: point - axis.into_inner() * axis.dot(&point),
            center,
        },
        angles_rad,
        misfit_rad: (misfit / turned.len() as f64).sqrt(),
    })
}

/// Rotation of camera_r ← camera_0.
fn predicted(axis: &Unit<Vector3<f64>>, angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle) * UnitQuaternion::from_axis_angle(axis, -angle)
}

/// The angle that explains a rotation best with this axis, and what it leaves, squared.
fn best_angle(seen: &UnitQuaternion<f64>, axis: &Unit<Vector3<f64>>, given: Option<f64>) -> (f64, f64) {
    let cost = |angle: f64| {
        let drawn = given.map_or(0.0, |given| (GIVEN_WEIGHT * (angle - given)).powi(2));
        predicted(axis, angle).angle_to(seen).powi(2) + drawn
    };
    let steps = (TAU / ANGLE_STEP) as usize;
    let mut best = (0.0, f64::INFINITY);
    for step in 0..steps {
        let angle = -PI + TAU * step as f64 / steps as f64;
        let cost = cost(angle);
        if cost < best.1 {
            best = (angle, cost);
        }
    }
    let mut reach = ANGLE_STEP / 2.0;
    while reach > FINEST_STEP {
        for angle in [best.0 - reach, best.0 + reach] {
            let cost = cost(angle);
            if cost < best.1 {
                best = (angle, cost);
            }
        }
        reach /= 2.0;
    }
    best
}

fn mean_rotation(motions: &[Transform<Camera, Camera>]) -> Option<UnitQuaternion<f64>> {
    let first = motions.first()?.rotation();
    let sum: Vector3<f64> = motions
        .iter()
        .map(|motion| (first.inverse() * motion.rotation()).scaled_axis())
        .sum();
    Some(first * UnitQuaternion::from_scaled_axis(sum / motions.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axis_angles_and_point_are_found() {
        for tilt in [0.52_f64, 1.22] {
            let toward = 1.9_f64;
            let truth = Oblique {
                axis: Unit::new_normalize(Vector3::new(tilt.sin() * toward.cos(), tilt.sin() * toward.sin(), tilt.cos())),
                point_mm: Vector3::zeros(),
                center: Pixel::default(),
            };
            let across = truth.axis.cross(&Vector3::z()).normalize();
            let truth = Oblique {
                point_mm: 0.7 * across,
                ..truth
            };
            let angles = [0.7, 1.6, -1.1, 2.6];
            let turned: Vec<Turned> = (angles.iter())
                .map(|angle| Turned {
                    motions: vec![truth.turned_from_zero(*angle); 2],
                    given_rad: None,
                })
                .collect();
            let found = searched(&turned, Pixel::default()).unwrap();
            assert!(found.oblique.axis.angle(&truth.axis) < 2e-3, "{found:?}");
            for (found, angle) in found.angles_rad.iter().zip(angles) {
                assert!((found - angle).abs() < 0.02, "{found} {angle}");
            }
            assert!((found.oblique.point_mm - truth.point_mm).norm() < 0.02, "{found:?}");
        }
    }
}
