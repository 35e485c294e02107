//! The integration tests, one binary.

mod architecture;
mod color;
mod temporal_median;
