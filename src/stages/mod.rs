//! What happens to a frame, one file or folder per stage, in line order.

pub mod color_normalization;
pub mod pose_refinement;
pub mod pose_stamping;
pub mod rolling_light_field;
pub mod scene_cut;
pub mod specularity_detection;
pub mod specularity_substitution;
pub mod temporal_median;
pub mod undistortion;
