//! The integration tests, one binary.
#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    clippy::expect_used,
    clippy::panic,
    reason = "a helper of a test may fail the test; clippy excuses only the test functions themselves"
)]

mod architecture;
mod bad_input;
mod calibrate_color;
mod calibration;
mod camera;
mod camera_source;
mod cli;
mod color;
mod config;
mod determinism;
mod drift;
mod fault_campaign;
mod feed;
mod feed_fuzz;
mod hand_eye;
mod import;
mod light_field;
mod live;
mod live_line;
mod media;
mod oblique;
mod pipeline;
mod recording;
mod robot;
mod rolling;
mod support;
mod survey;
mod synthetic;
mod temporal_median;
mod time_offset;
mod undistortion;
