//! What every command is given: its configuration, whether it may overwrite, and where it shows how far it is.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::cli::console::{Console, LogFormat, ProgressMode};
use crate::config::{Assignment, Config};

/// The options that every command has.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Options of every command")]
pub struct Globals {
    /// Say more (-v: what is decided, -vv: everything).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// Say only what went wrong.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
    /// How messages are written to stderr.
    #[arg(long, global = true, value_enum, default_value_t, value_name = "FORMAT")]
    pub log_format: LogFormat,
    /// How progress is shown on stderr: a bar on a terminal, JSON lines for machines.
    #[arg(long, global = true, value_enum, default_value_t, value_name = "HOW")]
    pub progress: ProgressMode,
    /// Overwrite what is there.
    #[arg(long, global = true)]
    pub force: bool,
    /// Read settings from a TOML file (see config/default.toml).
    #[arg(long, global = true, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Change one setting, such as `--set median.window_ms=200`; may be repeated.
    #[arg(long, global = true, value_name = "KEY=VALUE")]
    pub set: Vec<Assignment>,
    /// Print all settings as they stand after --config and --set, and end.
    #[arg(long, global = true)]
    pub print_config: bool,
}

impl Globals {
    /// The configuration that the options ask for.
    pub fn config(&self) -> anyhow::Result<Config> {
        Ok(Config::load(self.config.as_deref(), &self.set)?)
    }

    /// Only `--config` and `--set`, from a command line that lacks what its command needs.
    pub(super) fn only_configuration(arguments: &[OsString]) -> anyhow::Result<Self> {
        let mut globals = Self {
            print_config: true,
            ..Self::default()
        };
        let mut rest = arguments.iter().map(|argument| argument.to_string_lossy().into_owned());
        while let Some(argument) = rest.next() {
            let (name, inline) = match argument.split_once('=') {
                Some((name, value)) => (name.to_owned(), Some(value.to_owned())),
                None => (argument, None),
            };
            if name != "--config" && name != "--set" {
                continue;
            }
            let value = inline
                .or_else(|| rest.next())
                .ok_or_else(|| UsageError(format!("expected a value after {name}")))?;
            if name == "--config" {
                globals.config = Some(value.into());
            } else {
                globals.set.push(value.parse().map_err(UsageError)?);
            }
        }
        Ok(globals)
    }
}

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// All of the work was done.
    Complete,
    /// Some was not; why has been said.
    Incomplete,
    /// The user stopped it; what was written is whole.
    Interrupted,
}

/// The command line asks for something that cannot be meant.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// What every command is given.
#[derive(Debug)]
pub struct Context {
    /// All settings.
    pub config: Config,
    /// Overwrite what is there.
    pub force: bool,
    /// Shows progress.
    pub console: Console,
    /// Set by Ctrl-C.
    pub stop: Arc<AtomicBool>,
}

impl Context {
    /// Refuse to write over `path` unless told to.
    pub fn refuse_overwriting(&self, path: &Path) -> anyhow::Result<()> {
        let occupied = if path.is_dir() {
            path.read_dir().is_ok_and(|mut entries| entries.next().is_some())
        } else {
            path.exists()
        };
        if occupied && !self.force {
            anyhow::bail!(
                "{}: exists already and is not overwritten; remove it, choose another name or pass --force",
                path.display()
            );
        }
        Ok(())
    }
}
