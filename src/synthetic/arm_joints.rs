//! The arm as a chain of joints with the errors that real ones have.
//!
//! An encoder reports its joint with a constant offset (it was zeroed by hand), with backlash (the reading lags behind by half the
//! play whenever the direction turns), and with noise. Through the chain these become pose errors that depend on where the arm
//! is: smooth over a path, different elsewhere, and with a small jump where a joint turns back — unlike white noise on the pose.
//!
//! Joint values that bring the hand to a pose are found by damped least squares (Wampler 1986, DOI 10.1109/TSMC.1986.289285).

use nalgebra::{DVector, Matrix6, Vector6};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Normal};

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::kinematics::{Arm, ArmError, JointKind};

/// Errors of the joints' readings; uniform over ± for offsets, standard deviations for noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointErrors {
    /// Which arm: its offsets follow from this, and are the same in all of its recordings.
    pub arm_seed: u64,
    /// Largest constant offset of a sliding joint, mm.
    pub offset_mm: f64,
    /// Largest constant offset of a turning joint, rad.
    pub offset_rad: f64,
    /// Play of a sliding joint, mm.
    pub backlash_mm: f64,
    /// Play of a turning joint, rad.
    pub backlash_rad: f64,
    /// Noise of a sliding joint, mm.
    pub noise_mm: f64,
    /// Noise of a turning joint, rad.
    pub noise_rad: f64,
}

impl Default for JointErrors {
    fn default() -> Self {
        Self {
            arm_seed: 1,
            offset_mm: 0.5,
            offset_rad: 0.15_f64.to_radians(),
            backlash_mm: 0.08,
            backlash_rad: 0.02_f64.to_radians(),
            noise_mm: 0.03,
            noise_rad: 0.004_f64.to_radians(),
        }
    }
}

/// Where the arm stands in the middle of the operation, mm and rad; far from every limit and from where it loses a freedom.
pub const AT_WORK: [f64; 7] = [190.0, 0.45, -0.95, 0.20, 0.35, -0.60, 0.20];

/// Joint values along a path of the hand.
pub fn joint_path(arm: &Arm, start: &[f64], hands: &[Transform<RobotBase, Hand>]) -> Result<Vec<Vec<f64>>, ArmError> {
    let mut joints = start.to_vec();
    let mut path = Vec::with_capacity(hands.len());
    for hand in hands {
        joints = joints_of_hand(arm, &joints, hand)?;
        arm.check_limits(&joints)?;
        path.push(joints.clone());
    }
    Ok(path)
}

/// Joint values that bring the hand to `wanted`, near `guess`.
fn joints_of_hand(arm: &Arm, guess: &[f64], wanted: &Transform<RobotBase, Hand>) -> Result<Vec<f64>, ArmError> {
    /// A turn of one rad counts as much as a way of this length, mm: about the arm's reach.
    const REACH_MM: f64 = 300.0;
    const DAMPING: f64 = 1e-3;
    let mut joints = DVector::from_column_slice(guess);
    for _ in 0..60 {
        let found = arm.base_from_hand(joints.as_slice())?;
        let way = wanted.translation() - found.translation();
        let turn = (wanted.rotation() * found.rotation().inverse()).scaled_axis() * REACH_MM;
        let error = Vector6::new(way.x, way.y, way.z, turn.x, turn.y, turn.z);
        if error.amax() < 1e-9 {
            break;
        }
        let mut jacobian = arm.jacobian(joints.as_slice())?;
        for row in 3..6 {
            jacobian.row_mut(row).scale_mut(REACH_MM);
        }
        let damped = &jacobian * jacobian.transpose() + Matrix6::identity() * DAMPING;
        let Some(inverse) = damped.try_inverse() else {
            break;
        };
        joints += jacobian.transpose() * (inverse * error);
    }
    Ok(joints.as_slice().to_vec())
}

/// What the encoders say along a path of true joint values; `seed` is that of the recording's noise.
pub fn encoder_readings(arm: &Arm, errors: &JointErrors, seed: u64, path: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut of_the_arm = ChaCha8Rng::seed_from_u64(errors.arm_seed);
    let mut readings = path.to_vec();
    for (number, joint) in arm.joints().iter().enumerate() {
        let (offset, play, noise) = match joint.kind {
            JointKind::Prismatic => (errors.offset_mm, errors.backlash_mm, errors.noise_mm),
            JointKind::Revolute => (errors.offset_rad, errors.backlash_rad, errors.noise_rad),
        };
        let offset = offset * of_the_arm.random_range(-1.0..1.0);
        // The encoder sits on the motor's side of the gears: it may stand anywhere within the play, and is dragged along.
        let mut engaged = path.first().map_or(0.0, |first| first[number]);
        for (reading, truth) in readings.iter_mut().zip(path) {
            engaged = engaged.clamp(truth[number] - 0.5 * play, truth[number] + 0.5 * play);
            let jitter = Normal::new(0.0, noise).map_or(0.0, |normal| normal.sample(&mut random));
            reading[number] = engaged + offset + jitter;
        }
    }
    readings
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    #[test]
    fn joints_are_found_for_poses_within_reach() {
        let arm = Arm::aesop_3000().unwrap();
        let middle = arm.base_from_hand(&AT_WORK).unwrap();
        let hands: Vec<_> = (0..50)
            .map(|i| {
                let s = f64::from(i) * 0.06;
                middle.perturbed_left(&Vector6::new(30.0 * s.sin(), 25.0 * (1.3 * s).sin(), 20.0 * s.sin(), 0.0, 0.0, 0.0))
                    .perturbed_right(&Vector6::new(0.0, 0.0, 0.0, 0.2 * s.sin(), 0.2 * (0.7 * s).sin(), 0.1 * s.sin()))
            })
            .collect();
        let path = joint_path(&arm, &AT_WORK, &hands).unwrap();
        for (joints, hand) in path.iter().zip(&hands) {
            let error = arm.base_from_hand(joints).unwrap().inverse() * *hand;
            assert!(error.translation().norm() < 1e-6 && error.rotation().angle() < 1e-8);
        }
    }

    #[test]
    fn encoders_err_within_their_bounds_and_lag_where_they_turn() {
        let arm = Arm::aesop_3000().unwrap();
        let errors = JointErrors { noise_mm: 0.0, noise_rad: 0.0, offset_mm: 0.0, offset_rad: 0.0, ..JointErrors::default() };
        let path: Vec<Vec<f64>> = (0..200).map(|i| AT_WORK.iter().map(|q| q + 0.3 * (f64::from(i) * 0.05).sin()).collect()).collect();
        let readings = encoder_readings(&arm, &errors, 1, &path);
        let lag = |i: usize| readings[i][0] - path[i][0];
        // Rising: the reading is behind by half the play; falling: ahead.
        assert!((lag(20) + 0.04).abs() < 1e-9 && (lag(60) - 0.04).abs() < 1e-9, "{} {}", lag(20), lag(60));
    }
}
