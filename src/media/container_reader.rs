//! Video files and streams through libav, frame by frame.
//!
//! Packets are read one by one here, because an iterator over them turns every error into a silent end; a file that breaks
//! off yields the frames before the break and then an error that says where. Decoding is frame-threaded: this is the
//! offline path, where latency does not count.

use std::path::{Path, PathBuf};

use ffmpeg_next::codec::packet::side_data;
use ffmpeg_next::codec::{self, threading};
use ffmpeg_next::error::EAGAIN;
use ffmpeg_next::format::context::{self, StreamIo};
use ffmpeg_next::{Error, Packet, Rational, decoder, format, frame, media};

use crate::image::buffer::Rgb8;
use crate::image::pool::Pool;
use crate::media::color::{self, ColorTags};
use crate::media::error::{MediaError, libav_path, not_a_video};
use crate::media::filter::{DEINTERLACE, Filter};
use crate::media::frame_index::packet_stamps;
use crate::media::libav::{prepare_libav, timestamp_from_ticks};
use crate::media::reader::{DecodedFrame, VideoInfo};
use crate::media::truncation::{Shortfall, shortfall};
use crate::time::{Span, Timestamp};

/// Frame rate assumed where the container says none, frames per second.
const DEFAULT_RATE: Rational = Rational(25, 1);

/// Errors after which a decoder that is being emptied is given up.
const MOST_ERRORS_AT_END: u64 = 1000;

/// A demuxer, a decoder, and what is needed between them.
pub(crate) struct ContainerReader {
    name: String,
    path: Option<PathBuf>,
    input: context::Input,
    stream: usize,
    decoder: decoder::Video,
    time_base: Rational,
    info: VideoInfo,
    deinterlacer: Option<Filter>,
    scaler: Option<Filter>,
    decoded: frame::Video,
    current: frame::Video,
    pending: bool,
    ended: Ended,
    read_error: Option<Error>,
    damaged_packets: u64,
    last: Option<Timestamp>,
    number: u64,
    /// Frames handed on or dropped so far, for messages.
    read: u64,
    /// After a seek: drop what is earlier than this.
    drop_before: Option<Timestamp>,
    /// After a seek: time stamps of all frames, to number what comes.
    stamps: Option<Vec<Timestamp>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ended {
    No,
    PacketsDone,
    DecoderDone,
    Reported,
}

impl std::fmt::Debug for ContainerReader {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("ContainerReader")
            .field("name", &self.name)
            .field("info", &self.info)
            .finish_non_exhaustive()
    }
}

impl ContainerReader {
    pub(crate) fn open(path: &Path) -> Result<Self, MediaError> {
        prepare_libav();
        let length = match std::fs::metadata(path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Err(MediaError::Missing { path: path.into() }),
            Err(error) => return Err(not_a_video(path, &error.to_string(), "check the rights")),
            Ok(metadata) if metadata.is_dir() => return Err(not_a_video(path, "a folder", "name a file in it")),
            Ok(metadata) => metadata.len(),
        };
        if length == 0 {
            return Err(MediaError::Empty { path: path.into() });
        }
        let input = format::input(&libav_path(path)?).map_err(|error| match shortfall(path) {
            Some(Shortfall::Index) => not_a_video(
                path,
                "an MP4 without its index (moov)",
                "the recording was cut off; copy it again, or let a repair tool such as untrunc rebuild the index",
            ),
            _ => not_a_video(
                path,
                &format!("data that libav does not recognise ({error})"),
                "check that the file plays, and that its name is right",
            ),
        })?;
        Self::with_input(input, path.display().to_string(), Some(path.into()))
    }

    pub(crate) fn from_stream(stream: impl std::io::Read + Send + 'static, name: &str) -> Result<Self, MediaError> {
        prepare_libav();
        let refuse = |error: Error| MediaError::NotAVideo {
            name: name.to_owned(),
            found: format!("no y4m stream ({error})"),
            advice: "pipe y4m into it, e.g. `ffmpeg -i INPUT -f yuv4mpegpipe -`".to_owned(),
        };
        let input = format::input_from_stream(StreamIo::from_read(stream).map_err(refuse)?, None, None).map_err(refuse)?;
        Self::with_input(input, name.to_owned(), None)
    }

    fn with_input(input: context::Input, name: String, path: Option<PathBuf>) -> Result<Self, MediaError> {
        let Some(stream) = input.streams().best(media::Type::Video) else {
            let kinds: Vec<_> = input
                .streams()
                .map(|s| format!("{:?}", s.parameters().medium()).to_lowercase())
                .collect();
            let found = if kinds.is_empty() {
                "nothing".to_owned()
            } else {
                kinds.join(", ")
            };
            return Err(MediaError::NoVideoStream { name, found });
        };
        let decoder = open_decoder(&stream, &name)?;
        let time_base = stream.time_base();
        let rate = [stream.avg_frame_rate(), stream.rate(), DEFAULT_RATE]
            .into_iter()
            .find(|r| r.numerator() > 0 && r.denominator() > 0)
            .unwrap_or(DEFAULT_RATE);
        let duration_s = if stream.duration() > 0 {
            Some(timestamp_from_ticks(stream.duration(), time_base).seconds())
        } else {
            (input.duration() > 0).then(|| input.duration() as f64 * 1e-6)
        };
        let frame_count = match u64::try_from(stream.frames()) {
            Ok(frames) if frames > 0 => Some(frames),
            _ => duration_s.map(|d| (d * f64::from(rate.numerator()) / f64::from(rate.denominator())).round() as u64),
        };
        let info = VideoInfo {
            width: 0,
            height: 0,
            average_frame_rate: (rate.numerator(), rate.denominator()),
            time_base: (time_base.numerator(), time_base.denominator()),
            frame_count,
            duration_s,
            color: ColorTags::UNTAGGED,
            bit_depth: 8,
            interlaced: false,
            has_audio: input.streams().best(media::Type::Audio).is_some(),
            pixel_aspect: (1, 1),
            rotation_degrees: rotation_of(&stream),
            codec: decoder.codec().map_or_else(|| "unknown".to_owned(), |c| c.name().to_owned()),
            metadata: input.metadata().iter().map(|(k, v)| (k.to_owned(), v.to_owned())).collect(),
        };
        let stream = stream.index();
        let mut reader = Self {
            name,
            path,
            input,
            stream,
            decoder,
            time_base,
            info,
            deinterlacer: None,
            scaler: None,
            decoded: frame::Video::empty(),
            current: frame::Video::empty(),
            pending: false,
            ended: Ended::No,
            read_error: None,
            damaged_packets: 0,
            last: None,
            number: 0,
            read: 0,
            drop_before: None,
            stamps: None,
        };
        reader.learn_from_first_frame()?;
        Ok(reader)
    }

    fn learn_from_first_frame(&mut self) -> Result<(), MediaError> {
        if !self.advance()? {
            return Err(MediaError::NotAVideo {
                name: self.name.clone(),
                found: "not one frame that can be decoded".to_owned(),
                advice: "check that the file plays; it may be cut off near its beginning".to_owned(),
            });
        }
        self.pending = true;
        if self.info.rotation_degrees != 0 {
            tracing::warn!(
                degrees = self.info.rotation_degrees,
                "{}: the container asks players to turn the picture; it is left as stored",
                self.name
            );
        }
        Ok(())
    }

    pub(crate) fn info(&self) -> &VideoInfo {
        &self.info
    }

    pub(crate) fn next_frame(&mut self, pool: &Pool<Rgb8>) -> Result<Option<DecodedFrame>, MediaError> {
        loop {
            if !std::mem::take(&mut self.pending) && !self.advance()? {
                return Ok(None);
            }
            let timestamp = self.stamp_current();
            let number = self.number_of(timestamp);
            self.read += 1;
            if self.drop_before.is_some_and(|start| timestamp < start) {
                continue;
            }
            let mut image = pool.take(self.info.width, self.info.height);
            self.convert_current(&mut image).map_err(|reason| self.decode_error(reason))?;
            return Ok(Some(DecodedFrame {
                image,
                timestamp,
                number,
            }));
        }
    }

    /// Time stamp of the current frame: its own, or one frame after the last where it has none or runs backwards.
    fn stamp_current(&mut self) -> Timestamp {
        let unit = self
            .deinterlacer
            .as_mut()
            .and_then(Filter::time_base)
            .unwrap_or(self.time_base);
        let own = self
            .current
            .pts()
            .or(self.current.timestamp())
            .map(|ticks| timestamp_from_ticks(ticks, unit));
        let (frames, seconds) = self.info.average_frame_rate;
        let step = Span::from_seconds(f64::from(seconds) / f64::from(frames));
        let stamp = match (own, self.last) {
            (Some(own), Some(last)) if own <= last => {
                tracing::debug!(
                    "{}: frame {} is stamped no later than the one before it",
                    self.name,
                    self.number
                );
                last + step
            }
            (Some(own), _) => own,
            (None, Some(last)) => last + step,
            (None, None) => Timestamp(0),
        };
        self.last = Some(stamp);
        stamp
    }

    fn number_of(&mut self, timestamp: Timestamp) -> u64 {
        if let Some(stamps) = self.stamps.take() {
            self.number = stamps.partition_point(|&stamp| stamp < timestamp) as u64;
        }
        let number = self.number;
        self.number += 1;
        number
    }

    fn decode_error(&self, reason: impl ToString) -> MediaError {
        MediaError::Decode {
            name: self.name.clone(),
            frame: self.number,
            reason: reason.to_string(),
        }
    }

    /// Bring the next decoded (and deinterlaced) frame to `current`; false at the end.
    fn advance(&mut self) -> Result<bool, MediaError> {
        loop {
            if let Some(filter) = &mut self.deinterlacer
                && filter.pull(&mut self.current).map_err(|e| self.decode_error(e))?
            {
                return Ok(true);
            }
            if self.ended == Ended::DecoderDone || self.ended == Ended::Reported {
                return self.report_end();
            }
            match self.decoder.receive_frame(&mut self.decoded) {
                Ok(()) => {
                    self.check_size()?;
                    if self.deinterlacer.is_none() && self.decoded.is_interlaced() {
                        let filter = Filter::new(&self.decoded, self.time_base, DEINTERLACE);
                        self.deinterlacer = Some(filter.map_err(|e| self.decode_error(e))?);
                    }
                    let Some(filter) = &mut self.deinterlacer else {
                        std::mem::swap(&mut self.current, &mut self.decoded);
                        return Ok(true);
                    };
                    // A frame without a stamp of its own carries the decoder's best guess through the filter.
                    let stamp = self.decoded.pts().or(self.decoded.timestamp());
                    self.decoded.set_pts(stamp);
                    filter.push(&self.decoded).map_err(|e| self.decode_error(e))?;
                }
                Err(Error::Other { errno: EAGAIN }) if self.ended == Ended::No => self.feed_decoder(),
                Err(Error::Eof | Error::Other { errno: EAGAIN }) => {
                    self.ended = Ended::DecoderDone;
                    if let Some(filter) = &mut self.deinterlacer {
                        filter.flush().map_err(|e| self.decode_error(e))?;
                    }
                }
                Err(error) => {
                    self.note_damage(error);
                    // Behind the last packet an error may repeat for ever.
                    if self.ended == Ended::PacketsDone && self.damaged_packets > MOST_ERRORS_AT_END {
                        self.ended = Ended::DecoderDone;
                    }
                }
            }
        }
    }

    fn note_damage(&mut self, error: Error) {
        if self.damaged_packets == 0 {
            let seconds = self.last.unwrap_or_default().seconds();
            tracing::warn!(
                "{}: damaged data after {seconds:.3} s ({error}); decoding goes on behind it",
                self.name
            );
        }
        self.damaged_packets += 1;
    }

    fn feed_decoder(&mut self) {
        let mut packet = Packet::empty();
        match packet.read(&mut self.input) {
            Ok(()) if packet.stream() == self.stream => {
                if let Err(error) = self.decoder.send_packet(&packet) {
                    self.note_damage(error);
                }
            }
            Ok(()) => {}
            Err(error) => {
                if error != Error::Eof {
                    self.read_error = Some(error);
                }
                self.ended = Ended::PacketsDone;
                if let Err(error) = self.decoder.send_eof() {
                    self.note_damage(error);
                }
            }
        }
    }

    /// The size and colour of the first frame hold for all.
    fn check_size(&mut self) -> Result<(), MediaError> {
        let found = (self.decoded.width() as usize, self.decoded.height() as usize);
        if self.info.width == 0 {
            let aspect = self.decoded.aspect_ratio();
            (self.info.width, self.info.height) = found;
            self.info.color = ColorTags::of_frame(&self.decoded);
            self.info.bit_depth = color::bit_depth(self.decoded.format());
            self.info.interlaced = self.decoded.is_interlaced();
            if aspect.numerator() > 0 && aspect.denominator() > 0 {
                self.info.pixel_aspect = (aspect.numerator(), aspect.denominator());
            }
            return Ok(());
        }
        let expected = (self.info.width, self.info.height);
        if found == expected {
            return Ok(());
        }
        self.ended = Ended::Reported;
        let stamp = self
            .decoded
            .pts()
            .or(self.decoded.timestamp())
            .map(|ticks| timestamp_from_ticks(ticks, self.time_base));
        let seconds = stamp.or(self.last).unwrap_or_default().seconds();
        Err(MediaError::SizeChanged {
            name: self.name.clone(),
            expected,
            found,
            frame: self.number,
            seconds,
        })
    }

    /// At the end: was it the end of the video, or only of the file?
    fn report_end(&mut self) -> Result<bool, MediaError> {
        if self.ended == Ended::Reported {
            return Ok(false);
        }
        self.ended = Ended::Reported;
        if self.damaged_packets > 0 {
            tracing::warn!("{}: {} damaged packets could not be decoded", self.name, self.damaged_packets);
        }
        let cut = self.path.as_deref().and_then(shortfall);
        let found = match (cut, self.read_error) {
            (Some(Shortfall::Bytes(bytes)), _) => format!("the end of the file, {bytes} bytes too early,"),
            (_, Some(error)) => format!("a read error ({error})"),
            (_, None) => return Ok(false),
        };
        let seconds = self.last.unwrap_or_default().seconds();
        Err(MediaError::Truncated {
            name: self.name.clone(),
            found,
            frames: self.read,
            seconds,
        })
    }

    /// The current frame as RGB: directly where the format is a common one, else by libswscale.
    fn convert_current(&mut self, image: &mut crate::image::buffer::Image<Rgb8>) -> Result<(), String> {
        let planes_upright = (0..self.current.planes()).all(|p| self.current.stride(p) < usize::MAX / 2);
        let tags = ColorTags::of_frame(&self.current);
        if color::converts_directly(self.current.format()) && planes_upright {
            return color::rgb_from_frame(&self.current, &tags, image);
        }
        let describe = |error: Error| error.to_string();
        if self.scaler.is_none() {
            let input = if color::is_rgb(self.current.format()) {
                String::new()
            } else {
                format!("{}:", tags.scale_options(self.info.height))
            };
            let chain = format!("scale={input}flags=bicubic+accurate_rnd+full_chroma_int,format=rgb24");
            self.scaler = Some(Filter::new(&self.current, self.time_base, &chain).map_err(describe)?);
        }
        let scaler = self.scaler.as_mut().ok_or("no scaler")?;
        scaler.push(&self.current).map_err(describe)?;
        if !scaler.pull(&mut self.current).map_err(describe)? {
            return Err("the scaler kept the frame".to_owned());
        }
        color::rgb_from_frame(&self.current, &tags, image)
    }

    pub(crate) fn seek(&mut self, start: Timestamp) -> Result<(), MediaError> {
        self.drop_before = Some(start);
        let Some(path) = self.path.clone() else {
            // A stream cannot go back: decode and drop.
            return Ok(());
        };
        let stamps = packet_stamps(&path, self.stream)?;
        // Land half a second early: an encoder's reordering may stamp a keyframe later than the frames that need it.
        let target = (start - Span::from_seconds(0.5)).0.max(0) / 1000;
        let reopened = Self::open(&path)?;
        let (info, name) = (self.info.clone(), self.name.clone());
        *self = Self {
            info,
            name,
            drop_before: Some(start),
            ..reopened
        };
        let first = stamps.first().copied().unwrap_or_default();
        if stamps.len() < 2 || Timestamp(target * 1000) <= first || self.input.seek(target, ..target + 1).is_err() {
            return Ok(());
        }
        self.decoder.flush();
        (self.pending, self.ended, self.last, self.deinterlacer) = (false, Ended::No, None, None);
        (self.number, self.read, self.read_error) = (0, 0, None);
        self.stamps = Some(stamps);
        // Some demuxers land behind the target: then decode from the beginning.
        if self.advance()? {
            let at = self.stamp_current();
            self.last = None;
            self.pending = true;
            if at <= start {
                return Ok(());
            }
        }
        let reopened = Self::open(&path)?;
        let (info, name) = (self.info.clone(), self.name.clone());
        *self = Self {
            info,
            name,
            drop_before: Some(start),
            ..reopened
        };
        Ok(())
    }
}

fn open_decoder(stream: &ffmpeg_next::Stream<'_>, name: &str) -> Result<decoder::Video, MediaError> {
    let codec = format!("{:?}", stream.parameters().id()).to_lowercase();
    let refuse = |_| MediaError::NoDecoder {
        name: name.to_owned(),
        codec: codec.clone(),
    };
    let mut context = codec::context::Context::from_parameters(stream.parameters()).map_err(refuse)?;
    context.set_threading(threading::Config::kind(threading::Type::Frame));
    let mut decoder = context.decoder();
    decoder.set_packet_time_base(stream.time_base());
    decoder.video().map_err(refuse)
}

fn rotation_of(stream: &ffmpeg_next::Stream<'_>) -> i32 {
    let Some(matrix) = stream.side_data().find(|data| data.kind() == side_data::Type::DisplayMatrix) else {
        return 0;
    };
    let word = |index: usize| {
        matrix
            .data()
            .get(4 * index..4 * index + 4)
            .map_or(0, |bytes| i32::from_ne_bytes(bytes.try_into().unwrap_or_default()))
    };
    // The matrix turns counter-clockwise in 16.16 fixed point; its first row is (a, b).
    let degrees = f64::from(word(1)).atan2(f64::from(word(0))).to_degrees().round() as i32;
    degrees.rem_euclid(360)
}
