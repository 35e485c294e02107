//! `calibrate time-offset`: by how much the arm's clock differs from the camera's, from any recording in which both move.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::calibration::time_offset::drift::{DriftWatch, Verdict};
use crate::calibration::time_offset::image_motion::MotionTracker;
use crate::calibration::time_offset::offset::{self, TimedMotion};
use crate::calibration::time_offset::path_offset::{self, PathOffset};
use crate::calibration::time_offset::plot::{Plotted, drawn};
use crate::cli::calibrate::camera_path::{CORNERS, Corners, HARDLY, Stretches, Trust};
use crate::cli::calibrate::time_offset_report::{Found, Report, StretchReport};
use crate::cli::console;
use crate::cli::context::{Context, Ended};
use crate::cli::telescope;
use crate::image::pool::Pool;
use crate::media::image_files;
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress as _;
use crate::recording::folder::Recording;
use crate::robot::pose_buffer::{self, PoseBuffer};
use crate::time::{Span, Timestamp};

/// Measure how late the arm's stamps are.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  endofield calibrate time-offset survey/ --write

No board is needed. Where the recording has camera.yaml and hand_eye.yaml, the camera's path through the pictures is laid over the arm's;
otherwise (ultrasound, say) the picture's motion as a whole is compared with the arm's. Swing the scope to and fro in several directions,
not evenly. The offset is what must be added to a pose's stamp to get the camera's clock (negative where poses come late).
With --write the report goes beside hand_eye.yaml: time_offset_report.json and .png.")]
pub struct Args {
    /// A recording with pictures, frames.csv and poses.
    recording: PathBuf,
    /// Search within ± this, ms.
    #[arg(long, default_value_t = 300.0, value_name = "MS")]
    range_ms: f64,
    /// Around this, ms.
    #[arg(long, default_value_t = 0.0, value_name = "MS", allow_negative_numbers = true)]
    about_ms: f64,
    /// What tells the camera's motion.
    #[arg(long, value_enum, default_value_t = By::Best)]
    by: By,
    /// Write the offset into the recording's hand_eye.yaml, and the report beside it.
    #[arg(long)]
    write: bool,
    /// Write the figures as JSON here.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Draw likelihood and motion here, as PNG.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// How far an oblique telescope is turned against the camera head in this recording, degrees (`calibrate oblique` tells what turns).
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    telescope_angle_deg: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum By {
    /// The camera's path where the recording allows, the picture's motion otherwise.
    Best,
    /// The camera's path through the pictures.
    CameraPath,
    /// The motion of the picture as a whole.
    ImageMotion,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let beside = |name: &str| args.write.then(|| args.recording.join(name));
    let json = args.json.clone().or_else(|| beside("time_offset_report.json"));
    let plot = args.plot.clone().or_else(|| beside("time_offset_report.png"));
    for path in json.iter().chain(&plot) {
        context.refuse_overwriting(path)?;
    }
    if !(args.range_ms.is_finite() && (20.0..=5000.0).contains(&args.range_ms) && args.about_ms.is_finite()) {
        anyhow::bail!(crate::cli::context::UsageError(format!(
            "--range-ms: expected 20 to 5000 ms, found {}",
            args.range_ms
        )));
    }
    let untouched = Recording::open(&args.recording)?;
    let recording = telescope::turned(untouched.clone(), args.telescope_angle_deg)?;
    let trajectory = recording
        .trajectory
        .as_ref()
        .with_context(|| format!("{}: expected poses.tum or joints.csv, found none", args.recording.display()))?;
    let settings = pose_buffer::Settings {
        max_extrapolation_ms: 0.0,
        ..context.config.poses.clone()
    };
    let arm = PoseBuffer::from_trajectory(trajectory, &settings)?;
    let watched = watched(&recording, context)?;
    let (about, range) = (Span::from_milliseconds(args.about_ms), Span::from_milliseconds(args.range_ms));
    let by_motion = offset::estimate(&watched.motions, &arm, about, range);
    let by_path = match args.by {
        By::ImageMotion => None,
        By::Best if recording.camera.is_none() || recording.hand_eye.is_none() => None,
        By::Best | By::CameraPath => {
            let start = by_motion.as_ref().ok().map(|found| found.offset);
            Some(by_path(&recording, &arm, &watched.times, [about, range], start, context)?)
        }
    };
    let found = match (by_path, by_motion) {
        (Some(stretches), by_motion) => Found::by_path(stretches, by_motion.ok(), range),
        (None, by_motion) => Found::by_motion(by_motion?),
    };
    let mut report = found.report(watched.times.len());
    if let Some(believed_ms) = report.believed_ms() {
        report.drift = drift(&watched.motions, &arm, Span::from_milliseconds(believed_ms));
    }
    console::print(&report.table())?;
    if let Some(path) = &json {
        super::write_json(path, &serde_json::to_value(&report)?)?;
    }
    if let Some(path) = &plot {
        draw(path, &report, context.force)?;
    }
    let Some(offset_ms) = report.time_offset_ms.filter(|_| report.sure) else {
        anyhow::bail!("not observed: {}", report.advice);
    };
    if args.write {
        write(&args.recording, &untouched, Span::from_milliseconds(offset_ms))?;
    }
    Ok(Ended::Complete)
}

fn draw(path: &Path, report: &Report, force: bool) -> anyhow::Result<()> {
    if force && path.exists() {
        std::fs::remove_file(path).with_context(|| format!("cannot replace {}", path.display()))?;
    }
    let picture = drawn(&Plotted {
        offset_ms: report.time_offset_ms.unwrap_or(f64::NAN),
        sigma_ms: report.sigma_ms.unwrap_or(f64::NAN),
        curve: &report.curve,
        traces: &report.traces,
        traced: report.traced,
    });
    Ok(image_files::write(path, &picture)?)
}

fn write(folder: &Path, recording: &Recording, offset: Span) -> anyhow::Result<()> {
    let path = folder.join("hand_eye.yaml");
    let mut hand_eye = recording.hand_eye.clone().with_context(|| {
        format!(
            "{}: expected a hand-eye file to write the offset into, found none; run `endofield calibrate hand-eye` first",
            path.display()
        )
    })?;
    hand_eye.time_offset = Some(offset);
    hand_eye.write(&path)?;
    console::print(&format!("wrote {}\n", path.display()))
}

/// What one look through the video told.
struct Watched {
    times: Vec<Timestamp>,
    motions: Vec<TimedMotion>,
}

fn watched(recording: &Recording, context: &Context) -> anyhow::Result<Watched> {
    let mut reader = VideoReader::open(&Input::from_argument(recording.video.path()))?;
    let pool = Pool::new(4);
    let mut tracker = MotionTracker::default();
    let (mut times, mut motions): (Vec<Timestamp>, Vec<TimedMotion>) = (Vec::new(), Vec::new());
    context.console.begin("image motion", reader.info().frame_count.unwrap_or(0));
    while let Some(frame) = reader.next_frame(&pool)? {
        anyhow::ensure!(!context.console.stopping(), "stopped before all pictures were looked at");
        let at = match &recording.frame_times {
            Some(times) => *times
                .get(usize::try_from(frame.number)?)
                .with_context(|| format!("frames.csv: no line for frame {}", frame.number))?,
            None => frame.timestamp,
        };
        if let (Some(motion), Some(&from)) = (tracker.next(&frame.image), times.last()) {
            motions.push(TimedMotion { from, to: at, motion });
        }
        times.push(at);
        context.console.advance(1);
    }
    context.console.end();
    Ok(Watched { times, motions })
}

/// A stretch's figures, and the offset that its path told.
pub type ToldByPath = (StretchReport, Option<PathOffset>);

fn by_path(
    recording: &Recording,
    arm: &PoseBuffer,
    times: &[Timestamp],
    [about, range]: [Span; 2],
    by_motion: Option<Span>,
    context: &Context,
) -> anyhow::Result<Vec<ToldByPath>> {
    let (Some(camera), Some(hand_eye)) = (&recording.camera, &recording.hand_eye) else {
        anyhow::bail!("the camera's path needs camera.yaml and hand_eye.yaml in the recording; --by image-motion does without");
    };
    let readings: Vec<_> = arm.samples().copied().collect();
    let start = times.first().copied().unwrap_or_default();
    let stretches = Stretches::fetched(recording, camera, arm, times, about, context)?;
    context.console.begin("the camera's path", 3 * stretches.views.len() as u64);
    let mut told = Vec::new();
    for views in &stretches.views {
        let ends = [views.first(), views.last()].map(|view| view.map_or(0.0, |view| (view.exposed_at - start).seconds()));
        let mut report = StretchReport::new(ends);
        let mut look = |at: Span, trust: Trust, corners: Corners| -> Result<PathOffset, String> {
            let found = stretches.path(views, arm, hand_eye.hand_from_camera, at, trust, corners);
            let found = found.map_err(|error| error.to_string())?;
            (report.views, report.reprojection_px) = (found.path.poses().len(), Some(found.error_px));
            context.console.advance(1);
            let told = path_offset::estimate(&found.path, &readings, &hand_eye.hand_from_camera, about, range);
            told.map_err(|error| error.to_string())
        };
        // With the offset roughly known, the arm may straighten what the pictures leave loose. By how much paths through other corners
        // tell other offsets is what the pictures err.
        let mut rough = look(about, HARDLY, CORNERS[0]);
        // Begun far from the truth, a path may be bent: the picture's motion, however rough, is another place to begin.
        if let Some(start) = by_motion
            && !rough.as_ref().is_ok_and(PathOffset::is_sure)
            && let Ok(again) = look(start, HARDLY, CORNERS[0])
            && rough.as_ref().map_or(true, |rough| again.sigma_ms < rough.sigma_ms)
        {
            rough = Ok(again);
        }
        let found = rough.and_then(|rough| {
            let trust = Trust::across(rough.arm_noise);
            let [one, other] = CORNERS.map(|corners| look(rough.offset, trust, corners));
            Ok(one?.averaged(&other?))
        });
        anyhow::ensure!(!context.console.stopping(), "stopped before the camera's path was found");
        match found {
            Ok(offset) => {
                report.tell(&offset);
                told.push((report, Some(offset)));
            }
            Err(why) => {
                report.why_not = Some(why);
                told.push((report, None));
            }
        }
    }
    context.console.end();
    Ok(told)
}

/// Seconds into the recording, and what a look at the last seconds told.
fn drift(motions: &[TimedMotion], arm: &PoseBuffer, believed: Span) -> Vec<(f64, String)> {
    let start = motions.first().map_or(Timestamp(0), |first| first.from);
    let mut watch = DriftWatch::new(believed);
    let verdicts = motions.iter().filter_map(|motion| {
        let text = match watch.push(*motion, arm)? {
            Verdict::Agree => "agree".to_owned(),
            Verdict::Silent => "too little motion to tell".to_owned(),
            Verdict::Drifted { offset, sigma_ms } => format!("drifted to {:.0} ms (± {sigma_ms:.0})", offset.milliseconds()),
        };
        Some(((motion.to - start).seconds(), text))
    });
    verdicts.collect()
}
