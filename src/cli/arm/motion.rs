//! What a simulated arm plays: a recording's poses or joints, or a look around of its own.

use std::f64::consts::TAU;
use std::path::Path;

use anyhow::Context as _;
use nalgebra::{Isometry3, Translation3};

use crate::geometry::space::{Camera, RobotBase, World};
use crate::geometry::transform::Transform;
use crate::robot::feed::message::{JointValues, MOST_JOINTS, Reading};
use crate::robot::kinematics::{Arm, JointKind};
use crate::robot::quaternion::rotation_from_xyzw;
use crate::robot::trajectory::Trajectory as Recorded;
use crate::synthetic::arm::{ArmModel, ArmSettings, arm_readings, world_from_camera_at_work};
use crate::synthetic::arm_joints::JointErrors;
use crate::synthetic::trajectory::{Course, Trajectory};

/// Length of the arm's own look around, s; played forth and back.
const LOOK_AROUND_S: f64 = 40.0;
/// Readings of it a second, between which is interpolated.
const LOOK_AROUND_HZ: f64 = 100.0;
/// An arm without a motion of its own sways each joint by this share of its range.
const SWAY: f64 = 0.04;

/// Readings at increasing times.
#[derive(Debug)]
pub struct Motion {
    samples: Vec<(f64, Reading)>,
    /// Played back where it ends, so that it never jumps.
    pub returns: bool,
}

impl Motion {
    /// From `poses.tum`.
    pub fn from_poses(path: &Path) -> anyhow::Result<Self> {
        let poses = Recorded::read(path)?;
        let reading = |pose: &Isometry3<f64>| Reading::from_isometry(pose);
        let samples = poses.poses().iter();
        Ok(Self {
            samples: samples
                .map(|pose| (pose.stamp.seconds(), reading(pose.base_from_hand.isometry())))
                .collect(),
            returns: false,
        })
    }

    /// From `joints.csv`.
    pub fn from_joints(path: &Path, arm: &Arm) -> anyhow::Result<Self> {
        let samples = arm.read_joint_samples(path)?;
        let samples: Option<Vec<(f64, Reading)>> = samples
            .iter()
            .map(|sample| Some((sample.stamp.seconds(), Reading::Joints(JointValues::new(&sample.values)?))))
            .collect();
        Ok(Self {
            samples: samples.with_context(|| format!("expected an arm of at most {MOST_JOINTS} joints"))?,
            returns: false,
        })
    }

    /// From a recording's folder: its joints, or else its poses.
    pub fn from_recording(folder: &Path, arm: &Arm) -> anyhow::Result<Self> {
        let (joints, poses) = (folder.join("joints.csv"), folder.join("poses.tum"));
        if joints.exists() {
            Self::from_joints(&joints, arm)
        } else if poses.exists() {
            Self::from_poses(&poses)
        } else {
            anyhow::bail!("{}: expected joints.csv or poses.tum in it, found neither", folder.display())
        }
    }

    /// An AESOP 3000 that looks around in an abdomen, its joints erring as real ones do.
    pub fn look_around(seed: u64) -> anyhow::Result<Self> {
        let settings = ArmSettings {
            rate_hz: LOOK_AROUND_HZ,
            late_s: 0.0,
            model: ArmModel::Joints(JointErrors::default()),
            ..ArmSettings::default()
        };
        // The patient lies where the arm can reach.
        let still = Trajectory::new(Course::Still, 1.0, Transform::identity()).world_from_camera(0.0);
        let at_work: Transform<World, Camera> = world_from_camera_at_work(settings.scope_mm)?;
        let organs = at_work * Transform::from_isometry(*still.inverse().isometry());
        let path = Trajectory::new(Course::Live, LOOK_AROUND_S, organs);
        let readings = arm_readings(&settings, seed, 0.0, LOOK_AROUND_S, |t| path.world_from_camera(t))?;
        let joints = readings.iter().filter_map(|reading| {
            let values = JointValues::new(&reading.joints.as_ref()?.read)?;
            Some((reading.stamp_s, Reading::Joints(values)))
        });
        Ok(Self {
            samples: joints.collect(),
            returns: true,
        })
    }

    /// Any arm, swaying about the middle of its joints' ranges.
    pub fn sway(arm: &Arm) -> anyhow::Result<Self> {
        let count = (LOOK_AROUND_S * LOOK_AROUND_HZ) as usize;
        let samples = (0..=count).map(|i| {
            let t = i as f64 / LOOK_AROUND_HZ;
            let joints: Vec<f64> = (1_u8..)
                .zip(arm.joints())
                .map(|(number, joint)| {
                    let [lowest, highest] = joint.limits;
                    let phase = TAU * t / (4.0 + f64::from(number));
                    let value = 0.5 * (lowest + highest) + SWAY * (highest - lowest) * phase.sin();
                    match joint.kind {
                        JointKind::Revolute => value.to_radians(),
                        JointKind::Prismatic => value,
                    }
                })
                .collect();
            Some((t, Reading::Joints(JointValues::new(&joints)?)))
        });
        let samples: Option<Vec<(f64, Reading)>> = samples.collect();
        Ok(Self {
            samples: samples.with_context(|| format!("expected an arm of at most {MOST_JOINTS} joints"))?,
            returns: true,
        })
    }

    /// Seconds since its beginning at which it has readings.
    pub fn times(&self) -> Vec<f64> {
        let first = self.first_s();
        self.samples.iter().map(|(t, _)| t - first).collect()
    }

    /// Stamp of the first reading, s.
    pub fn first_s(&self) -> f64 {
        self.samples.first().map_or(0.0, |(t, _)| *t)
    }

    /// From the first reading to the last, s.
    pub fn length_s(&self) -> f64 {
        self.samples.last().map_or(0.0, |(t, _)| t - self.first_s())
    }

    /// The reading `since_start_s` after the beginning; between two it is interpolated.
    pub fn at(&self, since_start_s: f64) -> Option<Reading> {
        let length = self.length_s();
        let mut t = since_start_s;
        if self.returns && length > 0.0 {
            t = t.rem_euclid(2.0 * length);
            t = t.min(2.0 * length - t);
        }
        let t = t + self.first_s();
        let right = self.samples.partition_point(|(at, _)| *at <= t);
        let (before, after) = (
            right.checked_sub(1).and_then(|i| self.samples.get(i)),
            self.samples.get(right),
        );
        match (before, after) {
            (Some((t0, a)), Some((t1, b))) => Some(between(a, b, (t - t0) / (t1 - t0))),
            (Some((_, reading)), None) | (None, Some((_, reading))) => Some(*reading),
            (None, None) => None,
        }
    }
}

fn between(a: &Reading, b: &Reading, share: f64) -> Reading {
    match (a, b) {
        (Reading::Joints(a), Reading::Joints(b)) => {
            let pairs = a.as_slice().iter().zip(b.as_slice());
            let values: Vec<f64> = pairs.map(|(a, b)| a + (b - a) * share).collect();
            JointValues::new(&values).map_or(Reading::Joints(*a), Reading::Joints)
        }
        (a, b) => match (isometry(a), isometry(b)) {
            (Some(from), Some(to)) => {
                let from: Transform<RobotBase, Camera> = Transform::from_isometry(from);
                Reading::from_isometry(from.interpolated(&Transform::from_isometry(to), share).isometry())
            }
            _ => *a,
        },
    }
}

fn isometry(reading: &Reading) -> Option<Isometry3<f64>> {
    match reading {
        Reading::Joints(_) => None,
        Reading::Pose { translation, rotation } => {
            let rotation = rotation_from_xyzw(*rotation).ok()?;
            Some(Isometry3::from_parts(Translation3::from(*translation), rotation))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_look_around_goes_on_without_a_jump_and_within_the_limits() {
        let motion = Motion::look_around(1).unwrap();
        let arm = Arm::aesop_3000().unwrap();
        let pose = |t: f64| match motion.at(t).unwrap() {
            Reading::Joints(joints) => {
                arm.check_limits(joints.as_slice()).unwrap();
                arm.base_from_hand(joints.as_slice()).unwrap()
            }
            Reading::Pose { .. } => unreachable!(),
        };
        let mut last = pose(0.0);
        for i in 1..20_000 {
            let next = pose(f64::from(i) * 0.01);
            let step = (next.translation() - last.translation()).norm();
            // 1 mm in 10 ms is 100 mm/s, noise included.
            assert!(step < 1.0, "{step} mm at {} s", f64::from(i) * 0.01);
            last = next;
        }
    }

    #[test]
    fn any_arm_sways_within_its_limits() {
        let arm = Arm::from_toml(include_str!("../../../config/arms/six_axis.toml")).unwrap();
        let motion = Motion::sway(&arm).unwrap();
        for i in 0..400 {
            let Some(Reading::Joints(joints)) = motion.at(f64::from(i) * 0.1) else {
                panic!("expected joints")
            };
            arm.check_limits(joints.as_slice()).unwrap();
        }
    }

    #[test]
    fn between_two_poses_it_is_interpolated() {
        let pose = |x: f64| Reading::Pose {
            translation: [x, 0.0, 0.0],
            rotation: [0.0, 0.0, 0.0, 1.0],
        };
        let motion = Motion {
            samples: vec![(5.0, pose(0.0)), (6.0, pose(10.0))],
            returns: false,
        };
        assert!(matches!(motion.at(0.25), Some(Reading::Pose { translation: [x, ..], .. }) if (x - 2.5).abs() < 1e-12));
        assert_eq!(motion.at(9.0), Some(pose(10.0)));
    }
}
