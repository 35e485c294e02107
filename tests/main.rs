//! The integration tests, one binary.

mod architecture;
mod media;
mod pipeline;
mod support;
