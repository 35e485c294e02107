//! endofield: endoscope video, clearer than the endoscope saw it, a moment later, always.

pub mod camera;
pub mod frame;
pub mod geometry;
pub mod image;
pub mod light_field;
pub mod localization;
pub mod pipeline;
pub mod progress;
pub mod stages;
pub mod time;
