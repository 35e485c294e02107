//! A recording: everything one camera saw, and what is known about how it moved.

pub mod folder;
pub mod frame_times;
pub mod meta_image;
