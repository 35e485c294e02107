//! From a survey with rough arm poses to views whose poses fit the pictures, and sparse points of the scene.
//!
//! The arm knows each pose to a fraction of a millimetre and of a degree, at the wrong instant by some tens of milliseconds; at the
//! tissue that is several px. The pictures know the poses to hundredths of a millimetre, but neither place nor size of the
//! whole. So: corners are tracked from view to view starting at the arm's prediction (`tracking`), poses and points are adjusted
//! together with the arm's poses as priors (`solver::bundle_adjustment`), the offset between the clocks is read off the two paths
//! (`time_offset`), every point is looked for in every view (`reobservation`), and all is adjusted again with the priors
//! taken at the right instant. While the offset is unknown, the priors are loose along the path: by the speed times the offset's doubt.

use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
pub use crate::light_field::prior::PosePrior;
use crate::light_field::refinement::Refinement;
use crate::light_field::survey_report::SurveyReport;
use crate::progress::Progress;
use crate::time::{Span, Timestamp};

/// A picture of the survey that is to become a view.
#[derive(Clone, Debug)]
pub struct SurveyFrame {
    /// The frame's number in the recording.
    pub frame_number: u32,
    /// Undistorted.
    pub image: Image<Rgb8>,
    /// 0 = specular, instrument, out of field.
    pub confidence: Mask,
    /// On the camera's clock.
    pub exposed_at: Timestamp,
}

/// A point of the scene and where it was seen.
#[derive(Clone, Debug)]
pub struct ScenePoint {
    /// Where it is.
    pub position: Point<World>,
    /// View index and place in that view.
    pub observations: Vec<(u32, Pixel)>,
}

/// A survey whose poses fit its pictures.
#[derive(Clone, Debug)]
pub struct RefinedSurvey {
    /// Per frame given; `None` where the pictures do not tie it to the others.
    pub world_from_camera: Vec<Option<Transform<World, Camera>>>,
    /// The scene, sparsely.
    pub points: Vec<ScenePoint>,
    /// Add to a pose stamp to get the camera's clock.
    pub time_offset: Span,
    /// What was done.
    pub report: SurveyReport,
}

/// How a survey is refined.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Pictures wider than this are halved before tracking, px.
    pub max_working_width_px: usize,
    /// Cells along the longer side of a picture; each gives one corner per anchor view.
    pub corner_cells: usize,
    /// Weakest corner, (gray levels per px)².
    pub min_corner_strength: f32,
    /// Anchor views among the views.
    pub anchors: usize,
    /// Views to either side through which a corner is first followed.
    pub reach_views: usize,
    /// Least normalized cross-correlation of an observation with its anchor's patch.
    pub min_zncc: f32,
    /// Scene points at most.
    pub max_points: usize,
    /// Fewest observations that tie a view in.
    pub min_view_observations: usize,
    /// Add to a pose stamp to get the camera's clock, ms, where it is known; the search goes from here.
    pub known_time_offset_ms: Option<f64>,
    /// The offset is looked for in ± this, ms.
    pub time_offset_range_ms: f64,
    /// Standard deviation of the offset before it was looked for, ms.
    pub time_offset_doubt_ms: f64,
    /// Arm poses are averaged with a Gaussian of this standard deviation, ms; 0 takes them as they come.
    pub prior_smoothing_ms: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_working_width_px: 1100,
            corner_cells: 16,
            min_corner_strength: 0.15,
            anchors: 14,
            reach_views: 8,
            min_zncc: 0.8,
            max_points: 1200,
            min_view_observations: 15,
            known_time_offset_ms: None,
            time_offset_range_ms: 150.0,
            time_offset_doubt_ms: 60.0,
            prior_smoothing_ms: 25.0,
        }
    }
}

/// Why a survey could not be refined.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SurveyError {
    /// Too few pictures.
    #[error("a light field needs at least 3 views, found {0}: survey longer, or lower the spacing of views")]
    TooFewViews(usize),
    /// A picture of another size.
    #[error("frame {frame} is {found_width}x{found_height}, expected the camera's {width}x{height}: check camera.yaml")]
    Size {
        /// The frame's number.
        frame: u32,
        /// Columns found.
        found_width: usize,
        /// Rows found.
        found_height: usize,
        /// Columns expected.
        width: usize,
        /// Rows expected.
        height: usize,
    },
    /// The arm said nothing about most frames.
    #[error("only {found} of {views} views have an arm pose, at least 2 are needed: check that poses and frames share one clock")]
    TooFewPoses {
        /// Views with a pose.
        found: usize,
        /// Views.
        views: usize,
    },
    /// The camera rested.
    #[error(
        "the arm poses do not move or no depth explains the pictures: survey with some centimetres of sideways motion, and check hand_eye.yaml"
    )]
    NoParallax,
    /// Nothing to hold on to.
    #[error(
        "only {found} scene points could be tracked, at least {needed} are needed: the pictures are blurred, masked or without texture"
    )]
    TooFewPoints {
        /// Points found.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// Ctrl-C.
    #[error("stopped by the user")]
    Stopped,
}

/// Refine the poses of a survey and find scene points.
pub fn refine(
    frames: &[SurveyFrame],
    camera: &CameraModel,
    prior: &dyn PosePrior,
    settings: &Settings,
    progress: &dyn Progress,
) -> Result<RefinedSurvey, SurveyError> {
    Refinement::new(frames, camera, prior, settings)?.run(progress)
}
