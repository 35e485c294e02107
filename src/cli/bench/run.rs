//! `bench latency` and `bench throughput`: what a user types, and the run.

use std::path::{Path, PathBuf};

use crate::cli::bench::report::{BenchReport, Circumstances, write_csv};
use crate::cli::bench::{glass, plot};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::cli::live::session::{LightFieldState, Plan, Session};
use crate::cli::live::source::{Wanted, size_from_word};
use crate::cli::outputs::Outputs;
use crate::compose::Choice;
use crate::media::image_files;
use crate::progress::Progress as _;
use crate::time::{Clock as _, MonotonicClock, Span, process_time};

/// Single figures are kept of so many frames: 80 minutes at 60 a second.
const KEEP: usize = 300_000;
/// The light field is waited for at most so long before anything is measured.
const LONGEST_LOADING: Span = Span(300_000_000_000);

/// How long a frame takes through the line, and how many a second it can.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum What {
    /// How long a frame takes from its arrival until it is handed to the display, live: with deadlines, and drops at the doors.
    #[command(after_help = "Examples:\n  endofield bench latency --size 1920x1080 --fps 30\n  \
        endofield bench latency --recording recordings/live --light-field survey.lf --json latency.json --plot latency.png")]
    Latency(Measuring),
    /// How many frames a second the line can: nothing is skipped or dropped.
    #[command(after_help = "Example:\n  endofield bench throughput --recording recordings/live --light-field survey.lf")]
    Throughput(Measuring),
    /// How long a picture takes from a screen, by way of a camera that looks at it, until it arrives here.
    #[command(
        after_help = "The display is an output node that the camera's node is the other side of (v4l2loopback), or an output whose \
        cable leads back to a capture card.\nExample:\n  endofield bench glass-to-glass --virtual-camera /dev/video10 --device /dev/video10"
    )]
    GlassToGlass(glass::Args),
}

#[derive(Clone, Debug, clap::Args)]
struct Measuring {
    /// A recording instead of drawn pictures.
    #[arg(long, value_name = "DIR", group = "pictures")]
    recording: Option<PathBuf>,
    /// A camera's node instead of drawn pictures; latency only.
    #[arg(long, value_name = "/dev/videoN", group = "pictures")]
    device: Option<PathBuf>,
    /// Columns and rows of drawn pictures, or to ask a camera for [default: 1920x1080 for drawn ones].
    #[arg(long, value_name = "WxH", value_parser = size_from_word)]
    size: Option<(usize, usize)>,
    /// Frames a second [default: 30 for drawn ones, a recording's own].
    #[arg(long, value_name = "HZ")]
    fps: Option<f64>,
    /// The light field.
    #[arg(long, value_name = "LF")]
    light_field: Option<PathBuf>,
    /// Parts of the line to run.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Choice::ALL)]
    stages: Vec<Choice>,
    /// Measure for so long, s.
    #[arg(long, default_value_t = 10.0, value_name = "S")]
    duration: f64,
    /// Leave out so much at the beginning, s.
    #[arg(long, default_value_t = 2.0, value_name = "S")]
    warm_up: f64,
    /// Everything as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// A line a frame.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Distribution and course of the latency, as PNG.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// What each stage did when, for Perfetto or about:tracing.
    #[arg(long, value_name = "FILE.json")]
    trace: Option<PathBuf>,
}

const DRAWN_SIZE: (usize, usize) = (1920, 1080);
const DRAWN_RATE_HZ: f64 = 30.0;

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    match &args.what {
        What::Latency(measuring) => measure("latency", measuring, context),
        What::Throughput(measuring) => measure("throughput", measuring, context),
        What::GlassToGlass(args) => glass::run(args, context),
    }
}

fn measure(kind: &'static str, args: &Measuring, context: &Context) -> anyhow::Result<Ended> {
    check(kind, args)?;
    let mut outputs = Outputs::default();
    outputs.add("--json", args.json.as_deref());
    outputs.add("--csv", args.csv.as_deref());
    outputs.add("--plot", args.plot.as_deref());
    outputs.add("--trace", args.trace.as_deref());
    let inputs: Vec<&Path> = args
        .recording
        .as_deref()
        .into_iter()
        .chain(args.light_field.as_deref())
        .collect();
    outputs.check(&inputs, context)?;
    let mut config = context.config.clone();
    if let (Some(_), Some((width, height))) = (&args.device, args.size) {
        (config.camera.width, config.camera.height) = (width, height);
    }
    if let (Some(_), Some(rate)) = (&args.device, args.fps) {
        config.camera.frame_rate_hz = rate;
    }
    let wanted = match (&args.recording, &args.device) {
        (Some(path), _) => Wanted::Recording(path),
        (None, Some(path)) => Wanted::Camera(path),
        (None, None) => Wanted::Drawn {
            size: args.size.unwrap_or(DRAWN_SIZE),
            frame_rate_hz: args.fps.unwrap_or(DRAWN_RATE_HZ),
        },
    };
    let patient = kind == "throughput";
    let plan = Plan {
        wanted,
        frame_rate_hz: args.fps.filter(|_| args.recording.is_some()),
        count: None,
        arm: if args.device.is_some() {
            config.arm.port.clone()
        } else {
            String::new()
        },
        stages: &args.stages,
        light_field: args.light_field.as_deref(),
        record: None,
        record_enhanced: false,
        virtual_camera: None,
        display: None,
        trace: args.trace.as_deref(),
        keep: KEEP,
        patient,
    };
    let mut session = Session::start(&plan, &config)?;
    for part in &session.left_out {
        tracing::warn!("{part}");
    }
    let mut live = context.console.live_line();
    let mut phase = Phase::Loading;
    let mut entered = MonotonicClock.now();
    let (mut seconds, mut cpu_s, mut stopped) = (0.0, 0.0, false);
    let mut cpu_at_begin = process_time();
    while !session.line.has_ended() {
        session.line.wait_a_moment();
        let now = MonotonicClock.now();
        let light_field = session.light_field();
        live.update(
            || format!("{}: {} frames", phase.word(), session.meter.frames()),
            || serde_json::json!({"event": "progress", "task": "bench", "phase": phase.word(), "frames": session.meter.frames()}),
        );
        let within = now - entered;
        let next = match phase {
            Phase::Loading if light_field != LightFieldState::Loading || within > LONGEST_LOADING => Phase::WarmUp,
            Phase::WarmUp if within >= Span::from_seconds(args.warm_up) => {
                session.meter.begin_anew();
                cpu_at_begin = process_time();
                Phase::Measuring
            }
            Phase::Measuring if within >= Span::from_seconds(args.duration) => {
                seconds = within.seconds();
                cpu_s = (process_time().0 - cpu_at_begin.0) as f64 * 1e-9;
                Phase::Ending
            }
            same => same,
        };
        if next != phase {
            (phase, entered) = (next, now);
        }
        stopped |= context.console.stopping();
        if stopped || phase == Phase::Ending {
            if phase == Phase::Measuring {
                seconds = within.seconds();
                cpu_s = (process_time().0 - cpu_at_begin.0) as f64 * 1e-9;
            }
            session.stop();
            break;
        }
    }
    let measured = session.meter.get();
    drop(live);
    let Session {
        line,
        name,
        size,
        period,
        limits,
        arm,
        ..
    } = session;
    drop(arm);
    let outcome = line.wait();
    let about = Circumstances {
        kind,
        input: name,
        size,
        source_hz: if patient || period <= Span(0) {
            0.0
        } else {
            1.0 / period.seconds()
        },
        limits_ms: (!patient).then_some([limits.budget.milliseconds(), limits.deadline.milliseconds()]),
        warm_up_s: args.warm_up,
        seconds,
        cpu_s,
    };
    let report = BenchReport::new(about, &measured, &outcome);
    console::print(&report.table())?;
    if let Some(path) = &args.json {
        report.write_json(path)?;
    }
    if let Some(path) = &args.csv {
        write_csv(path, &measured.shown)?;
    }
    if let Some(path) = &args.plot {
        let title = format!("{} {}x{}: latency", report.kind, size.0, size.1);
        image_files::write(path, &plot::drawn(&measured.shown, &title, report.deadline_ms))?;
    }
    for fault in &report.faults {
        tracing::error!("{fault}");
    }
    Ok(match (stopped, report.faults.is_empty() && report.frames > 0) {
        (true, _) => Ended::Interrupted,
        (false, true) => Ended::Complete,
        (false, false) => Ended::Incomplete,
    })
}

/// What a run is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Loading,
    WarmUp,
    Measuring,
    Ending,
}

impl Phase {
    fn word(self) -> &'static str {
        match self {
            Self::Loading => "waiting for the light field",
            Self::WarmUp => "warming up",
            Self::Measuring => "measuring",
            Self::Ending => "ending",
        }
    }
}

fn check(kind: &str, args: &Measuring) -> Result<(), UsageError> {
    if !(args.duration > 0.0 && args.duration <= 1e6) {
        return Err(UsageError(format!(
            "--duration: expected more than 0 s, found {}",
            args.duration
        )));
    }
    if !(0.0..=1e4).contains(&args.warm_up) {
        return Err(UsageError(format!("--warm-up: expected 0 s or more, found {}", args.warm_up)));
    }
    if let Some(rate) = args.fps.filter(|rate| !(1.0..=240.0).contains(rate)) {
        return Err(UsageError(format!("--fps: expected 1 to 240 frames a second, found {rate}")));
    }
    if kind == "throughput" && args.device.is_some() {
        let message = "--device: a camera gives frames at its own pace, which says nothing about the line's; use --recording";
        return Err(UsageError(message.to_owned()));
    }
    Ok(())
}
