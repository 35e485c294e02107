//! What the threads of a line share, and what each leaves behind.

use std::any::Any;
use std::sync::atomic::{AtomicBool, AtomicU64};

use crate::pipeline::outcome::{SinkOutcome, StageOutcome};
use crate::pipeline::timing::Durations;

/// Counts that all threads of a line share with whoever watches it.
#[derive(Debug, Default)]
pub(in crate::pipeline) struct Shared {
    pub(in crate::pipeline) stop: AtomicBool,
    pub(in crate::pipeline) frames_in: AtomicU64,
}

/// What a thread of the line leaves behind.
#[derive(Debug)]
pub(in crate::pipeline) enum Left {
    Source {
        working: Durations,
        failure: Option<String>,
        stopped: bool,
    },
    Stage {
        position: usize,
        outcome: StageOutcome,
    },
    Sink {
        position: usize,
        outcome: SinkOutcome,
    },
    Watchdog,
}

pub(super) fn message_from_panic(payload: &(dyn Any + Send)) -> String {
    payload
        .downcast_ref::<&str>()
        .map(|text| (*text).to_owned())
        .or_else(|| payload.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "no message".to_owned())
}
