//! The integration tests, one binary.

mod architecture;
mod camera;
mod recording;
mod robot;
mod undistortion;
mod media;
mod color;
mod temporal_median;
