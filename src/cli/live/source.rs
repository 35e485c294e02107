//! Where a live line's pictures and poses come from: a camera and an arm, a recording played at its own pace, or drawn pictures.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::bail;
use rayon::prelude::*;

use crate::camera::file as camera_file;
use crate::config::Config;
use crate::image::buffer::{Image, Rgb8};
use crate::image::field_of_view;
use crate::image::pool::Pool;
use crate::media::reader::{Input, VideoReader};
use crate::pipeline::stage::Source;
use crate::recording::folder::{Recording, Video};
use crate::robot::hand_eye::HandEye;
use crate::robot::pose_buffer::PoseBuffer;
use crate::sources::camera::capture::CaptureWatch;
use crate::sources::synthetic::{Clip, Pace, SyntheticSource};
use crate::stages::pose_stamping::Poses;
use crate::time::{Clock, Span, Timestamp};

/// Of a recording so many bytes of pictures are kept in memory; what comes after is not played.
const MOST_BYTES: usize = 1 << 30;
/// Drawn pictures, shown in turn.
const DRAWN: u64 = 16;
/// The image field is looked for in so many pictures.
const FIELD_PICTURES: usize = 8;
/// From the decision to play to the first picture.
const LEAD: Span = Span(100_000_000);

/// Where pictures come from.
#[derive(Clone, Copy, Debug)]
pub enum Wanted<'a> {
    /// A camera's node.
    Camera(&'a Path),
    /// A recording's folder, or a video.
    Recording(&'a Path),
    /// Drawn ones of this size and rate.
    Drawn {
        /// Columns and rows.
        size: (usize, usize),
        /// Frames a second.
        frame_rate_hz: f64,
    },
}

/// A source that is ready to begin, and what is known beside its pictures.
pub struct Ready {
    /// Of the pictures.
    pub source: Box<dyn Source>,
    /// What is known beside the pictures.
    pub recording: Recording,
    /// Size of the pictures, px; a camera that is absent tells only what it was asked for.
    pub size: (usize, usize),
    /// From picture to picture; zero when unknown.
    pub period: Span,
    /// The poses of a recording that is played again and again.
    pub poses: Option<Poses>,
    /// How the camera is, if it is one.
    pub watch: Option<CaptureWatch>,
    /// What is read, in words.
    pub name: String,
}

impl std::fmt::Debug for Ready {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ready")
            .field("name", &self.name)
            .field("size", &self.size)
            .finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Making<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Making").field("pace", &self.pace).finish_non_exhaustive()
    }
}

/// How a source is made.
pub struct Making<'a> {
    /// All settings.
    pub config: &'a Config,
    /// Whose time frames carry.
    pub clock: Arc<dyn Clock>,
    /// Ends the source.
    pub stop: Arc<AtomicBool>,
    /// The source ends after so many frames.
    pub count: Option<u64>,
    /// Frames a second, in place of a recording's own.
    pub frame_rate_hz: Option<f64>,
    /// How quickly pictures that are no camera's follow each other.
    pub pace: Pace,
}

impl Making<'_> {
    /// The source that is wanted.
    pub fn make(&self, wanted: Wanted<'_>) -> anyhow::Result<Ready> {
        match wanted {
            Wanted::Camera(path) => self.camera(path),
            Wanted::Recording(path) => self.recording(path),
            Wanted::Drawn { size, frame_rate_hz } => Ok(self.drawn(size, frame_rate_hz)),
        }
    }

    #[cfg(all(target_os = "linux", feature = "v4l2"))]
    fn camera(&self, path: &Path) -> anyhow::Result<Ready> {
        use crate::sources::camera::capture::CaptureSource;
        use crate::sources::camera::v4l2::V4l2Camera;

        let recording = self.instrument()?;
        let wish = self.config.camera.wish();
        let camera = Box::new(V4l2Camera::new(path));
        let mut source = CaptureSource::new(camera, wish, Arc::clone(&self.clock), Pool::new(16), Arc::clone(&self.stop))
            .with_model(recording.camera.clone().map(Arc::new));
        let mode = source.open_now()?;
        let calibrated = recording.camera.as_ref().map(|camera| (camera.width, camera.height));
        let size = mode.map(|mode| (mode.width, mode.height)).or(wish.size).or(calibrated);
        let rate = mode.map(|mode| mode.frame_rate_hz).or(wish.frame_rate_hz).unwrap_or(0.0);
        Ok(Ready {
            watch: Some(source.watch()),
            source: Box::new(source),
            recording,
            size: size.unwrap_or((1920, 1080)),
            period: if rate > 0.0 { Span::from_seconds(1.0 / rate) } else { Span(0) },
            poses: None,
            name: path.display().to_string(),
        })
    }

    #[cfg(not(all(target_os = "linux", feature = "v4l2")))]
    fn camera(&self, path: &Path) -> anyhow::Result<Ready> {
        bail!(
            "{}: this program was built without cameras (feature `v4l2`, Linux only); use --recording or --synthetic",
            path.display()
        )
    }

    /// What was calibrated for the camera.
    #[cfg_attr(
        not(all(target_os = "linux", feature = "v4l2")),
        expect(dead_code, reason = "only cameras have instruments")
    )]
    fn instrument(&self) -> anyhow::Result<Recording> {
        let mut known = Recording::plain(Video::File("camera".into()));
        if self.config.camera.instrument.is_empty() {
            return Ok(known);
        }
        let folder = Path::new(&self.config.camera.instrument);
        if !folder.is_dir() {
            bail!(
                "camera.instrument: expected a folder with camera.yaml, hand_eye.yaml, color.yaml, found none at {}",
                folder.display()
            );
        }
        let there = |name: &str| Some(folder.join(name)).filter(|file| file.exists());
        known.camera = there("camera.yaml").map(|file| camera_file::read(&file)).transpose()?;
        known.hand_eye = there("hand_eye.yaml").map(|file| HandEye::read(&file)).transpose()?;
        known.color = there("color.yaml");
        Ok(known)
    }

    fn recording(&self, path: &Path) -> anyhow::Result<Ready> {
        let recording = Recording::open(path)?;
        let mut reader = VideoReader::open(&Input::from_argument(recording.video.path()))?;
        let info = reader.info().clone();
        recording.check_video_size(info.width, info.height)?;
        let pool = Pool::new(1);
        let (mut pictures, mut times) = (Vec::new(), Vec::new());
        let most = (MOST_BYTES / (3 * info.width * info.height).max(1)).max(2);
        while pictures.len() < most {
            let Some(frame) = reader.next_frame(&pool)? else { break };
            let exact = recording.frame_times.as_ref().and_then(|times| times.get(pictures.len()));
            times.push(exact.copied().unwrap_or(frame.timestamp));
            pictures.push((*frame.image).clone());
        }
        if pictures.is_empty() {
            bail!("{}: expected pictures, found none", path.display());
        }
        if pictures.len() == most {
            tracing::info!("only the first {most} pictures are kept in memory and played again and again");
        }
        let step = (pictures.len() / FIELD_PICTURES).max(1);
        let some: Vec<&Image<Rgb8>> = pictures.iter().step_by(step).collect();
        let field = field_of_view::find(&some, &self.config.field_of_view);
        let clip = Clip {
            pictures: Arc::new(pictures),
            times,
            camera: recording.camera.clone().map(Arc::new),
            field_of_view: field.map(|field| Arc::new(field.mask)),
        };
        // Poses belong to pictures at the recording's own pace.
        let first = clip.times.first().copied().unwrap_or_default();
        let own_pace = clip.clone();
        let clip = match self.frame_rate_hz {
            Some(rate) => clip.at_rate(rate),
            None => clip,
        };
        let began = self.clock.now() + LEAD;
        let poses = match (&recording.trajectory, self.frame_rate_hz) {
            (Some(trajectory), None) => Some(Poses::Repeated {
                buffer: PoseBuffer::from_trajectory(trajectory, &self.config.poses)?,
                first,
                began,
                length: own_pace.length(),
            }),
            (Some(_), Some(_)) => {
                tracing::warn!(
                    "at another rate the recording's poses do not fit its pictures; the camera is looked for in the picture alone"
                );
                None
            }
            (None, _) => None,
        };
        Ok(Ready {
            size: (info.width, info.height),
            period: clip.period(),
            source: self.player(clip, began),
            recording: Recording {
                trajectory: None,
                ..recording
            },
            poses,
            watch: None,
            name: path.display().to_string(),
        })
    }

    fn drawn(&self, size: (usize, usize), frame_rate_hz: f64) -> Ready {
        let pictures: Vec<Image<Rgb8>> = (0..DRAWN).into_par_iter().map(|number| drawn_picture(size, number)).collect();
        let period = Span::from_seconds(1.0 / frame_rate_hz);
        let clip = Clip {
            times: (0..DRAWN as i64).map(|number| Timestamp(number * period.0)).collect(),
            pictures: Arc::new(pictures),
            camera: None,
            field_of_view: None,
        };
        Ready {
            source: self.player(clip, self.clock.now() + LEAD),
            recording: Recording::plain(Video::File("drawn".into())),
            size,
            period,
            poses: None,
            watch: None,
            name: format!("drawn pictures, {}x{} at {frame_rate_hz} Hz", size.0, size.1),
        }
    }

    fn player(&self, clip: Clip, began: Timestamp) -> Box<dyn Source> {
        let (clock, stop) = (Arc::clone(&self.clock), Arc::clone(&self.stop));
        Box::new(SyntheticSource::new(clip, began, self.count, clock, Pool::new(32), stop).at_pace(self.pace))
    }
}

/// Tissue that drifts to and fro, with specularities that stay: cheap enough to be drawn while the user waits.
fn drawn_picture((width, height): (usize, usize), number: u64) -> Image<Rgb8> {
    let turn = std::f32::consts::TAU * number as f32 / DRAWN as f32;
    let shift = [0.006 * width as f32 * turn.cos(), 0.004 * width as f32 * turn.sin()];
    let wave = |length: f32, at: f32| (std::f32::consts::TAU * at / (length * width as f32)).sin();
    let columns: Vec<[f32; 2]> = (0..width)
        .map(|x| x as f32 + shift[0])
        .map(|u| [wave(0.021, u), wave(0.13, u)])
        .collect();
    let mut image = Image::filled(width, height, [0; 3]);
    let spots: Vec<[f32; 3]> = (0..24_u32)
        .map(|spot| {
            let place = |salt: u32| (spot.wrapping_mul(2_654_435_761).rotate_left(salt) >> 8) as f32 / 16_777_216.0;
            [
                place(0) * width as f32,
                place(11) * height as f32,
                (0.002 + 0.006 * place(19)) * width as f32,
            ]
        })
        .collect();
    for y in 0..height {
        let v = y as f32 + shift[1];
        let row = [wave(0.026, v), wave(0.11, v)];
        for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
            let [fine, coarse] = columns.get(x).copied().unwrap_or_default();
            let texture = 14.0 * fine * row[0] + 16.0 * coarse * row[1];
            // Noise of a sensor, about one level.
            let hashed = (x as u32 ^ ((y as u32) << 12) ^ ((number as u32) << 24)).wrapping_mul(0x9e37_79b1);
            let noise = (hashed >> 29) as f32 * 0.5 - 1.75;
            *pixel = [150.0, 78.0, 68.0].map(|base| (base + texture + noise) as u8);
        }
    }
    for [x, y, radius] in spots {
        let reach = radius.ceil() as isize;
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let (u, v) = (x as isize + dx, y as isize + dy);
                let inside = (dx * dx + dy * dy) as f32 <= radius * radius;
                if inside && u >= 0 && v >= 0 && (u as usize) < width && (v as usize) < height {
                    image.set(u as usize, v as usize, [253, 252, 250]);
                }
            }
        }
    }
    image
}

/// Two numbers with an x between.
pub fn size_from_word(word: &str) -> Result<(usize, usize), String> {
    let parsed = word
        .split_once('x')
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    parsed
        .filter(|(width, height)| (16..=16_384).contains(width) && (16..=16_384).contains(height))
        .ok_or_else(|| format!("expected WIDTHxHEIGHT such as 1920x1080, 16 to 16384 each, found `{word}`"))
}

/// Files beside a recording's pictures that belong to the camera, for a copy of it.
pub fn calibration_files(config: &Config, wanted: Wanted<'_>) -> Vec<std::path::PathBuf> {
    let folder = match wanted {
        Wanted::Camera(_) if !config.camera.instrument.is_empty() => Path::new(&config.camera.instrument),
        Wanted::Recording(path) => path,
        _ => return Vec::new(),
    };
    ["camera.yaml", "hand_eye.yaml", "color.yaml"]
        .map(|name| folder.join(name))
        .into_iter()
        .filter(|file| file.is_file())
        .collect()
}

/// What `live --list` prints.
#[cfg(all(target_os = "linux", feature = "v4l2"))]
pub fn list() -> anyhow::Result<String> {
    use crate::sources::camera::v4l2::{modes_of, nodes};

    let nodes = nodes();
    if nodes.is_empty() {
        bail!(
            "expected a camera or capture card, found none under /dev/video*; is it plugged in, and are you in the group `video`?"
        );
    }
    let mut text = String::new();
    for node in nodes {
        text += &format!("{}  {} ({})\n", node.path.display(), node.card, node.bus);
        for mode in modes_of(&node) {
            text += &format!("  {mode}\n");
        }
    }
    Ok(text)
}

/// What `live --list` prints.
#[cfg(not(all(target_os = "linux", feature = "v4l2")))]
pub fn list() -> anyhow::Result<String> {
    bail!("this program was built without cameras (feature `v4l2`, Linux only)")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read() {
        assert_eq!(size_from_word("1920x1080"), Ok((1920, 1080)));
        for wrong in ["1920", "0x10", "axb", "1920x1080x2", "20000x100"] {
            assert!(size_from_word(wrong).unwrap_err().contains(wrong));
        }
    }

    #[test]
    fn drawn_pictures_move_and_shine() {
        let (a, b) = (drawn_picture((320, 180), 0), drawn_picture((320, 180), 4));
        assert_ne!(a, b);
        let shining = a.pixels().iter().filter(|pixel| pixel[2] > 240).count();
        assert!((20..5000).contains(&shining), "{shining}");
    }
}
