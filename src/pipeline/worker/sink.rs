//! A sink's thread: feeds it from its queue.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use crate::pipeline::gate::Handed;
use crate::pipeline::outcome::SinkOutcome;
use crate::pipeline::queue::{DropCount, Receiver};
use crate::pipeline::stage::Sink;
use crate::pipeline::worker::left::{Left, Shared, message_from_panic};
use crate::time::Clock;

/// Feeds one sink from its queue.
pub(in crate::pipeline) struct SinkWorker {
    pub(in crate::pipeline) position: usize,
    pub(in crate::pipeline) sink: Box<dyn Sink>,
    pub(in crate::pipeline) input: Receiver<Handed>,
    pub(in crate::pipeline) drops: DropCount,
    /// When this sink ends before its time, the line stops.
    pub(in crate::pipeline) essential: bool,
    pub(in crate::pipeline) clock: Arc<dyn Clock>,
    pub(in crate::pipeline) shared: Arc<Shared>,
}

impl SinkWorker {
    pub(in crate::pipeline) fn run(mut self) -> Left {
        let mut outcome = SinkOutcome {
            name: self.sink.name(),
            ..SinkOutcome::default()
        };
        while let Some((frame, handed)) = self.input.pop() {
            let entered = self.clock.now();
            outcome.waiting.record(entered - handed);
            outcome.failure = failure_of(|| self.sink.consume(&frame));
            if outcome.failure.is_some() {
                break;
            }
            outcome.working.record(self.clock.now() - entered);
            outcome.taken += 1;
        }
        // Closing the queue first lets a line that waits at it go on while the sink writes its end.
        drop(self.input);
        if outcome.failure.is_some() && self.essential {
            self.shared.stop.store(true, Ordering::Release);
        }
        let at_end = failure_of(|| self.sink.finish());
        outcome.failure = outcome.failure.or(at_end);
        if let Some(failure) = &outcome.failure {
            tracing::error!("{failure}");
        }
        outcome.dropped = self.drops.get();
        Left::Sink {
            position: self.position,
            outcome,
        }
    }
}

fn failure_of<E: std::fmt::Display>(work: impl FnOnce() -> Result<(), E>) -> Option<String> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => None,
        Ok(Err(error)) => Some(error.to_string()),
        Err(payload) => Some(format!("it panicked: {}", message_from_panic(payload.as_ref()))),
    }
}
