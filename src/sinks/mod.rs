//! Where frames go.

pub mod display;
pub mod drift;
pub mod mask;
pub mod meter;
pub mod recorder;
pub mod report;
pub mod side_by_side;
pub mod trace;
#[cfg(all(target_os = "linux", feature = "v4l2"))]
pub mod v4l2_output;
pub mod video;
pub mod virtual_camera;
