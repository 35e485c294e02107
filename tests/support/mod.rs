//! What the integration tests share.

pub mod line;
pub mod scene;
