//! One video frame on its way through the line, with everything that is known about it.

use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::pool::Pooled;
use crate::time::{Span, Timestamp};

/// Counts every frame the source saw, from 0, so a gap shows a loss.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FrameId(pub u64);

/// What happened to a pixel; the values of the `--mask-out` file.
pub mod provenance_code {
    /// As the camera saw it.
    pub const UNTOUCHED: u8 = 0;
    /// A specularity left as it was.
    pub const LEFT: u8 = 64;
    /// Filled from recent frames.
    pub const RECENT: u8 = 128;
    /// Made up (explicit offline fallback only).
    pub const MADE_UP: u8 = 192;
    /// Filled from the light field.
    pub const LIGHT_FIELD: u8 = 255;
}

/// Where a pose came from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseOrigin {
    /// No pose for this frame.
    #[default]
    Missing,
    /// Interpolated from the arm's poses around the exposure, possibly refined by the picture.
    Measured,
    /// Carried over from neighbouring frames.
    Predicted,
}

/// For each replaced pixel, what replaced it.
#[derive(Debug)]
pub struct Provenance {
    /// A [`provenance_code`] per pixel.
    pub code: Pooled<u8>,
    /// Index of the view that spoke loudest, where `code` is `LIGHT_FIELD` or `RECENT`; anything elsewhere.
    pub view: Pooled<u16>,
    /// How sure, 0–255, where filled; anything elsewhere.
    pub confidence: Pooled<u8>,
}

/// The picture at the size at which it is looked at, and what was seen in it.
#[derive(Debug)]
pub struct Analysis {
    /// Picture pixels along a pixel of everything below; squares cut off by the right and lower border count.
    pub step: usize,
    /// Mean colors of the squares; `None` where the picture itself is looked at.
    pub reduced: Option<Pooled<Rgb8>>,
    /// 255 inside the image field, squares that reach out of it are outside; `None` = everywhere.
    pub field_of_view: Option<Arc<Mask>>,
    /// 255 where the lamp's mirror image hides the tissue.
    pub specularities: Pooled<u8>,
    /// 255 where an instrument is seen.
    pub instruments: Pooled<u8>,
}

impl Analysis {
    /// What is looked at of the frame's `picture`.
    pub fn image<'a>(&'a self, picture: &'a Image<Rgb8>) -> &'a Image<Rgb8> {
        self.reduced.as_deref().unwrap_or(picture)
    }
}

/// What the light field had to say about a frame, in figures.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Alignment {
    /// How well the picture's detail agrees with the light field's, −1…1.
    pub correlation: f32,
    /// Root mean square residual of the picture against the light field around the filled regions, gray levels.
    pub residual_levels: f32,
    /// How far the picture moved the arm's pose, px at the scene, median over the picture.
    pub correction_px: f32,
    /// Root mean square of the remaining per-region shifts, px.
    pub region_shift_px: f32,
    /// False when the frame could not be aligned and was left alone.
    pub aligned: bool,
}

/// In and out of one stage.
#[derive(Clone, Copy, Debug)]
pub struct StageTiming {
    /// The stage's name.
    pub stage: &'static str,
    /// When the stage began with it.
    pub entered: Timestamp,
    /// Handed on.
    pub left: Timestamp,
    /// True when the stage failed or was switched off and the frame passed unaltered.
    pub bypassed: bool,
}

/// One video frame.
#[derive(Debug)]
pub struct Frame {
    /// Its number at the source.
    pub id: FrameId,
    /// When it was exposed, on the recording's clock.
    pub exposed_at: Timestamp,
    /// When a player shows it: the stamp of the container it came from, which outputs keep.
    pub presented_at: Timestamp,
    /// Since the frame before it; zero for the first.
    pub since_previous: Span,
    /// When we had it, on the host's clock.
    pub arrived_at: Timestamp,
    /// The picture.
    pub image: Pooled<Rgb8>,
    /// The picture as it came, kept when somebody asked for it (side by side).
    pub original: Option<Pooled<Rgb8>>,
    /// Explains the pixels of `image`; the undistortion stage replaces it. `None` when the camera is not calibrated.
    pub camera: Option<Arc<CameraModel>>,
    /// 255 inside the endoscope's (circular) image field of `image`; `None` = everywhere.
    pub field_of_view: Option<Arc<Mask>>,
    /// True on the first frame after a scene cut.
    pub scene_cut: bool,
    /// Where the camera was.
    pub world_from_camera: Option<Transform<World, Camera>>,
    /// Where that pose came from.
    pub pose_origin: PoseOrigin,
    /// Speed of the camera at exposure, from the poses: mm/s and rad/s.
    pub camera_speed: Option<(f64, f64)>,
    /// How well the light field fits.
    pub alignment: Option<Alignment>,
    /// What was seen in the picture as it leaves the undistortion.
    pub analysis: Option<Analysis>,
    /// What was replaced, and by what.
    pub provenance: Option<Provenance>,
    /// True for a copy that left before the first stage: for taps, and live for whoever waits when the line is late.
    pub untouched: bool,
    /// Where the frame spent its time.
    pub timings: Vec<StageTiming>,
}

impl Frame {
    /// A frame as a source makes it: picture and time, everything else unknown.
    pub fn new(id: FrameId, exposed_at: Timestamp, arrived_at: Timestamp, image: Pooled<Rgb8>) -> Self {
        Self {
            id,
            exposed_at,
            presented_at: exposed_at,
            since_previous: Span::default(),
            arrived_at,
            image,
            original: None,
            camera: None,
            field_of_view: None,
            scene_cut: false,
            world_from_camera: None,
            pose_origin: PoseOrigin::Missing,
            camera_speed: None,
            alignment: None,
            analysis: None,
            provenance: None,
            untouched: false,
            timings: Vec::with_capacity(12),
        }
    }
}
