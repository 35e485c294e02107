//! The source's thread: asks for frames and sends them into the line.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use crate::frame::Frame;
use crate::image::buffer::Rgb8;
use crate::image::pool::Pool;
use crate::pipeline::gate::Handed;
use crate::pipeline::live::Limits;
use crate::pipeline::queue::Sender;
use crate::pipeline::seat::Way;
use crate::pipeline::stage::Source;
use crate::pipeline::timing::Durations;
use crate::pipeline::worker::left::{Left, Shared, message_from_panic};
use crate::time::Clock;

/// Asks the source for frames and sends them into the line.
pub(in crate::pipeline) struct SourceWorker {
    pub(in crate::pipeline) source: Box<dyn Source>,
    pub(in crate::pipeline) way: Way,
    /// Sinks of the untouched picture.
    pub(in crate::pipeline) taps: Vec<Sender<Handed>>,
    /// Where the copies for taps, overdue frames and side by side come from.
    pub(in crate::pipeline) copies: Pool<Rgb8>,
    pub(in crate::pipeline) keep_original: bool,
    /// Of a live line.
    pub(in crate::pipeline) limits: Option<Limits>,
    pub(in crate::pipeline) clock: Arc<dyn Clock>,
    pub(in crate::pipeline) shared: Arc<Shared>,
}

impl SourceWorker {
    pub(in crate::pipeline) fn run(mut self) -> Left {
        let mut working = Durations::new();
        let mut failure = None;
        let mut stopped = false;
        let stamps_arrivals = self.source.stamps_arrivals();
        loop {
            if self.shared.stop.load(Ordering::Acquire) {
                stopped = true;
                break;
            }
            let asked = self.clock.now();
            let next = catch_unwind(AssertUnwindSafe(|| self.source.next_frame()));
            let had = self.clock.now();
            let mut frame = match next {
                Ok(Ok(Some(frame))) => frame,
                Ok(Ok(None)) => break,
                Ok(Err(error)) => {
                    failure = Some(error.to_string());
                    break;
                }
                Err(payload) => {
                    failure = Some(format!("the source panicked: {}", message_from_panic(payload.as_ref())));
                    break;
                }
            };
            if stamps_arrivals {
                // Waiting for a camera is no work; making a picture of what came is.
                working.record(had - frame.arrived_at);
            } else {
                working.record(had - asked);
                frame.arrived_at = had;
            }
            self.shared.frames_in.fetch_add(1, Ordering::Relaxed);
            if !self.taps.is_empty() || self.limits.is_some() {
                let untouched = Arc::new(self.untouched_copy(&frame));
                self.taps.retain(|tap| tap.push((Arc::clone(&untouched), had)).is_ok());
                if let Some(limits) = &self.limits {
                    self.way.end.expect(untouched, frame.arrived_at + limits.deadline);
                }
            }
            if self.keep_original {
                frame.original = Some(self.copies.take_copy(&frame.image));
            }
            if self.way.push(frame).is_err() {
                break;
            }
        }
        if let Some(message) = &failure {
            tracing::error!("{message}");
        }
        Left::Source {
            working,
            failure,
            stopped,
        }
    }

    fn untouched_copy(&self, frame: &Frame) -> Frame {
        let mut copy = Frame::new(
            frame.id,
            frame.exposed_at,
            frame.arrived_at,
            self.copies.take_copy(&frame.image),
        );
        copy.presented_at = frame.presented_at;
        copy.since_previous = frame.since_previous;
        copy.camera.clone_from(&frame.camera);
        copy.field_of_view.clone_from(&frame.field_of_view);
        copy.scene_cut = frame.scene_cut;
        copy.untouched = true;
        copy
    }
}
