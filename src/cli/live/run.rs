//! `live` itself: what a user types, and the loop that watches.

use std::path::{Path, PathBuf};
#[cfg(feature = "viewer")]
use std::sync::Arc;

use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::cli::live::session::{Plan, Session};
use crate::cli::live::source::{self, Wanted, size_from_word};
use crate::cli::live::watch::Watcher;
use crate::cli::outputs::Outputs;
use crate::compose::Choice;
use crate::pipeline::outcome::Outcome;
use crate::sinks::display::Display;
use crate::time::{Clock as _, MonotonicClock, Span};
#[cfg(feature = "viewer")]
use crate::viewer::window::{Look, Place, WindowSystem};

/// Drawn pictures are of this size and rate unless told otherwise.
const DRAWN_SIZE: (usize, usize) = (1280, 720);
const DRAWN_RATE_HZ: f64 = 30.0;

/// The whole line on a camera and an arm, while they run.
///
/// The picture never stops: a frame that is not done in time goes out as it came, a stage that is too slow is switched off for a
/// while, and a camera, an arm or a disk that fails is waited for. What happened is told when it happens, counted, and summed up at the end.
#[derive(Clone, Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  endofield live --list\n  endofield live --device /dev/video0 --size 1920x1080 --fps 30 --arm /dev/ttyUSB0 --light-field survey.lf\n  \
    endofield live --recording recordings/live --light-field survey.lf --duration 20\n  endofield live --synthetic --duration 5\n\n\
    Keys of the window: h shows them; Escape brings the raw picture. Ends with q, with Ctrl-C (exit code 130) or after --duration. Settings: [live], [camera] and [arm] in config/default.toml."
)]
pub struct Args {
    /// The camera's or capture card's node [default: camera.device].
    #[arg(long, value_name = "/dev/videoN", group = "pictures")]
    device: Option<PathBuf>,
    /// Drawn pictures instead of a camera's.
    #[arg(long, group = "pictures")]
    synthetic: bool,
    /// A recording, played again and again at its own pace instead of a camera.
    #[arg(long, value_name = "DIR", group = "pictures")]
    recording: Option<PathBuf>,
    /// Name the cameras that are there and what they can, and end.
    #[arg(long)]
    list: bool,
    /// Columns and rows to ask for [default: camera.width, camera.height].
    #[arg(long, value_name = "WxH", value_parser = size_from_word)]
    size: Option<(usize, usize)>,
    /// Frames a second to ask for [default: camera.frame_rate_hz].
    #[arg(long, value_name = "HZ")]
    fps: Option<f64>,
    /// The arm's serial port [default: arm.port].
    #[arg(long, value_name = "PORT")]
    arm: Option<String>,
    /// A folder with camera.yaml, hand_eye.yaml, color.yaml of this camera [default: camera.instrument].
    #[arg(long, value_name = "DIR")]
    instrument: Option<PathBuf>,
    /// The light field; it is read while the line runs already.
    #[arg(long, value_name = "LF")]
    light_field: Option<PathBuf>,
    /// Parts of the line to run.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Choice::ALL)]
    stages: Vec<Choice>,
    /// Record what comes in, as a recording that `process` plays.
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Record the enhanced picture as well, beside what comes in.
    #[arg(long, requires = "record")]
    record_enhanced: bool,
    /// Show the enhanced picture to other programs as a camera: an output node of Video4Linux2, as the module v4l2loopback gives.
    #[arg(long, value_name = "/dev/videoN")]
    virtual_camera: Option<PathBuf>,
    /// Write what each stage did when, for Perfetto or about:tracing.
    #[arg(long, value_name = "FILE.json")]
    trace: Option<PathBuf>,
    /// Without a window.
    #[arg(long)]
    headless: bool,
    /// The window takes all of this monitor, counted from 0.
    #[arg(long, value_name = "MONITOR", num_args = 0..=1, default_missing_value = "0", conflicts_with = "headless")]
    full_screen: Option<usize>,
    /// End after so many seconds.
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration: Option<f64>,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    if args.list {
        console::print(&source::list()?)?;
        return Ok(Ended::Complete);
    }
    let began = MonotonicClock.now();
    check(args)?;
    let mut config = context.config.clone();
    if let Some((width, height)) = args.size {
        (config.camera.width, config.camera.height) = (width, height);
    }
    if let Some(rate) = args.fps {
        config.camera.frame_rate_hz = rate;
    }
    if let Some(folder) = &args.instrument {
        config.camera.instrument = folder.to_string_lossy().into_owned();
    }
    let device = args.device.clone().unwrap_or_else(|| PathBuf::from(&config.camera.device));
    let wanted = wanted(args, &device);
    let mut outputs = Outputs::default();
    let folder = args.record.as_ref().map(|folder| folder.join(""));
    outputs.add("--record", folder.as_deref());
    outputs.add("--trace", args.trace.as_deref());
    let inputs: Vec<&Path> = args
        .recording
        .as_deref()
        .into_iter()
        .chain(args.light_field.as_deref())
        .collect();
    outputs.check(&inputs, context)?;

    let window = window(args);
    let is_camera = matches!(wanted, Wanted::Camera(_));
    let plan = Plan {
        wanted,
        frame_rate_hz: args.fps.filter(|_| !is_camera),
        count: None,
        // A recording brings its own poses.
        arm: args
            .arm
            .clone()
            .unwrap_or_else(|| if is_camera { config.arm.port.clone() } else { String::new() }),
        stages: &args.stages,
        light_field: args.light_field.as_deref(),
        record: args.record.as_deref(),
        record_enhanced: args.record_enhanced,
        virtual_camera: args.virtual_camera.as_deref(),
        display: window.as_ref().map(|(_, display)| display.clone()),
        trace: args.trace.as_deref(),
        keep: 0,
        patient: false,
    };
    let session = Session::start(&plan, &config)?;
    for part in &session.left_out {
        tracing::warn!("{part}");
    }
    let end = args.duration.map(|seconds| began + Span::from_seconds(seconds));
    let mut watcher = Watcher::new(context, session, began, end);
    show(window, args, &mut watcher);
    watcher.wait();
    let (session, stopped_by_user) = watcher.finish();
    let Session {
        line, arm, camera, name, ..
    } = session;
    drop(arm);
    let outcome = line.wait();
    let seconds = (MonotonicClock.now() - began).seconds();
    console::print(&summary(&outcome, &name, seconds))?;
    if let Some(camera) = camera.map(|camera| camera.status()) {
        tracing::info!(
            "camera: {} frames, {} missed, {} damaged, {} broken, {} stale, {} interruptions",
            camera.frames,
            camera.missed,
            camera.damaged,
            camera.broken,
            camera.stale,
            camera.interruptions
        );
    }
    let faults = outcome.faults();
    for fault in &faults {
        tracing::error!("{fault}");
    }
    Ok(match (stopped_by_user, faults.is_empty() && outcome.frames_out > 0) {
        (true, _) => Ended::Interrupted,
        (false, true) => Ended::Complete,
        (false, false) => Ended::Incomplete,
    })
}

/// The way to the window system, and where frames wait to be shown.
#[cfg(feature = "viewer")]
type Shown = (WindowSystem, Display);

#[cfg(not(feature = "viewer"))]
type Shown = ((), Display);

#[cfg(feature = "viewer")]
fn window(args: &Args) -> Option<Shown> {
    if args.headless {
        return None;
    }
    match WindowSystem::open() {
        Ok(system) => {
            let display = Display::new(system.wake());
            Some((system, display))
        }
        Err(error) => {
            tracing::warn!("{error}: the line runs without one; --headless says that none is wanted");
            None
        }
    }
}

#[cfg(not(feature = "viewer"))]
fn window(_args: &Args) -> Option<Shown> {
    None
}

/// Show the line in its window until either ends; the line outlives a window that fails.
#[cfg(feature = "viewer")]
fn show(window: Option<Shown>, args: &Args, watcher: &mut Watcher<'_>) {
    let Some((system, display)) = window else { return };
    let place = Place {
        title: format!("endofield: {}", watcher.session.name),
        full_screen: args.full_screen,
        snapshots: args.record.clone().unwrap_or_else(|| PathBuf::from(".")),
    };
    let controls = Arc::clone(watcher.session.line.controls());
    let look = |wants_to_end: bool| watcher.look(wants_to_end).map_or(Look::Ended, Look::Runs);
    if let Err(error) = system.run(place, display, controls, look) {
        tracing::error!("{error}: the line goes on without it");
    }
}

#[cfg(not(feature = "viewer"))]
fn show(_window: Option<Shown>, _args: &Args, _watcher: &mut Watcher<'_>) {}

fn check(args: &Args) -> Result<(), UsageError> {
    if let Some(seconds) = args.duration.filter(|s| !(*s > 0.0 && *s <= 1e9)) {
        return Err(UsageError(format!("--duration: expected more than 0 s, found {seconds}")));
    }
    if let Some(rate) = args.fps.filter(|rate| !(1.0..=240.0).contains(rate)) {
        return Err(UsageError(format!("--fps: expected 1 to 240 frames a second, found {rate}")));
    }
    Ok(())
}

fn wanted<'a>(args: &'a Args, device: &'a Path) -> Wanted<'a> {
    match &args.recording {
        Some(path) => Wanted::Recording(path),
        None if args.synthetic => Wanted::Drawn {
            size: args.size.unwrap_or(DRAWN_SIZE),
            frame_rate_hz: args.fps.unwrap_or(DRAWN_RATE_HZ),
        },
        None => Wanted::Camera(device),
    }
}

fn summary(outcome: &Outcome, name: &str, seconds: f64) -> String {
    let line = outcome.end_to_end.summary();
    let mut text = format!(
        "{name}: {} frames in, {} out in {seconds:.1} s; {} of them as they came because the line was late, {} overtaken, {} dropped at the entry\n\
         added latency: p50 {:.1} ms, p95 {:.1} ms, p99 {:.1} ms, p99.9 {:.1} ms, at most {:.1} ms\n",
        outcome.frames_in,
        outcome.frames_out,
        outcome.passed.rescued,
        outcome.passed.overtaken,
        outcome.frames_dropped,
        line.p50_ms,
        line.p95_ms,
        line.p99_ms,
        line.p999_ms,
        line.max_ms
    );
    for stage in &outcome.stages {
        let working = stage.working.summary();
        text += &format!(
            "  {:<26} {:>7.2} ms p50 {:>7.2} ms p99  {} treated, {} passed by for time, {} off, {} failed, rested {}×, hung {}×\n",
            stage.name,
            working.p50_ms,
            working.p99_ms,
            working.count,
            stage.skipped + stage.overdue,
            stage.switched_off,
            stage.failures,
            stage.rests,
            stage.hangs
        );
    }
    for sink in outcome.sinks.iter().filter(|sink| sink.dropped > 0) {
        text += &format!("  {:<26} {} frames, {} dropped\n", sink.name, sink.taken, sink.dropped);
    }
    text
}
