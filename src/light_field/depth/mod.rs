//! Depth of the views: plane sweep, semi-global smoothing, consistency across views.

pub mod pairing;
pub mod plane_sweep;
pub mod semi_global;
pub mod stereo;
