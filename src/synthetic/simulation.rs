//! A whole simulated operation: survey and live recording of one world, with the truth.

use std::fmt::Write as _;
use std::path::Path;

use rayon::prelude::*;
use serde_json::json;

use crate::geometry::transform::Transform;
use crate::media::writer::{Output, VideoWriter, WriterSettings};
use crate::progress::Progress;
use crate::robot::kinematics::ArmError;
use crate::synthetic::airborne::Smoke;
use crate::synthetic::arm::{ArmModel, ArmReading, ArmSettings, arm_readings, world_from_camera_at_work};
use crate::synthetic::export::{
    ExportError, make_folder, write_arm, write_camera, write_hand_eye, write_mask, write_poses, write_rgb, write_text, write_true_arm, write_u16,
};
use crate::synthetic::noise::hash_u64;
use crate::synthetic::organs::Anatomy;
use crate::synthetic::renderer::{Obstacles, Rendered, Renderer, Shot};
use crate::synthetic::scene::{World3d, laparoscope};
use crate::synthetic::sensor::AutoExposure;
use crate::synthetic::trajectory::{Course, Trajectory};
use crate::time::Timestamp;

/// How the pictures of a recording are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    /// `video.mp4`, near-lossless.
    Video,
    /// `frames/%06d.png`.
    Pictures,
}

/// What to simulate.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Which organs.
    pub anatomy: Anatomy,
    /// Everything random follows from it.
    pub seed: u64,
    /// Columns of the pictures.
    pub width: usize,
    /// Rows of the pictures.
    pub height: usize,
    /// Frames a second.
    pub frame_rate_hz: f64,
    /// Frames of the survey; 0 = none.
    pub survey_frames: usize,
    /// Frames of the live recording; 0 = none.
    pub live_frames: usize,
    /// How the pictures are stored.
    pub storage: Storage,
    /// How the arm measures.
    pub arm: ArmSettings,
    /// Stroke of a breath, mm.
    pub breathing_mm: f64,
    /// Stroke of a heartbeat, mm.
    pub heartbeat_mm: f64,
    /// Sensor noise; 1 = about one level.
    pub noise: f64,
    /// A grasper crosses the live recording.
    pub instrument: bool,
    /// Particles in a frame of the live recording, on average.
    pub particles_per_frame: f64,
    /// Optical depth of the thickest smoke in the live recording.
    pub smoke: f64,
    /// Radius of the round image field in widths of the picture; `None` = no field stop.
    pub field_radius: Option<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            anatomy: Anatomy::GallBladder,
            seed: 1,
            width: 960,
            height: 540,
            frame_rate_hz: 25.0,
            survey_frames: 72,
            live_frames: 100,
            storage: Storage::Video,
            arm: ArmSettings::default(),
            breathing_mm: 0.0,
            heartbeat_mm: 0.0,
            noise: 1.0,
            instrument: false,
            particles_per_frame: 0.0,
            smoke: 0.0,
            field_radius: Some(0.47),
        }
    }
}

/// A simulation failed.
#[derive(Debug, thiserror::Error)]
pub enum SimulationError {
    /// A setting cannot be.
    #[error("`{key}` is {value}, expected {expected}")]
    Setting {
        /// Which.
        key: &'static str,
        /// What it was.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// A file could not be written.
    #[error(transparent)]
    Export(#[from] ExportError),
    /// The arm cannot do what it shall.
    #[error("the simulated arm: {0}")]
    Arm(#[from] ArmError),
    /// The user stopped it.
    #[error("stopped; what was written so far is kept")]
    Stopped,
}

/// What came of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Summary {
    /// Frames rendered.
    pub frames: usize,
    /// Mean share of specular pixels where the truth was written.
    pub specular_share: f64,
    /// Mean level of the pictures inside the field.
    pub mean_level: f64,
}

/// The stretch of arm readings before and after the pictures, s.
pub(super) const POSE_MARGIN_S: f64 = 0.4;

impl Settings {
    pub(super) fn checked(&self) -> Result<(), SimulationError> {
        let fault = |key, value: String, expected| Err(SimulationError::Setting { key, value, expected });
        if !(64..=8192).contains(&self.width) || !(48..=8192).contains(&self.height) {
            return fault("size", format!("{}x{}", self.width, self.height), "64x48 to 8192x8192");
        }
        if !(1.0..=240.0).contains(&self.frame_rate_hz) {
            return fault("frame_rate_hz", self.frame_rate_hz.to_string(), "1 to 240");
        }
        if !(1.0..=2000.0).contains(&self.arm.rate_hz) {
            return fault("arm rate", self.arm.rate_hz.to_string(), "1 to 2000 Hz");
        }
        Ok(())
    }
}

/// One recording before it is rendered.
struct Plan {
    name: &'static str,
    shots: Vec<Shot>,
    readings: Vec<ArmReading>,
}

/// Simulate an operation into `out`: `survey`, `live` and `truth`.
pub fn simulate(out: &Path, settings: &Settings, progress: &dyn Progress) -> Result<Summary, SimulationError> {
    settings.checked()?;
    let renderer = renderer_of(settings)?;
    let mut plans = Vec::new();
    if settings.survey_frames > 0 {
        plans.push(planned("survey", Course::Survey, settings.survey_frames, settings, &renderer)?);
    }
    if settings.live_frames > 0 {
        plans.push(planned("live", Course::Live, settings.live_frames, settings, &renderer)?);
    }
    let mut summary = Summary::default();
    for plan in &plans {
        write_recording(out, plan, settings, &renderer)?;
        render_recording(out, plan, settings, &renderer, progress, &mut summary)?;
    }
    let frames = summary.frames.max(1) as f64;
    summary.specular_share /= frames;
    summary.mean_level /= frames;
    write_mask(&out.join("truth/field.png"), &renderer.field_mask())?;
    write_text(&out.join("truth/truth.json"), &truth_json(settings, &plans, &summary))?;
    Ok(summary)
}

/// The world and the camera of `settings`.
pub(super) fn renderer_of(settings: &Settings) -> Result<Renderer, SimulationError> {
    let camera = laparoscope(settings.width, settings.height);
    let mut world = World3d::new(settings.anatomy, settings.seed, settings.width);
    world.motion.breathing_mm = settings.breathing_mm;
    world.motion.heartbeat_mm = settings.heartbeat_mm;
    if matches!(settings.arm.model, ArmModel::Joints(_)) {
        // The patient lies where the arm can reach.
        let organs_from_camera = Trajectory::new(Course::Still, 1.0, Transform::identity()).world_from_camera(0.0);
        let at_work = world_from_camera_at_work(settings.arm.scope_mm)?;
        world.world_from_organs = at_work * Transform::from_isometry(*organs_from_camera.inverse().isometry());
    }
    Ok(Renderer::new(world, camera, settings.field_radius, settings.noise))
}

fn planned(name: &'static str, course: Course, frames: usize, settings: &Settings, renderer: &Renderer) -> Result<Plan, SimulationError> {
    let duration_s = frames as f64 / settings.frame_rate_hz;
    let trajectory = Trajectory::new(course, duration_s, renderer.world().world_from_organs);
    let times: Vec<f64> = (0..frames).map(|frame| frame as f64 / settings.frame_rate_hz).collect();
    let metered: Vec<Vec<f32>> =
        times.par_iter().map(|&t| renderer.metered(t, trajectory.world_from_camera(t))).collect();
    let exposures = AutoExposure::default().exposures(&metered, renderer.sensor());
    // The survey's noise is not the live recording's.
    let seed = hash_u64(settings.seed ^ hash_u64(name.len() as u64));
    let obstacles = if course == Course::Survey {
        Obstacles::default()
    } else {
        Obstacles {
            instrument: settings.instrument,
            particles_per_frame: settings.particles_per_frame,
            smoke: (settings.smoke > 0.0).then(|| Smoke::new(seed, settings.smoke, duration_s)),
        }
    };
    let shots = times
        .iter()
        .zip(exposures)
        .enumerate()
        .map(|(frame, (&seconds, exposure))| Shot {
            frame: frame as u64,
            seconds,
            world_from_camera: trajectory.world_from_camera(seconds),
            exposure,
            noise_key: seed,
            obstacles,
        })
        .collect();
    let readings = arm_readings(&settings.arm, seed, -POSE_MARGIN_S, duration_s + POSE_MARGIN_S, |t| {
        trajectory.world_from_camera(t)
    })?;
    Ok(Plan { name, shots, readings })
}

/// Everything but the pictures.
fn write_recording(out: &Path, plan: &Plan, settings: &Settings, renderer: &Renderer) -> Result<(), SimulationError> {
    let folder = out.join(plan.name);
    let truth = out.join("truth").join(plan.name);
    make_folder(&folder)?;
    for kind in ["diffuse", "specular", "strength", "instrument", "depth"] {
        make_folder(&truth.join(kind))?;
    }
    if plan.shots.iter().any(|shot| shot.obstacles.particles_per_frame > 0.0) {
        for kind in ["particles", "particles_video", "clean"] {
            make_folder(&truth.join(kind))?;
        }
    }
    let mut frames = String::from("frame,timestamp_s\n");
    let mut exposures = String::from("frame,timestamp_s,exposure\n");
    for shot in &plan.shots {
        // Writing to a String cannot fail.
        let _infallible = writeln!(frames, "{},{:.6}", shot.frame, shot.seconds);
        let _infallible = writeln!(exposures, "{},{:.6},{:.8}", shot.frame, shot.seconds, shot.exposure);
    }
    write_text(&folder.join("frames.csv"), &frames)?;
    write_text(&truth.join("exposure.csv"), &exposures)?;
    write_arm(&folder, &plan.readings)?;
    write_true_arm(&truth, &plan.readings)?;
    write_camera(&folder.join("camera.yaml"), renderer.camera())?;
    write_camera(&truth.join("camera.yaml"), &renderer.camera().pinhole())?;
    write_hand_eye(&folder.join("hand_eye.yaml"), settings.arm.scope_mm)?;
    let exact = plan.shots.iter().map(|shot| (shot.seconds, shot.world_from_camera));
    write_poses(&truth.join("camera_poses.tum"), "T_world_camera", exact)?;
    Ok(())
}

/// Frames rendered at a time, then written in order; the same whatever the number of threads.
const BATCH: usize = 8;

fn render_recording(
    out: &Path,
    plan: &Plan,
    settings: &Settings,
    renderer: &Renderer,
    progress: &dyn Progress,
    summary: &mut Summary,
) -> Result<(), SimulationError> {
    progress.begin(&format!("rendering {}", plan.name), plan.shots.len() as u64);
    let truth = out.join("truth").join(plan.name);
    let mut video = video_writer(&out.join(plan.name), settings)?;
    for batch in plan.shots.chunks(BATCH) {
        let rendered: Vec<(Rendered, [f64; 2])> = batch
            .par_iter()
            .map(|shot| {
                let rendered = renderer.render(shot, true);
                write_truth(&truth, shot.frame, &rendered)?;
                let figures = measured(&rendered);
                Ok((Rendered { truth: None, without_particles: None, ..rendered }, figures))
            })
            .collect::<Result<_, ExportError>>()?;
        for (shot, (rendered, [specular, level])) in batch.iter().zip(&rendered) {
            video.write(&rendered.video, Timestamp::from_seconds(shot.seconds)).map_err(ExportError::from)?;
            summary.specular_share += specular;
            summary.mean_level += level;
            summary.frames += 1;
            progress.advance(1);
        }
        if progress.stopping() {
            video.finish().map_err(ExportError::from)?;
            return Err(SimulationError::Stopped);
        }
    }
    video.finish().map_err(ExportError::from)?;
    progress.end();
    Ok(())
}

/// `video.mp4` or `frames/%06d.png` in `folder`; an existing one is replaced (whether it may be was asked before).
pub(super) fn video_writer(folder: &Path, settings: &Settings) -> Result<VideoWriter, SimulationError> {
    // Milliseconds: the rate of the pictures need not be a whole number.
    let rate = ((settings.frame_rate_hz * 1000.0).round() as i32, 1000);
    let encoding = WriterSettings {
        // Noise of one level survives; the file stays a tenth of PNGs.
        crf: 5,
        ..WriterSettings::new(settings.width, settings.height, rate)
    };
    let output = match settings.storage {
        Storage::Video => Output::File(folder.join("video.mp4")),
        Storage::Pictures => {
            make_folder(&folder.join("frames"))?;
            Output::Images(folder.join("frames"))
        }
    };
    Ok(VideoWriter::create(&output, &encoding, true).map_err(ExportError::from)?)
}

fn write_truth(folder: &Path, frame: u64, rendered: &Rendered) -> Result<(), ExportError> {
    let name = format!("{frame:06}.png");
    if let Some((clean, mask)) = &rendered.without_particles {
        write_rgb(&folder.join("clean").join(&name), clean)?;
        write_mask(&folder.join("particles_video").join(&name), mask)?;
    }
    if let Some(exact) = &rendered.truth {
        write_rgb(&folder.join("diffuse").join(&name), &exact.diffuse)?;
        write_mask(&folder.join("specular").join(&name), &exact.specular)?;
        write_mask(&folder.join("strength").join(&name), &exact.strength)?;
        write_mask(&folder.join("instrument").join(&name), &exact.instrument)?;
        if rendered.without_particles.is_some() {
            write_mask(&folder.join("particles").join(&name), &exact.particles)?;
        }
        write_u16(&folder.join("depth").join(&name), &exact.depth)?;
    }
    Ok(())
}

/// Share of specular pixels, and mean level of the picture inside the field.
fn measured(rendered: &Rendered) -> [f64; 2] {
    let specular = rendered.truth.as_ref().map_or(0.0, |truth| {
        let count = truth.specular.pixels().iter().filter(|&&m| m > 0).count();
        count as f64 / truth.specular.pixels().len() as f64
    });
    let lit = rendered.video.pixels().iter().filter(|p| p.iter().any(|&v| v > 6));
    let (count, sum) = lit.fold((0_u64, 0_u64), |(count, sum), p| {
        (count + 3, sum + p.iter().map(|&v| u64::from(v)).sum::<u64>())
    });
    [specular, sum as f64 / count.max(1) as f64]
}

fn truth_json(settings: &Settings, plans: &[Plan], summary: &Summary) -> String {
    let recordings: Vec<&str> = plans.iter().map(|plan| plan.name).collect();
    let value = json!({
        "unit": "mm",
        "seed": settings.seed,
        "recordings": recordings,
        "geometry": "undistorted: pinhole with the recording's camera matrix and size",
        "files": {
            "<recording>/diffuse/%06d.png": "8-bit sRGB, without mirror reflections and noise, same exposure",
            "<recording>/specular/%06d.png": "255 where the full picture is more than 12 levels (luma) above the diffuse one",
            "<recording>/strength/%06d.png": "levels (luma) above the diffuse picture",
            "<recording>/instrument/%06d.png": "255 where an instrument is seen",
            "<recording>/particles/%06d.png": "255 where a particle is seen, if there are any",
            "<recording>/particles_video/%06d.png": "the same in the video's own, distorted geometry",
            "<recording>/clean/%06d.png": "the video's frame without particles, same noise, in the video's own geometry",
            "<recording>/depth/%06d.png": "16-bit, hundredths of a mm along the optical axis; 0 outside the field",
            "<recording>/camera_poses.tum": "T_world_camera at each frame's exposure",
            "<recording>/hand_poses.tum": "T_base_hand, exact, on the camera's clock",
            "<recording>/joints.csv": "exact joint values (mm, rad) on the camera's clock, where the arm is a chain of joints",
            "<recording>/exposure.csv": "factor on the light",
            "<recording>/camera.yaml": "the pinhole camera of the truth",
            "field.png": "255 inside the image field, undistorted",
        },
        "time_offset_s": -settings.arm.late_s,
        "arm": arm_json(&settings.arm),
        "motion": { "breathing_mm": settings.breathing_mm, "heartbeat_mm": settings.heartbeat_mm },
        "obstacles": {
            "instrument": settings.instrument,
            "particles_per_frame": settings.particles_per_frame,
            "smoke_optical_depth": settings.smoke,
        },
        "specular_share": summary.specular_share,
        "mean_level": summary.mean_level,
    });
    format!("{value:#}\n")
}

fn arm_json(arm: &ArmSettings) -> serde_json::Value {
    match &arm.model {
        ArmModel::PoseNoise { position_mm, rotation_rad } => json!({
            "rate_hz": arm.rate_hz,
            "position_noise_mm": position_mm,
            "rotation_noise_rad": rotation_rad,
        }),
        ArmModel::Joints(errors) => json!({
            "rate_hz": arm.rate_hz,
            "joint_errors": {
                "offset_mm": errors.offset_mm,
                "offset_rad": errors.offset_rad,
                "backlash_mm": errors.backlash_mm,
                "backlash_rad": errors.backlash_rad,
                "noise_mm": errors.noise_mm,
                "noise_rad": errors.noise_rad,
            },
        }),
    }
}
