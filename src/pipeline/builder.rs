//! Put a line together; refuse one that cannot run.

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::pipeline::live::Limits;
use crate::pipeline::queue::{Overflow, Queue};
use crate::pipeline::scheduling::{self, Scheduling};
use crate::pipeline::stage::{Sink, Source, Stage};
use crate::time::Clock;

/// So many frames wait between two stages: enough that two neighbours need not march in step, few enough for the memory.
const BETWEEN_STAGES: usize = 2;

/// Why a line cannot run.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum BuildError {
    /// Nothing takes the frames.
    #[error("expected at least one sink at the line's end, found none: give the frames somewhere to go")]
    NoSink,
    /// Two of a kind could not be told apart in reports and switches.
    #[error("expected every stage and every sink to have its own name, found `{0}` twice")]
    SameName(&'static str),
    /// A nameless thread.
    #[error("expected a name for every stage and sink, found an empty one")]
    NoName,
    /// A queue that holds nothing.
    #[error("expected room for at least 1 frame in the queue of `{0}`, found 0")]
    NoRoom(&'static str),
    /// A live line must not wait for anybody.
    #[error("expected every queue into and out of a live line to drop its oldest, found one that waits at `{0}`")]
    Waits(&'static str),
}

pub(super) struct Door {
    pub(super) sink: Box<dyn Sink>,
    pub(super) queue: Queue,
    pub(super) essential: bool,
}

/// A line in the making.
pub struct Builder {
    source: Box<dyn Source>,
    clock: Arc<dyn Clock>,
    entry: Queue,
    between: usize,
    keep_original: bool,
    limits: Option<Limits>,
    scheduling: Arc<Scheduling>,
    stages: Vec<Box<dyn Stage>>,
    taps: Vec<Door>,
    sinks: Vec<Door>,
}

/// A line that can run.
pub struct Pipeline {
    pub(super) source: Box<dyn Source>,
    pub(super) clock: Arc<dyn Clock>,
    pub(super) entry: Queue,
    pub(super) between: usize,
    pub(super) keep_original: bool,
    pub(super) limits: Option<Limits>,
    pub(super) scheduling: Arc<Scheduling>,
    pub(super) stages: Vec<Box<dyn Stage>>,
    pub(super) taps: Vec<Door>,
    pub(super) sinks: Vec<Door>,
}

impl std::fmt::Debug for Pipeline {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let stages: Vec<_> = self.stages.iter().map(|stage| stage.name()).collect();
        let sinks: Vec<_> = self.taps.iter().chain(&self.sinks).map(|door| door.sink.name()).collect();
        f.debug_struct("Pipeline")
            .field("stages", &stages)
            .field("sinks", &sinks)
            .finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Builder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let stages: Vec<_> = self.stages.iter().map(|stage| stage.name()).collect();
        f.debug_struct("Builder").field("stages", &stages).finish_non_exhaustive()
    }
}

impl Pipeline {
    /// Begin a line at `source`; `clock` times it. Until told otherwise nothing in it drops.
    pub fn builder(source: Box<dyn Source>, clock: Arc<dyn Clock>) -> Builder {
        Builder {
            source,
            clock,
            entry: Queue::blocking(BETWEEN_STAGES),
            between: BETWEEN_STAGES,
            keep_original: false,
            limits: None,
            scheduling: Arc::new(Scheduling::new(&scheduling::Settings::default())),
            stages: Vec::new(),
            taps: Vec::new(),
            sinks: Vec::new(),
        }
    }
}

impl Builder {
    /// The queue between source and first stage: the one place before the sinks where a live line may drop.
    #[must_use]
    pub fn entry(mut self, queue: Queue) -> Self {
        self.entry = queue;
        self
    }

    /// So many frames may wait between two stages.
    #[must_use]
    pub fn between_stages(mut self, frames: usize) -> Self {
        self.between = frames;
        self
    }

    /// Keep a copy of each frame's untouched picture in [`crate::frame::Frame::original`].
    #[must_use]
    pub fn keep_original(mut self, keep: bool) -> Self {
        self.keep_original = keep;
        self
    }

    /// A live line: no frame waits longer than `limits` say. Every queue at its doors must drop its oldest.
    #[must_use]
    pub fn live(mut self, limits: Limits) -> Self {
        self.limits = Some(limits);
        self
    }

    /// What the operating system is asked for on behalf of the line's threads.
    #[must_use]
    pub fn scheduling(mut self, settings: &scheduling::Settings) -> Self {
        self.scheduling = Arc::new(Scheduling::new(settings));
        self
    }

    /// A sink of the untouched picture, which leaves before the first stage.
    #[must_use]
    pub fn tap(mut self, sink: Box<dyn Sink>, queue: Queue) -> Self {
        self.taps.push(Door {
            sink,
            queue,
            essential: false,
        });
        self
    }

    /// The next stage.
    #[must_use]
    pub fn stage(mut self, stage: Box<dyn Stage>) -> Self {
        self.stages.push(stage);
        self
    }

    /// One more sink of finished frames. If it fails, the others go on.
    #[must_use]
    pub fn sink(mut self, sink: Box<dyn Sink>, queue: Queue) -> Self {
        self.sinks.push(Door {
            sink,
            queue,
            essential: false,
        });
        self
    }

    /// A sink without which the work is pointless: if it fails, the line stops cleanly.
    #[must_use]
    pub fn essential_sink(mut self, sink: Box<dyn Sink>, queue: Queue) -> Self {
        self.sinks.push(Door {
            sink,
            queue,
            essential: true,
        });
        self
    }

    /// Check the line.
    pub fn build(self) -> Result<Pipeline, BuildError> {
        if self.sinks.is_empty() {
            return Err(BuildError::NoSink);
        }
        let doors = || self.taps.iter().chain(&self.sinks);
        let mut seen = BTreeSet::new();
        for name in self
            .stages
            .iter()
            .map(|stage| stage.name())
            .chain(doors().map(|door| door.sink.name()))
        {
            if name.is_empty() {
                return Err(BuildError::NoName);
            }
            if !seen.insert(name) {
                return Err(BuildError::SameName(name));
            }
        }
        if let Some(door) = doors().find(|door| door.queue.capacity == 0) {
            return Err(BuildError::NoRoom(door.sink.name()));
        }
        if self.limits.is_some() {
            let waits = |queue: Queue| queue.overflow == Overflow::Block;
            if let Some(door) = doors().find(|door| waits(door.queue)) {
                return Err(BuildError::Waits(door.sink.name()));
            }
            if waits(self.entry) {
                return Err(BuildError::Waits("source"));
            }
        }
        if self.entry.capacity == 0 || self.between == 0 {
            return Err(BuildError::NoRoom("stages"));
        }
        Ok(Pipeline {
            source: self.source,
            clock: self.clock,
            entry: self.entry,
            between: self.between,
            keep_original: self.keep_original,
            limits: self.limits,
            scheduling: self.scheduling,
            stages: self.stages,
            taps: self.taps,
            sinks: self.sinks,
        })
    }
}

impl Pipeline {
    /// The most frames that can be under way at once, for pools.
    pub fn frames_under_way(&self) -> usize {
        let sinks: usize = self.taps.iter().chain(&self.sinks).map(|door| door.queue.capacity + 1).sum();
        self.entry.capacity + 1 + self.stages.len() * (self.between + 1) + sinks
    }

    /// True when some queue of the line may drop.
    pub fn may_drop(&self) -> bool {
        let mut queues = self.taps.iter().chain(&self.sinks).map(|door| door.queue).chain([self.entry]);
        queues.any(|queue| queue.overflow == Overflow::DropOldest)
    }
}
