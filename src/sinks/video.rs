//! The enhanced video.

use std::sync::Arc;

use crate::frame::Frame;
use crate::media::writer::VideoWriter;
use crate::pipeline::stage::{Sink, SinkError};

/// Writes every frame's picture, stamped as its recording stamps it.
#[derive(Debug)]
pub struct VideoSink {
    writer: VideoWriter,
}

impl VideoSink {
    /// A sink that writes with `writer`.
    pub fn new(writer: VideoWriter) -> Self {
        Self { writer }
    }
}

impl Sink for VideoSink {
    fn name(&self) -> &'static str {
        "video"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        self.writer
            .write(&frame.image, frame.presented_at)
            .map_err(|error| SinkError(error.to_string()))
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        self.writer.finish().map_err(|error| SinkError(error.to_string()))
    }
}
