//! What a camera must be able to do, whatever drives it; so that a test can play one that misbehaves.

use std::fmt;
use std::time::Duration;

use crate::media::layout::{Layout, Matrix, Range};
use crate::time::{Span, Timestamp};

/// How a camera delivers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mode {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// How a picture lies in its buffer.
    pub layout: Layout,
    /// Bytes from row to row.
    pub stride: usize,
    /// Its colors.
    pub matrix: Matrix,
    /// Its levels.
    pub range: Range,
    /// Frames a second; 0 = unknown.
    pub frame_rate_hz: f64,
    /// Two pictures in one, line by line.
    pub interlaced: bool,
}

impl Mode {
    /// From frame to frame; zero when unknown.
    pub fn period(&self) -> Span {
        if self.frame_rate_hz > 0.0 {
            Span::from_seconds(1.0 / self.frame_rate_hz)
        } else {
            Span(0)
        }
    }

    /// Bytes of a whole picture; 0 where any number may be whole.
    pub fn bytes(&self) -> usize {
        self.layout
            .rows(self.width, self.height)
            .map_or(0, |(row, rows)| (rows.max(1) - 1) * self.stride.max(row) + row)
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} {}", self.width, self.height, self.layout.name())?;
        if self.frame_rate_hz > 0.0 {
            write!(f, " at {:.4} Hz", (self.frame_rate_hz * 1e3).round() * 1e-3)?;
        }
        if self.interlaced {
            write!(f, ", interlaced")?;
        }
        Ok(())
    }
}

/// What is asked of a camera; what is left open is as the camera has it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wish {
    /// Columns and rows.
    pub size: Option<(usize, usize)>,
    /// Frames a second.
    pub frame_rate_hz: Option<f64>,
    /// How pictures are laid out.
    pub layout: Option<Layout>,
}

/// What is told with a frame's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// When it was exposed, if the driver tells by our clock.
    pub at: Option<Timestamp>,
    /// The driver's count; it begins anew with each stream, and wraps.
    pub sequence: u32,
    /// The driver says that the bytes are damaged.
    pub damaged: bool,
}

/// Why a camera cannot be had, or was lost: what a person reads.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CameraError {
    /// Nothing there; it may come.
    #[error("{0}")]
    Absent(String),
    /// There, and no use however often it is tried.
    #[error("{0}")]
    Unusable(String),
}

/// A camera that may come and go.
pub trait Camera: Send {
    /// What it is called.
    fn name(&self) -> String;
    /// Begin a stream.
    fn open(&mut self, wish: &Wish) -> Result<Box<dyn Stream>, CameraError>;
    /// Wait before trying again.
    fn pause(&mut self, length: Duration) {
        std::thread::sleep(length);
    }
}

/// A camera that delivers.
pub trait Stream: Send {
    /// How.
    fn mode(&self) -> Mode;
    /// Wait for a frame, at most so long: true when one is there.
    fn wait(&mut self, patience: Duration) -> std::io::Result<bool>;
    /// Take the frame that is there; `taken` sees its bytes while they are ours.
    fn take(&mut self, taken: &mut dyn FnMut(&[u8], Stamp)) -> std::io::Result<()>;
    /// Whether a picture comes in at the other end; `None` when the driver cannot tell.
    fn has_signal(&mut self) -> Option<bool> {
        None
    }
    /// True when the device wants another mode, as after a change of the signal's.
    fn wants_other_mode(&mut self) -> bool {
        false
    }
}
