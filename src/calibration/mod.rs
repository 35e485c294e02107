//! Calibration: what a camera is, how it sits on the arm, how far the clocks are apart, and what its colours mean; each with its errors.

pub mod board;
pub mod camera;
pub mod color;
pub mod error;
pub mod hand_eye;
pub mod homography;
pub mod oblique;
pub mod pivot;
pub mod plot;
pub mod time_offset;
