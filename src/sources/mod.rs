//! Where frames come from.

pub mod camera;
pub mod recording;
pub mod synthetic;
