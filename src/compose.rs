//! The line, stage by stage, in the order in which a frame meets them.
//!
//! What a recording lacks switches off what needs it: such a stage is left out, and [`Line::left_out`] says why in one line each.

use std::fmt;
use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::config::Config;
use crate::frame::FrameId;
use crate::light_field::view::LightField;
use crate::pipeline::slot::Slot;
use crate::pipeline::stage::Stage;
use crate::progress::Silent;
use crate::recording::folder::Recording;
use crate::robot::pose_buffer::{self, PoseBuffer};
use crate::stages::color_normalization::color_file::ColorFile;
use crate::stages::color_normalization::stage::ColorNormalization;
use crate::stages::pose_refinement::{PoseRefinement, Reference};
use crate::stages::pose_stamping::{PoseStamping, Poses};
use crate::stages::rolling_light_field::{Maker, RollingLightField};
use crate::stages::specularity_detection::SpecularityDetection;
use crate::stages::specularity_substitution::stage::{SpecularitySubstitution, Witnesses};
use crate::stages::temporal_median::stage::TemporalMedian;
use crate::stages::undistortion::{self, Undistortion};
use crate::stages::{color_normalization, pose_refinement, temporal_median};
use crate::time::Span;

/// A part of the line that a user chooses by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Choice {
    /// Temporal color median: particles and noise.
    Median,
    /// Color normalization.
    Color,
    /// Undistortion.
    Undistort,
    /// Specularities, substituted from a light field.
    Specular,
}

impl Choice {
    /// The whole line.
    pub const ALL: [Self; 4] = [Self::Median, Self::Color, Self::Undistort, Self::Specular];
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Median => "median",
            Self::Color => "color",
            Self::Undistort => "undistort",
            Self::Specular => "specular",
        })
    }
}

/// A part of the line that cannot run, wholly or in part, and why.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LeftOut {
    /// Which.
    pub stage: Choice,
    /// Why, and what would help.
    pub why: String,
}

impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.stage, self.why)
    }
}

/// What the line is made from.
#[derive(Debug)]
pub struct Equipment<'a> {
    /// What is known beside the pictures.
    pub recording: &'a Recording,
    /// What other views saw.
    pub light_field: Option<Arc<LightField>>,
    /// True when a light field is still on its way: its stages wait for it at the line's [`LightFieldDoor`].
    pub light_field_to_come: bool,
    /// Whether the line may wait for work on a frame, as on a recording: then a light field can be made of its own last frames.
    pub may_wait: bool,
    /// The arm's poses, where they are not the recording's as they stand there.
    pub poses: Option<Poses>,
    /// Size of the pictures, px.
    pub size: (usize, usize),
}

/// The stages, ready to run.
pub struct Line {
    /// In the order of the line.
    pub stages: Vec<Box<dyn Stage>>,
    /// What was wanted and cannot run.
    pub left_out: Vec<LeftOut>,
    /// Explains the pixels that leave the line, where known beforehand.
    pub output_camera: Option<Arc<CameraModel>>,
    /// Where light fields enter, if there are stages for one.
    pub light_field_door: Option<LightFieldDoor>,
}

/// Where light fields enter a line: the one way, before its first frame and while it runs, for surveys and for those of the last frames.
#[derive(Clone, Debug)]
pub struct LightFieldDoor {
    alignment: pose_refinement::Settings,
    /// Of stages that know no time offset of their own.
    time_offset: Option<Slot<Span>>,
    reference: Slot<Reference>,
    witnesses: Slot<Witnesses>,
}

impl LightFieldDoor {
    /// Make the light field ready, in the caller's thread; each stage takes its part before its next frame.
    pub fn bring(&self, light_field: Arc<LightField>) {
        self.bring_from(FrameId(0), light_field);
    }

    /// The same, for frame `first` and those after it: frames before it that are still under way keep what they had.
    fn bring_from(&self, first: FrameId, light_field: Arc<LightField>) {
        let offset = light_field.time_offset;
        let reference = Reference::new(Arc::clone(&light_field), &self.alignment);
        let witnesses = Witnesses::new(light_field);
        if let Some(slot) = self.time_offset.as_ref().filter(|_| offset != Span(0)) {
            slot.put(first, offset);
        }
        self.reference.put(first, reference);
        self.witnesses.put(first, witnesses);
    }
}

/// Why a line cannot be put together.
#[derive(Debug, thiserror::Error)]
pub enum ComposeError {
    /// The temporal median's settings.
    #[error(transparent)]
    Median(#[from] temporal_median::settings::SettingsError),
    /// Color normalization's settings or table.
    #[error(transparent)]
    Color(#[from] color_normalization::stage::ColorError),
    /// The undistortion's settings.
    #[error(transparent)]
    Undistortion(#[from] undistortion::UndistortionError),
    /// The settings of the arm's poses.
    #[error(transparent)]
    Poses(#[from] pose_buffer::SettingsError),
    /// `color.yaml`.
    #[error(transparent)]
    ColorFile(#[from] color_normalization::color_file::ColorFileError),
}

impl fmt::Debug for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let stages: Vec<_> = self.stages.iter().map(|stage| stage.name()).collect();
        f.debug_struct("Line")
            .field("stages", &stages)
            .field("left_out", &self.left_out)
            .finish_non_exhaustive()
    }
}

impl Line {
    fn leave_out(&mut self, stage: Choice, why: impl Into<String>) {
        self.left_out.push(LeftOut { stage, why: why.into() });
    }
}

/// Put the wanted stages together, as far as the equipment allows.
pub fn line(config: &Config, wanted: &[Choice], equipment: &Equipment<'_>) -> Result<Line, ComposeError> {
    let recording = equipment.recording;
    let wants = |choice: Choice| wanted.contains(&choice);
    let mut line = Line {
        stages: Vec::new(),
        left_out: Vec::new(),
        output_camera: None,
        light_field_door: None,
    };

    if wants(Choice::Median) {
        line.stages.push(Box::new(TemporalMedian::new(&config.median)?));
    }
    if wants(Choice::Color) {
        let color_file = recording.color.as_deref().map(ColorFile::read).transpose()?;
        let stage = ColorNormalization::new(&config.color, color_file.as_ref())?;
        match stage.idle_reason() {
            Some(why) => line.leave_out(Choice::Color, why),
            None => line.stages.push(Box::new(stage)),
        }
    }
    if wants(Choice::Undistort) {
        match &recording.camera {
            Some(camera) => {
                let stage = Undistortion::new(&config.undistort, camera)?;
                line.output_camera = Some(Arc::clone(stage.pinhole()));
                line.stages.push(Box::new(stage));
            }
            None => line.leave_out(
                Choice::Undistort,
                "no camera.yaml beside the video, so the picture keeps the lens's distortion (`endofield calibrate camera` makes it)",
            ),
        }
    }
    if wants(Choice::Specular) {
        specular(config, wanted, equipment, &mut line)?;
    }
    Ok(line)
}

/// The stages that find specularities and, where everything that takes is there, substitute them.
fn specular(config: &Config, wanted: &[Choice], equipment: &Equipment<'_>, line: &mut Line) -> Result<(), ComposeError> {
    let recording = equipment.recording;
    let only_marked = "specularities are only found and marked 64 in the mask";
    let has_poses = equipment.poses.is_some() || recording.trajectory.is_some();
    let rolls = config.rolling.enabled && equipment.may_wait && has_poses && recording.hand_eye.is_some();
    let lacking = if equipment.light_field.is_none() && !equipment.light_field_to_come && !rolls {
        Some(if config.rolling.enabled && equipment.may_wait {
            "no light field (--light-field LF), nor poses and hand_eye.yaml to make one of the video's own frames"
        } else {
            "no light field (--light-field LF)"
        })
    } else if recording.camera.is_none() {
        Some("no camera.yaml beside the video")
    } else if !wanted.contains(&Choice::Undistort) {
        Some("the light field's pictures are undistorted and the video's are not to be (add undistort to --stages)")
    } else {
        None
    };
    line.stages.push(Box::new(SpecularityDetection::new(&config.specularity)));
    if let Some(lacking) = lacking {
        line.leave_out(Choice::Specular, format!("{lacking}, so {only_marked}"));
        line.stages
            .push(Box::new(SpecularitySubstitution::new(&config.substitution, None)));
        return Ok(());
    }
    if !has_poses || recording.hand_eye.is_none() {
        let missing = if has_poses { "hand_eye.yaml" } else { "poses.tum" };
        line.leave_out(
            Choice::Specular,
            format!("no {missing} beside the video, so the camera is looked for in the picture alone"),
        );
    }
    light_field_stages(config, equipment, rolls, line)
}

/// The stages that use a light field, in the order of the line, and the door by which it comes.
fn light_field_stages(config: &Config, equipment: &Equipment<'_>, rolls: bool, line: &mut Line) -> Result<(), ComposeError> {
    let mut door = LightFieldDoor {
        alignment: config.pose_refinement.clone(),
        time_offset: None,
        reference: Slot::new(),
        witnesses: Slot::new(),
    };
    if let Some(stamping) = stamping(config, equipment, &mut door)? {
        line.stages.push(Box::new(stamping));
    }
    if equipment.light_field.is_none() && rolls {
        // The last frames were stamped already: an offset found among them would reach some frames still under way and not others.
        let of_frames = LightFieldDoor {
            time_offset: None,
            ..door.clone()
        };
        let maker = made_at_once(config, of_frames);
        line.stages.push(Box::new(RollingLightField::new(&config.rolling, maker)));
    }
    line.stages.push(Box::new(PoseRefinement::awaiting(
        &config.pose_refinement,
        door.reference.clone(),
    )));
    line.stages.push(Box::new(SpecularitySubstitution::awaiting(
        &config.substitution,
        door.witnesses.clone(),
    )));
    if let Some(light_field) = &equipment.light_field {
        door.bring(Arc::clone(light_field));
    }
    line.light_field_door = Some(door);
    Ok(())
}

/// The names of the stages that have nothing to do before there is a light field.
pub fn idle_without_light_field() -> [&'static str; 2] {
    ["pose", "pose_refinement"]
}

/// The stage that knows the arm's poses. Where the hand-eye file tells no time offset, the survey's is taken.
fn stamping(config: &Config, equipment: &Equipment<'_>, door: &mut LightFieldDoor) -> Result<Option<PoseStamping>, ComposeError> {
    let recorded = || equipment.recording.trajectory.as_ref();
    let poses = match &equipment.poses {
        Some(poses) => Some(poses.clone()),
        None => recorded()
            .map(|trajectory| PoseBuffer::from_trajectory(trajectory, &config.poses).map(Poses::Recorded))
            .transpose()?,
    };
    let (Some(poses), Some(hand_eye)) = (poses, &equipment.recording.hand_eye) else {
        return Ok(None);
    };
    let stamping = PoseStamping::new(poses, hand_eye.clone());
    if hand_eye.time_offset.is_some() {
        return Ok(Some(stamping));
    }
    let newer = door.time_offset.insert(Slot::new()).clone();
    Ok(Some(stamping.awaiting(newer)))
}

/// Makes each light field before the frame that called for it goes on: on a recording nothing hurries, and every run is alike.
fn made_at_once(config: &Config, door: LightFieldDoor) -> Maker {
    let (trust, settings) = (config.survey.clone(), config.rolling.clone());
    let mut told = false;
    Box::new(
        move |batch, camera, first| match batch.built(camera, &trust, &settings, &Silent) {
            Ok(light_field) => {
                tracing::debug!("a light field of {} of the last frames", light_field.views.len());
                door.bring_from(first, Arc::new(light_field));
            }
            Err(error) if !told => {
                told = true;
                tracing::warn!("specular: no light field could be made of the last frames, a later one may: {error}");
            }
            Err(_) => {}
        },
    )
}
