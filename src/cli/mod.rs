//! The commands; the only place that prints.

pub mod simulate;

use clap::{Parser, Subcommand};

use crate::progress::Silent;

#[derive(Debug, Parser)]
#[command(name = "endofield", version)]
struct Cli {
    /// Overwrite what is there.
    #[arg(long, global = true)]
    force: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make recordings of a simulated operation, with exact truth.
    Simulate(simulate::Args),
}

/// Run the command line.
pub fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    match cli.command {
        Command::Simulate(mut args) => {
            args.force = cli.force;
            simulate::run(args, &Silent)
        }
    }
}
