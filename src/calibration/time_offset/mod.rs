//! By how much the arm's clock differs from the camera's, told by how the picture and the arm move: any scene will do, without a board.
//!
//! [`image_motion`] measures how each picture moved against the one before; [`offset`] finds the shift of the arm's clock at which the
//! arm's motion explains that best; [`drift`] watches whether it still does.

pub mod drift;
pub mod image_motion;
pub mod offset;
