//! Where frames come from.

pub mod recording;
