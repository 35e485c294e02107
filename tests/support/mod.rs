//! What the integration tests share.

pub mod command;
pub mod line;
pub mod played_camera;
pub mod scene;
