//! Images: pixel buffers, their pool, and what is done to pixels without knowing what they show.

pub mod buffer;
pub mod color;
pub mod pool;
pub mod wide;
