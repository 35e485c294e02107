//! A serial line without hardware: a pseudo-terminal, one end of which looks like a serial port to any program.

use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::os::unix::ffi::OsStringExt as _;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

/// The arm's end. Dropping it pulls the cable.
#[derive(Debug)]
pub struct PseudoTerminal {
    device: File,
    path: PathBuf,
    link: Option<PathBuf>,
}

impl PseudoTerminal {
    /// A new line; `link` is made to point to it, so that it can be found under the same path again after a pull.
    pub fn open(link: Option<&Path>) -> io::Result<Self> {
        let device = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&device)?;
        unlockpt(&device)?;
        let path = PathBuf::from(std::ffi::OsString::from_vec(ptsname(&device, Vec::new())?.into_bytes()));
        // Opened once and closed: from now on the system tells when nobody listens. Raw, so that bytes pass as they are even
        // for a program that does not ask for that.
        let other_end = File::options().read(true).write(true).open(&path)?;
        let mut mode = tcgetattr(&other_end)?;
        mode.make_raw();
        tcsetattr(&other_end, OptionalActions::Now, &mode)?;
        drop(other_end);
        fcntl_setfl(&device, OFlags::NONBLOCK)?;
        if let Some(link) = link {
            // Beside and then over: there is no instant without the link.
            let beside = link.with_extension("new");
            match std::fs::remove_file(&beside) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
            symlink(&path, &beside)?;
            std::fs::rename(&beside, link)?;
        }
        Ok(Self {
            device: File::from(device),
            path,
            link: link.map(Path::to_owned),
        })
    }

    /// What the other program opens: the link, where there is one.
    pub fn path(&self) -> &Path {
        self.link.as_deref().unwrap_or(&self.path)
    }

    /// True when a program has the other end open.
    pub fn has_listener(&self) -> bool {
        let mut set = [PollFd::new(&self.device, PollFlags::empty())];
        let polled = poll(&mut set, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }));
        polled.is_ok() && set.iter().all(|end| !end.revents().contains(PollFlags::HUP))
    }

    /// As many bytes as fit; 0 when the line is full.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.device.write(bytes) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(0),
            result => result,
        }
    }

    /// What the other program has sent; 0 when nothing.
    pub fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.device.read(buffer) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(0),
            result => result,
        }
    }
}

impl Drop for PseudoTerminal {
    fn drop(&mut self) {
        // Only if it still points here: another line may have taken the path.
        if let Some(link) = &self.link
            && std::fs::read_link(link).is_ok_and(|target| target == self.path)
        {
            let _gone = std::fs::remove_file(link);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_pass_as_they_are_and_listeners_are_seen() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("arm");
        let mut line = PseudoTerminal::open(Some(&link)).unwrap();
        assert!(!line.has_listener());
        let mut other = File::options().read(true).write(true).open(&link).unwrap();
        assert!(line.has_listener());
        let sent: Vec<u8> = (0..=255).collect();
        assert_eq!(line.write(&sent).unwrap(), 256);
        let mut came = [0; 256];
        other.read_exact(&mut came).unwrap();
        assert_eq!(came.as_slice(), sent);
        other.write_all(b"hello").unwrap();
        drop(other);
        assert!(!line.has_listener());
        drop(line);
        assert!(!link.exists() && std::fs::read_link(&link).is_err());
    }
}
