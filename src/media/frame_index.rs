//! The time stamps of all frames of a file, without decoding one.
//!
//! After a seek, a frame's number is the count of earlier stamps: exact also where the frame rate varies.

use std::path::Path;

use ffmpeg_next::codec::packet::Flags;
use ffmpeg_next::{Packet, Rational, format};

use crate::media::error::{MediaError, libav_path, not_a_video};
use crate::media::libav::timestamp_from_ticks;
use crate::time::Timestamp;

/// `AV_PKT_FLAG_DISCARD`: decoded but never shown (cut off by an edit list).
const DISCARDED: i32 = 4;

/// Time stamps of all frames of a stream, in order, without decoding.
pub(crate) fn packet_stamps(path: &Path, stream: usize) -> Result<Vec<Timestamp>, MediaError> {
    let mut input = format::input(&libav_path(path)?).map_err(|e| not_a_video(path, &e.to_string(), "check the file"))?;
    let unit = input.stream(stream).map_or(Rational(1, 25), |s| s.time_base());
    let discarded = Flags::from_bits_retain(DISCARDED);
    let mut stamps = Vec::new();
    let mut packet = Packet::empty();
    while packet.read(&mut input).is_ok() {
        if packet.stream() == stream && !packet.flags().contains(discarded) {
            match packet.pts().or(packet.dts()) {
                Some(ticks) => stamps.push(timestamp_from_ticks(ticks, unit)),
                None => return Ok(Vec::new()),
            }
        }
    }
    stamps.sort_unstable();
    Ok(stamps)
}
