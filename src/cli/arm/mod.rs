//! `arm`: the arm's live feed, simulated and watched.

pub mod monitor;
pub mod motion;
pub mod port;
pub mod simulate;

use clap::Subcommand;

use crate::cli::context::{Context, Ended};

/// The arm's live feed: play one, watch one.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example, in two terminals:\n  endofield arm simulate --port /tmp/arm\n  endofield arm monitor --port /tmp/arm"
)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Simulate(simulate::Args),
    Monitor(monitor::Args),
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    match &args.command {
        Command::Simulate(args) => simulate::run(args, context),
        Command::Monitor(args) => monitor::run(args, context),
    }
}
