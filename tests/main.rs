//! The integration tests, one binary.

mod architecture;
mod light_field;
