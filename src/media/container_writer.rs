//! MP4, MOV, Matroska and AVI files through libav.
//!
//! Everything is set so that a file cut off at any moment still plays: MP4 and MOV in fragments of about one second (ISO/IEC
//! 14496-12 §8.8), Matroska in clusters of one second, every packet flushed to the file. Pictures are H.264 without
//! B-frames, so that decoding order is display order and no time stamp needs shifting. Masks are FFV1; in MP4, which players
//! expect to hold H.264, they are lossless H.264 in gray, tagged full range, so that every decoder returns the same bytes.

use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use ffmpeg_next::codec::{self, threading};
use ffmpeg_next::error::EAGAIN;
use ffmpeg_next::format::context::Output;
use ffmpeg_next::format::{Pixel, flag};
use ffmpeg_next::{Dictionary, Error, Packet, Rational, color, encoder, format, frame};

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::media::color::Planes;
use crate::media::error::{MediaError, libav_path};
use crate::media::libav::{prepare_libav, ticks_from_timestamp};
use crate::media::sound::SoundCopy;
use crate::media::writer::{Content, WriterSettings};
use crate::time::Timestamp;

/// An encoder, a muxer, and the sound that goes in between.
pub(crate) struct ContainerWriter {
    path: PathBuf,
    output: Output,
    encoder: encoder::video::Encoder,
    encoder_time_base: Rational,
    stream_time_base: Rational,
    sound: Option<(SoundCopy, Rational)>,
    planes: Option<Planes>,
    format: Pixel,
    frame_ticks: i64,
    origin: Timestamp,
    last_ticks: Option<i64>,
    frames: u64,
    failed: bool,
}

impl std::fmt::Debug for ContainerWriter {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter
            .debug_struct("ContainerWriter")
            .field("path", &self.path)
            .field("frames", &self.frames)
            .finish_non_exhaustive()
    }
}

impl ContainerWriter {
    pub(crate) fn create(path: &Path, settings: &WriterSettings) -> Result<Self, MediaError> {
        prepare_libav();
        let sound = match &settings.sound {
            Some(sound) => SoundCopy::open(sound)?,
            None => None,
        };
        let Some(sound) = sound else {
            return Self::open(path, settings, None).map_err(|e| cannot_create(path, e));
        };
        let codec = sound.stream().map_or(codec::Id::None, |s| s.parameters().id());
        Self::open(path, settings, Some(sound)).or_else(|error| {
            let silent = Self::open(path, settings, None).map_err(|_| cannot_create(path, error))?;
            tracing::warn!(
                "{}: this kind of file cannot hold {codec:?} sound; written without sound, .mkv can hold it",
                path.display()
            );
            Ok(silent)
        })
    }

    fn open(path: &Path, settings: &WriterSettings, sound: Option<SoundCopy>) -> Result<Self, Error> {
        let name = libav_path(path).map_err(|_| Error::Other {
            errno: ffmpeg_next::error::EINVAL,
        })?;
        let container = path
            .extension()
            .map(|e| e.to_string_lossy().to_ascii_lowercase())
            .unwrap_or_default();
        let mut output = format::output(&name)?;
        let global_header = output.format().flags().contains(flag::Flags::GLOBAL_HEADER);
        let time_base = time_base_for(&container, settings);
        let choice = CodecChoice::of(settings, &container);
        let encoder = open_encoder(settings, &choice, time_base, global_header)?;
        {
            let mut stream = output.add_stream(encoder::find_by_name(choice.name))?;
            stream.set_parameters(&encoder);
            stream.set_time_base(time_base);
            stream.set_avg_frame_rate(settings.average_frame_rate);
        }
        if let Some(sound) = &sound {
            let source = sound.stream().ok_or(Error::StreamNotFound)?;
            let mut stream = output.add_stream(encoder::find(codec::Id::None))?;
            stream.set_parameters(source.parameters());
            stream.set_time_base(sound.time_base());
            forget_codec_tag(&mut stream);
        }
        let mut metadata = Dictionary::new();
        for (key, value) in &settings.metadata {
            // What describes the old container is not true of the new one.
            if !["major_brand", "minor_version", "compatible_brands", "encoder", "duration"]
                .contains(&key.to_ascii_lowercase().as_str())
            {
                metadata.set(key, value);
            }
        }
        output.set_metadata(metadata);
        let rest = output.write_header_with(muxer_options(&container))?;
        drop(rest);
        let stream_time_base = output.stream(0).ok_or(Error::StreamNotFound)?.time_base();
        let sound = match sound {
            Some(sound) => Some((sound, output.stream(1).ok_or(Error::StreamNotFound)?.time_base())),
            None => None,
        };
        let planes = (settings.content == Content::Color).then(|| Planes::new(settings.width, settings.height, &settings.color));
        let (frames, seconds) = settings.average_frame_rate;
        let ticks_per_second = f64::from(time_base.denominator()) / f64::from(time_base.numerator());
        Ok(Self {
            path: path.into(),
            output,
            encoder,
            encoder_time_base: time_base,
            stream_time_base,
            sound,
            planes,
            format: choice.format,
            frame_ticks: (ticks_per_second * f64::from(seconds) / f64::from(frames.max(1)))
                .round()
                .max(1.0) as i64,
            origin: settings.origin,
            last_ticks: None,
            frames: 0,
            failed: false,
        })
    }

    pub(crate) fn write_color(&mut self, picture: &Image<Rgb8>, timestamp: Timestamp) -> Result<(), MediaError> {
        let mut frame = frame::Video::new(self.format, picture.width() as u32, picture.height() as u32);
        if self.format == Pixel::RGB24 {
            copy_plane(picture.as_bytes(), 3 * picture.width(), &mut frame, 0);
            return self.encode(frame, timestamp);
        }
        let planes = self.planes.as_mut().ok_or_else(|| cannot_create(&self.path, Error::Bug))?;
        let frames = self.frames;
        planes.fill(picture).map_err(|reason| MediaError::Write {
            path: self.path.clone(),
            frames,
            reason,
        })?;
        for (index, (plane, row)) in planes.planes().into_iter().enumerate() {
            copy_plane(plane, row, &mut frame, index);
        }
        self.encode(frame, timestamp)
    }

    pub(crate) fn write_gray(&mut self, mask: &Mask, timestamp: Timestamp) -> Result<(), MediaError> {
        let mut frame = frame::Video::new(self.format, mask.width() as u32, mask.height() as u32);
        copy_plane(mask.as_bytes(), mask.width(), &mut frame, 0);
        self.encode(frame, timestamp)
    }

    fn encode(&mut self, mut frame: frame::Video, timestamp: Timestamp) -> Result<(), MediaError> {
        let mut ticks = ticks_from_timestamp(Timestamp(timestamp.0 - self.origin.0), self.encoder_time_base);
        // Two frames within one unit (AVI, or stamps that stand still): the later one moves on.
        if let Some(last) = self.last_ticks {
            ticks = ticks.max(last + 1);
        }
        self.last_ticks = Some(ticks);
        frame.set_pts(Some(ticks));
        frame.set_kind(ffmpeg_next::picture::Type::None);
        let sound = self.write_sound(Some(timestamp));
        let sent = sound
            .and_then(|()| self.encoder.send_frame(&frame))
            .and_then(|()| self.drain());
        sent.map_err(|error| self.fail(error))?;
        self.frames += 1;
        Ok(())
    }

    fn fail(&mut self, error: Error) -> MediaError {
        self.failed = true;
        MediaError::Write {
            path: self.path.clone(),
            frames: self.frames,
            reason: error.to_string(),
        }
    }

    fn drain(&mut self) -> Result<(), Error> {
        loop {
            let mut packet = Packet::empty();
            match self.encoder.receive_packet(&mut packet) {
                Ok(()) => {
                    packet.set_stream(0);
                    packet.set_duration(self.frame_ticks);
                    packet.rescale_ts(self.encoder_time_base, self.stream_time_base);
                    packet.write_interleaved(&mut self.output)?;
                }
                Err(Error::Eof | Error::Other { errno: EAGAIN }) => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    }

    fn write_sound(&mut self, until: Option<Timestamp>) -> Result<(), Error> {
        let Some((sound, time_base)) = &mut self.sound else {
            return Ok(());
        };
        while let Some(mut packet) = sound.take_before(until, self.origin) {
            packet.set_stream(1);
            packet.rescale_ts(sound.time_base(), *time_base);
            packet.write_interleaved(&mut self.output)?;
        }
        Ok(())
    }

    pub(crate) fn finish(&mut self) -> Result<(), MediaError> {
        if self.failed {
            // Reported when it happened; the fragments on disk stand as they are.
            return Ok(());
        }
        let flushed = self
            .encoder
            .send_eof()
            .and_then(|()| self.drain())
            .and_then(|()| self.write_sound(None));
        let ended = flushed.and_then(|()| self.output.write_trailer());
        ended.map_err(|error| self.fail(error))?;
        if self.frames > 0 && self.lacks_its_end() {
            self.failed = true;
            return Err(MediaError::Write {
                path: self.path.clone(),
                frames: self.frames,
                reason: "the end did not come to the disk; is it full?".to_owned(),
            });
        }
        Ok(())
    }

    /// MP4's muxer does not tell when its last fragment could not be written. Behind that fragment comes the box `mfro` (ISO/IEC
    /// 14496-12 §8.8.11), 16 bytes that end the file: once a write has failed libav writes no more, so if they are there, all is.
    fn lacks_its_end(&self) -> bool {
        let in_fragments = self.path.extension().is_some_and(|e| {
            let e = e.to_ascii_lowercase();
            e == "mp4" || e == "mov"
        });
        let end = || -> std::io::Result<[u8; 16]> {
            let mut file = std::fs::File::open(&self.path)?;
            file.seek(SeekFrom::End(-16))?;
            let mut end = [0; 16];
            file.read_exact(&mut end)?;
            Ok(end)
        };
        in_fragments && !end().is_ok_and(|end| &end[4..8] == b"mfro")
    }
}

/// Which encoder, for what pixels.
struct CodecChoice {
    name: &'static str,
    format: Pixel,
    lossless: bool,
}

impl CodecChoice {
    fn of(settings: &WriterSettings, container: &str) -> Self {
        match settings.content {
            Content::Mask if container == "mp4" || container == "mov" => Self {
                name: "libx264",
                format: Pixel::GRAY8,
                lossless: true,
            },
            Content::Mask => Self {
                name: "ffv1",
                format: Pixel::GRAY8,
                lossless: true,
            },
            // Measured at 1080p on one core: 54 ms a frame, FFV1 took 132.
            Content::Lossless => Self {
                name: "libx264rgb",
                format: Pixel::RGB24,
                lossless: true,
            },
            Content::Color if settings.width.is_multiple_of(2) && settings.height.is_multiple_of(2) => Self {
                name: "libx264",
                format: Pixel::YUV420P,
                lossless: false,
            },
            Content::Color => Self {
                name: "libx264",
                format: Pixel::YUV444P,
                lossless: false,
            },
        }
    }
}

fn open_encoder(
    settings: &WriterSettings,
    choice: &CodecChoice,
    time_base: Rational,
    global_header: bool,
) -> Result<encoder::video::Encoder, Error> {
    let codec = encoder::find_by_name(choice.name).ok_or(Error::EncoderNotFound)?;
    let mut context = codec::context::Context::new_with_codec(codec);
    context.set_threading(threading::Config::kind(threading::Type::Frame));
    let mut video = context.encoder().video()?;
    let (frames, seconds) = settings.average_frame_rate;
    let frames_per_second = (f64::from(frames) / f64::from(seconds.max(1))).round().clamp(1.0, 240.0) as u32;
    video.set_width(settings.width as u32);
    video.set_height(settings.height as u32);
    video.set_format(choice.format);
    video.set_time_base(time_base);
    video.set_frame_rate(Some(settings.average_frame_rate));
    video.set_aspect_ratio(settings.pixel_aspect);
    video.set_gop(frames_per_second);
    video.set_max_b_frames(0);
    if settings.content == Content::Mask {
        video.set_color_range(color::Range::JPEG);
    } else if settings.content == Content::Lossless {
        video.set_colorspace(color::Space::RGB);
        video.set_color_range(color::Range::JPEG);
    } else {
        video.set_colorspace(settings.color.matrix);
        video.set_color_range(settings.color.range);
        video.set_color_primaries(settings.color.primaries);
        video.set_color_transfer_characteristic(settings.color.transfer);
    }
    if global_header {
        video.set_flags(codec::Flags::GLOBAL_HEADER);
    }
    let mut options = Dictionary::new();
    if choice.name.starts_with("libx264") {
        let is_mask = settings.content == Content::Mask;
        options.set("preset", if is_mask { "veryfast" } else { &settings.preset });
        if choice.lossless {
            options.set("qp", "0");
        } else {
            options.set("crf", &settings.crf.to_string());
        }
    } else {
        options.set("level", "3");
        options.set("slicecrc", "1");
    }
    video.open_with(options)
}

/// Units in which the container keeps time stamps.
fn time_base_for(container: &str, settings: &WriterSettings) -> Rational {
    if container == "avi" {
        // AVI numbers its frames and keeps no stamps.
        let (frames, seconds) = settings.average_frame_rate;
        Rational(seconds, frames)
    } else {
        Rational(settings.time_base.0, settings.time_base.1)
    }
}

fn muxer_options(container: &str) -> Dictionary<'static> {
    let mut options = Dictionary::new();
    options.set("flush_packets", "1");
    match container {
        "mp4" | "mov" => {
            options.set("movflags", "+frag_keyframe+empty_moov+default_base_moof");
            // Stamps are kept as they are instead of being shifted to begin at 0.
            options.set("use_editlist", "0");
            options.set("avoid_negative_ts", "make_non_negative");
        }
        "mkv" => options.set("cluster_time_limit", "1000"),
        _ => {}
    }
    options
}

/// A codec's four-letter tag belongs to the container it came from; 0 lets the muxer choose its own.
fn forget_codec_tag(stream: &mut ffmpeg_next::StreamMut<'_>) {
    #[expect(
        unsafe_code,
        reason = "ffmpeg-next has no safe setter for the codec tag, and stream copy needs one"
    )]
    // SAFETY: `stream` borrows a live output context whose stream owns its `codecpar`; a plain integer field is written.
    unsafe {
        (*stream.parameters().as_mut_ptr()).codec_tag = 0;
    }
}

fn copy_plane(from: &[u8], row: usize, frame: &mut frame::Video, plane: usize) {
    let stride = frame.stride(plane);
    for (source, target) in from.chunks_exact(row).zip(frame.data_mut(plane).chunks_mut(stride)) {
        if let Some(target) = target.get_mut(..row) {
            target.copy_from_slice(source);
        }
    }
}

fn cannot_create(path: &Path, error: Error) -> MediaError {
    MediaError::Create {
        path: path.into(),
        reason: error.to_string(),
    }
}
