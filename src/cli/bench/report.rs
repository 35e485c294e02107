//! What a bench has measured, as a table, as JSON and as CSV.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context as _;
use serde::Serialize;

use crate::pipeline::ledger::Passed;
use crate::pipeline::outcome::Outcome;
use crate::pipeline::timing::Summary;
use crate::sinks::meter::{Measured, Shown};

/// One stage's times.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigures {
    /// Its name.
    pub name: String,
    /// Time in it, per frame that it treated.
    pub working: Summary,
    /// Time between the stage before and this one, per frame.
    pub waiting: Summary,
    /// Frames that passed it by because there was no time, over the whole run.
    pub passed_by_for_time: u64,
    /// Frames that it failed on, over the whole run.
    pub failures: u64,
    /// Times it was switched off for a while, over the whole run.
    pub rests: u64,
    /// Times it hung, over the whole run.
    pub hangs: u64,
}

/// What the machine gave.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Machine {
    /// Cores that this process may use.
    pub cores: usize,
    /// Processor time in shares of one core.
    pub cpu_share: f64,
    /// Processor time per frame, ms.
    pub cpu_ms_per_frame: f64,
    /// Most memory that was ever held, MB.
    pub peak_memory_mb: f64,
}

/// A whole run.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// Version of the program.
    pub version: &'static str,
    /// What was measured: `latency` or `throughput`.
    pub kind: &'static str,
    /// What was read.
    pub input: String,
    /// Columns and rows.
    pub size: (usize, usize),
    /// Frames a second that the source gives; 0 = unknown or as fast as it goes.
    pub source_hz: f64,
    /// Stages' budget, ms; absent where nothing is skipped.
    pub budget_ms: Option<f64>,
    /// After so long a frame is shown as it came, ms; absent where nothing is skipped.
    pub deadline_ms: Option<f64>,
    /// Left out at the beginning, s.
    pub warm_up_s: f64,
    /// Measured for so long, s.
    pub seconds: f64,
    /// Frames measured.
    pub frames: u64,
    /// Frames a second that came out.
    pub frames_per_second: f64,
    /// From arrival in the process until handed to the display.
    pub end_to_end: Summary,
    /// From frame to frame at the display.
    pub interval: Summary,
    /// How far that is from the frames' own distance in time.
    pub jitter: Summary,
    /// Making a picture of what the source got.
    pub source: Summary,
    /// In the order of the line.
    pub stages: Vec<StageFigures>,
    /// Frames that the source delivered, warm-up included.
    pub frames_in: u64,
    /// Frames that found no room before the first stage, warm-up included.
    pub dropped_at_entry: u64,
    /// What came out, warm-up included.
    pub passed: Passed,
    /// What the machine gave.
    pub machine: Machine,
    /// What went wrong for good.
    pub faults: Vec<String>,
}

/// What is known of a run beside its measurements.
#[derive(Debug)]
pub struct Circumstances {
    /// `latency` or `throughput`.
    pub kind: &'static str,
    /// What was read.
    pub input: String,
    /// Columns and rows.
    pub size: (usize, usize),
    /// Frames a second that the source gives.
    pub source_hz: f64,
    /// Budget and deadline, ms.
    pub limits_ms: Option<[f64; 2]>,
    /// Left out at the beginning, s.
    pub warm_up_s: f64,
    /// Measured for so long, s.
    pub seconds: f64,
    /// Processor time while it was measured, s.
    pub cpu_s: f64,
}

impl BenchReport {
    /// From everything that is known.
    pub fn new(about: Circumstances, measured: &Measured, outcome: &Outcome) -> Self {
        let frames = measured.frames.max(1) as f64;
        let stages = outcome.stages.iter().map(|stage| {
            let times = measured.stages.iter().find(|times| times.name == stage.name);
            StageFigures {
                name: stage.name.to_owned(),
                working: times.map(|times| times.working.summary()).unwrap_or_default(),
                waiting: times.map(|times| times.waiting.summary()).unwrap_or_default(),
                passed_by_for_time: stage.skipped + stage.overdue,
                failures: stage.failures,
                rests: stage.rests,
                hangs: stage.hangs,
            }
        });
        Self {
            version: env!("CARGO_PKG_VERSION"),
            kind: about.kind,
            input: about.input,
            size: about.size,
            source_hz: about.source_hz,
            budget_ms: about.limits_ms.map(|[budget, _]| budget),
            deadline_ms: about.limits_ms.map(|[_, deadline]| deadline),
            warm_up_s: about.warm_up_s,
            seconds: about.seconds,
            frames: measured.frames,
            frames_per_second: measured.frames as f64 / about.seconds.max(1e-9),
            end_to_end: measured.latency.summary(),
            interval: measured.interval.summary(),
            jitter: measured.jitter.summary(),
            source: outcome.source_working.summary(),
            stages: stages.collect(),
            frames_in: outcome.frames_in,
            dropped_at_entry: outcome.frames_dropped,
            passed: outcome.passed,
            machine: Machine {
                cores: std::thread::available_parallelism().map_or(1, usize::from),
                cpu_share: about.cpu_s / about.seconds.max(1e-9),
                cpu_ms_per_frame: 1e3 * about.cpu_s / frames,
                peak_memory_mb: peak_memory_mb(),
            },
            faults: outcome.faults(),
        }
    }

    /// For a terminal.
    pub fn table(&self) -> String {
        let mut text = format!(
            "{}: {}x{}, {} frames in {:.1} s after {:.1} s of warm-up: {:.1} frames a second\n\n{:<28}{:>9}{:>9}{:>9}{:>9}{:>9}\n",
            self.input,
            self.size.0,
            self.size.1,
            self.frames,
            self.seconds,
            self.warm_up_s,
            self.frames_per_second,
            "ms per frame",
            "p50",
            "p95",
            "p99",
            "p99.9",
            "max"
        );
        let mut row = |name: &str, times: &Summary| {
            // Writing into a string cannot fail.
            let _written = writeln!(
                text,
                "{name:<28}{:>9.2}{:>9.2}{:>9.2}{:>9.2}{:>9.2}",
                times.p50_ms, times.p95_ms, times.p99_ms, times.p999_ms, times.max_ms
            );
        };
        row("source", &self.source);
        for stage in &self.stages {
            row(&stage.name, &stage.working);
            row("  waiting before it", &stage.waiting);
        }
        row("arrival to display", &self.end_to_end);
        row("frame to frame", &self.interval);
        row("jitter of that", &self.jitter);
        let _written = writeln!(
            text,
            "\n{} frames in, {} out: {} as they came because the line was late, {} overtaken; {} dropped at the entry",
            self.frames_in, self.passed.out, self.passed.rescued, self.passed.overtaken, self.dropped_at_entry
        );
        for stage in self
            .stages
            .iter()
            .filter(|stage| stage.passed_by_for_time + stage.rests + stage.hangs > 0)
        {
            let _written = writeln!(
                text,
                "{}: {} frames passed it by for lack of time, it rested {}×, hung {}×",
                stage.name, stage.passed_by_for_time, stage.rests, stage.hangs
            );
        }
        let machine = &self.machine;
        let _written = writeln!(
            text,
            "processor: {:.0} % of a core ({} cores), {:.1} ms a frame; memory at its peak: {:.0} MB",
            100.0 * machine.cpu_share,
            machine.cores,
            machine.cpu_ms_per_frame,
            machine.peak_memory_mb
        );
        text
    }

    /// Write it as JSON.
    pub fn write_json(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    }
}

/// A line a frame.
pub fn write_csv(path: &Path, shown: &[Shown]) -> anyhow::Result<()> {
    let mut text = String::from("frame,arrived_s,latency_ms,untouched,passed_by\n");
    for frame in shown {
        let _written = writeln!(
            text,
            "{},{:.6},{:.3},{},{}",
            frame.frame,
            frame.arrived_s,
            frame.latency_ms,
            u8::from(frame.untouched),
            frame.passed_by
        );
    }
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// As the kernel counts it; 0 where it does not tell.
fn peak_memory_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let kilobytes = status.lines().find_map(|line| {
        line.strip_prefix("VmHWM:")?
            .trim()
            .strip_suffix("kB")?
            .trim()
            .parse::<f64>()
            .ok()
    });
    kilobytes.unwrap_or(0.0) * 1024.0 * 1e-6
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::outcome::StageOutcome;
    use crate::sinks::meter::StageTimes;
    use crate::time::Span;

    #[test]
    fn a_report_tells_every_stage_and_adds_up() {
        let mut measured = Measured {
            frames: 50,
            ..Measured::default()
        };
        measured.latency.record(Span::from_milliseconds(12.0));
        let mut times = StageTimes::new("one");
        times.working.record(Span::from_milliseconds(7.0));
        measured.stages.push(times);
        let mut outcome = Outcome {
            frames_in: 60,
            ..Outcome::default()
        };
        for name in ["one", "two"] {
            outcome.stages.push(StageOutcome {
                name,
                skipped: 3,
                ..StageOutcome::default()
            });
        }
        let about = Circumstances {
            kind: "latency",
            input: "drawn".to_owned(),
            size: (64, 48),
            source_hz: 25.0,
            limits_ms: Some([30.0, 40.0]),
            warm_up_s: 1.0,
            seconds: 2.0,
            cpu_s: 1.0,
        };
        let report = BenchReport::new(about, &measured, &outcome);
        assert_eq!((report.frames_per_second, report.machine.cpu_share), (25.0, 0.5));
        assert_eq!(report.machine.cpu_ms_per_frame, 20.0);
        assert!((report.stages[0].working.p50_ms - 7.0).abs() < 0.01 && report.stages[1].working.count == 0);
        assert!(report.machine.peak_memory_mb > 1.0, "a process on Linux holds some memory");
        let table = report.table();
        assert!(
            table.contains("one") && table.contains("arrival to display") && table.contains("two: 3 frames"),
            "{table}"
        );
    }
}
