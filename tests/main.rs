//! The integration tests, one binary.

mod architecture;
mod camera;
mod recording;
mod robot;
mod undistortion;
mod cli;
mod color;
mod config;
mod determinism;
mod light_field;
mod media;
mod pipeline;
mod support;
mod temporal_median;
mod survey;
