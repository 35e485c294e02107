//! Where frames go.

pub mod mask;
pub mod report;
pub mod side_by_side;
pub mod video;
