//! `calibrate time-offset`: by how much the arm's clock differs from the camera's, from any recording in which both move.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::Context as _;
use serde::Serialize;

use crate::calibration::time_offset::drift::{DriftWatch, Verdict};
use crate::calibration::time_offset::image_motion::MotionTracker;
use crate::calibration::time_offset::offset::{Offset, TimedMotion, estimate};
use crate::cli::console;
use crate::cli::context::{Context, Ended};
use crate::image::pool::Pool;
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress as _;
use crate::recording::folder::Recording;
use crate::robot::pose_buffer::{self, PoseBuffer};
use crate::time::{Span, Timestamp};

/// Measure how late the arm's stamps are.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  endofield calibrate time-offset survey/ --write

No board is needed: the picture's motion is compared with the arm's. Move the scope in several directions, and not evenly.
The offset is what must be added to a pose's stamp to get the camera's clock (negative where poses come late).")]
pub struct Args {
    /// A recording with pictures, frames.csv and poses.
    recording: PathBuf,
    /// Search within ± this, ms.
    #[arg(long, default_value_t = 300.0, value_name = "MS")]
    range_ms: f64,
    /// Around this, ms.
    #[arg(long, default_value_t = 0.0, value_name = "MS", allow_negative_numbers = true)]
    about_ms: f64,
    /// Write the offset into the recording's hand_eye.yaml.
    #[arg(long)]
    write: bool,
    /// Also write the figures as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Debug, Serialize)]
struct Report {
    time_offset_ms: f64,
    sigma_ms: f64,
    sure: bool,
    explained: f64,
    distinctness: f64,
    window_s: f64,
    independent_windows: f64,
    frames: usize,
    /// Offset (ms) and logarithm of its likelihood.
    curve: Vec<[f64; 2]>,
    /// Seconds into the recording, and what a look at the last seconds told.
    drift: Vec<(f64, String)>,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    if let Some(path) = &args.json {
        context.refuse_overwriting(path)?;
    }
    let recording = Recording::open(&args.recording)?;
    let trajectory = recording
        .trajectory
        .as_ref()
        .with_context(|| format!("{}: expected poses.tum or joints.csv, found none", args.recording.display()))?;
    let settings = pose_buffer::Settings {
        max_extrapolation_ms: 0.0,
        ..context.config.poses.clone()
    };
    let arm = PoseBuffer::from_trajectory(trajectory, &settings)?;
    let motions = image_motions(&recording, context)?;
    let range = Span::from_milliseconds(args.range_ms);
    let found = estimate(&motions, &arm, Span::from_milliseconds(args.about_ms), range)?;
    let report = report(&found, &motions, &arm);
    console::print(&table(&report))?;
    if let Some(path) = &args.json {
        super::write_json(path, &serde_json::to_value(&report)?)?;
    }
    if !found.is_sure() {
        anyhow::bail!(
            "the offset is not sure enough to be used: move the scope more, in several directions and not evenly, while recording"
        );
    }
    if args.write {
        let path = args.recording.join("hand_eye.yaml");
        let mut hand_eye = recording.hand_eye.clone().with_context(|| {
            format!(
                "{}: expected a hand-eye file to write the offset into, found none",
                path.display()
            )
        })?;
        hand_eye.time_offset = Some(found.offset);
        hand_eye.write(&path)?;
        console::print(&format!("wrote {}\n", path.display()))?;
    }
    Ok(Ended::Complete)
}

fn image_motions(recording: &Recording, context: &Context) -> anyhow::Result<Vec<TimedMotion>> {
    let mut reader = VideoReader::open(&Input::from_argument(recording.video.path()))?;
    let pool = Pool::new(4);
    let mut tracker = MotionTracker::default();
    let mut motions = Vec::new();
    let mut previous: Option<Timestamp> = None;
    context.console.begin("image motion", reader.info().frame_count.unwrap_or(0));
    while let Some(frame) = reader.next_frame(&pool)? {
        anyhow::ensure!(!context.console.stopping(), "stopped before all pictures were looked at");
        let at = match &recording.frame_times {
            Some(times) => *times
                .get(usize::try_from(frame.number)?)
                .with_context(|| format!("frames.csv: no line for frame {}", frame.number))?,
            None => frame.timestamp,
        };
        if let (Some(motion), Some(from)) = (tracker.next(&frame.image), previous) {
            motions.push(TimedMotion { from, to: at, motion });
        }
        previous = Some(at);
        context.console.advance(1);
    }
    context.console.end();
    Ok(motions)
}

fn report(found: &Offset, motions: &[TimedMotion], arm: &PoseBuffer) -> Report {
    let start = motions.first().map_or(Timestamp(0), |first| first.from);
    let mut watch = DriftWatch::new(found.offset);
    let verdicts = motions.iter().filter_map(|motion| {
        let verdict = watch.push(*motion, arm)?;
        let text = match verdict {
            Verdict::Agree => "agree".to_owned(),
            Verdict::Silent => "too little motion to tell".to_owned(),
            Verdict::Drifted { offset, sigma_ms } => format!("drifted to {:.0} ms (± {sigma_ms:.0})", offset.milliseconds()),
        };
        Some(((motion.to - start).seconds(), text))
    });
    Report {
        time_offset_ms: found.offset.milliseconds(),
        sigma_ms: found.sigma_ms,
        sure: found.is_sure(),
        explained: found.explained,
        distinctness: found.distinctness,
        window_s: found.windows[0],
        independent_windows: found.windows[1],
        frames: motions.len() + 1,
        curve: found.curve.clone(),
        drift: verdicts.collect(),
    }
}

/// Rows of the likelihood's plot on the terminal.
const PLOT_ROWS: usize = 8;
const PLOT_COLUMNS: usize = 61;

fn table(report: &Report) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "time offset   {:.1} ms (± {:.1}): to be added to the arm's stamps\n  {:.0} % of the picture's motion explained by the arm's, over {:.1} s \
        windows, {:.0} of them independent, of {} frames",
        report.time_offset_ms,
        report.sigma_ms,
        100.0 * report.explained,
        report.window_s,
        report.independent_windows,
        report.frames
    );
    text.push_str(&plot(&report.curve));
    let agree = report.drift.iter().filter(|(_, verdict)| verdict == "agree").count();
    let _ = writeln!(text, "  over the recording: {agree} of {} looks agree", report.drift.len());
    for (at, verdict) in report.drift.iter().filter(|(_, verdict)| verdict.starts_with("drifted")) {
        let _ = writeln!(text, "  ! at {at:.0} s the clocks have {verdict}");
    }
    text
}

/// The likelihood over the offset, as columns.
fn plot(curve: &[[f64; 2]]) -> String {
    let (Some(first), Some(last)) = (curve.first(), curve.last()) else {
        return String::new();
    };
    let (low, high) = curve.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), [_, l]| {
        (low.min(*l), high.max(*l))
    });
    let columns: Vec<usize> = (0..PLOT_COLUMNS)
        .map(|column| {
            let [_, likelihood] = curve[column * (curve.len() - 1) / (PLOT_COLUMNS - 1)];
            ((likelihood - low) / (high - low).max(1e-12) * PLOT_ROWS as f64).round() as usize
        })
        .collect();
    let mut text = String::new();
    for row in (1..=PLOT_ROWS).rev() {
        let line: String = columns.iter().map(|&height| if height >= row { '#' } else { ' ' }).collect();
        let _ = writeln!(text, "  |{line}");
    }
    let _ = writeln!(text, "  {:<30.0}log-likelihood{:>18.0} ms", first[0], last[0]);
    text
}
