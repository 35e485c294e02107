//! The newest frame for whoever shows it, and a call that wakes them; no more is kept.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use crate::frame::Frame;
use crate::pipeline::stage::{Sink, SinkError};

/// Wakes whoever shows frames.
pub type Wake = Arc<dyn Fn() + Send + Sync>;

#[derive(Default)]
struct Newest {
    raw: Option<Arc<Frame>>,
    finished: Option<Arc<Frame>>,
}

/// Where frames wait to be shown.
#[derive(Clone)]
pub struct Display {
    newest: Arc<Mutex<Newest>>,
    wake: Wake,
}

impl fmt::Debug for Display {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Display").finish_non_exhaustive()
    }
}

impl Display {
    /// `wake` is called for each frame; it must not wait for anything.
    pub fn new(wake: Wake) -> Self {
        Self {
            newest: Arc::default(),
            wake,
        }
    }

    /// The newest frame as it came, and the newest that came out of the line.
    pub fn newest(&self) -> [Option<Arc<Frame>>; 2] {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        [newest.raw.clone(), newest.finished.clone()]
    }

    /// For frames as they come, before the first stage.
    pub fn raw_sink(&self) -> DisplaySink {
        DisplaySink {
            display: self.clone(),
            side: Side::Raw,
        }
    }

    /// For frames that come out of the line.
    pub fn sink(&self) -> DisplaySink {
        DisplaySink {
            display: self.clone(),
            side: Side::Finished,
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Side {
    Raw,
    Finished,
}

/// Lays each frame in the place of the one before.
#[derive(Debug)]
pub struct DisplaySink {
    display: Display,
    side: Side,
}

impl Sink for DisplaySink {
    fn name(&self) -> &'static str {
        match self.side {
            Side::Raw => "window (raw)",
            Side::Finished => "window",
        }
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let mut newest = self.display.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let place = match self.side {
            Side::Raw => &mut newest.raw,
            Side::Finished => &mut newest.finished,
        };
        let before = place.replace(Arc::clone(frame));
        drop(newest);
        // Given back to its pool outside the lock.
        drop(before);
        (self.display.wake)();
        Ok(())
    }
}
