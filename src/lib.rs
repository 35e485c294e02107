//! endofield: endoscope video, clearer than the endoscope saw it, a moment later, always.

pub mod calibration;
pub mod camera;
pub mod cli;
pub mod compose;
pub mod config;
pub mod frame;
pub mod geometry;
pub mod image;
pub mod light_field;
pub mod localization;
pub mod media;
pub mod pipeline;
pub mod progress;
pub mod quality;
pub mod recording;
pub mod robot;
pub mod sinks;
pub mod solver;
pub mod sources;
pub mod stages;
pub mod synthetic;
pub mod time;
#[cfg(all(target_os = "linux", feature = "v4l2"))]
pub mod video4linux;
pub mod viewer;
pub mod yaml;
