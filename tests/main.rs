//! The integration tests, one binary.

mod architecture;
mod camera;
mod cli;
mod color;
mod config;
mod determinism;
mod light_field;
mod media;
mod pipeline;
mod recording;
mod robot;
mod support;
mod survey;
mod synthetic;
mod temporal_median;
mod undistortion;
