//! From a message to a pose that may be believed, or a count of why not.

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::feed::clock::{ClockEstimate, DeviceClock};
use crate::robot::feed::message::{Message, Reading, Sample, fault_names};
use crate::robot::feed::sequence::{Order, SequenceWatch};
use crate::robot::feed::settings::{PoseClock, Settings};
use crate::robot::feed::statistics::FeedStatistics;
use crate::robot::kinematics::{Arm, ArmError};
use crate::robot::quaternion::{QuaternionFault, rotation_from_xyzw};
use crate::robot::trajectory::TimedPose;
use crate::time::{Span, Timestamp};

/// Why a message gives no pose.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// Heard before.
    #[error("a message came twice")]
    Repeated,
    /// The arm itself says so.
    #[error("the arm reports: {0}")]
    Fault(String),
    /// NaN or infinite.
    #[error("a number is not finite")]
    NotFinite,
    /// No rotation.
    #[error(transparent)]
    Rotation(#[from] QuaternionFault),
    /// A joint where it cannot be.
    #[error(transparent)]
    Joints(#[from] ArmError),
}

/// A message taken in.
#[derive(Debug)]
pub struct Accepted {
    /// What it says.
    pub sample: Sample,
    /// How much longer than at best it took.
    pub delay: Span,
}

/// Judges messages.
#[derive(Debug)]
pub struct Intake {
    arm: Arm,
    pose_clock: PoseClock,
    delay: Span,
    refused_faults: u16,
    sequence: SequenceWatch,
    clock: DeviceClock,
    faults: u16,
    statistics: FeedStatistics,
}

impl Intake {
    /// For this arm.
    pub fn new(arm: Arm, settings: &Settings) -> Self {
        Self {
            arm,
            pose_clock: settings.clock,
            delay: Span::from_milliseconds(settings.delay_ms),
            refused_faults: settings.refused_faults,
            sequence: SequenceWatch::default(),
            clock: DeviceClock::new(settings.max_drift_ppm),
            faults: 0,
            statistics: FeedStatistics::default(),
        }
    }

    /// What has been counted.
    pub fn statistics(&mut self) -> &mut FeedStatistics {
        &mut self.statistics
    }

    /// What is known of the device's clock.
    pub fn clock(&self) -> Option<ClockEstimate> {
        self.clock.estimate()
    }

    /// Judge a message that arrived just now.
    pub fn take(&mut self, message: Message, arrival: Timestamp) -> Result<Accepted, Refusal> {
        let order = message
            .sequence
            .map_or(Order::First, |number| self.sequence.judge(number, message.fingerprint));
        match order {
            Order::First => {}
            Order::Next { lost } => self.statistics.lost += u64::from(lost),
            Order::Repeated => {
                self.statistics.repeated += 1;
                return Err(Refusal::Repeated);
            }
            Order::Restarted => {
                self.statistics.restarts += 1;
                tracing::warn!("the arm counts anew: it was restarted");
                self.clock.reset();
            }
        }
        self.note_faults(message.faults);
        let (stamp, delay) = match self.pose_clock {
            PoseClock::Device => (self.clock.alone(message.device_time), Span(0)),
            PoseClock::Host => {
                let mapped = self.clock.map(message.device_time, arrival);
                if mapped.restarted {
                    self.statistics.restarts += 1;
                    tracing::warn!("the arm's clock jumped: it is learned anew");
                }
                (mapped.host, mapped.delay)
            }
        };
        let base_from_hand = self.base_from_hand(&message).inspect_err(|refusal| match refusal {
            Refusal::Repeated => {}
            Refusal::Fault(_) => self.statistics.refused_fault += 1,
            Refusal::NotFinite | Refusal::Rotation(_) => self.statistics.refused_number += 1,
            Refusal::Joints(_) => self.statistics.refused_joints += 1,
        })?;
        self.statistics.poses += 1;
        let pose = TimedPose {
            stamp: stamp - self.delay,
            base_from_hand,
        };
        Ok(Accepted {
            sample: Sample { message, arrival, pose },
            delay,
        })
    }

    fn base_from_hand(&self, message: &Message) -> Result<Transform<RobotBase, Hand>, Refusal> {
        let distrusted = message.faults & self.refused_faults;
        if distrusted != 0 {
            return Err(Refusal::Fault(fault_names(distrusted).join(", ")));
        }
        match &message.reading {
            Reading::Joints(joints) => {
                let joints = joints.as_slice();
                if joints.iter().any(|v| !v.is_finite()) {
                    return Err(Refusal::NotFinite);
                }
                self.arm.check_limits(joints)?;
                Ok(self.arm.base_from_hand(joints)?)
            }
            Reading::Pose { translation, rotation } => {
                if translation.iter().any(|v| !v.is_finite()) {
                    return Err(Refusal::NotFinite);
                }
                Ok(Transform::new(rotation_from_xyzw(*rotation)?, (*translation).into()))
            }
        }
    }

    fn note_faults(&mut self, faults: u16) {
        self.statistics.with_faults += u64::from(faults != 0);
        if faults != self.faults {
            if faults == 0 {
                tracing::info!("the arm reports no faults any more");
            } else {
                tracing::warn!("the arm reports: {}", fault_names(faults).join(", "));
            }
            self.faults = faults;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::feed::message::{DeviceTime, JointValues, fault_bit};

    fn joints(values: &[f64], sequence: u32) -> Message {
        Message {
            sequence: Some(sequence),
            device_time: DeviceTime::Microseconds32(sequence * 10_000),
            status: 0,
            faults: 0,
            reading: Reading::Joints(JointValues::new(values).unwrap()),
            fingerprint: sequence,
        }
    }

    fn intake() -> Intake {
        Intake::new(Arm::aesop_3000().unwrap(), &Settings::default())
    }

    fn at(sequence: u32) -> Timestamp {
        Timestamp(i64::from(sequence) * 10_000_000 + 5)
    }

    #[test]
    fn joints_become_a_pose_on_the_hosts_clock() {
        let mut intake = intake();
        let values = [200.0, 0.5, -0.7, 0.2, 0.3, -0.4, 0.1];
        for sequence in 0..10 {
            let accepted = intake.take(joints(&values, sequence), at(sequence)).unwrap();
            let pose = accepted.sample.pose;
            assert!((pose.base_from_hand.translation() - nalgebra::Vector3::new(715.126, 141.102, 161.636)).amax() < 1e-3);
            assert_eq!(pose.stamp, at(sequence));
        }
        assert_eq!(intake.statistics().poses, 10);
    }

    #[test]
    fn what_cannot_be_is_refused_and_counted() {
        let mut intake = intake();
        let good = [200.0, 0.5, -0.7, 0.2, 0.3, -0.4, 0.1];
        let mut number = 0;
        let mut refused = |message: Message| {
            number += 1;
            let message = Message {
                sequence: Some(number),
                fingerprint: number,
                ..message
            };
            intake.take(message, at(number)).unwrap_err().to_string()
        };
        let with = |index: usize, value: f64| {
            let mut values = good;
            values[index] = value;
            joints(&values, 0)
        };
        assert!(refused(with(2, f64::NAN)).contains("finite"));
        assert!(refused(with(0, f64::INFINITY)).contains("finite"));
        assert!(refused(with(1, 3.1)).contains("shoulder"));
        assert!(refused(joints(&good[..6], 0)).contains("7 joints"));
        let pose = |translation, rotation| Message {
            reading: Reading::Pose { translation, rotation },
            ..joints(&good, 0)
        };
        assert!(refused(pose([0.0; 3], [0.0; 4])).contains("length 0"));
        assert!(refused(pose([f64::NAN, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])).contains("finite"));
        assert!(refused(pose([0.0; 3], [0.0, f64::INFINITY, 0.0, 1.0])).contains("finite"));
        let faulty = Message {
            faults: fault_bit::ENCODER | fault_bit::DRIVE,
            ..joints(&good, 0)
        };
        assert!(refused(faulty).ends_with("encoder"));
        let tally = *intake.statistics();
        assert_eq!(
            (tally.refused_number, tally.refused_joints, tally.refused_fault, tally.poses),
            (5, 2, 1, 0)
        );
        assert!(matches!(
            intake.take(
                Message {
                    sequence: Some(8),
                    fingerprint: 8,
                    ..joints(&good, 8)
                },
                at(9)
            ),
            Err(Refusal::Repeated)
        ));
        // A fault that does not touch the joints' values is told and the pose taken.
        let hot = Message {
            faults: fault_bit::TEMPERATURE,
            ..joints(&good, 12)
        };
        assert!(intake.take(hot, at(12)).is_ok());
        let tally = intake.statistics();
        assert_eq!((tally.lost, tally.with_faults, tally.repeated), (3, 2, 1));
    }

    #[test]
    fn a_restart_is_learned_anew() {
        let mut intake = intake();
        let good = [200.0, 0.5, -0.7, 0.2, 0.3, -0.4, 0.1];
        for sequence in 100..200 {
            intake.take(joints(&good, sequence), at(sequence)).unwrap();
        }
        for sequence in 0..100 {
            let arrival = Timestamp(at(sequence).0 + 5_000_000_000);
            let pose = intake.take(joints(&good, sequence), arrival).unwrap().sample.pose;
            assert_eq!(pose.stamp, arrival);
        }
        assert_eq!(intake.statistics().restarts, 1);
    }
}
