//! From joint values to the hand: a serial chain by Denavit and Hartenberg.
//!
//! Standard convention (Denavit and Hartenberg 1955; Craig calls it "distal"): row i maps the space of link i to that of link
//! i−1 by Rz(θ) Tz(d) Tx(a) Rx(α). A revolute joint's value adds to θ, a prismatic one's to d. The hand is the last link.
//!
//! To first order a small change δq of the joints moves the hand by J δq, so a covariance Σ of the joints becomes J Σ Jᵀ of the
//! pose: of (translation mm, rotation rad) as in [`Transform::perturbed_left`], but for the translation, which is that of the hand's
//! own origin; both in the base's axes. Errors of the same joint are strongly correlated between poses: the covariance says how far *one* pose may be off.

use std::path::{Path, PathBuf};

use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Matrix6xX, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::trajectory::{PoseFault, TimedPose, Trajectory, TrajectoryError, numbers_of_line};
use crate::time::Timestamp;

/// How a joint moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JointKind {
    /// It turns; its value is an angle, rad.
    Revolute,
    /// It slides; its value is a length, mm.
    Prismatic,
}

/// A row of the table, as in the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Joint {
    /// For messages.
    #[serde(default)]
    pub name: String,
    /// How it moves.
    pub kind: JointKind,
    /// Twist, degrees.
    #[serde(default)]
    pub alpha_deg: f64,
    /// Length, mm.
    #[serde(default)]
    pub a: f64,
    /// Angle at value 0, degrees.
    #[serde(default)]
    pub theta_deg: f64,
    /// Offset at value 0, mm.
    #[serde(default)]
    pub d: f64,
    /// Smallest and largest value, mm or degrees.
    pub limits: [f64; 2],
}

/// A serial arm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Arm {
    /// For messages.
    pub name: String,
    /// Always mm.
    unit: String,
    /// From base to hand.
    #[serde(rename = "joint")]
    joints: Vec<Joint>,
}

/// Joint values and the arm's stamp of them.
#[derive(Clone, Debug, PartialEq)]
pub struct JointSample {
    /// On the arm's clock.
    pub stamp: Timestamp,
    /// From base to hand, mm or rad.
    pub values: Vec<f64>,
}

/// Why there is no arm, or no pose for these joint values.
#[derive(Debug, thiserror::Error)]
pub enum ArmError {
    /// The disk said no.
    #[error("cannot read the arm {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not a table of joints.
    #[error("the arm's table: {0}")]
    Table(String),
    /// Too few or too many values.
    #[error("{arm} has {expected} joints, found {found} values")]
    Count {
        /// The arm.
        arm: String,
        /// Its joints.
        expected: usize,
        /// The values given.
        found: usize,
    },
    /// A covariance of another arm.
    #[error("{arm} has {expected} joints: expected a {expected}×{expected} covariance, found {rows}×{columns}")]
    Covariance {
        /// The arm.
        arm: String,
        /// Its joints.
        expected: usize,
        /// Of the matrix.
        rows: usize,
        /// Of the matrix.
        columns: usize,
    },
    /// A value the joint cannot take.
    #[error("joint {number} ({name}) of {arm}: expected {lowest} to {highest} {unit}, found {found}")]
    Limit {
        /// The arm.
        arm: String,
        /// Counted from 1.
        number: usize,
        /// The joint.
        name: String,
        /// Smallest value.
        lowest: f64,
        /// Largest value.
        highest: f64,
        /// mm or degrees.
        unit: &'static str,
        /// The value given.
        found: f64,
    },
}

impl Joint {
    fn link(&self, value: f64) -> Isometry3<f64> {
        let (turn, slide) = match self.kind {
            JointKind::Revolute => (value, 0.0),
            JointKind::Prismatic => (0.0, value),
        };
        let about_z = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.theta_deg.to_radians() + turn);
        let about_x = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.alpha_deg.to_radians());
        let shift = about_z * Vector3::new(self.a, 0.0, self.d + slide);
        Isometry3::from_parts(Translation3::from(shift), about_z * about_x)
    }
}

impl Arm {
    /// From the text of a file like `config/arms/aesop3000.toml`.
    pub fn from_toml(text: &str) -> Result<Self, ArmError> {
        let arm: Self = toml::from_str(text).map_err(|e| ArmError::Table(e.to_string()))?;
        if arm.unit != "mm" {
            return Err(ArmError::Table(format!("`unit`: expected mm, found `{}`", arm.unit)));
        }
        if arm.joints.is_empty() {
            return Err(ArmError::Table("expected at least one [[joint]], found none".into()));
        }
        for (joint, number) in arm.joints.iter().zip(1..) {
            let numbers = [
                joint.alpha_deg,
                joint.a,
                joint.theta_deg,
                joint.d,
                joint.limits[0],
                joint.limits[1],
            ];
            if numbers.iter().any(|v| !v.is_finite()) || joint.limits[0] > joint.limits[1] {
                let message = format!(
                    "joint {number} ({}): expected finite numbers and limits = [lowest, highest]",
                    joint.name
                );
                return Err(ArmError::Table(message));
            }
        }
        Ok(arm)
    }

    /// Read a file like `config/arms/aesop3000.toml`.
    pub fn read(path: &Path) -> Result<Self, ArmError> {
        let text = std::fs::read_to_string(path).map_err(|source| ArmError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        Self::from_toml(&text)
    }

    /// The arm of `config/arms/aesop3000.toml`, as built in.
    pub fn aesop_3000() -> Result<Self, ArmError> {
        Self::from_toml(include_str!("../../config/arms/aesop3000.toml"))
    }

    /// From base to hand.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    fn check_count(&self, values: &[f64]) -> Result<(), ArmError> {
        if values.len() == self.joints.len() {
            Ok(())
        } else {
            Err(ArmError::Count {
                arm: self.name.clone(),
                expected: self.joints.len(),
                found: values.len(),
            })
        }
    }

    /// An error when a joint cannot take its value (mm or rad).
    pub fn check_limits(&self, values: &[f64]) -> Result<(), ArmError> {
        self.check_count(values)?;
        for ((joint, value), number) in self.joints.iter().zip(values).zip(1..) {
            let (found, unit) = match joint.kind {
                JointKind::Revolute => (value.to_degrees(), "degrees"),
                JointKind::Prismatic => (*value, "mm"),
            };
            let [lowest, highest] = joint.limits;
            // Encoders read a hair beyond the stop.
            let slack = 0.02 * (highest - lowest);
            if !(lowest - slack..=highest + slack).contains(&found) {
                let (arm, name) = (self.name.clone(), joint.name.clone());
                return Err(ArmError::Limit {
                    arm,
                    number,
                    name,
                    lowest,
                    highest,
                    unit,
                    found,
                });
            }
        }
        Ok(())
    }

    /// Where the hand is for these joint values (mm or rad); limits are not asked.
    pub fn base_from_hand(&self, values: &[f64]) -> Result<Transform<RobotBase, Hand>, ArmError> {
        self.check_count(values)?;
        let links = self.joints.iter().zip(values).map(|(joint, value)| joint.link(*value));
        Ok(Transform::from_isometry(
            links.fold(Isometry3::identity(), |chain, link| chain * link),
        ))
    }

    /// How the hand moves per unit of each joint, in the base's axes: rows 0–2 the hand's origin (mm), rows 3–5 its rotation (rad).
    pub fn jacobian(&self, values: &[f64]) -> Result<Matrix6xX<f64>, ArmError> {
        let hand = self.base_from_hand(values)?.translation();
        let mut jacobian = Matrix6xX::zeros(values.len());
        let mut chain = Isometry3::identity();
        for (column, (joint, value)) in self.joints.iter().zip(values).enumerate() {
            // Row i of the table moves along or about the z axis of link i−1.
            let axis = chain.rotation * Vector3::z();
            let (motion, turn) = match joint.kind {
                JointKind::Revolute => (axis.cross(&(hand - chain.translation.vector)), axis),
                JointKind::Prismatic => (axis, Vector3::zeros()),
            };
            jacobian.fixed_view_mut::<3, 1>(0, column).copy_from(&motion);
            jacobian.fixed_view_mut::<3, 1>(3, column).copy_from(&turn);
            chain *= joint.link(*value);
        }
        Ok(jacobian)
    }

    /// Covariance of the hand's pose, of (translation of its origin mm, rotation rad) in the base's axes: the pose is off by
    /// t + δt and exp(δr)·R. `joints` is that of the joint values, mm² and rad²; to first order.
    pub fn pose_covariance(&self, values: &[f64], joints: &DMatrix<f64>) -> Result<Matrix6<f64>, ArmError> {
        self.check_count(values)?;
        if joints.shape() != (values.len(), values.len()) {
            return Err(ArmError::Covariance {
                arm: self.name.clone(),
                expected: values.len(),
                rows: joints.nrows(),
                columns: joints.ncols(),
            });
        }
        let jacobian = self.jacobian(values)?;
        let product = &jacobian * joints * jacobian.transpose();
        let covariance = Matrix6::from_fn(|i, j| product[(i, j)]);
        // Rounding leaves it slightly lopsided.
        Ok((covariance + covariance.transpose()) * 0.5)
    }

    /// The same, where the joints' errors are independent: their standard deviations, mm or rad.
    pub fn pose_covariance_of_noise(&self, values: &[f64], joint_sigmas: &[f64]) -> Result<Matrix6<f64>, ArmError> {
        self.check_count(joint_sigmas)?;
        let variances = joint_sigmas.iter().map(|sigma| sigma * sigma);
        let joints = DMatrix::from_diagonal(&DVector::from_iterator(joint_sigmas.len(), variances));
        self.pose_covariance(values, &joints)
    }

    /// Read `joints.csv` (`timestamp_s,q1,…,qn`; mm or rad) and turn every line into a pose.
    pub fn read_joints(&self, path: &Path) -> Result<Trajectory, TrajectoryError> {
        let mut poses: Vec<TimedPose> = Vec::new();
        for sample in self.read_joint_samples(path)? {
            // Counted when it was read.
            if let Ok(base_from_hand) = self.base_from_hand(&sample.values) {
                let stamp = sample.stamp;
                poses.push(TimedPose { stamp, base_from_hand });
            }
        }
        Trajectory::new(poses).ok_or_else(|| TrajectoryError::Empty { path: path.to_owned() })
    }

    /// Read `joints.csv` as it is: every line within the joints' limits, stamps increasing.
    pub fn read_joint_samples(&self, path: &Path) -> Result<Vec<JointSample>, TrajectoryError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrajectoryError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let mut samples: Vec<JointSample> = Vec::new();
        for (line_number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            let is_header = samples.is_empty() && line.starts_with(char::is_alphabetic) && line.contains('q');
            if line.is_empty() || line.starts_with('#') || is_header {
                continue;
            }
            let sample = self.sample_of_line(line).and_then(|sample| match samples.last() {
                Some(last) if last.stamp >= sample.stamp => Err(PoseFault::Backwards {
                    previous_s: last.stamp.seconds(),
                    found_s: sample.stamp.seconds(),
                }),
                _ => Ok(sample),
            });
            samples.push(sample.map_err(|fault| TrajectoryError::Line {
                path: path.to_owned(),
                line: line_number,
                fault,
            })?);
        }
        if samples.is_empty() {
            return Err(TrajectoryError::Empty { path: path.to_owned() });
        }
        Ok(samples)
    }

    fn sample_of_line(&self, line: &str) -> Result<JointSample, PoseFault> {
        let mut values = numbers_of_line(line, self.joints.len() + 1, "timestamp_s, then a value per joint")?;
        let stamp = Timestamp::from_seconds(values.remove(0));
        self.check_limits(&values)
            .map_err(|error| PoseFault::Joints(error.to_string()))?;
        Ok(JointSample { stamp, values })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_distr::Distribution as _;

    fn close(found: Vector3<f64>, expected: [f64; 3], bound: f64) {
        assert!((found - Vector3::from(expected)).amax() < bound, "{found:?} {expected:?}");
    }

    /// Values of an independent implementation of the same table, given to 1e-4 cm: 1e-3 mm.
    #[test]
    fn aesop_test_vectors() {
        let arm = Arm::aesop_3000().unwrap();
        let d = f64::to_radians;
        for (q, p, z, x) in [
            ([0.0; 7], [791.5, 0.0, -100.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]),
            (
                [200.0, 0.5, -0.7, 0.2, 0.3, -0.4, 0.1],
                [715.126, 141.102, 161.636],
                [-0.1486, 0.3079, -0.9397],
                [0.9883, 0.0138, -0.1518],
            ),
            (
                [190.5, d(30.0), d(-60.0), d(10.0), d(20.0), d(-30.0), d(45.0)],
                [666.457, 42.681, 147.747],
                [-0.1560, 0.4321, -0.8883],
                [0.9286, 0.3708, 0.0173],
            ),
        ] {
            let pose = arm.base_from_hand(&q).unwrap();
            close(pose.translation(), p, 1e-3);
            close(pose.rotation() * Vector3::z(), z, 1e-4);
            close(pose.rotation() * Vector3::x(), x, 1e-4);
            arm.check_limits(&q).unwrap();
        }
    }

    #[test]
    fn jacobian_is_the_derivative() {
        for arm in [
            Arm::aesop_3000().unwrap(),
            Arm::from_toml(include_str!("../../config/arms/six_axis.toml")).unwrap(),
        ] {
            let q: Vec<f64> = arm.joints().iter().enumerate().map(|(i, _)| 0.3 - 0.1 * i as f64).collect();
            let jacobian = arm.jacobian(&q).unwrap();
            let h = 1e-6;
            for column in 0..q.len() {
                let moved = |step: f64| {
                    let mut q = q.clone();
                    q[column] += step;
                    arm.base_from_hand(&q).unwrap()
                };
                let (after, before) = (moved(h), moved(-h));
                let motion = (after.translation() - before.translation()) / (2.0 * h);
                let turn = (after.rotation() * before.rotation().inverse()).scaled_axis() / (2.0 * h);
                assert!((jacobian.fixed_view::<3, 1>(0, column) - motion).amax() < 1e-5);
                assert!((jacobian.fixed_view::<3, 1>(3, column) - turn).amax() < 1e-7);
            }
        }
    }

    /// Monte Carlo: N draws of the joints, their poses' sample covariance against the stated one. An element of the sample
    /// covariance deviates with √((Σii Σjj + Σij²)/N); 21 of them stay within 5 of that but for 1 in 10⁵ seeds. The second order of
    /// the chain adds (½ κ σ²)² per joint, where κ ≤ 1 m/rad² is the curvature: 1e-3² rad · 1 m = 1e-3 mm against 1 mm, nothing.
    #[test]
    fn covariance_is_that_of_many_draws() {
        let arm = Arm::aesop_3000().unwrap();
        let q = [190.0, 0.45, -0.95, 0.20, 0.35, -0.60, 0.20];
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let normal = rand_distr::Normal::new(0.0, 1.0).unwrap();
        // Correlated, as joints driven by one belt are.
        let mut factor = DMatrix::<f64>::identity(7, 7) * 1e-3;
        factor[(0, 0)] = 0.2;
        factor[(2, 1)] = 0.7e-3;
        factor[(5, 4)] = -0.4e-3;
        let joints = &factor * factor.transpose();
        let stated = arm.pose_covariance(&q, &joints).unwrap();
        let pose = arm.base_from_hand(&q).unwrap();
        let count = 20_000;
        let mut found = Matrix6::zeros();
        for _ in 0..count {
            let draw = &factor * DVector::from_fn(7, |_, _| normal.sample(&mut rng));
            let values: Vec<f64> = q.iter().zip(draw.iter()).map(|(a, b)| a + b).collect();
            let other = arm.base_from_hand(&values).unwrap();
            let moved = other.translation() - pose.translation();
            let turned = (other.rotation() * pose.rotation().inverse()).scaled_axis();
            let d = nalgebra::Vector6::new(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z);
            found += d * d.transpose() / f64::from(count);
        }
        for i in 0..6 {
            for j in 0..6 {
                let spread = ((stated[(i, i)] * stated[(j, j)] + stated[(i, j)].powi(2)) / f64::from(count)).sqrt();
                let error = (found[(i, j)] - stated[(i, j)]).abs();
                assert!(error < 5.0 * spread + 1e-12, "({i}, {j}): {error} against {spread}");
            }
        }
        // The axes matter: in the hand's axes it would be another matrix.
        let turn = pose.rotation().to_rotation_matrix();
        let in_hand = turn.matrix().transpose() * stated.fixed_view::<3, 3>(0, 0) * turn.matrix();
        assert!((in_hand - stated.fixed_view::<3, 3>(0, 0)).amax() > 0.1 * stated.fixed_view::<3, 3>(0, 0).amax());
        let sigmas = [0.1; 7];
        let independent = arm.pose_covariance_of_noise(&q, &sigmas).unwrap();
        let expected = arm.pose_covariance(&q, &(DMatrix::identity(7, 7) * 0.01)).unwrap();
        assert!((independent - expected).amax() < 1e-9 * expected.amax());
        assert!(
            arm.pose_covariance(&q, &DMatrix::identity(6, 6))
                .unwrap_err()
                .to_string()
                .contains("7×7")
        );
    }

    #[test]
    fn faults_are_named() {
        let arm = Arm::aesop_3000().unwrap();
        assert!(arm.base_from_hand(&[0.0; 6]).unwrap_err().to_string().contains("7 joints"));
        let message = arm
            .check_limits(&[0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            .unwrap_err()
            .to_string();
        assert!(message.contains("shoulder") && message.contains("157.5"), "{message}");
        assert!(arm.check_limits(&[f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).is_err());
        assert!(Arm::from_toml("name = \"x\"\nunit = \"cm\"\njoint = []\n").is_err());
    }

    #[test]
    fn joints_become_poses() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("joints.csv");
        let arm = Arm::aesop_3000().unwrap();
        std::fs::write(
            &path,
            "timestamp_s,q1,q2,q3,q4,q5,q6,q7\n0.0,0,0,0,0,0,0,0\n0.02,10,0,0,0,0,0,0\n",
        )
        .unwrap();
        let trajectory = arm.read_joints(&path).unwrap();
        close(trajectory.poses()[1].base_from_hand.translation(), [791.5, 0.0, -90.0], 1e-9);
        std::fs::write(&path, "0.0,0,0,0,0,0,0,0\n0.02,900,0,0,0,0,0,0\n").unwrap();
        assert!(
            arm.read_joints(&path)
                .unwrap_err()
                .to_string()
                .contains("joints.csv, line 2: joint 1 (slide)")
        );
    }
}
