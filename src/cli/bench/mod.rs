//! `bench`: how long a frame takes through the line, and how many a second it can.

pub mod glass;
pub mod pattern;
pub mod plot;
pub mod report;
pub mod run;
