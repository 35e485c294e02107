//! The window of a live line: what it shows, and what its keys do.

pub mod keys;
pub mod picture;
#[cfg(feature = "viewer")]
pub mod window;
