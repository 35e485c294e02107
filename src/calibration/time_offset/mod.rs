//! By how much the arm's clock differs from the camera's, told by how the picture and the arm move: any scene will do, without a board.
//!
//! Where the camera is calibrated and structure from motion gives its path ([`camera_path`]), [`path_offset`] finds the shift of the
//! arm's clock at which the arm's path is that path. Without a camera model, [`image_motion`] measures how each picture moved against
//! the one before, and [`offset`] finds the shift at which the arm's motion explains that best. [`drift`] watches whether it still does.

pub mod camera_path;
pub mod drift;
pub mod image_motion;
pub mod offset;
mod path_deviation;
mod path_matching;
pub mod path_offset;
pub mod plot;
