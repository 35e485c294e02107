//! What happens to a frame, one file or folder per stage, in line order.

pub mod pose_refinement;
pub mod specularity_detection;
pub mod specularity_substitution;
