//! Images: pixel buffers, their pool, and what is done to pixels without knowing what they show.

pub mod blur;
pub mod buffer;
pub mod components;
pub mod distance;
pub mod pool;
pub mod specularity;
