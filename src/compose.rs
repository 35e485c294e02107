//! The line, stage by stage, in the order in which a frame meets them.
//!
//! What a recording lacks switches off what needs it: such a stage is left out, and [`Line::left_out`] says why in one line each.

use std::fmt;
use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::config::Config;
use crate::light_field::build::BuildSettings;
use crate::light_field::view::LightField;
use crate::pipeline::slot::Slot;
use crate::pipeline::stage::Stage;
use crate::progress::Silent;
use crate::recording::folder::Recording;
use crate::robot::pose_buffer::{self, PoseBuffer};
use crate::stages::color_normalization::color_file::ColorFile;
use crate::stages::color_normalization::stage::ColorNormalization;
use crate::stages::pose_refinement::{PoseRefinement, Reference};
use crate::stages::pose_stamping::PoseStamping;
use crate::stages::rolling_light_field::{Maker, RollingLightField};
use crate::stages::specularity_detection::SpecularityDetection;
use crate::stages::specularity_substitution::stage::{SpecularitySubstitution, Witnesses};
use crate::stages::temporal_median::stage::TemporalMedian;
use crate::stages::undistortion::{self, Undistortion};
use crate::stages::{color_normalization, temporal_median};
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
    let rolls = config.rolling.enabled && recording.trajectory.is_some() && recording.hand_eye.is_some();
    let lacking = if equipment.light_field.is_none() && !rolls {
        Some(if config.rolling.enabled {
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
    let light_field = equipment.light_field.as_ref();
    match (&recording.trajectory, &recording.hand_eye) {
        (Some(trajectory), Some(hand_eye)) => {
            let poses = PoseBuffer::from_trajectory(trajectory, &config.poses)?;
            let mut stamping = PoseStamping::new(poses, hand_eye.clone());
            let of_survey = light_field.map_or(Span(0), |light_field| light_field.time_offset);
            if hand_eye.time_offset.is_none() && of_survey != Span(0) {
                stamping = stamping.with_time_offset(of_survey);
            }
            line.stages.push(Box::new(stamping));
        }
        (trajectory, _) => {
            let missing = if trajectory.is_none() { "poses.tum" } else { "hand_eye.yaml" };
            line.leave_out(
                Choice::Specular,
                format!("no {missing} beside the video, so the camera is looked for in the picture alone"),
            );
        }
    }
    match light_field {
        Some(light_field) => {
            line.stages.push(Box::new(PoseRefinement::new(
                &config.pose_refinement,
                Arc::clone(light_field),
            )));
            line.stages.push(Box::new(SpecularitySubstitution::new(
                &config.substitution,
                Some(Arc::clone(light_field)),
            )));
        }
        None => rolling(config, line),
    }
    Ok(())
}

/// The stages that make a light field of the video's own last frames, and use it.
fn rolling(config: &Config, line: &mut Line) {
    let (reference, witnesses) = (Slot::new(), Slot::new());
    let maker = made_at_once(config, reference.clone(), witnesses.clone());
    line.stages.push(Box::new(RollingLightField::new(&config.rolling, maker)));
    line.stages
        .push(Box::new(PoseRefinement::awaiting(&config.pose_refinement, reference)));
    line.stages
        .push(Box::new(SpecularitySubstitution::awaiting(&config.substitution, witnesses)));
}

/// Makes each light field before the frame that called for it goes on: on a recording nothing hurries, and every run is alike.
fn made_at_once(config: &Config, reference: Slot<Reference>, witnesses: Slot<Witnesses>) -> Maker {
    let (trust, alignment) = (config.survey.clone(), config.pose_refinement.clone());
    let mut told = false;
    Box::new(
        move |batch, camera| match batch.built(camera, &trust, &BuildSettings::default(), &Silent) {
            Ok(light_field) => {
                tracing::debug!("a light field of {} of the last frames", light_field.views.len());
                let light_field = Arc::new(light_field);
                reference.put(Reference::new(Arc::clone(&light_field), &alignment));
                witnesses.put(Witnesses::new(light_field));
            }
            Err(error) if !told => {
                told = true;
                tracing::warn!("specular: no light field could be made of the last frames, a later one may: {error}");
            }
            Err(_) => {}
        },
    )
}
