//! `calibrate`: what must be known of camera, arm and color before the light field can be trusted.

pub mod camera;
pub mod pictures;

use clap::Subcommand;

use crate::cli::context::{Context, Ended};

/// Measure the camera from pictures of a board.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  endofield calibrate camera pictures/ --board checkerboard:9x6 --square-mm 4 -o camera.yaml")]
pub struct Args {
    #[command(subcommand)]
    subject: Subject,
}

#[derive(Debug, Subcommand)]
enum Subject {
    Camera(camera::Args),
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    match &args.subject {
        Subject::Camera(args) => camera::run(args, context),
    }
}
