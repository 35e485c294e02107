//! A camera or capture card as the source of a live line: pictures as they come, and a line that lives on while none do.

pub mod capture;
pub mod device;
pub mod pixels;
pub mod settings;
#[cfg(all(target_os = "linux", feature = "v4l2"))]
pub mod v4l2;
