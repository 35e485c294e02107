//! `calibrate`: what must be known of camera, arm and color before the light field can be trusted.

pub mod camera;
pub mod camera_path;
pub mod color;
pub mod color_white;
pub mod hand_eye;
pub mod hand_eye_camera;
pub mod hand_eye_report;
pub mod hand_eye_scene;
pub mod hands;
pub mod oblique;
pub mod pictures;
pub mod pivot;
pub mod pose_files;
pub mod time_offset;
pub mod time_offset_report;

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Subcommand;

use crate::cli::console;
use crate::cli::context::{Context, Ended};

/// Measure camera, arm, clocks and colors.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  endofield calibrate camera pictures/ --board checkerboard:9x6 --square-mm 4 -o camera.yaml
  endofield calibrate hand-eye stations/ --camera camera.yaml --board checkerboard:9x6 --square-mm 4
  endofield calibrate time-offset survey/
  endofield calibrate color chart.png -o color.yaml
  endofield calibrate pivot pointer/*.txt"
)]
pub struct Args {
    #[command(subcommand)]
    subject: Subject,
}

#[derive(Debug, Subcommand)]
enum Subject {
    Camera(camera::Args),
    Color(color::Args),
    HandEye(hand_eye::Args),
    Oblique(oblique::Args),
    TimeOffset(time_offset::Args),
    Pivot(pivot::Args),
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    match &args.subject {
        Subject::Camera(args) => camera::run(args, context),
        Subject::Color(args) => color::run(args, context),
        Subject::HandEye(args) => hand_eye::run(args, context),
        Subject::Oblique(args) => oblique::run(args, context),
        Subject::TimeOffset(args) => time_offset::run(args, context),
        Subject::Pivot(args) => pivot::run(args, context),
    }
}

/// `camera.yaml` → `camera_report.json`.
fn beside(output: &Path, ending: &str) -> PathBuf {
    let stem = output
        .file_stem()
        .map_or_else(|| "result".into(), |stem| stem.to_string_lossy());
    output.with_file_name(format!("{stem}{ending}"))
}

fn write_json(path: &Path, value: &serde_json::Value) -> anyhow::Result<()> {
    std::fs::write(path, format!("{value:#}\n"))
        .with_context(|| format!("{}: cannot be written; check folder, rights and space", path.display()))
}

/// The last line of a calibration: what lies where.
fn say_written(paths: &[&Path]) -> anyhow::Result<()> {
    let names: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    let listed = match names.split_last() {
        Some((last, before)) if !before.is_empty() => format!("{} and {last}", before.join(", ")),
        _ => names.concat(),
    };
    console::print(&format!("\nwrote {listed}\n"))
}
