//! The sound of a video, copied packet by packet beside the new pictures.

use std::path::Path;

use ffmpeg_next::format::context;
use ffmpeg_next::{Packet, Rational, format, media};

use crate::media::error::{MediaError, libav_path};
use crate::media::libav::{prepare_libav, ticks_from_timestamp, timestamp_from_ticks};
use crate::media::writer::Sound;
use crate::time::Timestamp;

/// Reads the sound of one file in step with the pictures of another.
pub(crate) struct SoundCopy {
    input: context::Input,
    stream: usize,
    time_base: Rational,
    start: Option<Timestamp>,
    end: Option<Timestamp>,
    next: Option<(Packet, Timestamp)>,
}

impl SoundCopy {
    /// The best sound stream; `None` when there is none.
    pub(crate) fn open(sound: &Sound) -> Result<Option<Self>, MediaError> {
        prepare_libav();
        let input = format::input(&libav_path(&sound.path)?).map_err(|error| not_readable(&sound.path, &error.to_string()))?;
        let Some(stream) = input.streams().best(media::Type::Audio) else {
            return Ok(None);
        };
        let (index, time_base) = (stream.index(), stream.time_base());
        let mut copy = Self {
            input,
            stream: index,
            time_base,
            start: sound.start,
            end: sound.end,
            next: None,
        };
        if let Some(start) = sound.start {
            let target = start.0 / 1000;
            // Not every container can: then what comes before the start is read and dropped.
            if copy.input.seek(target, ..target + 1).is_err() {
                tracing::debug!("{}: sound cannot be sought, reading from the beginning", sound.path.display());
            }
        }
        copy.read_next();
        Ok(Some(copy))
    }

    pub(crate) fn time_base(&self) -> Rational {
        self.time_base
    }

    pub(crate) fn stream(&self) -> Option<ffmpeg_next::Stream<'_>> {
        self.input.stream(self.stream)
    }

    /// The next packet to be heard before `until`, its stamps moved by `-origin`.
    pub(crate) fn take_before(&mut self, until: Option<Timestamp>, origin: Timestamp) -> Option<Packet> {
        let (_, time) = self.next.as_ref()?;
        if until.is_some_and(|until| *time >= until) {
            return None;
        }
        let (mut packet, _) = self.next.take()?;
        let shift = ticks_from_timestamp(origin, self.time_base);
        packet.set_pts(packet.pts().map(|ticks| ticks - shift));
        packet.set_dts(packet.dts().or(packet.pts()).map(|ticks| ticks - shift));
        packet.set_position(-1);
        self.read_next();
        Some(packet)
    }

    fn read_next(&mut self) {
        let mut packet = Packet::empty();
        // Unreadable sound ends here; the pictures tell of a truncated file.
        while packet.read(&mut self.input).is_ok() {
            let Some(ticks) = packet.pts().or(packet.dts()) else {
                continue;
            };
            if packet.stream() != self.stream {
                continue;
            }
            let time = timestamp_from_ticks(ticks, self.time_base);
            // An encoder's run-in is stamped before 0; players drop it, and some containers cannot hold it.
            if time < Timestamp(0) || self.start.is_some_and(|start| time < start) {
                continue;
            }
            if self.end.is_some_and(|end| time >= end) {
                break;
            }
            self.next = Some((packet, time));
            return;
        }
        self.next = None;
    }
}

fn not_readable(path: &Path, found: &str) -> MediaError {
    let advice = "check that the file plays".to_owned();
    MediaError::NotAVideo {
        name: path.display().to_string(),
        found: found.to_owned(),
        advice,
    }
}
