//! What came of a line that has ended: counts, times, and everything that went wrong.

use crate::pipeline::ledger::Passed;
use crate::pipeline::timing::Durations;

/// What came of one stage.
#[derive(Clone, Debug, Default)]
pub struct StageOutcome {
    /// The stage's name.
    pub name: &'static str,
    /// Time in the stage, per frame that it treated.
    pub working: Durations,
    /// Time between the stage before and this one, until a core was free, per frame.
    pub waiting: Durations,
    /// Frames that it failed on and that went on as they came.
    pub failures: u64,
    /// The first failure's message.
    pub first_failure: Option<String>,
    /// Frames that passed while it was switched off.
    pub switched_off: u64,
    /// Live: frames that passed because there was no time for it.
    pub skipped: u64,
    /// Live: frames whose untouched picture went out while they were here.
    pub overdue: u64,
    /// Live: times it was switched off for a while because it overran often.
    pub rests: u64,
    /// Live: times it did not return from a frame for too long.
    pub hangs: u64,
    /// The panic's message, if it panicked; from then on it was passed by.
    pub panic: Option<String>,
}

/// What came of one sink.
#[derive(Clone, Debug, Default)]
pub struct SinkOutcome {
    /// The sink's name.
    pub name: &'static str,
    /// Frames that it took.
    pub taken: u64,
    /// Frames that its queue dropped.
    pub dropped: u64,
    /// Time in the sink, per frame.
    pub working: Durations,
    /// Time in the sink's queue, per frame.
    pub waiting: Durations,
    /// Why it ended before its time.
    pub failure: Option<String>,
}

/// What came of the whole line.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// Frames that the source delivered.
    pub frames_in: u64,
    /// Frames that came to the line's end.
    pub frames_out: u64,
    /// Frames dropped between source and first stage.
    pub frames_dropped: u64,
    /// What came out of a live line, and how.
    pub passed: Passed,
    /// Time the source took for a frame.
    pub source_working: Durations,
    /// From arrival to the end of the line, before the sinks.
    pub end_to_end: Durations,
    /// In the order of the line.
    pub stages: Vec<StageOutcome>,
    /// Sinks of the untouched picture first, then the others, each in the order of the builder.
    pub sinks: Vec<SinkOutcome>,
    /// Why the source ended before its time.
    pub source_failure: Option<String>,
    /// True when the line was asked to stop before the source's end.
    pub stopped: bool,
    /// Threads of the line that died of a fault in the line itself.
    pub lost_threads: Vec<String>,
}

impl Outcome {
    /// Everything that went wrong for good, one line each; empty when all of the work was done.
    ///
    /// Single failed frames are not among them, they were treated as the line promises: look at [`StageOutcome::failures`].
    pub fn faults(&self) -> Vec<String> {
        let source = self.source_failure.iter().cloned();
        let stages = self.stages.iter().filter_map(|stage| {
            let panic = stage.panic.as_ref()?;
            Some(format!(
                "stage `{}` failed beyond repair and was bypassed from then on: {panic}",
                stage.name
            ))
        });
        let sinks = self.sinks.iter().filter_map(|sink| {
            let failure = sink.failure.as_ref()?;
            Some(format!("{} ended after {} frames: {failure}", sink.name, sink.taken))
        });
        let threads = self
            .lost_threads
            .iter()
            .map(|thread| format!("thread `{thread}` of the line died"));
        source.chain(stages).chain(sinks).chain(threads).collect()
    }
}
