//! A live line put together: source, arm, stages, sinks, and the light field that comes later.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use anyhow::Context as _;
use crossbeam::channel::bounded;

use crate::cli::live::source::{Making, Ready, Wanted, calibration_files};
use crate::compose::{self, Choice, Equipment, LeftOut, LightFieldDoor, Line};
use crate::config::Config;
use crate::light_field::build::{self as light_field_build, BuildSettings};
use crate::media::writer::Content;
use crate::pipeline::builder::Pipeline;
use crate::pipeline::control::Controls;
use crate::pipeline::live::Limits;
use crate::pipeline::queue::Queue;
use crate::pipeline::runner::RunningPipeline;
use crate::progress::Progress;
use crate::robot::feed::line::LineSource;
use crate::robot::feed::reader::ArmFeed;
use crate::sinks::display::Display;
use crate::sinks::drift::{DriftReading, DriftSink};
use crate::sinks::meter::{MeterReading, MeterSink};
use crate::sinks::recorder::{RecorderReading, RecorderSettings, RecorderSink, Track};
use crate::sinks::trace::{TraceFormat, TraceSink};
use crate::sinks::virtual_camera::{Screen, VirtualCameraReading, VirtualCameraSink};
use crate::sources::camera::capture::CaptureWatch;
use crate::sources::synthetic::Pace;
use crate::stages::pose_stamping::Poses;
use crate::time::{Clock, MonotonicClock, Span};

/// Samples of the arm that may wait for the recorder.
const ARM_SAMPLES: usize = 8192;
/// Frames whose times may wait to be written.
const TRACED: usize = 240;

/// What a session is made from.
#[derive(Debug)]
pub struct Plan<'a> {
    /// Where pictures come from.
    pub wanted: Wanted<'a>,
    /// Frames a second, in place of a recording's own.
    pub frame_rate_hz: Option<f64>,
    /// The source ends after so many frames.
    pub count: Option<u64>,
    /// The arm's port; none when empty.
    pub arm: String,
    /// Parts of the line.
    pub stages: &'a [Choice],
    /// What other views saw.
    pub light_field: Option<&'a Path>,
    /// A folder to record into.
    pub record: Option<&'a Path>,
    /// Record the enhanced picture too.
    pub record_enhanced: bool,
    /// The node of a virtual camera.
    pub virtual_camera: Option<&'a Path>,
    /// Where frames are laid to be shown.
    pub display: Option<Display>,
    /// A file for the trace.
    pub trace: Option<&'a Path>,
    /// Single figures are kept of so many frames.
    pub keep: usize,
    /// Nothing is dropped or skipped: for measuring throughput.
    pub patient: bool,
}

/// How far the light field has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LightFieldState {
    /// Not wanted.
    None,
    /// Being read.
    Loading,
    /// In the line.
    Ready,
    /// It cannot be used; why has been said.
    Failed,
}

impl LightFieldState {
    /// A word.
    pub fn word(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Loading => "loading",
            Self::Ready => "ready",
            Self::Failed => "failed",
        }
    }
}

/// Reads a light field beside the running line.
struct Loader {
    thread: Option<JoinHandle<anyhow::Result<()>>>,
    wish_to_stop: Arc<AtomicBool>,
    outcome: LightFieldState,
}

/// A live line at work.
pub struct Session {
    /// The line; taken when it ends.
    pub line: RunningPipeline,
    /// What was wanted and cannot run.
    pub left_out: Vec<LeftOut>,
    /// What is read, in words.
    pub name: String,
    /// Size of the pictures, px.
    pub size: (usize, usize),
    /// From picture to picture; zero when unknown.
    pub period: Span,
    /// Limits of the line.
    pub limits: Limits,
    /// Ends the source.
    pub stop: Arc<AtomicBool>,
    /// What comes out.
    pub meter: MeterReading,
    /// How the camera is.
    pub camera: Option<CaptureWatch>,
    /// How the arm is.
    pub arm: Option<ArmFeed>,
    /// Whether picture and arm agree.
    pub drift: Option<DriftReading>,
    /// What is recorded.
    pub recorder: Option<RecorderReading>,
    /// What is recorded of the enhanced picture.
    pub enhanced_recorder: Option<RecorderReading>,
    /// What other programs see.
    pub virtual_camera: Option<VirtualCameraReading>,
    loader: Option<Loader>,
}

/// What the thread that reads the light field needs.
struct Awaited {
    door: LightFieldDoor,
    controls: Arc<Controls>,
    stop: Arc<AtomicBool>,
}

impl Awaited {
    fn bring(self, folder: &Path) -> anyhow::Result<()> {
        let light_field = Arc::new(light_field_build::open(
            folder,
            &BuildSettings::default(),
            &Quiet(&self.stop),
        )?);
        let views = light_field.views.len();
        self.door.bring(light_field);
        for name in idle_stages(&self.controls) {
            self.controls.resume(name)?;
        }
        tracing::info!(
            "light field: {views} views from {}, in the line from now on",
            folder.display()
        );
        Ok(())
    }
}

/// Stages of the line that have nothing to do before there is a light field.
fn idle_stages(controls: &Controls) -> Vec<&'static str> {
    let idle = compose::idle_without_light_field();
    controls.stages().filter(|name| idle.contains(name)).collect()
}

/// Shows nothing, and stops when the line does.
struct Quiet<'a>(&'a AtomicBool);

impl Progress for Quiet<'_> {
    fn begin(&self, _task: &str, _total: u64) {}
    fn advance(&self, _steps: u64) {}
    fn end(&self) {}
    fn stopping(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Session")
            .field("name", &self.name)
            .field("line", &self.line)
            .finish_non_exhaustive()
    }
}

impl Session {
    /// Put it together and start it.
    pub fn start(plan: &Plan<'_>, config: &Config) -> anyhow::Result<Self> {
        let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
        let stop = Arc::new(AtomicBool::new(false));
        let making = Making {
            config,
            clock: Arc::clone(&clock),
            stop: Arc::clone(&stop),
            count: plan.count,
            frame_rate_hz: plan.frame_rate_hz,
            pace: if plan.patient { Pace::Unbound } else { Pace::Own },
        };
        let ready = making.make(plan.wanted)?;
        let (tap, samples) = bounded(ARM_SAMPLES);
        let arm = if plan.arm.is_empty() {
            None
        } else {
            let mut settings = config.arm.clone();
            settings.port.clone_from(&plan.arm);
            let source = LineSource::from_word(&plan.arm);
            let tap = plan.record.map(|_| tap);
            Some(ArmFeed::start(source, &settings, &config.poses, Arc::clone(&clock), tap)?)
        };
        let Ready {
            source,
            recording,
            size,
            period,
            poses,
            watch,
            name,
        } = ready;
        let poses = arm.as_ref().map(|arm| Poses::Live(arm.poses().clone())).or(poses);
        let equipment = Equipment {
            recording: &recording,
            light_field: None,
            light_field_to_come: plan.light_field.is_some(),
            may_wait: false,
            poses,
            size,
        };
        let Line {
            stages,
            left_out,
            light_field_door,
            ..
        } = compose::line(config, plan.stages, &equipment)?;
        let stage_names: Vec<&'static str> = stages.iter().map(|stage| stage.name()).collect();

        let limits = config.live.limits().for_period(period);
        let mut builder = Pipeline::builder(source, Arc::clone(&clock))
            .between_stages(1)
            .scheduling(&config.scheduling)
            .keep_original(plan.display.is_some());
        if !plan.patient {
            builder = builder.live(limits).entry(Queue::newest_only());
        }
        for stage in stages {
            builder = builder.stage(stage);
        }
        let door = |capacity: usize| {
            if plan.patient {
                Queue::blocking(capacity)
            } else {
                Queue::drop_oldest(capacity)
            }
        };
        let meter = MeterSink::new(Arc::clone(&clock), plan.keep);
        let reading = meter.reading();
        builder = builder.sink(Box::new(meter), door(2));
        if let Some(display) = &plan.display {
            builder = builder
                .tap(Box::new(display.raw_sink()), door(1))
                .sink(Box::new(display.sink()), door(1));
        }
        let (mut recorder, mut enhanced_recorder) = (None, None);
        if let Some(folder) = plan.record {
            let raw = RecorderSettings {
                track: Track::Raw,
                content: if config.live.lossless_recording {
                    Content::Lossless
                } else {
                    Content::Color
                },
                folder: folder.to_owned(),
                frame_rate_hz: if period > Span(0) { 1.0 / period.seconds() } else { 25.0 },
                beside: calibration_files(config, plan.wanted),
            };
            let enhanced = RecorderSettings {
                track: Track::Enhanced,
                beside: Vec::new(),
                ..raw.clone()
            };
            let sink = RecorderSink::new(raw, arm.as_ref().map(|_| samples))?;
            recorder = Some(sink.reading());
            builder = builder.tap(Box::new(sink), door(config.live.frames_before_recorder));
            if plan.record_enhanced {
                let sink = RecorderSink::new(enhanced, None)?;
                enhanced_recorder = Some(sink.reading());
                builder = builder.sink(Box::new(sink), door(config.live.frames_before_recorder));
            }
            let table = TraceSink::new(&folder.join("timings.csv"), TraceFormat::Table, stage_names.clone())?;
            builder = builder.sink(Box::new(table), door(TRACED));
        }
        let mut virtual_camera = None;
        if let Some(path) = plan.virtual_camera {
            let sink = VirtualCameraSink::new(
                virtual_camera_at(path)?,
                config.virtual_camera.layout().map_err(anyhow::Error::msg)?,
            );
            virtual_camera = Some(sink.reading());
            builder = builder.sink(Box::new(sink), door(1));
        }
        if let Some(path) = plan.trace {
            let trace = TraceSink::new(path, TraceFormat::Events, stage_names.clone())?;
            builder = builder.sink(Box::new(trace), door(TRACED));
        }
        let mut drift = None;
        if let Some(arm) = &arm {
            let believed = recording.hand_eye.as_ref().and_then(|hand_eye| hand_eye.time_offset);
            let sink = DriftSink::new(arm.poses().clone(), believed.unwrap_or_default());
            drift = Some(sink.reading());
            builder = builder.tap(Box::new(sink), door(1));
        }
        let line = builder.build()?.start()?;
        let loader = match plan.light_field.zip(light_field_door) {
            Some((folder, door)) => {
                for name in idle_stages(line.controls()) {
                    line.controls().bypass(name)?;
                }
                let awaited = Awaited {
                    door,
                    controls: Arc::clone(line.controls()),
                    stop: Arc::clone(&stop),
                };
                Some(Loader::start(awaited, folder.to_owned(), Arc::clone(&stop))?)
            }
            None => None,
        };
        Ok(Self {
            line,
            left_out,
            name,
            size,
            period,
            limits,
            stop,
            meter: reading,
            camera: watch,
            arm,
            drift,
            recorder,
            enhanced_recorder,
            virtual_camera,
            loader,
        })
    }

    /// How far the light field has come; a failure is told when it is found.
    pub fn light_field(&mut self) -> LightFieldState {
        self.loader.as_mut().map_or(LightFieldState::None, Loader::look)
    }

    /// Stop the source; the line then ends by itself.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Release);
        self.line.stop();
    }
}

/// The node behind which other programs find the picture.
#[cfg(all(target_os = "linux", feature = "v4l2"))]
fn virtual_camera_at(path: &Path) -> anyhow::Result<Box<dyn Screen>> {
    Ok(Box::new(crate::sinks::v4l2_output::V4l2Output::new(path)))
}

#[cfg(not(all(target_os = "linux", feature = "v4l2")))]
fn virtual_camera_at(path: &Path) -> anyhow::Result<Box<dyn Screen>> {
    anyhow::bail!(
        "{}: this program was built without virtual cameras (feature `v4l2`, Linux only)",
        path.display()
    )
}

impl Loader {
    fn start(awaited: Awaited, folder: PathBuf, wish_to_stop: Arc<AtomicBool>) -> anyhow::Result<Self> {
        let thread = std::thread::Builder::new()
            .name("light field".to_owned())
            .spawn(move || awaited.bring(&folder))
            .context("expected a thread to read the light field")?;
        Ok(Self {
            thread: Some(thread),
            wish_to_stop,
            outcome: LightFieldState::Loading,
        })
    }

    fn look(&mut self) -> LightFieldState {
        let Some(thread) = self.thread.take_if(|thread| thread.is_finished()) else {
            return self.outcome;
        };
        self.outcome = match thread.join() {
            Ok(Ok(())) => LightFieldState::Ready,
            Ok(Err(_)) if self.wish_to_stop.load(Ordering::Acquire) => LightFieldState::Loading,
            Ok(Err(error)) => {
                tracing::error!("light field: {error:#}; the line goes on without it");
                LightFieldState::Failed
            }
            Err(_) => {
                tracing::error!("light field: a fault of this program; the line goes on without it");
                LightFieldState::Failed
            }
        };
        self.outcome
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.wish_to_stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // What it had to say nobody waits for any more.
            let _left = thread.join();
        }
    }
}
