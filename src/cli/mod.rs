//! The commands; the only place that prints.

pub mod arm;
pub mod bench;
pub mod calibrate;
pub mod console;
pub mod context;
pub mod demo;
pub mod import;
pub mod import_sequence;
pub mod light_field;
pub mod live;
pub mod measure;
pub mod outputs;
pub mod process;
pub mod report;
pub mod simulate;
pub mod telescope;

use std::ffi::OsString;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use clap::error::ErrorKind;
use clap::{Parser, Subcommand};
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::cli::console::Console;
use crate::cli::context::{Context, Ended, Globals, UsageError};
use crate::config::{Config, ConfigError};

/// What a shell sees when the user pressed Ctrl-C.
const INTERRUPTED: u8 = 130;
/// What a shell sees when the command line was wrong.
const BAD_USAGE: u8 = 2;

/// Endoscope video, clearer than the endoscope saw it.
#[derive(Debug, Parser)]
#[command(name = "endofield", version, about, propagate_version = true)]
#[command(
    after_help = "See it run without hardware:\n  endofield demo\n\nEnhance a video:\n  endofield process operation.mp4 -o enhanced.mp4\n\n\
    Exit code: 0 all of the work was done, 1 it was not, 2 bad usage, 130 after Ctrl-C (what was written is playable)."
)]
struct Cli {
    #[command(flatten)]
    globals: Globals,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Calibrate(calibrate::Args),
    Demo(demo::Args),
    Process(process::Args),
    Live(live::run::Args),
    LightField(light_field::Args),
    Simulate(simulate::Args),
    Import(import_sequence::Args),
    Arm(arm::Args),
    Bench(bench::run::Args),
}

/// Run the command line; its outcome as the process's exit code.
pub fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let cli = match Cli::try_parse_from(&arguments) {
        Ok(cli) => cli,
        // `endofield process --print-config` asks for no input.
        Err(error) if is_about_missing(error.kind()) && arguments.iter().any(|argument| argument == "--print-config") => {
            return code_from(Globals::only_configuration(&arguments).and_then(|globals| print_config(&globals)));
        }
        Err(error) => {
            // Nothing can be told to a user whose terminal is gone.
            let _told = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(BAD_USAGE));
        }
    };
    code_from(dispatch(cli))
}

fn is_about_missing(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::MissingRequiredArgument | ErrorKind::MissingSubcommand | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    )
}

fn dispatch(cli: Cli) -> anyhow::Result<Ended> {
    if cli.globals.print_config {
        return print_config(&cli.globals);
    }
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // In this order: the first signal asks for a clean stop, a second one ends the program at once.
        signal_hook::flag::register_conditional_shutdown(signal, i32::from(INTERRUPTED), Arc::clone(&stop))
            .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&stop)))
            .context("expected to be told of Ctrl-C, the system refused")?;
    }
    let console = Console::new(cli.globals.progress, Arc::clone(&stop));
    console.install_log(&cli.globals)?;
    let context = Context {
        config: cli.globals.config()?,
        force: cli.globals.force,
        console,
        stop,
    };
    let result = run(cli.command, &context);
    match result {
        Ok(Ended::Complete) if context.stop.load(Ordering::Acquire) => Ok(Ended::Interrupted),
        // What a command calls an error because it was stopped is what the user wanted.
        Err(error) if context.stop.load(Ordering::Acquire) => {
            tracing::info!("{error:#}");
            Ok(Ended::Interrupted)
        }
        result => result,
    }
}

fn run(command: Command, context: &Context) -> anyhow::Result<Ended> {
    match command {
        Command::Calibrate(args) => calibrate::run(&args, context),
        Command::Demo(args) => demo::run(&args, context),
        Command::Process(args) => process::run(&args, context),
        Command::Live(args) => live::run::run(&args, context),
        Command::LightField(args) => {
            light_field::run(&args, &context.config, context.force, &context.console).map(|()| Ended::Complete)
        }
        Command::Simulate(args) => simulate::run(args, context),
        Command::Import(args) => import_sequence::run(&args, context),
        Command::Arm(args) => arm::run(&args, context),
        Command::Bench(args) => bench::run::run(&args, context),
    }
}

fn print_config(globals: &Globals) -> anyhow::Result<Ended> {
    let config: Config = globals.config()?;
    console::print(&config.to_toml())?;
    Ok(Ended::Complete)
}

fn code_from(result: anyhow::Result<Ended>) -> ExitCode {
    match result {
        Ok(Ended::Complete) => ExitCode::SUCCESS,
        Ok(Ended::Incomplete) => ExitCode::FAILURE,
        Ok(Ended::Interrupted) => ExitCode::from(INTERRUPTED),
        Err(error) => {
            console::print_error(&error);
            let of_usage =
                error.downcast_ref::<UsageError>().is_some() || matches!(error.downcast_ref(), Some(ConfigError::Set { .. }));
            if of_usage {
                ExitCode::from(BAD_USAGE)
            } else {
                ExitCode::FAILURE
            }
        }
    }
}
