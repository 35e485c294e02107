//! What a camera must be able to do, whatever drives it; so that a test can play one that misbehaves.

use std::fmt;
use std::time::Duration;

use crate::time::{Span, Timestamp};

/// How a camera lays out its pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Layout {
    /// Packed 4:2:2, Y first.
    Yuyv,
    /// Packed 4:2:2, U first.
    Uyvy,
    /// 4:2:0, a plane of Y, then one of U and V in turn.
    Nv12,
    /// A JPEG file for each frame.
    Mjpeg,
    /// Red, green, blue.
    Rgb24,
    /// Blue, green, red.
    Bgr24,
}

impl Layout {
    /// All of them, the best for us first: what needs least work, and keeps most color.
    pub const ALL: [Self; 6] = [Self::Rgb24, Self::Bgr24, Self::Yuyv, Self::Uyvy, Self::Nv12, Self::Mjpeg];

    /// Bytes of a row without padding, and rows of that length in a picture; `None` where that is not fixed.
    pub fn rows(self, width: usize, height: usize) -> Option<(usize, usize)> {
        match self {
            Self::Yuyv | Self::Uyvy => Some((width.div_ceil(2) * 4, height)),
            Self::Nv12 => Some((width, height + height.div_ceil(2))),
            Self::Rgb24 | Self::Bgr24 => Some((3 * width, height)),
            Self::Mjpeg => None,
        }
    }

    /// As drivers name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Yuyv => "YUYV",
            Self::Uyvy => "UYVY",
            Self::Nv12 => "NV12",
            Self::Mjpeg => "MJPG",
            Self::Rgb24 => "RGB3",
            Self::Bgr24 => "BGR3",
        }
    }
}

/// By which matrix colors were mixed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matrix {
    /// ITU-R BT.601.
    Bt601,
    /// ITU-R BT.709.
    Bt709,
    /// ITU-R BT.2020.
    Bt2020,
}

/// Between which levels black and white lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Range {
    /// 16 and 235.
    Limited,
    /// 0 and 255.
    Full,
}

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
