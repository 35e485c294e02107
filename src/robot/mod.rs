pub mod densify;
pub mod hand_eye;
pub mod kinematics;
pub mod pose_buffer;
pub mod quaternion;
pub mod trajectory;
