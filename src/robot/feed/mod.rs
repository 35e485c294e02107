//! The arm, live: from the bytes of its serial line to poses on the host's clock.
//!
//! Bytes come from a [`line`] (serial port, stdin, file); a [`driver`] makes [`message`]s of them ([`wire`] and [`parser`] for the
//! binary format of `docs/arm_feed.md`, [`text`] for lines of text); [`clock`] carries the arm's time to the host's; [`intake`]
//! refuses what cannot be and asks the kinematics for the hand; [`reader`] is the thread that does all this and mends the line.
//! [`faults`] and [`pseudo_terminal`] play an arm on a bad line, for tests and for whoever has no arm.

pub mod check;
pub mod clock;
pub mod driver;
pub mod faults;
pub mod intake;
pub mod line;
pub mod message;
pub mod parser;
pub mod pseudo_terminal;
pub mod reader;
pub mod sequence;
pub mod settings;
pub mod statistics;
pub mod text;
pub mod wire;
