//! The integration tests, one binary.

mod architecture;
mod pipeline;
mod support;
