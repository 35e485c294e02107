//! What happens to a frame: one stage a file.

pub mod pose_stamping;
pub mod undistortion;
//! What happens to a frame, one room per stage, in line order.

pub mod color_normalization;
pub mod scene_cut;
pub mod temporal_median;
