//! How fast the whole line is on this machine: 1080p frames of a simulated operation through every stage.
//!
//! `cargo bench --bench pipeline [-- [FRAMES] [--front] [--json FILE] [--recording FOLDER --light-field FOLDER [--enlarge N]]]`, 200
//! frames unless told, fewer where they would take longer than a quarter of a minute. Three tables:
//!
//! 1. each stage alone on one core: processor time a frame, which does not depend on what else the machine does;
//! 2. the line as it runs, one thread a stage over rayon's pool: wall time a frame and stage, and frames per second;
//! 3. the pixel kernels, each alone on one core.
//!
//! `--recording FOLDER --light-field FOLDER` plays the first frames of a recording instead, `--enlarge 2` at twice its size.
//! `--front` leaves the substitution out. Decoding and encoding are not in it; `endofield process --report` measures them too.
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::expect_used,
    reason = "it is its own harness"
)]

use std::path::PathBuf;
use std::sync::Arc;

use endofield::compose::{self, Choice, Equipment, Line};
use endofield::config::Config;
use endofield::frame::Frame;
use endofield::pipeline::builder::Pipeline;
use endofield::pipeline::outcome::Outcome;
use endofield::pipeline::queue::Queue;
use endofield::pipeline::runner::Wish;
use endofield::pipeline::stage::{Sink, SinkError, Source as _};
use endofield::pipeline::timing::Summary;
use endofield::time::{Clock as _, MonotonicClock};

mod kernels;
mod measure;
mod operation;

use measure::{cpu_ms, median, timed};
use operation::Operation;

/// Frames for table 1, of which the first few only warm up.
const FRAMES_ON_ONE_CORE: u64 = 20;
const WARM_UP: u64 = 8;
/// The line is stopped after so long, seconds.
const LONGEST_RUN_S: f64 = 15.0;
/// Its time is told apart: the other stages have a bound of their own.
const SUBSTITUTION: &str = "specularity_substitution";

/// What stands before the substitution.
#[derive(Clone, Copy, PartialEq)]
enum Front {
    Alone,
    WithSubstitution,
}

struct Nowhere;

impl Sink for Nowhere {
    fn name(&self) -> &'static str {
        "nowhere"
    }
    fn consume(&mut self, _frame: &Arc<Frame>) -> Result<(), SinkError> {
        Ok(())
    }
}

fn line(operation: &Operation, front: Front) -> Line {
    let mut config = Config::default();
    // Colors of the start are the reference: a simulated recording has no color.yaml, and the stage shall work.
    config.color.reference = endofield::stages::color_normalization::settings::ReferenceSource::Start;
    config.color.start_ms = 40.0;
    let equipment = Equipment {
        recording: &operation.recording,
        light_field: Some(Arc::clone(&operation.light_field)),
        light_field_to_come: false,
        may_wait: false,
        poses: None,
        size: operation.size,
    };
    let mut line = compose::line(&config, &Choice::ALL, &equipment).expect("the default line stands");
    if front == Front::Alone {
        line.stages.retain(|stage| stage.name() != SUBSTITUTION);
    }
    line
}

/// What a stage costs alone on one core.
struct Alone {
    stage: &'static str,
    /// Processor time, ms a frame.
    median: f64,
    worst: f64,
    /// Of its pictures and masks: the same before and after a change that leaves results alone.
    fingerprint: u32,
}

/// To be called inside a pool of one thread.
fn on_one_core(operation: &Operation, front: Front) -> Vec<Alone> {
    let mut stages = line(operation, front).stages;
    let mut times = vec![Vec::new(); stages.len()];
    let mut fingerprints = vec![0; stages.len()];
    let mut source = operation.source(FRAMES_ON_ONE_CORE);
    while let Ok(Some(mut frame)) = source.next_frame() {
        for ((stage, times), fingerprint) in stages.iter_mut().zip(&mut times).zip(&mut fingerprints) {
            let (ms, result) = timed(|| stage.process(&mut frame));
            if let Err(error) = result {
                println!("{} failed: {error}", stage.name());
            }
            if frame.id.0 >= WARM_UP {
                times.push(ms);
            }
            let masks = frame
                .analysis
                .iter()
                .flat_map(|seen| [&seen.specularities, &seen.instruments]);
            *fingerprint = masks.fold(hash(*fingerprint, frame.image.as_bytes()), |hashed, mask| {
                hash(hashed, mask.pixels())
            });
        }
    }
    let rows = stages.iter().zip(times).zip(fingerprints);
    rows.map(|((stage, times), fingerprint)| Alone {
        stage: stage.name(),
        worst: times.iter().copied().fold(0.0, f64::max),
        median: median(times),
        fingerprint,
    })
    .collect()
}

/// FNV-1a over words of eight bytes, folded.
fn hash(start: u32, bytes: &[u8]) -> u32 {
    let words = bytes
        .chunks(8)
        .map(|word| word.iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte)));
    let hashed = words.fold(u64::from(start) ^ 0xcbf2_9ce4_8422_2325, |hashed, word| {
        (hashed ^ word).wrapping_mul(0x0100_0000_01b3).rotate_left(29)
    });
    (hashed ^ hashed >> 32) as u32
}

struct Whole {
    outcome: Outcome,
    seconds: f64,
    cpu_ms: f64,
}

fn whole_line(operation: &Operation, front: Front, count: u64) -> Whole {
    let line = line(operation, front);
    for part in &line.left_out {
        eprintln!("left out: {part}");
    }
    let mut builder = Pipeline::builder(Box::new(operation.source(count)), Arc::new(MonotonicClock));
    for stage in line.stages {
        builder = builder.stage(stage);
    }
    let pipeline = builder
        .sink(Box::new(Nowhere), Queue::blocking(2))
        .build()
        .expect("the line stands");
    let (began, began_cpu) = (MonotonicClock.now(), cpu_ms());
    let outcome = pipeline.start().expect("threads").wait_looking(|_| {
        if (MonotonicClock.now() - began).seconds() > LONGEST_RUN_S {
            Wish::Stop
        } else {
            Wish::GoOn
        }
    });
    Whole {
        outcome,
        seconds: (MonotonicClock.now() - began).seconds(),
        cpu_ms: cpu_ms() - began_cpu,
    }
}

fn main() {
    let mut count = 200;
    let mut front = Front::WithSubstitution;
    let mut json = None;
    let (mut recording, mut light_field, mut enlargement) = (None, None, 1);
    // Cargo adds `--bench`.
    let mut arguments = std::env::args().skip(1).filter(|argument| argument != "--bench");
    while let Some(argument) = arguments.next() {
        if argument == "--json" {
            json = arguments.next();
        } else if argument == "--recording" {
            recording = arguments.next().map(PathBuf::from);
        } else if argument == "--light-field" {
            light_field = arguments.next().map(PathBuf::from);
        } else if argument == "--enlarge" {
            enlargement = arguments.next().and_then(|by| by.parse().ok()).unwrap_or(1);
        } else if argument == "--front" {
            front = Front::Alone;
        } else if let Ok(number) = argument.parse::<u64>() {
            count = number;
        }
    }
    let operation = match recording.zip(light_field) {
        Some((recording, light_field)) => Operation::recorded(&recording, &light_field, enlargement),
        None => Operation::simulated(count.max(FRAMES_ON_ONE_CORE)),
    };
    let one_core = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let alone = one_core.install(|| on_one_core(&operation, front));
    let kernels = one_core.install(|| kernels::timings(&operation));
    let whole = whole_line(&operation, front, count);

    println!("\n{:<28}{:>9}{:>9}  fingerprint", "ms a frame on one core", "median", "worst");
    for row in &alone {
        println!(
            "{:<28}{:>9.2}{:>9.2}  {:08x}",
            row.stage, row.median, row.worst, row.fingerprint
        );
    }
    let sum = |wanted: fn(&str) -> bool| -> f64 { alone.iter().filter(|row| wanted(row.stage)).map(|row| row.median).sum() };
    let (all, others) = (sum(|_| true), sum(|stage| stage != SUBSTITUTION));
    println!("{:<28}{all:>9.2}", "all");
    println!("{:<28}{others:>9.2}", "all but the substitution");
    print_whole(&whole, operation.size);
    println!("\n{:<28}{:>9}", "ms a kernel on one core", "fastest");
    for (name, ms) in &kernels {
        println!("{name:<28}{ms:>9.2}");
    }
    if let Some(path) = json {
        let fields = |rows: Vec<(&str, f64)>| -> serde_json::Map<String, serde_json::Value> {
            rows.into_iter().map(|(name, ms)| (name.to_owned(), ms.into())).collect()
        };
        let report = serde_json::json!({
            "size": operation.size,
            "stage_ms_on_one_core": fields(alone.iter().map(|row| (row.stage, row.median)).collect()),
            "kernel_ms_on_one_core": fields(kernels.iter().map(|row| (row.0.as_str(), row.1)).collect()),
            "fps": whole.outcome.frames_out as f64 / whole.seconds,
            "cpu_ms_per_frame": whole.cpu_ms / whole.outcome.frames_out.max(1) as f64,
            "threads": threads(),
        });
        std::fs::write(&path, format!("{report:#}\n")).expect("the JSON file can be written");
    }
}

fn print_whole(whole: &Whole, size: (usize, usize)) {
    let row = |name: &str, times: &Summary| {
        println!(
            "{name:<28}{:>9.2}{:>9.2}{:>9.2}{:>9.2}",
            times.p50_ms, times.p95_ms, times.p99_ms, times.max_ms
        );
    };
    let outcome = &whole.outcome;
    println!(
        "\n{:<28}{:>9}{:>9}{:>9}{:>9}",
        "ms a frame, all at once", "p50", "p95", "p99", "max"
    );
    row("source (a copy)", &outcome.source_working.summary());
    for stage in &outcome.stages {
        row(stage.name, &stage.working.summary());
        if let Some(failure) = &stage.first_failure {
            println!("  failed on {} frames: {failure}", stage.failures);
        }
    }
    row("end to end (with waiting)", &outcome.end_to_end.summary());
    let frames = outcome.frames_out as f64;
    println!(
        "\n{frames} frames of {}x{} in {:.1} s: {:.1} fps on {} threads; {:.1} ms of processor time a frame; memory at its peak: {}",
        size.0,
        size.1,
        whole.seconds,
        frames / whole.seconds,
        threads(),
        whole.cpu_ms / frames.max(1.0),
        peak_memory()
    );
    for fault in outcome.faults() {
        println!("fault: {fault}");
    }
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn peak_memory() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .map_or_else(|| "unknown".to_owned(), |value| value.trim().to_owned())
}
