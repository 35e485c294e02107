//! Video4Linux2 beyond what the crate `v4l` has calls for; the room where its unsafe calls are made.

pub mod fourcc;
mod ioctl;
pub mod output;
pub mod signal;
