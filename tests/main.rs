//! The integration tests, one binary.

mod architecture;
mod camera;
mod recording;
mod robot;
mod undistortion;
mod media;
mod cli;
mod color;
mod config;
mod determinism;
mod light_field;
mod pipeline;
mod support;
mod temporal_median;
mod survey;
mod synthetic;
