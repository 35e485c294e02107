//! The arm: its kinematics, its poses in files and live, and how the camera sits on it.

pub mod densify;
pub mod feed;
pub mod hand_eye;
pub mod kinematics;
pub mod pose_buffer;
pub mod quaternion;
pub mod trajectory;
