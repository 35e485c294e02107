//! Where frames go.

pub mod drift;
pub mod mask;
pub mod meter;
pub mod recorder;
pub mod report;
pub mod side_by_side;
pub mod trace;
pub mod video;
