//! The end of the line that a simulated arm holds: a serial port, or a pseudo-terminal of its own.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use serialport::TTYPort;

use crate::cli::context::UsageError;
use crate::robot::feed::line::{LineError, open_port};
use crate::robot::feed::pseudo_terminal::PseudoTerminal;
use crate::robot::feed::settings::Settings;

/// More than this is not kept for a listener who is too slow: a wire does not wait.
const MOST_PENDING_BYTES: usize = 4096;

/// Which end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortChoice {
    /// A serial port that is there.
    Serial(PathBuf),
    /// A pseudo-terminal, under a path of its own if it has one.
    Pseudo(Option<PathBuf>),
}

impl PortChoice {
    /// `pty`, the path of a port, or a path at which nothing is yet: a pseudo-terminal appears there.
    pub fn from_word(word: &str) -> anyhow::Result<Self> {
        let path = PathBuf::from(word);
        if word == "pty" {
            return Ok(Self::Pseudo(None));
        }
        if path.exists() {
            return Ok(Self::Serial(path));
        }
        let parent = path
            .parent()
            .filter(|parent| !parent.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        if parent.starts_with("/dev") && !parent.starts_with("/dev/shm") {
            return Err(LineError::Missing(path).into());
        }
        if !parent.is_dir() {
            let message = format!(
                "{word}: expected a serial port, `pty`, or a new name in an existing folder; {} is none",
                parent.display()
            );
            return Err(UsageError(message).into());
        }
        Ok(Self::Pseudo(Some(path)))
    }
}

/// The open end.
#[derive(Debug)]
pub enum ArmPort {
    /// A serial port.
    Serial {
        /// The port.
        port: TTYPort,
        /// Its path.
        path: PathBuf,
    },
    /// A pseudo-terminal and what has not fitted into it yet.
    Pseudo {
        /// The arm's end of it.
        line: PseudoTerminal,
        /// The rest of a packet.
        pending: Vec<u8>,
    },
}

/// What became of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sent {
    /// On their way.
    Whole,
    /// Nobody listens.
    Unheard,
    /// The listener is too slow.
    Overrun,
}

impl ArmPort {
    /// Open it.
    pub fn open(choice: &PortChoice, settings: &Settings) -> anyhow::Result<Self> {
        Ok(match choice {
            PortChoice::Serial(path) => Self::Serial {
                port: open_port(path, settings)?,
                path: path.clone(),
            },
            PortChoice::Pseudo(link) => Self::Pseudo {
                line: PseudoTerminal::open(link.as_deref())?,
                pending: Vec::new(),
            },
        })
    }

    /// What a listener opens.
    pub fn path(&self) -> &Path {
        match self {
            Self::Serial { path, .. } => path,
            Self::Pseudo { line, .. } => line.path(),
        }
    }

    /// Send bytes.
    pub fn send(&mut self, bytes: &[u8]) -> io::Result<Sent> {
        match self {
            Self::Serial { port, .. } => match port.write_all(bytes) {
                Ok(()) => Ok(Sent::Whole),
                Err(error) if error.kind() == io::ErrorKind::TimedOut => Ok(Sent::Overrun),
                Err(error) => Err(error),
            },
            Self::Pseudo { line, pending } => {
                if !line.has_listener() {
                    pending.clear();
                    return Ok(Sent::Unheard);
                }
                let overrun = pending.len() + bytes.len() > MOST_PENDING_BYTES;
                if !overrun {
                    pending.extend_from_slice(bytes);
                }
                let written = match line.write(pending) {
                    Ok(written) => written,
                    // The listener left in this instant.
                    Err(error) if error.raw_os_error() == Some(5) => {
                        pending.clear();
                        return Ok(Sent::Unheard);
                    }
                    Err(error) => return Err(error),
                };
                pending.drain(..written.min(pending.len()));
                Ok(if overrun { Sent::Overrun } else { Sent::Whole })
            }
        }
    }
}
