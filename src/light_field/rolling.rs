//! A light field of what the camera saw last: frames join as views while the scope moves, the oldest leave.
//!
//! It needs no survey, and it follows tissue that has moved since one. A frame becomes a view when the camera has come far enough since
//! the last view that the lamp's mirror image lies elsewhere on the tissue. After every few new views the light field is made anew from
//! all that are held: poses refined with the arm's as priors, depth, surface, gains ([`build`]). Its world is the arm's base.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::build::{self, BuildSettings};
use crate::light_field::depth::stereo::StereoSettings;
use crate::light_field::error::LightFieldError;
use crate::light_field::prior::{PosePrior, PriorSettings};
use crate::light_field::survey::{self, SurveyError};
use crate::light_field::view::{Kind, LightField, View};
use crate::progress::Progress;
use crate::time::{Span, Timestamp};

/// How frames become views, and when the light field is made anew.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Build one from the video's own frames where no light field is given.
    pub enabled: bool,
    /// Views held at most; the oldest leave.
    pub max_views: usize,
    /// Views older than this leave, s.
    pub max_age_s: f64,
    /// Views before the first light field is made.
    pub first_views: usize,
    /// New views before the next one.
    pub views_between: usize,
    /// A frame becomes a view when the picture has moved so far since the last view, rad: shift over `scene_depth_mm`, plus turn.
    pub min_step_rad: f64,
    /// Views that get a depth map of their own; the surface serves the rest.
    pub depth_views: usize,
    /// Depth is found in pictures at most this wide, px.
    pub depth_width_px: usize,
    /// Typical distance of the scene, mm; weighs sideways steps against turns.
    pub scene_depth_mm: f64,
    /// A frame less sharp than this share of those before it does not become a view.
    pub min_relative_sharpness: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            enabled: true,
            max_views: 36,
            max_age_s: 20.0,
            first_views: 10,
            views_between: 12,
            min_step_rad: 0.016,
            depth_views: 8,
            depth_width_px: 480,
            scene_depth_mm: 75.0,
            min_relative_sharpness: 0.6,
        }
    }
}

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("max_views", self.max_views as f64, 3.0, 400.0),
            ("max_age_s", self.max_age_s, 0.1, 3600.0),
            ("first_views", self.first_views as f64, 3.0, self.max_views as f64),
            ("views_between", self.views_between as f64, 1.0, 400.0),
            ("min_step_rad", self.min_step_rad, 1e-4, 1.0),
            ("depth_views", self.depth_views as f64, 2.0, 400.0),
            ("depth_width_px", self.depth_width_px as f64, 64.0, 2000.0),
            ("scene_depth_mm", self.scene_depth_mm, 1.0, 1000.0),
            ("min_relative_sharpness", self.min_relative_sharpness, 0.0, 1.0),
        ] {
            if !(low..=high).contains(&value) {
                return Err(format!("rolling.{key}: expected {low} to {high}, found {value}"));
            }
        }
        Ok(())
    }
}

/// Sharpness is compared with that of so many frames before.
const REMEMBERED: usize = 15;

/// The views held, and where the arm said the camera was.
#[derive(Debug)]
pub struct RollingViews {
    settings: Settings,
    views: VecDeque<View>,
    path: VecDeque<(Timestamp, Transform<World, Camera>)>,
    sharpness: VecDeque<f64>,
    last_view: Option<Transform<World, Camera>>,
    fresh: usize,
    made_before: bool,
}

impl RollingViews {
    /// None yet.
    pub fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            views: VecDeque::new(),
            path: VecDeque::new(),
            sharpness: VecDeque::new(),
            last_view: None,
            fresh: 0,
            made_before: false,
        }
    }

    /// A frame's pose by the arm and its sharpness; true if the frame should join as a view.
    pub fn is_wanted(&mut self, exposed_at: Timestamp, pose: &Transform<World, Camera>, sharpness: f64) -> bool {
        self.path.push_back((exposed_at, *pose));
        let oldest = exposed_at - Span::from_seconds(self.settings.max_age_s);
        while self.path.front().is_some_and(|(at, _)| *at < oldest) {
            self.path.pop_front();
        }
        let usual = self.usual_sharpness();
        if self.sharpness.len() == REMEMBERED {
            self.sharpness.pop_front();
        }
        self.sharpness.push_back(sharpness);
        if usual.is_some_and(|usual| sharpness < self.settings.min_relative_sharpness * usual) {
            return false;
        }
        self.last_view.is_none_or(|last| {
            let step = last.inverse() * *pose;
            step.translation().norm() / self.settings.scene_depth_mm + step.rotation().angle() >= self.settings.min_step_rad
        })
    }

    fn usual_sharpness(&self) -> Option<f64> {
        let mut sorted: Vec<f64> = self.sharpness.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied()
    }

    /// A view joins; `view.world_from_camera` is the arm's word.
    pub fn join(&mut self, view: View) {
        let oldest = view.exposed_at - Span::from_seconds(self.settings.max_age_s);
        self.last_view = Some(view.world_from_camera);
        self.views.push_back(view);
        self.fresh += 1;
        while self.views.len() > self.settings.max_views || self.views.front().is_some_and(|view| view.exposed_at < oldest) {
            self.views.pop_front();
        }
    }

    /// The views for a new light field, if it is time for one.
    pub fn due(&mut self) -> Option<Batch> {
        let enough = if self.made_before {
            self.settings.views_between
        } else {
            self.settings.first_views
        };
        if self.fresh < enough || self.views.len() < self.settings.first_views.min(self.settings.max_views) {
            return None;
        }
        self.fresh = 0;
        self.made_before = true;
        Some(Batch {
            views: self.views.iter().cloned().collect(),
            path: self.path.iter().copied().collect(),
        })
    }

    /// After a scene cut nothing of before holds.
    pub fn forget(&mut self) {
        *self = Self::new(&self.settings);
    }
}

/// Views, and the path of the camera by the arm's word, of which a light field is to be made.
#[derive(Clone, Debug)]
pub struct Batch {
    views: Vec<View>,
    path: Vec<(Timestamp, Transform<World, Camera>)>,
}

/// Why none was made.
#[derive(Debug, thiserror::Error)]
pub enum RollingError {
    /// The views' poses could not be refined.
    #[error(transparent)]
    Poses(#[from] SurveyError),
    /// No depth, no surface.
    #[error(transparent)]
    Surface(#[from] LightFieldError),
}

impl Batch {
    /// Make the light field. The camera is the views' own.
    pub fn built(
        self,
        camera: &CameraModel,
        trust: &PriorSettings,
        settings: &Settings,
        progress: &dyn Progress,
    ) -> Result<LightField, RollingError> {
        let Self { views, path } = self;
        let prior = Path { path, trust };
        let known = survey::Settings {
            min_view_observations: 10,
            ..survey::Settings::default()
        };
        let (mut light_field, _) = build::refined(views, camera, &prior, &known, progress)?;
        "the video's own last frames".clone_into(&mut light_field.recipe);
        light_field.kind = Kind::Rolling;
        // It is made often and holds for a few seconds: quickly rather than finely.
        let quick = BuildSettings {
            stereo: StereoSettings {
                reference_views: settings.depth_views,
                max_width_px: settings.depth_width_px,
                ..StereoSettings::default()
            },
            ..BuildSettings::default()
        };
        build::complete(&mut light_field, &quick, progress)?;
        Ok(light_field)
    }
}

/// The camera's path, frame by frame.
struct Path<'a> {
    path: Vec<(Timestamp, Transform<World, Camera>)>,
    trust: &'a PriorSettings,
}

/// Frames farther apart than this are not bridged.
const LONGEST_GAP: Span = Span(250_000_000);

impl PosePrior for Path<'_> {
    fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>> {
        let next = self.path.partition_point(|(stamp, _)| *stamp <= at);
        let (before, pose) = self.path.get(next.checked_sub(1)?)?;
        match self.path.get(next) {
            Some((after, to)) if *after - *before <= LONGEST_GAP => {
                Some(pose.interpolated(to, (at - *before).0 as f64 / (*after - *before).0 as f64))
            }
            _ if *before == at => Some(*pose),
            _ => None,
        }
    }

    fn sigma_mm(&self) -> f64 {
        self.trust.arm_sigma_mm
    }

    fn sigma_rad(&self) -> f64 {
        self.trust.arm_sigma_rad
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;
    use crate::image::buffer::Image;

    const FRAME_S: f64 = 0.04;

    fn eye(mm: f64) -> Transform<World, Camera> {
        Transform::new(UnitQuaternion::identity(), Vector3::new(mm, 0.0, 0.0))
    }

    fn view(number: u32, world_from_camera: Transform<World, Camera>) -> View {
        let camera = CameraModel {
            width: 2,
            height: 2,
            intrinsics: Intrinsics {
                fx: 2.0,
                fy: 2.0,
                cx: 0.5,
                cy: 0.5,
            },
            distortion: Distortion::None,
        };
        View {
            frame_number: number,
            image: Image::filled(2, 2, [0; 3]),
            confidence: Image::filled(2, 2, 255),
            depth: Image::filled(2, 2, 0.0),
            camera: Arc::new(camera),
            world_from_camera,
            gain: [1.0; 3],
            exposed_at: Timestamp::from_seconds(f64::from(number) * FRAME_S),
        }
    }

    fn settings() -> Settings {
        Settings {
            max_views: 6,
            first_views: 3,
            views_between: 2,
            max_age_s: 1.0,
            min_step_rad: 0.1,
            scene_depth_mm: 100.0,
            ..Settings::default()
        }
    }

    /// Frames 4 mm apart (0.04 rad at 100 mm); numbers of the views, and of those at which a light field was due, with how many views.
    fn played(
        views: &mut RollingViews,
        frames: std::ops::Range<u32>,
        is_sharp: impl Fn(u32) -> bool,
    ) -> (Vec<u32>, Vec<(u32, usize)>) {
        let (mut joined, mut due) = (Vec::new(), Vec::new());
        for number in frames {
            let pose = eye(4.0 * f64::from(number));
            let sharpness = if is_sharp(number) { 1.0 } else { 0.3 };
            let at = Timestamp::from_seconds(f64::from(number) * FRAME_S);
            if views.is_wanted(at, &pose, sharpness) {
                views.join(view(number, pose));
                joined.push(number);
                due.extend(views.due().map(|batch| (number, batch.views.len())));
            }
        }
        (joined, due)
    }

    #[test]
    fn a_view_joins_when_the_picture_has_moved_and_a_blurred_one_waits() {
        let (joined, _) = played(&mut RollingViews::new(&settings()), 0..10, |_| true);
        assert_eq!(joined, [0, 3, 6, 9]);
        let (joined, _) = played(&mut RollingViews::new(&settings()), 0..10, |number| number != 3);
        assert_eq!(joined, [0, 4, 7]);
    }

    #[test]
    fn light_fields_are_due_at_first_and_then_after_every_few_views_and_views_are_bounded() {
        let (joined, due) = played(&mut RollingViews::new(&settings()), 0..31, |_| true);
        assert_eq!(joined.len(), 11);
        assert_eq!(due, [(6, 3), (12, 5), (18, 6), (24, 6), (30, 6)]);
    }

    #[test]
    fn old_views_leave_and_a_cut_forgets_all() {
        let mut views = RollingViews::new(&settings());
        let _ = played(&mut views, 0..10, |_| true);
        // Two seconds later.
        let _ = played(&mut views, 60..61, |_| true);
        assert_eq!(views.views.len(), 1);
        assert!(views.path.len() <= 2);
        views.forget();
        assert!(views.views.is_empty() && views.due().is_none());
    }

    #[test]
    fn the_path_is_bridged_between_frames_and_not_across_gaps() {
        let second = Timestamp::from_seconds;
        let path = Path {
            path: vec![(second(0.0), eye(0.0)), (second(0.1), eye(2.0)), (second(1.0), eye(3.0))],
            trust: &PriorSettings::default(),
        };
        let x = |at: f64| path.world_from_camera(second(at)).map(|pose| pose.translation().x);
        assert!((x(0.05).unwrap() - 1.0).abs() < 1e-9);
        assert_eq!((x(0.5), x(-0.1), x(1.2)), (None, None, None));
        assert_eq!(x(1.0), Some(3.0));
    }
}
