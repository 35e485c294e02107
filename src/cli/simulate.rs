//! `simulate`: recordings of a world with known answers.

use std::path::PathBuf;

use anyhow::{Context as _, bail};

use crate::progress::Progress;
use crate::synthetic::arm::ArmSettings;
use crate::synthetic::organs::Anatomy;
use crate::synthetic::simulation::{Settings, Subject, simulate};

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
    /// Frames of the live recording (25 a second).
    #[arg(long, default_value_t = 100)]
    frames: usize,
    /// Frames of the survey (25 a second).
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
    /// Standard deviation of the arm's position per axis, mm.
    #[arg(long, default_value_t = 0.25)]
    pose_noise_mm: f64,
    /// Standard deviation of the arm's orientation per axis, degrees.
    #[arg(long, default_value_t = 0.08)]
    pose_noise_deg: f64,
    /// How late the stamps of the arm's poses are, ms.
    #[arg(long, default_value_t = 40.0)]
    pose_late_ms: f64,
    /// From the hand to the lens, mm.
    #[arg(long, default_value_t = 300.0)]
    scope_mm: f64,
    /// Fill the whole picture instead of a round field.
    #[arg(long)]
    full_frame: bool,
    /// Write into a folder that is not empty: the program's own `--force`, which `main` fills in.
    #[arg(skip)]
    pub force: bool,
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
pub fn run(args: Args, progress: &dyn Progress) -> anyhow::Result<()> {
    let occupied = args.out.read_dir().is_ok_and(|mut entries| entries.next().is_some());
    if occupied && !args.force {
        bail!("{} is not empty; name another folder or add --force", args.out.display());
    }
    let settings = Settings {
        subject: match args.scene {
            Scene::Gall => Subject::Organs(Anatomy::GallBladder),
            Scene::Liver => Subject::Organs(Anatomy::Liver),
            Scene::Calibration => Subject::Board,
        },
        seed: args.seed,
        width: args.size.width,
        height: args.size.height,
        survey_frames: args.survey_frames,
        live_frames: args.frames,
        arm: ArmSettings {
            late_s: args.pose_late_ms * 1e-3,
            position_noise_mm: args.pose_noise_mm,
            rotation_noise_rad: args.pose_noise_deg.to_radians(),
            scope_mm: args.scope_mm,
            ..ArmSettings::default()
        },
        breathing_mm: args.breathing_mm,
        heartbeat_mm: args.heartbeat_mm,
        noise: args.noise,
        instrument: args.instrument,
        particles_per_frame: args.particles,
        smoke: args.smoke,
        field_radius: (!args.full_frame).then_some(0.47),
        ..Settings::default()
    };
    let summary = simulate(&args.out, &settings, progress).with_context(|| format!("simulating into {}", args.out.display()))?;
    tracing::info!(
        frames = summary.frames,
        specular_percent = summary.specular_share * 100.0,
        mean_level = summary.mean_level,
        "simulated"
    );
    Ok(())
}
