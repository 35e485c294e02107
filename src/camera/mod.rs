//! The camera: image size, intrinsics and lens distortion, and what follows from them.

pub mod distortion;
pub mod file;
pub mod intrinsics;
pub mod model;
pub mod oblique;
pub mod opencv_xml;
pub mod undistortion;
