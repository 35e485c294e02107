//! What an arm says, whatever its protocol: a reading, the device's time of it, and how the arm feels.

use nalgebra::Isometry3;

use crate::robot::trajectory::TimedPose;
use crate::time::Timestamp;

/// An arm with more joints has no driver here; a bound keeps messages free of allocation.
pub const MOST_JOINTS: usize = 16;

/// Values of joints, mm or rad, from base to hand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointValues {
    values: [f64; MOST_JOINTS],
    count: usize,
}

impl JointValues {
    /// `None` when there are more than [`MOST_JOINTS`].
    pub fn new(values: &[f64]) -> Option<Self> {
        let mut all = [0.0; MOST_JOINTS];
        all.get_mut(..values.len())?.copy_from_slice(values);
        Some(Self {
            values: all,
            count: values.len(),
        })
    }

    /// From base to hand.
    pub fn as_slice(&self) -> &[f64] {
        self.values.get(..self.count).unwrap_or(&[])
    }
}

/// What was measured. Numbers are as they came: not yet asked whether they can be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reading {
    /// Joint values, for the kinematics.
    Joints(JointValues),
    /// Where the hand is in the base, mm, as `x y z`, and its rotation as `x y z w`.
    Pose {
        /// mm.
        translation: [f64; 3],
        /// x y z w.
        rotation: [f64; 4],
    },
}

impl Reading {
    /// A pose.
    pub fn from_isometry(pose: &Isometry3<f64>) -> Self {
        let rotation = pose.rotation;
        Self::Pose {
            translation: pose.translation.vector.into(),
            rotation: [rotation.i, rotation.j, rotation.k, rotation.w],
        }
    }
}

/// The device's own clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceTime {
    /// A 32-bit counter of microseconds: back at 0 after 71.6 minutes.
    Microseconds32(u32),
    /// A clock that does not wrap.
    Nanoseconds(i64),
}

/// What the arm is doing (bits).
pub mod status_bit {
    /// A joint moves.
    pub const MOVING: u8 = 1;
    /// The brakes hold.
    pub const BRAKED: u8 = 2;
    /// A hand guides it.
    pub const GUIDED: u8 = 4;
}

/// What the arm complains of (bits); 7 and up belong to the arm's maker.
pub mod fault_bit {
    /// The emergency stop is pressed.
    pub const EMERGENCY_STOP: u16 = 1;
    /// A joint stands at its stop.
    pub const JOINT_LIMIT: u16 = 2;
    /// A joint's value cannot be trusted.
    pub const ENCODER: u16 = 4;
    /// A motor does not do what it was told.
    pub const DRIVE: u16 = 8;
    /// Something is too hot.
    pub const TEMPERATURE: u16 = 16;
    /// The arm does not hear one of its own parts.
    pub const INTERNAL_LINK: u16 = 32;
    /// The joints have not been referenced since power-up: their zeros are unknown.
    pub const NOT_REFERENCED: u16 = 64;
}

/// The faults' names, for messages.
pub fn fault_names(faults: u16) -> Vec<String> {
    const NAMES: [&str; 7] = [
        "emergency stop",
        "joint at its limit",
        "encoder",
        "drive",
        "temperature",
        "internal link",
        "joints not referenced",
    ];
    (0..16)
        .filter(|bit| faults >> bit & 1 == 1)
        .map(|bit| {
            NAMES
                .get(bit)
                .map_or_else(|| format!("maker's fault {bit}"), |name| (*name).to_owned())
        })
        .collect()
}

/// One message of the arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Message {
    /// Counted by the arm, where its protocol counts.
    pub sequence: Option<u32>,
    /// When the reading was true, on the device's clock.
    pub device_time: DeviceTime,
    /// [`status_bit`].
    pub status: u8,
    /// [`fault_bit`].
    pub faults: u16,
    /// What was measured.
    pub reading: Reading,
    /// A number that two different messages seldom share; tells a repetition from a restart.
    pub fingerprint: u32,
}

/// A message that was understood and believed.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// As it came.
    pub message: Message,
    /// When its last byte was here, on the host's clock.
    pub arrival: Timestamp,
    /// The pose, on the host's clock (or the device's, where the feed was told so).
    pub pose: TimedPose,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_are_bounded() {
        assert_eq!(JointValues::new(&[1.0, 2.0]).unwrap().as_slice(), [1.0, 2.0]);
        assert!(JointValues::new(&[0.0; MOST_JOINTS]).is_some());
        assert!(JointValues::new(&[0.0; MOST_JOINTS + 1]).is_none());
    }

    #[test]
    fn faults_have_names() {
        assert_eq!(fault_names(fault_bit::ENCODER | 0x8000), ["encoder", "maker's fault 15"]);
        assert!(fault_names(0).is_empty());
    }
}
