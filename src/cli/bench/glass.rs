//! `bench glass-to-glass`: from handing a picture to a screen until a camera that looks at it has delivered it.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use serde::Serialize;

use crate::cli::bench::pattern::{PatternReader, draw};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::cli::live::source::size_from_word;
use crate::cli::outputs::Outputs;
use crate::image::buffer::Image;
use crate::media::layout::Layout;
use crate::pipeline::stage::Source;
use crate::pipeline::timing::{Durations, Summary};
use crate::progress::Progress as _;
use crate::sinks::virtual_camera::Screen;
use crate::time::{Clock as _, MonotonicClock, Span, Timestamp};

const DEFAULT_SIZE: (usize, usize) = (1280, 720);
const DEFAULT_RATE_HZ: f64 = 30.0;
/// A picture is waited for no longer than this by the screen.
const PATIENCE: Duration = Duration::from_millis(50);
/// So many numbers are remembered: a delay longer than this many pictures is not found.
const REMEMBERED: usize = 4096;

/// How long a picture takes from a screen into this program.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// The output node on which numbered pictures are shown.
    #[arg(long, value_name = "/dev/videoN")]
    virtual_camera: PathBuf,
    /// The camera that sees them.
    #[arg(long, value_name = "/dev/videoN")]
    device: PathBuf,
    /// Columns and rows of the pictures that are shown [default: 1280x720].
    #[arg(long, value_name = "WxH", value_parser = size_from_word)]
    size: Option<(usize, usize)>,
    /// Pictures shown a second.
    #[arg(long, value_name = "HZ", default_value_t = DEFAULT_RATE_HZ)]
    fps: f64,
    /// Measure for so long, s.
    #[arg(long, default_value_t = 10.0, value_name = "S")]
    duration: f64,
    /// Everything as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
struct Report {
    /// From handing a picture to the screen until the first frame that shows it is here.
    delay: Summary,
    /// The shortest of these, ms.
    least_ms: f64,
    /// Until that frame was exposed, by the camera's driver.
    until_exposed: Summary,
    /// Pictures shown.
    shown: u64,
    /// Frames that came.
    frames: u64,
    /// Of these, frames in which no number could be read.
    unread: u64,
    /// From picture to picture and from frame to frame, ms: the delay is known no finer than both.
    periods_ms: [f64; 2],
}

impl Report {
    fn table(&self) -> String {
        let delay = &self.delay;
        format!(
            "glass to glass: p50 {:.1} ms, p95 {:.1} ms, p99 {:.1} ms, at most {:.1} ms, at least {:.1} ms, of {} pictures\n\
             until exposed:  p50 {:.1} ms, p95 {:.1} ms\n\
             {} pictures shown every {:.1} ms; {} frames seen every {:.1} ms, {} of them without a number that could be read\n",
            delay.p50_ms,
            delay.p95_ms,
            delay.p99_ms,
            delay.max_ms,
            self.least_ms,
            delay.count,
            self.until_exposed.p50_ms,
            self.until_exposed.p95_ms,
            self.shown,
            self.periods_ms[0],
            self.frames,
            self.periods_ms[1],
            self.unread
        )
    }
}

/// When each number was shown last.
#[derive(Debug)]
struct Shown {
    at: Vec<Option<(u16, Timestamp)>>,
}

impl Shown {
    fn new() -> Self {
        Self {
            at: vec![None; REMEMBERED],
        }
    }

    fn put(&mut self, number: u16, at: Timestamp) {
        let place = usize::from(number) % REMEMBERED;
        if let Some(slot) = self.at.get_mut(place) {
            *slot = Some((number, at));
        }
    }

    /// When it was shown; only once for each number.
    fn take(&mut self, number: u16) -> Option<Timestamp> {
        let slot = self.at.get_mut(usize::from(number) % REMEMBERED)?;
        slot.take_if(|(shown, _)| *shown == number).map(|(_, at)| at)
    }
}

/// Shows a number after the other.
struct Shower {
    screen: Box<dyn Screen>,
    size: (usize, usize),
    layout: Layout,
    period: Span,
    shown: Arc<Mutex<Shown>>,
    end: Timestamp,
    /// The user's wish to end.
    wish: Arc<AtomicBool>,
    /// Ends the camera as well, which may be waiting for a frame.
    stop: Arc<AtomicBool>,
}

impl Shower {
    fn run(mut self) -> Result<u64, String> {
        let count = self.show();
        self.screen.close();
        self.stop.store(true, Ordering::Release);
        count
    }

    fn show(&mut self) -> Result<u64, String> {
        self.screen.open(self.size, self.layout)?;
        let mut picture = Image::filled(self.size.0, self.size.1, [0; 3]);
        let (mut number, mut count) = (0_u16, 0_u64);
        let mut next = MonotonicClock.now();
        while MonotonicClock.now() < self.end && !self.wish.load(Ordering::Acquire) {
            draw(number, &mut picture);
            let left = next - MonotonicClock.now();
            std::thread::sleep(Duration::from_nanos(u64::try_from(left.0).unwrap_or(0)));
            let at = MonotonicClock.now();
            // Before it is shown: the camera may be quicker than this thread.
            self.shown.lock().unwrap_or_else(PoisonError::into_inner).put(number, at);
            match self.screen.show(&picture, PATIENCE) {
                Ok(true) => count += 1,
                Ok(false) => {
                    self.shown.lock().unwrap_or_else(PoisonError::into_inner).take(number);
                }
                Err(error) => return Err(format!("{}: {error}", self.screen.name())),
            }
            number = number.wrapping_add(1);
            next = (next + self.period).max(MonotonicClock.now());
        }
        Ok(count)
    }
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    check(args)?;
    let mut outputs = Outputs::default();
    outputs.add("--json", args.json.as_deref());
    outputs.check(&[], context)?;
    let stop = Arc::new(AtomicBool::new(false));
    let mut camera = camera(&args.device, context, &stop)?;
    let shown = Arc::new(Mutex::new(Shown::new()));
    let shower = Shower {
        screen: screen(&args.virtual_camera)?,
        size: args.size.unwrap_or(DEFAULT_SIZE),
        layout: context.config.virtual_camera.layout().map_err(anyhow::Error::msg)?,
        period: Span::from_seconds(1.0 / args.fps),
        shown: Arc::clone(&shown),
        end: MonotonicClock.now() + Span::from_seconds(args.duration),
        wish: Arc::clone(&context.stop),
        stop,
    };
    let thread = std::thread::Builder::new()
        .name("pattern".to_owned())
        .spawn(move || shower.run())
        .context("expected a thread to show pictures")?;
    let (mut delay, mut until_exposed, mut interval) = (Durations::new(), Durations::new(), Durations::new());
    let (mut frames, mut unread, mut least_ms) = (0_u64, 0_u64, f64::INFINITY);
    let mut reader = PatternReader::default();
    let mut previous: Option<Timestamp> = None;
    while let Some(frame) = camera.next_frame()? {
        frames += 1;
        if let Some(previous) = previous.replace(frame.exposed_at) {
            interval.record(frame.exposed_at - previous);
        }
        let Some(number) = reader.read(&frame.image) else {
            unread += 1;
            continue;
        };
        let at = shown.lock().unwrap_or_else(PoisonError::into_inner).take(number);
        if let Some(at) = at {
            let took = frame.arrived_at - at;
            delay.record(took);
            until_exposed.record(frame.exposed_at - at);
            least_ms = least_ms.min(took.milliseconds());
        }
    }
    let count = match thread.join() {
        Ok(count) => count.map_err(anyhow::Error::msg)?,
        Err(_) => anyhow::bail!("showing pictures ended by a fault of this program"),
    };
    let report = Report {
        delay: delay.summary(),
        least_ms: if least_ms.is_finite() { least_ms } else { 0.0 },
        until_exposed: until_exposed.summary(),
        shown: count,
        frames,
        unread,
        periods_ms: [1e3 * args.duration / (count.max(1) as f64), interval.quantile_ms(0.5)],
    };
    console::print(&report.table())?;
    if let Some(path) = &args.json {
        let text = serde_json::to_string_pretty(&report)? + "\n";
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if report.delay.count == 0 {
        tracing::error!(
            "expected to find the numbered pictures in the camera's, found none in {frames} frames: does {} see {}?",
            args.device.display(),
            args.virtual_camera.display()
        );
    }
    Ok(match (context.console.stopping(), report.delay.count > 0) {
        (true, _) => Ended::Interrupted,
        (false, true) => Ended::Complete,
        (false, false) => Ended::Incomplete,
    })
}

#[cfg(all(target_os = "linux", feature = "v4l2"))]
fn camera(path: &Path, context: &Context, stop: &Arc<AtomicBool>) -> anyhow::Result<Box<dyn Source>> {
    use crate::image::pool::Pool;
    use crate::sources::camera::capture::CaptureSource;
    use crate::sources::camera::v4l2::V4l2Camera;

    let camera = Box::new(V4l2Camera::new(path));
    let wish = context.config.camera.wish();
    let mut source = CaptureSource::new(camera, wish, Arc::new(MonotonicClock), Pool::new(4), Arc::clone(stop));
    source.open_now()?;
    Ok(Box::new(source))
}

#[cfg(not(all(target_os = "linux", feature = "v4l2")))]
fn camera(path: &Path, _context: &Context, _stop: &Arc<AtomicBool>) -> anyhow::Result<Box<dyn Source>> {
    anyhow::bail!(
        "{}: this program was built without cameras (feature `v4l2`, Linux only)",
        path.display()
    )
}

#[cfg(all(target_os = "linux", feature = "v4l2"))]
fn screen(path: &Path) -> anyhow::Result<Box<dyn Screen>> {
    Ok(Box::new(crate::sinks::v4l2_output::V4l2Output::new(path)))
}

#[cfg(not(all(target_os = "linux", feature = "v4l2")))]
fn screen(path: &Path) -> anyhow::Result<Box<dyn Screen>> {
    anyhow::bail!(
        "{}: this program was built without virtual cameras (feature `v4l2`, Linux only)",
        path.display()
    )
}

fn check(args: &Args) -> Result<(), UsageError> {
    if !(1.0..=240.0).contains(&args.fps) {
        return Err(UsageError(format!(
            "--fps: expected 1 to 240 pictures a second, found {}",
            args.fps
        )));
    }
    if !(args.duration > 0.0 && args.duration <= 1e6) {
        return Err(UsageError(format!(
            "--duration: expected more than 0 s, found {}",
            args.duration
        )));
    }
    Ok(())
}
