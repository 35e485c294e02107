//! Gives each frame the pose of the camera at the instant of its exposure.
//!
//! The arm's clock runs apart from the camera's: exposure time − time offset is the instant to ask the arm about. Then
//! world_from_camera = world_from_base · base_from_hand · hand_from_camera; the world is the arm's base.

use crate::frame::{Frame, PoseOrigin};
use crate::geometry::space::{RobotBase, World};
use crate::geometry::transform::Transform;
use crate::pipeline::slot::Slot;
use crate::pipeline::stage::{Stage, StageError};
use crate::robot::feed::reader::SharedPoses;
use crate::robot::hand_eye::HandEye;
use crate::robot::pose_buffer::{Origin, PoseBuffer, PoseLookupError, StampedPose};
use crate::time::{Span, Timestamp};

/// Where the arm's poses are.
#[derive(Clone, Debug)]
pub enum Poses {
    /// All of them, from a recording.
    Recorded(PoseBuffer),
    /// Those of the last seconds, from an arm.
    Live(SharedPoses),
    /// A recording's that is played again and again.
    Repeated {
        /// On the recording's clock.
        buffer: PoseBuffer,
        /// The recording's first picture, on its own clock.
        first: Timestamp,
        /// When that picture was first played, on the host's clock.
        began: Timestamp,
        /// From one turn to the next.
        length: Span,
    },
}

impl Poses {
    /// Where the hand was when a picture was exposed, if `time_offset` must be added to a pose stamp to get the camera's clock.
    fn pose_at(&self, exposed_at: Timestamp, time_offset: Span) -> Result<StampedPose, PoseLookupError> {
        match self {
            Self::Recorded(buffer) => buffer.pose_at(exposed_at - time_offset),
            Self::Live(poses) => poses.pose_at(exposed_at - time_offset),
            Self::Repeated {
                buffer,
                first,
                began,
                length,
            } => {
                let within = (exposed_at - *began).0.rem_euclid(length.0.max(1));
                buffer.pose_at(*first + Span(within) - time_offset)
            }
        }
    }
}

/// Stamps frames with poses; a frame without one is marked, not held up.
#[derive(Debug)]
pub struct PoseStamping {
    poses: Poses,
    hand_eye: HandEye,
    time_offset: Span,
    /// Where a better time offset comes.
    newer: Slot<Span>,
    world_from_base: Transform<World, RobotBase>,
}

impl PoseStamping {
    /// With the time offset of the hand-eye file, or none.
    pub fn new(poses: Poses, hand_eye: HandEye) -> Self {
        let time_offset = hand_eye.time_offset.unwrap_or_default();
        Self {
            poses,
            hand_eye,
            time_offset,
            newer: Slot::new(),
            world_from_base: Transform::identity(),
        }
    }

    /// Every time offset that comes there is taken from then on, as one that was found with a light field.
    #[must_use]
    pub fn awaiting(mut self, newer: Slot<Span>) -> Self {
        self.newer = newer;
        self
    }

    /// With another time offset, as estimated from the pictures.
    pub fn with_time_offset(mut self, time_offset: Span) -> Self {
        self.time_offset = time_offset;
        self
    }
}

impl Stage for PoseStamping {
    fn name(&self) -> &'static str {
        "pose"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        if let Some(newer) = self.newer.take(frame.id) {
            self.time_offset = newer;
        }
        let Ok(pose) = self.poses.pose_at(frame.exposed_at, self.time_offset) else {
            frame.world_from_camera = None;
            frame.pose_origin = PoseOrigin::Missing;
            frame.camera_speed = None;
            return Ok(());
        };
        let hand_from_camera = &self.hand_eye.hand_from_camera;
        // The camera sits on a lever: the hand's turning moves it.
        let lever = pose.base_from_hand.rotation() * hand_from_camera.translation();
        let velocity = pose.velocity_mm_s + pose.angular_velocity_rad_s.cross(&lever);
        frame.world_from_camera = Some(self.world_from_base * pose.base_from_hand * *hand_from_camera);
        frame.pose_origin = match pose.origin {
            Origin::Measured => PoseOrigin::Measured,
            Origin::Predicted => PoseOrigin::Predicted,
        };
        frame.camera_speed = Some((velocity.norm(), pose.angular_velocity_rad_s.norm()));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::robot::pose_buffer::Settings;
    use crate::robot::trajectory::{TimedPose, Trajectory};
    use crate::time::Timestamp;
    use nalgebra::{UnitQuaternion, Vector3};

    /// The hand turns about the base's z axis at 0.5 rad/s and slides along x at 10 mm/s.
    fn hand_at(t: f64) -> Transform<RobotBase, crate::geometry::space::Hand> {
        Transform::new(
            UnitQuaternion::from_scaled_axis(Vector3::z() * (0.5 * t)),
            Vector3::new(10.0 * t, 0.0, 0.0),
        )
    }

    fn stamped(at_s: f64, offset_ms: f64) -> Frame {
        let poses = (0..100).map(|i| {
            let t = 0.02 * i as f64;
            TimedPose {
                stamp: Timestamp::from_seconds(t),
                base_from_hand: hand_at(t),
            }
        });
        let trajectory = Trajectory::new(poses.collect()).unwrap();
        let buffer = PoseBuffer::from_trajectory(&trajectory, &Settings::default()).unwrap();
        let mut hand_eye = HandEye::new(Transform::new(UnitQuaternion::identity(), Vector3::new(300.0, 0.0, 5.0)));
        hand_eye.time_offset = Some(Span::from_milliseconds(offset_ms));
        let at = Timestamp::from_seconds(at_s);
        let mut frame = Frame::new(FrameId(0), at, at, Pool::new(1).take(2, 2));
        PoseStamping::new(Poses::Recorded(buffer), hand_eye)
            .process(&mut frame)
            .unwrap();
        frame
    }

    #[test]
    fn the_offset_is_taken_off_the_exposure_time() {
        // A stamp that is 40 ms late gets −40 ms added: the camera's instant 1 s is the arm's 1.04 s.
        let frame = stamped(1.0, -40.0);
        let camera = frame.world_from_camera.unwrap();
        let truth = hand_at(1.04)
            * Transform::<_, crate::geometry::space::Camera>::new(UnitQuaternion::identity(), Vector3::new(300.0, 0.0, 5.0));
        assert!((camera.translation() - truth.translation()).norm() < 1e-6);
        assert_eq!(frame.pose_origin, PoseOrigin::Measured);
    }

    #[test]
    fn the_lever_counts_in_the_speed() {
        let (linear, angular) = stamped(1.0, 0.0).camera_speed.unwrap();
        let velocity = Vector3::new(10.0, 0.0, 0.0) + 0.5 * 300.0 * Vector3::new(-(0.5_f64).sin(), (0.5_f64).cos(), 0.0);
        assert!((linear - velocity.norm()).abs() < 1e-4, "{linear}");
        assert!((angular - 0.5).abs() < 1e-6);
    }

    #[test]
    fn a_recording_that_is_played_again_repeats_its_poses() {
        let poses = (0..100).map(|i| {
            let t = 5.0 + 0.02 * f64::from(i);
            TimedPose {
                stamp: Timestamp::from_seconds(t),
                base_from_hand: hand_at(t),
            }
        });
        let trajectory = Trajectory::new(poses.collect()).unwrap();
        let poses = Poses::Repeated {
            buffer: PoseBuffer::from_trajectory(&trajectory, &Settings::default()).unwrap(),
            first: Timestamp::from_seconds(5.2),
            began: Timestamp::from_seconds(1000.0),
            length: Span::from_seconds(1.5),
        };
        for turn in [0.0, 1.0, 7.0] {
            let at = Timestamp::from_seconds(1000.0 + 1.5 * turn + 0.8);
            let pose = poses.pose_at(at, Span::from_milliseconds(-100.0)).unwrap();
            let truth = hand_at(5.2 + 0.8 + 0.1);
            assert!((pose.base_from_hand.translation() - truth.translation()).norm() < 1e-6);
        }
    }

    #[test]
    fn beyond_the_poses_the_frame_says_so() {
        assert_eq!(stamped(2.0, 0.0).pose_origin, PoseOrigin::Predicted);
        let frame = stamped(3.0, 0.0);
        assert_eq!(frame.pose_origin, PoseOrigin::Missing);
        assert!(frame.world_from_camera.is_none());
    }
}
