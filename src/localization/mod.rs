//! Localization: where the camera is, told by the picture against the light field.

pub mod detail;
pub mod image_alignment;
