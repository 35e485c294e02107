//! `simulate`: recordings of a world with known answers.

use std::path::PathBuf;

use anyhow::Context as _;

use crate::cli::context::{Context, Ended};
use crate::synthetic::arm::{ArmModel, ArmSettings};
use crate::synthetic::arm_joints::JointErrors;
use crate::synthetic::calibration_scene::simulate_boards;
use crate::synthetic::organs::Anatomy;
use crate::synthetic::simulation::{Settings, SimulationError, Storage, simulate};

/// Make recordings of a simulated operation, with exact truth.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  endofield simulate /tmp/operation --scene gall --size 960x540 --frames 100\n\n\
    writes /tmp/operation/survey and /tmp/operation/live (recordings) and /tmp/operation/truth."
)]
pub struct Args {
    /// Folder to make.
    out: PathBuf,
    /// What lies before the scope.
    #[arg(long, value_enum, default_value_t = Scene::Gall)]
    scene: Scene,
    /// Everything random follows from it; the same seed gives the same files, bit for bit.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Size of the pictures, px.
    #[arg(long, default_value = "960x540", value_parser = size_from_text)]
    size: Size,
    /// Frames a second, of both recordings.
    #[arg(long, default_value_t = 25.0, value_name = "N")]
    fps: f64,
    /// Frames of the live recording.
    #[arg(long, default_value_t = 100)]
    frames: usize,
    /// Frames of the survey.
    #[arg(long, default_value_t = 72)]
    survey_frames: usize,
    /// Stroke of a breath, mm (12 breaths a minute).
    #[arg(long, default_value_t = 0.0)]
    breathing_mm: f64,
    /// Stroke of a heartbeat, mm (72 beats a minute).
    #[arg(long, default_value_t = 0.0)]
    heartbeat_mm: f64,
    /// A steel grasper crosses the live recording.
    #[arg(long)]
    instrument: bool,
    /// Particles in a frame of the live recording, on average.
    #[arg(long, default_value_t = 0.0)]
    particles: f64,
    /// Optical depth of the thickest smoke in the live recording (1 = dense).
    #[arg(long, default_value_t = 0.0)]
    smoke: f64,
    /// Sensor noise; 1 = about one level.
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// How the arm errs: white noise on its poses (poses.tum), or offsets, backlash and noise of its joints (joints.csv).
    #[arg(long, value_enum, default_value_t = ArmKind::PoseNoise)]
    arm: ArmKind,
    /// How the pictures are stored: near-lossless H.264, or numbered PNGs (always, for --scene calibration).
    #[arg(long, value_enum, default_value_t = VideoKind::Mp4)]
    video: VideoKind,
    /// Standard deviation of the arm's position per axis, mm.
    #[arg(long, default_value_t = 0.25)]
    pose_noise_mm: f64,
    /// Standard deviation of the arm's orientation per axis, degrees.
    #[arg(long, default_value_t = 0.08)]
    pose_noise_deg: f64,
    /// How late the stamps of the arm's poses are, ms.
    #[arg(long, default_value_t = 40.0, allow_negative_numbers = true)]
    pose_late_ms: f64,
    /// From the hand to the lens, mm.
    #[arg(long, default_value_t = 300.0)]
    scope_mm: f64,
    /// Fill the whole picture instead of a round field.
    #[arg(long)]
    full_frame: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Scene {
    /// Gall bladder on its liver bed.
    Gall,
    /// Two liver lobes.
    Liver,
    /// A checkerboard, 9x6 corners of 4 mm: waved before a still scope (survey), and still before a moving one (live).
    Calibration,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ArmKind {
    /// White noise on the poses.
    PoseNoise,
    /// An AESOP 3000 whose joints err.
    Joints,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum VideoKind {
    /// `video.mp4`.
    Mp4,
    /// `frames/%06d.png`.
    Png,
}

#[derive(Clone, Copy, Debug)]
struct Size {
    width: usize,
    height: usize,
}

fn size_from_text(text: &str) -> Result<Size, String> {
    let parsed = text.split_once('x').and_then(|(w, h)| {
        Some(Size {
            width: w.parse().ok()?,
            height: h.parse().ok()?,
        })
    });
    parsed.ok_or_else(|| format!("expected WIDTHxHEIGHT such as 960x540, found `{text}`"))
}

/// Run it.
pub fn run(args: Args, context: &Context) -> anyhow::Result<Ended> {
    context.refuse_overwriting(&args.out)?;
    let settings = Settings {
        anatomy: match args.scene {
            Scene::Gall => Anatomy::GallBladder,
            Scene::Liver | Scene::Calibration => Anatomy::Liver,
        },
        seed: args.seed,
        width: args.size.width,
        height: args.size.height,
        frame_rate_hz: args.fps,
        survey_frames: args.survey_frames,
        live_frames: args.frames,
        arm: ArmSettings {
            late_s: args.pose_late_ms * 1e-3,
            model: match args.arm {
                ArmKind::PoseNoise => ArmModel::PoseNoise {
                    position_mm: args.pose_noise_mm,
                    rotation_rad: args.pose_noise_deg.to_radians(),
                },
                ArmKind::Joints => ArmModel::Joints(JointErrors::default()),
            },
            scope_mm: args.scope_mm,
            ..ArmSettings::default()
        },
        breathing_mm: args.breathing_mm,
        heartbeat_mm: args.heartbeat_mm,
        storage: match args.video {
            VideoKind::Mp4 => Storage::Video,
            VideoKind::Png => Storage::Pictures,
        },
        noise: args.noise,
        instrument: args.instrument,
        particles_per_frame: args.particles,
        smoke: args.smoke,
        field_radius: (!args.full_frame).then_some(0.47),
    };
    let made = if args.scene == Scene::Calibration {
        simulate_boards(&args.out, &settings, &context.console)
    } else {
        simulate(&args.out, &settings, &context.console)
    };
    let summary = match made {
        Ok(summary) => summary,
        Err(SimulationError::Stopped) => return Ok(Ended::Interrupted),
        Err(error) => return Err(error).with_context(|| format!("simulating into {}", args.out.display())),
    };
    tracing::info!(
        frames = summary.frames,
        specular_percent = summary.specular_share * 100.0,
        mean_level = summary.mean_level,
        "simulated"
    );
    Ok(Ended::Complete)
}
