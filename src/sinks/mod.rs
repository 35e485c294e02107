//! Where frames go.

pub mod mask;
pub mod side_by_side;
pub mod video;
pub mod report;
