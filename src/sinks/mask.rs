//! What happened to each pixel, as a lossless gray video.

use std::sync::Arc;

use crate::frame::{Frame, provenance_code};
use crate::image::buffer::{Image, Mask};
use crate::media::writer::VideoWriter;
use crate::pipeline::stage::{Sink, SinkError};

/// Writes every frame's provenance codes; all untouched for a frame that no stage replaced anything in.
#[derive(Debug)]
pub struct MaskSink {
    writer: VideoWriter,
    untouched: Mask,
}

impl MaskSink {
    /// A sink that writes with `writer`, which was opened for masks.
    pub fn new(writer: VideoWriter) -> Self {
        Self {
            writer,
            untouched: Image::filled(0, 0, provenance_code::UNTOUCHED),
        }
    }
}

impl Sink for MaskSink {
    fn name(&self) -> &'static str {
        "mask"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let mask: &Mask = match &frame.provenance {
            Some(provenance) => &provenance.code,
            None => {
                if self.untouched.size() != frame.image.size() {
                    self.untouched
                        .resize(frame.image.width(), frame.image.height(), provenance_code::UNTOUCHED);
                }
                &self.untouched
            }
        };
        self.writer
            .write_gray(mask, frame.presented_at)
            .map_err(|error| SinkError(error.to_string()))
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        self.writer.finish().map_err(|error| SinkError(error.to_string()))
    }
}
