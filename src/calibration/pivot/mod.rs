//! The tip of a tracked tool, from poses while it turned about the tip.

pub mod fit;
pub mod plot;
