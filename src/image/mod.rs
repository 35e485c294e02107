//! Images: pixel buffers, their pool, and what is done to pixels without knowing what they show.

pub mod buffer;
<<<<<<< HEAD
pub mod color;
pub mod pool;
pub mod wide;
=======
pub mod corners;
pub mod gradient;
pub mod patch;
pub mod pool;
pub mod pyramid;
>>>>>>> survey
