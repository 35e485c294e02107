//! A protocol, told apart from everything else: bytes in, messages out. Another arm is one more file that does this.

use crate::robot::feed::message::Message;
use crate::robot::feed::parser::Parser;
use crate::robot::feed::settings::Protocol;
use crate::robot::feed::text::{TextContent, TextDriver};
use crate::robot::feed::wire::{Unusable, decode};

/// What a driver has counted since it was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DriverCounts {
    /// All bytes.
    pub bytes: u64,
    /// Bytes that belong to no message and never will.
    pub bytes_skipped: u64,
    /// Whole messages, understood or not.
    pub intact: u64,
    /// What looked like a message and had the wrong check.
    pub bad_check: u64,
    /// Whole, but of a version or type that this program does not know.
    pub unknown: u64,
    /// Of a known type, but not as its format says.
    pub malformed: u64,
}

/// Where in the stream the next byte stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Joined {
    /// At its beginning, as in a file.
    AtStart,
    /// Anywhere, as when a cable is plugged in.
    Midway,
}

/// A protocol. It may be fed anything, in pieces of any size; its memory is bounded.
pub trait Driver: Send {
    /// For messages.
    fn name(&self) -> &'static str;
    /// Take bytes; every message that they complete is delivered, in order.
    fn take(&mut self, bytes: &[u8], deliver: &mut dyn FnMut(Message));
    /// The line was opened (again): what is pending will not be completed.
    fn reset(&mut self, joined: Joined);
    /// What has been counted.
    fn counts(&self) -> DriverCounts;
    /// What to send to the arm when the line opens; most arms talk unasked.
    fn greeting(&self) -> &[u8] {
        &[]
    }
}

/// The driver of a protocol.
pub fn driver(protocol: Protocol) -> Box<dyn Driver> {
    match protocol {
        Protocol::Endofield => Box::<EndofieldDriver>::default(),
        Protocol::TextPoses => Box::new(TextDriver::new(TextContent::Poses)),
        Protocol::TextJoints => Box::new(TextDriver::new(TextContent::Joints)),
    }
}

/// Our own binary format: [`crate::robot::feed::wire`].
#[derive(Debug, Default)]
pub struct EndofieldDriver {
    parser: Parser,
    unknown: u64,
    malformed: u64,
}

impl Driver for EndofieldDriver {
    fn name(&self) -> &'static str {
        "endofield"
    }

    fn take(&mut self, bytes: &[u8], deliver: &mut dyn FnMut(Message)) {
        let (unknown, malformed) = (&mut self.unknown, &mut self.malformed);
        self.parser.take(bytes, |packet| match decode(packet) {
            Ok(message) => deliver(message),
            Err(Unusable::Unknown) => *unknown += 1,
            Err(Unusable::Malformed) => *malformed += 1,
        });
    }

    fn reset(&mut self, _joined: Joined) {
        self.parser.reset();
    }

    fn counts(&self) -> DriverCounts {
        let counts = self.parser.counts();
        DriverCounts {
            bytes: counts.bytes,
            bytes_skipped: counts.bytes_skipped,
            intact: counts.packets,
            bad_check: counts.bad_check,
            unknown: self.unknown,
            malformed: self.malformed,
        }
    }
}
