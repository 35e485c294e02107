//! Where the hand was at the pictures that a calibration looks at.

use std::path::Path;

use anyhow::Context as _;

use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::cli::context::Context;
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::recording::folder::Recording;
use crate::robot::kinematics::{Arm, JointSample};
use crate::robot::pose_buffer::PoseBuffer;
use crate::time::{Span, Timestamp};

/// Where the hand was at each picture.
#[derive(Debug)]
pub enum Hands {
    /// As told, one a picture.
    Told(Vec<Transform<RobotBase, Hand>>),
    /// Read from the arm's path when the picture was exposed.
    Timed {
        /// The path.
        arm: PoseBuffer,
        /// When each picture was exposed.
        instants: Vec<Timestamp>,
    },
    /// Read from joint values.
    Jointed {
        /// Its kinematics.
        arm: Arm,
        /// What its joints told.
        samples: Vec<JointSample>,
        /// When each picture was exposed.
        instants: Vec<Timestamp>,
    },
}

impl Hands {
    /// From what lies beside a recording, at some of its frames; with an arm's kinematics from its joints.
    pub fn of_recording(
        (folder, recording): (&Path, &Recording),
        arm: Option<&Path>,
        frames: &[u64],
        context: &Context,
    ) -> anyhow::Result<Self> {
        let times = recording.frame_times.as_ref().with_context(|| {
            format!(
                "{}: expected frames.csv with each frame's exposure time on the arm's clock, found none",
                folder.display()
            )
        })?;
        let instants = frames
            .iter()
            .map(|&frame| {
                let number = usize::try_from(frame).unwrap_or(usize::MAX);
                times
                    .get(number)
                    .copied()
                    .with_context(|| format!("frames.csv: no line for frame {}", frame))
            })
            .collect::<anyhow::Result<Vec<Timestamp>>>()?;
        let joints = folder.join("joints.csv");
        if let Some(path) = arm {
            let arm = Arm::read(path)?;
            let samples = arm.read_joint_samples(&joints)?;
            return Ok(Self::Jointed { arm, samples, instants });
        }
        let trajectory = recording
            .trajectory
            .as_ref()
            .with_context(|| format!("{}: expected poses.tum or joints.csv, found none", folder.display()))?;
        Ok(Self::Timed {
            arm: PoseBuffer::from_trajectory(trajectory, &context.config.poses)?,
            instants,
        })
    }

    /// Only these pictures.
    pub fn kept(self, pictures: &[usize]) -> Self {
        let of = |instants: Vec<Timestamp>| pictures.iter().map(|&picture| instants[picture]).collect();
        match self {
            Self::Told(poses) => Self::Told(pictures.iter().map(|&picture| poses[picture]).collect()),
            Self::Timed { arm, instants } => Self::Timed {
                arm,
                instants: of(instants),
            },
            Self::Jointed { arm, samples, instants } => Self::Jointed {
                arm,
                samples,
                instants: of(instants),
            },
        }
    }
}

impl HandPoses for Hands {
    fn base_from_hand(&self, view: usize, offset_s: f64, offsets: &[f64]) -> Option<Transform<RobotBase, Hand>> {
        let offset = Span::from_seconds(offset_s);
        match self {
            Self::Told(poses) => poses.get(view).copied(),
            Self::Timed { arm, instants } => arm
                .pose_at(*instants.get(view)? - offset)
                .ok()
                .map(|found| found.base_from_hand),
            Self::Jointed { arm, samples, instants } => {
                let mut values = joints_at(samples, *instants.get(view)? - offset)?;
                for (value, offset) in values.iter_mut().zip(offsets) {
                    *value += offset;
                }
                arm.base_from_hand(&values).ok()
            }
        }
    }

    fn joints(&self) -> usize {
        match self {
            Self::Jointed { arm, .. } => arm.joints().len(),
            _ => 0,
        }
    }
}

/// Joint values between two samples.
fn joints_at(samples: &[JointSample], at: Timestamp) -> Option<Vec<f64>> {
    let after = samples.partition_point(|sample| sample.stamp <= at);
    let before = samples.get(after.checked_sub(1)?)?;
    let Some(next) = samples.get(after) else {
        return (before.stamp == at).then(|| before.values.clone());
    };
    let t = (at - before.stamp).seconds() / (next.stamp - before.stamp).seconds();
    Some(
        (before.values.iter().zip(&next.values))
            .map(|(a, b)| a + t * (b - a))
            .collect(),
    )
}

/// Standard deviations of joint offsets: none if they are not looked for.
pub fn joint_sigmas(hands: &Hands, degrees: f64) -> Vec<f64> {
    use crate::robot::kinematics::JointKind;
    match hands {
        Hands::Jointed { arm, .. } if degrees > 0.0 => (arm.joints().iter())
            .map(|joint| match joint.kind {
                JointKind::Prismatic => 10.0 * degrees,
                JointKind::Revolute => degrees.to_radians(),
            })
            .collect(),
        _ => Vec::new(),
    }
}
