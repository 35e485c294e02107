pub mod hand_eye;
pub mod quaternion;
pub mod trajectory;
