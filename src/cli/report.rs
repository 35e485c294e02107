//! The report of a run of the line, as `--report` writes it.

use std::path::Path;

use anyhow::Context as _;
use serde::Serialize;

use crate::compose::LeftOut;
use crate::pipeline::outcome::Outcome;
use crate::pipeline::timing::Summary;
use crate::sinks::report::FrameRecord;

/// Frames in, out and lost.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct FrameCounts {
    /// That the source delivered.
    #[serde(rename = "in")]
    pub entered: u64,
    /// That came to the line's end.
    #[serde(rename = "out")]
    pub left: u64,
    /// Dropped between source and first stage.
    pub dropped: u64,
}

/// One stage's times and troubles.
#[derive(Clone, Debug, Serialize)]
pub struct StageReport {
    /// Its name.
    pub name: String,
    /// Time in it, per frame.
    #[serde(flatten)]
    pub working: Summary,
    /// Time in the queue before it.
    pub waiting: Summary,
    /// Frames that it failed on and that went on as they came.
    pub failures: u64,
    /// What the first failure was.
    pub first_failure: Option<String>,
    /// Why it was bypassed for good.
    pub panic: Option<String>,
}

/// One sink's times and troubles.
#[derive(Clone, Debug, Serialize)]
pub struct SinkReport {
    /// Its name.
    pub name: String,
    /// Time in it, per frame.
    #[serde(flatten)]
    pub working: Summary,
    /// Frames that its queue dropped.
    pub dropped: u64,
    /// Why it ended before its time.
    pub failure: Option<String>,
}

/// What came of a run of the line.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// What was read.
    pub input: String,
    /// What was written.
    pub output: String,
    /// True when all of the work was done.
    pub complete: bool,
    /// True when the user stopped it.
    pub interrupted: bool,
    /// What went wrong for good.
    pub faults: Vec<String>,
    /// What was wanted and could not run.
    pub left_out: Vec<LeftOut>,
    /// Frames in, out and lost.
    pub frames: FrameCounts,
    /// How long it took, s.
    pub seconds: f64,
    /// Frames per second over all.
    pub frames_per_second: f64,
    /// Decoding, per frame.
    pub source: Summary,
    /// In the order of the line.
    pub stages: Vec<StageReport>,
    /// From arrival to the end of the line.
    pub end_to_end: Summary,
    /// Writers.
    pub sinks: Vec<SinkReport>,
    /// One for each frame.
    pub per_frame: Vec<FrameRecord>,
}

impl Report {
    /// From what a line left behind.
    pub fn new(outcome: &Outcome, seconds: f64, left_out: Vec<LeftOut>, per_frame: Vec<FrameRecord>) -> Self {
        let faults = outcome.faults();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            input: String::new(),
            output: String::new(),
            complete: faults.is_empty() && !outcome.stopped,
            interrupted: outcome.stopped,
            faults,
            left_out,
            frames: FrameCounts {
                entered: outcome.frames_in,
                left: outcome.frames_out,
                dropped: outcome.frames_dropped,
            },
            seconds,
            frames_per_second: if seconds > 0.0 {
                outcome.frames_out as f64 / seconds
            } else {
                0.0
            },
            source: outcome.source_working.summary(),
            stages: outcome
                .stages
                .iter()
                .map(|stage| StageReport {
                    name: stage.name.to_owned(),
                    working: stage.working.summary(),
                    waiting: stage.waiting.summary(),
                    failures: stage.failures,
                    first_failure: stage.first_failure.clone(),
                    panic: stage.panic.clone(),
                })
                .collect(),
            end_to_end: outcome.end_to_end.summary(),
            sinks: outcome
                .sinks
                .iter()
                .map(|sink| SinkReport {
                    name: sink.name.to_owned(),
                    working: sink.working.summary(),
                    dropped: sink.dropped,
                    failure: sink.failure.clone(),
                })
                .collect(),
            per_frame,
        }
    }

    /// Frames that the output took: fewer than came to the line's end when its disk is full.
    pub fn written(&self) -> u64 {
        let output = self.sinks.first().map(|sink| sink.working.count);
        output.unwrap_or(self.frames.left)
    }

    /// Write it as JSON.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self)?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("{}: cannot be written; check folder, rights and space", path.display()))
    }

    /// Milliseconds per stage as a table for a terminal.
    pub fn timing_table(&self) -> String {
        let row = |name: &str, times: &Summary| {
            format!(
                "  {name:<26}{:>9.2}{:>9.2}{:>9.2}{:>9.2}\n",
                times.p50_ms, times.p95_ms, times.p99_ms, times.max_ms
            )
        };
        let mut table = format!("  {:<26}{:>9}{:>9}{:>9}{:>9}\n", "ms per frame", "p50", "p95", "p99", "max");
        table += &row("source", &self.source);
        for stage in &self.stages {
            table += &row(&stage.name, &stage.working);
        }
        table += &row("end to end (with waiting)", &self.end_to_end);
        for sink in self.sinks.iter().filter(|sink| sink.name != "report") {
            table += &row(&format!("sink {}", sink.name), &sink.working);
        }
        table
    }
}
