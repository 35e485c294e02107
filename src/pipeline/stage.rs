//! What a part of the line must be able to do.

use std::sync::Arc;

use crate::frame::Frame;

/// Why a stage could not treat a frame; the frame goes on as it came.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct StageError(pub String);

/// Why a source could not deliver.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SourceError(pub String);

/// Why a sink could not take a frame.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct SinkError(pub String);

/// Where frames come from.
pub trait Source: Send {
    /// The next frame; `None` at the end.
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError>;
    /// True when [`Frame::arrived_at`] is the instant at which this process was given the frame's bytes, which is earlier than
    /// when a picture was made of them.
    fn stamps_arrivals(&self) -> bool {
        false
    }
}

/// What happens to a frame. A stage works on its own buffer and swaps the result in as its last act.
pub trait Stage: Send {
    /// For threads, logs and report columns.
    fn name(&self) -> &'static str;
    /// Treat one frame. On an error the frame must be as it came. No allocation once warm, no I/O, no clock.
    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError>;
    /// After a gap or an error: forget history.
    fn reset(&mut self) {}
    /// From the next frame on, this much of the effect is wanted, 0–1. A stage that only knows all or nothing ignores it.
    fn set_strength(&mut self, _strength: f32) {}
}

/// Where frames go.
pub trait Sink: Send {
    /// For threads, logs and report columns.
    fn name(&self) -> &'static str;
    /// Take one finished frame.
    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError>;
    /// No more frames will come: make what was written complete.
    fn finish(&mut self) -> Result<(), SinkError> {
        Ok(())
    }
}
