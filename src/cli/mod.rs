//! The commands; the only place that prints.

pub mod simulate;

use clap::{Parser, Subcommand};

use crate::progress::Silent;

#[derive(Debug, Parser)]
#[command(name = "endofield", version)]
struct Cli {
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
    match Cli::parse().command {
        Command::Simulate(args) => simulate::run(args, &Silent),
    }
}
