//! Where the bytes come from: a serial port, standard input, or a file.
//!
//! All are read with a time-out, so that silence and the wish to stop are noticed. A port is locked for this program alone.

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serialport::{ClearBuffer, DataBits, SerialPort as _, StopBits, TTYPort};

use crate::robot::feed::settings::{DataTerminalReady, FlowControl, Parity, Settings};

/// A read waits at most so long.
pub const READ_TIMEOUT: Duration = Duration::from_millis(10);

/// Where the bytes come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LineSource {
    /// A serial port, or what looks like one.
    Port(PathBuf),
    /// Standard input.
    Input,
    /// A file of recorded bytes or lines.
    File(PathBuf),
}

impl LineSource {
    /// `-` is standard input; an existing file that is no device is a file; all else is a port, there or not yet.
    pub fn from_word(word: &str) -> Self {
        let path = PathBuf::from(word);
        match std::fs::metadata(&path) {
            _ if word == "-" => Self::Input,
            Ok(found) if found.is_file() => Self::File(path),
            _ => Self::Port(path),
        }
    }
}

/// Why a line cannot be opened: what a person reads.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LineError {
    /// No such path.
    #[error("{}: not there; is the adapter plugged in? (`ls /dev/serial/by-id` names those that are)", .0.display())]
    Missing(PathBuf),
    /// Another program has it.
    #[error("{}: in use by another program", .0.display())]
    Busy(PathBuf),
    /// Rights.
    #[error("{}: permission denied; serial ports usually belong to the group `dialout`", .0.display())]
    Denied(PathBuf),
    /// A path, but to something else.
    #[error("{}: expected a serial port, found something else", .0.display())]
    NoPort(PathBuf),
    /// Anything else.
    #[error("{}: {reason}", path.display())]
    Other {
        /// The port.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
}

/// What a read brought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Heard {
    /// So many bytes.
    Bytes(usize),
    /// None in time.
    Nothing,
    /// There will be no more.
    End,
}

/// An open line.
#[derive(Debug)]
pub struct Line {
    end: End,
    /// Which device the port's path led to.
    device: Option<u64>,
}

#[derive(Debug)]
enum End {
    Port(TTYPort),
    Input(io::Stdin),
    File(File),
}

fn device_of(path: &Path) -> Option<u64> {
    std::fs::metadata(path).ok().map(|found| found.rdev())
}

/// Open a serial port with all of its parameters.
pub fn open_port(path: &Path, settings: &Settings) -> Result<TTYPort, LineError> {
    let other = |reason: String| LineError::Other {
        path: path.to_owned(),
        reason,
    };
    match std::fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(LineError::Missing(path.to_owned())),
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => return Err(LineError::Denied(path.to_owned())),
        Err(error) => return Err(other(error.to_string())),
        Ok(found) if !found.file_type().is_char_device() => return Err(LineError::NoPort(path.to_owned())),
        Ok(_) => {}
    }
    let name = path.to_str().ok_or_else(|| other("expected a path in UTF-8".to_owned()))?;
    let builder = serialport::new(name, settings.baud)
        .data_bits(match settings.data_bits {
            5 => DataBits::Five,
            6 => DataBits::Six,
            7 => DataBits::Seven,
            _ => DataBits::Eight,
        })
        .parity(match settings.parity {
            Parity::None => serialport::Parity::None,
            Parity::Odd => serialport::Parity::Odd,
            Parity::Even => serialport::Parity::Even,
        })
        .stop_bits(if settings.stop_bits == 2 {
            StopBits::Two
        } else {
            StopBits::One
        })
        .flow_control(match settings.flow_control {
            FlowControl::None => serialport::FlowControl::None,
            FlowControl::Software => serialport::FlowControl::Software,
            FlowControl::Hardware => serialport::FlowControl::Hardware,
        })
        .timeout(READ_TIMEOUT);
    let builder = match settings.dtr {
        DataTerminalReady::Keep => builder.preserve_dtr_on_open(),
        DataTerminalReady::On => builder.dtr_on_open(true),
        DataTerminalReady::Off => builder.dtr_on_open(false),
    };
    let port = builder.open_native().map_err(|error| match error.kind() {
        _ if !path.exists() => LineError::Missing(path.to_owned()),
        serialport::ErrorKind::Io(io::ErrorKind::PermissionDenied) => LineError::Denied(path.to_owned()),
        serialport::ErrorKind::NoDevice | serialport::ErrorKind::Io(io::ErrorKind::ResourceBusy) => {
            LineError::Busy(path.to_owned())
        }
        _ if error.to_string().contains("Not a typewriter") => LineError::NoPort(path.to_owned()),
        _ => other(error.to_string()),
    })?;
    // Drivers may round to what the hardware can; far off, every byte is garbage.
    if let Ok(baud) = port.baud_rate()
        && baud.abs_diff(settings.baud) > settings.baud / 20
    {
        tracing::warn!(
            "{}: asked for {} baud, the port runs at {baud}",
            path.display(),
            settings.baud
        );
    }
    Ok(port)
}

impl Line {
    /// Open it. What a port has collected before is thrown away: its age is unknown.
    pub fn open(source: &LineSource, settings: &Settings) -> Result<Self, LineError> {
        match source {
            LineSource::Input => Ok(Self {
                end: End::Input(io::stdin()),
                device: None,
            }),
            LineSource::File(path) => match File::open(path) {
                Ok(file) => Ok(Self {
                    end: End::File(file),
                    device: None,
                }),
                Err(error) if error.kind() == io::ErrorKind::NotFound => Err(LineError::Missing(path.clone())),
                Err(error) => Err(LineError::Other {
                    path: path.clone(),
                    reason: error.to_string(),
                }),
            },
            LineSource::Port(path) => {
                // Asked before opening: if the path changes in between, the line is found to be another one and opened anew.
                let device = device_of(path);
                let port = open_port(path, settings)?;
                if let Err(error) = port.clear(ClearBuffer::Input) {
                    tracing::debug!("{}: cannot clear its input: {error}", path.display());
                }
                Ok(Self {
                    end: End::Port(port),
                    device,
                })
            }
        }
    }

    /// True when the path by now leads to another device, or nowhere: a port may die without a word.
    pub fn is_elsewhere(&self, source: &LineSource) -> bool {
        match source {
            LineSource::Port(path) => self.device != device_of(path),
            _ => false,
        }
    }

    /// Say something to the arm.
    pub fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match &mut self.end {
            End::Port(port) => port.write_all(bytes),
            // A file and a pipe only talk.
            End::Input(_) | End::File(_) => Ok(()),
        }
    }

    /// Wait a little for bytes.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<Heard> {
        let result = match &mut self.end {
            End::Port(port) => match port.read(buffer) {
                Ok(0) => {
                    return Err(io::Error::new(
                        io::ErrorKind::BrokenPipe,
                        "the port was closed from the other side",
                    ));
                }
                result => result,
            },
            End::File(file) => file.read(buffer),
            End::Input(input) => {
                let wait = Timespec {
                    tv_sec: 0,
                    tv_nsec: i64::from(READ_TIMEOUT.subsec_nanos()),
                };
                match poll(&mut [PollFd::new(&*input, PollFlags::IN)], Some(&wait)) {
                    Ok(0) => return Ok(Heard::Nothing),
                    // Not through std's buffer, which poll does not see.
                    Ok(_) => rustix::io::read(&*input, buffer).map_err(io::Error::from),
                    Err(error) => Err(error.into()),
                }
            }
        };
        match result {
            Ok(0) => Ok(Heard::End),
            Ok(count) => Ok(Heard::Bytes(count)),
            Err(error) if is_patience(error.kind()) => Ok(Heard::Nothing),
            Err(error) => Err(error),
        }
    }
}

fn is_patience(kind: io::ErrorKind) -> bool {
    matches!(
        kind,
        io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::feed::pseudo_terminal::PseudoTerminal;

    #[test]
    fn words_become_sources() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("poses.tum");
        std::fs::write(&file, "x").unwrap();
        assert_eq!(LineSource::from_word("-"), LineSource::Input);
        assert_eq!(LineSource::from_word(file.to_str().unwrap()), LineSource::File(file));
        assert!(matches!(LineSource::from_word("/dev/ttyUSB77"), LineSource::Port(_)));
    }

    #[test]
    fn what_cannot_be_opened_is_named() {
        let open = |word: &str| Line::open(&LineSource::Port(word.into()), &Settings::default()).unwrap_err();
        assert!(open("/dev/ttyNotThere").to_string().contains("not there"));
        let folder = tempfile::tempdir().unwrap();
        let message = open(folder.path().to_str().unwrap()).to_string();
        assert!(message.contains("expected a serial port"), "{message}");
        let message = open("/dev/null").to_string();
        assert!(message.contains("expected a serial port"), "{message}");
        let line = PseudoTerminal::open(None).unwrap();
        let _taken = open_port(line.path(), &Settings::default()).unwrap();
        assert!(open(line.path().to_str().unwrap()).to_string().contains("in use"));
    }

    #[test]
    fn a_port_takes_every_parameter() {
        let line = PseudoTerminal::open(None).unwrap();
        let settings = Settings {
            baud: 38_400,
            parity: Parity::Even,
            stop_bits: 2,
            dtr: DataTerminalReady::On,
            ..Settings::default()
        };
        let port = open_port(line.path(), &settings).unwrap();
        assert_eq!(port.baud_rate().unwrap(), 38_400);
        assert_eq!(port.stop_bits().unwrap(), StopBits::Two);
    }

    #[test]
    fn silence_bytes_and_a_hang_up_are_told_apart() {
        let mut arm = PseudoTerminal::open(None).unwrap();
        let source = LineSource::Port(arm.path().to_owned());
        let mut line = Line::open(&source, &Settings::default()).unwrap();
        let mut buffer = [0; 64];
        assert_eq!(line.read(&mut buffer).unwrap(), Heard::Nothing);
        arm.write(b"abc").unwrap();
        let heard = (0..100).find_map(|_| Some(line.read(&mut buffer).unwrap()).filter(|heard| *heard != Heard::Nothing));
        assert_eq!(heard, Some(Heard::Bytes(3)));
        assert!(!line.is_elsewhere(&source));
        drop(arm);
        assert!(line.read(&mut buffer).is_err());
    }
}
