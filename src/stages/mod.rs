//! What happens to a frame: one stage a file.

pub mod pose_stamping;
pub mod undistortion;
