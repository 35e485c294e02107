//! `live`: the line on camera and arm, while they run.

pub mod run;
pub mod session;
pub mod source;
pub mod status;
pub mod watch;
