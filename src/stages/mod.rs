//! What happens to a frame, one room per stage.

pub mod color_normalization;
pub mod pose_stamping;
pub mod scene_cut;
pub mod temporal_median;
pub mod undistortion;
