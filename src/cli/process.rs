//! `process`: the whole line on a recorded video.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

use anyhow::{Context as _, bail};
use tracing::subscriber::NoSubscriber;

use crate::camera::file as camera_file;
use crate::camera::model::CameraModel;
use crate::cli::context::{Context, Ended, UsageError};
use crate::cli::outputs::{Outputs, beside};
use crate::cli::report::Report;
use crate::cli::telescope;
use crate::compose::{self, Choice, Equipment, Line};
use crate::config::Config;
use crate::frame::PoseOrigin;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::field_of_view;
use crate::image::pool::Pool;
use crate::light_field::build::{self as light_field_build, BuildSettings};
use crate::media::error::MediaError;
use crate::media::reader::{Input, VideoReader};
use crate::media::writer::{Output, Sound, VideoWriter, WriterSettings};
use crate::pipeline::builder::Pipeline;
use crate::pipeline::queue::Queue;
use crate::pipeline::runner::Wish;
use crate::pipeline::stage::Sink;
use crate::progress::Progress as _;
use crate::recording::folder::{Recording, Video};
use crate::sinks::mask::MaskSink;
use crate::sinks::report::{FrameRecord, ReportSink};
use crate::sinks::side_by_side::SideBySideSink;
use crate::sinks::video::VideoSink;
use crate::sources::recording::{Playback, RecordingSource};
use crate::time::{Clock, MonotonicClock, Timestamp};

/// The whole line on a recorded video: temporal median, color normalization, undistortion, specularities substituted from a
/// light field.
///
/// What the input lacks switches off what needs it, with one clear line; the rest runs.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:\n  endofield process operation.mp4 -o enhanced.mp4\n  \
    endofield process recordings/live -o enhanced.mkv --light-field survey.lf --mask-out mask.mkv --report report.json\n  \
    ffmpeg -i in.mp4 -f yuv4mpegpipe - | endofield process - -o - | ffplay -")]
pub struct Args {
    /// A recording's folder, a video file, a folder of pictures, a pattern such as frames/%06d.png, or - for y4m on stdin.
    pub input: PathBuf,
    /// The enhanced video by its ending (.mp4 .mkv .avi .mov), numbered PNGs when it ends in / or holds %06d, - for y4m on stdout.
    #[arg(short, long)]
    pub output: PathBuf,
    /// The light field (`endofield light-field build` makes it).
    #[arg(long, value_name = "LF")]
    pub light_field: Option<PathBuf>,
    /// Parts of the line to run.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Choice::ALL)]
    pub stages: Vec<Choice>,
    /// What happened to each pixel, as a lossless gray video or numbered PNGs: 0 untouched, 64 left, 128 from recent frames,
    /// 192 made up, 255 from the light field.
    #[arg(long, value_name = "MASK")]
    pub mask_out: Option<PathBuf>,
    /// Before and after in one video.
    #[arg(long, value_name = "FILE")]
    pub side_by_side: Option<PathBuf>,
    /// Times and what was done to each frame, as JSON.
    #[arg(long, value_name = "FILE.json")]
    pub report: Option<PathBuf>,
    /// Begin here, s.
    #[arg(long, value_name = "S")]
    pub start: Option<f64>,
    /// End here, s.
    #[arg(long, value_name = "S")]
    pub end: Option<f64>,
    /// How far an oblique telescope is turned against the camera head in this recording, degrees (`calibrate oblique` tells what turns).
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    pub telescope_angle_deg: Option<f64>,
}

/// The image field is looked for in so many frames …
const FIELD_FRAMES: usize = 8;
/// … of which each is so far from the one before.
const FIELD_STEP: usize = 6;

/// What came of it.
#[derive(Debug)]
pub struct Processed {
    /// How it ended.
    pub ended: Ended,
    /// Times, and what was done to each frame.
    pub report: Report,
}

/// Run it, and say what came of it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let Processed { ended, report } = process(args, context, Vec::new())?;
    tracing::debug!("\n{}", report.timing_table());
    tracing::info!(
        "{} of {} frames written to {} in {:.1} s ({:.1} fps, {:.1} ms per frame end to end)",
        report.written(),
        report.frames.entered,
        args.output.display(),
        report.seconds,
        report.frames_per_second,
        report.end_to_end.p50_ms
    );
    Ok(ended)
}

/// The work itself, for this command and for `demo`; `extra` sinks see each finished frame, with the picture as it came.
pub fn process(args: &Args, context: &Context, extra: Vec<Box<dyn Sink>>) -> anyhow::Result<Processed> {
    let span = TimeSpan::checked(args)?;
    let output = Output::from_argument(&args.output).map_err(|error| UsageError(error.to_string()))?;
    let recording = telescope::turned(open_recording(&args.input)?, args.telescope_angle_deg)?;
    let input = if args.input == Path::new("-") {
        Input::Y4mStdin
    } else {
        Input::from_argument(recording.video.path())
    };
    check_outputs(args, &recording, context)?;

    let reader = VideoReader::open(&input)?;
    let info = reader.info().clone();
    recording.check_video_size(info.width, info.height)?;
    let light_field = match &args.light_field {
        Some(folder) => Some(Arc::new(light_field_build::open(
            folder,
            &BuildSettings::default(),
            &context.console,
        )?)),
        None => None,
    };
    let equipment = Equipment {
        recording: &recording,
        light_field,
        light_field_to_come: false,
        may_wait: true,
        poses: None,
        size: (info.width, info.height),
    };
    let Line {
        stages,
        left_out,
        output_camera,
        ..
    } = compose::line(&context.config, &args.stages, &equipment)?;
    for part in &left_out {
        tracing::warn!("{part}");
    }
    let substitutes = stages.iter().any(|stage| stage.name() == "pose_refinement");

    let mut writing = WriterSettings::like(&info);
    writing.crf = context.config.output.crf;
    writing.preset.clone_from(&context.config.output.preset);
    writing.origin = span.start.unwrap_or(Timestamp(0));
    if let (true, Output::File(_), Input::File(path)) = (info.has_audio, &output, &input) {
        writing.sound = Some(Sound {
            path: path.clone(),
            start: span.start,
            end: span.end,
        });
    }
    let queue = Queue::blocking(context.config.line.frames_before_sinks);
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
    let pool = Pool::new(64);
    let playback = Playback {
        exposure_times: recording.frame_times.clone(),
        start: span.start,
        end: span.end,
        camera: recording.camera.clone().map(Arc::new),
        field_of_view: image_field(&input, span, &context.config)?.map(Arc::new),
    };
    let source = RecordingSource::new(reader, playback, Arc::clone(&clock), pool)?;
    let mut builder = Pipeline::builder(Box::new(source), Arc::clone(&clock))
        .entry(Queue::blocking(context.config.line.frames_between_stages))
        .between_stages(context.config.line.frames_between_stages)
        .keep_original(args.side_by_side.is_some() || !extra.is_empty());
    for stage in stages {
        builder = builder.stage(stage);
    }
    builder = builder.essential_sink(
        Box::new(VideoSink::new(VideoWriter::create(&output, &writing, context.force)?)),
        queue,
    );
    if let Some(path) = &args.mask_out {
        let output = Output::from_argument(path).map_err(|error| UsageError(error.to_string()))?;
        let writer = VideoWriter::create(&output, &writing.for_masks(), context.force)?;
        builder = builder.sink(Box::new(MaskSink::new(writer)), queue);
    }
    if let Some(path) = &args.side_by_side {
        let output = Output::from_argument(path).map_err(|error| UsageError(error.to_string()))?;
        let wide = WriterSettings {
            width: SideBySideSink::output_width(info.width),
            sound: None,
            ..writing.clone()
        };
        builder = builder.sink(
            Box::new(SideBySideSink::new(VideoWriter::create(&output, &wide, context.force)?)),
            queue,
        );
    }
    for sink in extra {
        builder = builder.essential_sink(sink, queue);
    }
    let (sink, gathered) = ReportSink::new();
    let running = builder.sink(Box::new(sink), queue).build()?;
    if let Some(camera) = &output_camera {
        write_camera(camera, args, &recording, context)?;
    }

    let began = clock.now();
    let running = running.start()?;
    context.console.begin(
        "process",
        span.frames(info.frame_count, info.duration_s, info.frames_per_second()),
    );
    let mut shown = 0;
    let outcome = running.wait_looking(|line| {
        let status = line.status();
        context.console.advance(status.frames_out - shown);
        shown = status.frames_out;
        if context.console.stopping() { Wish::Stop } else { Wish::GoOn }
    });
    context.console.advance(outcome.frames_out.saturating_sub(shown));
    context.console.end();
    let seconds = (clock.now() - began).seconds();

    for stage in outcome.stages.iter().filter(|stage| stage.failures > 0) {
        tracing::warn!(
            "{} let {} of {} frames pass as they came: {}",
            stage.name,
            stage.failures,
            outcome.frames_in,
            stage.first_failure.as_deref().unwrap_or("no reason given")
        );
    }
    let per_frame = std::mem::take(&mut gathered.lock().unwrap_or_else(PoisonError::into_inner).frames);
    if let Some(said) = substitutes.then(|| left_alone(&per_frame)).flatten() {
        tracing::warn!("{said}");
    }
    let mut report = Report::new(&outcome, seconds, left_out, per_frame);
    report.input = args.input.display().to_string();
    report.output = args.output.display().to_string();
    if let Some(path) = &args.report {
        report.write(path)?;
    }
    let ended = match (report.faults.is_empty(), outcome.stopped) {
        (false, _) => Ended::Incomplete,
        (true, true) => Ended::Interrupted,
        (true, false) => Ended::Complete,
    };
    Ok(Processed { ended, report })
}

/// One line on the frames whose specularities were left because the camera's place was not found; `None` when there are none.
fn left_alone(frames: &[FrameRecord]) -> Option<String> {
    let lost: Vec<&FrameRecord> = frames.iter().filter(|frame| frame.pose_correction_px.is_none()).collect();
    let without_pose = lost.iter().filter(|frame| frame.pose == PoseOrigin::Missing).count();
    let first = lost.first()?.frame;
    Some(format!(
        "specular: left as they were on {} of {} frames (the first is {first}): {without_pose} without a pose, {} that do not fit the light field",
        lost.len(),
        frames.len(),
        lost.len() - without_pose
    ))
}

fn open_recording(input: &Path) -> anyhow::Result<Recording> {
    if input == Path::new("-") {
        return Ok(Recording::plain(Video::File(input.to_owned())));
    }
    if input.to_string_lossy().contains('%') && !input.exists() {
        return Ok(Recording::plain(Video::Frames(input.to_owned())));
    }
    Ok(Recording::open(input)?)
}

/// The endoscope's image field, from a few frames of the part that is asked for. A stream cannot be read twice, so it has none.
fn image_field(input: &Input, span: TimeSpan, config: &Config) -> anyhow::Result<Option<Mask>> {
    if *input == Input::Y4mStdin {
        return Ok(None);
    }
    // What is wrong with the video is told when it is played, and once.
    let frames = tracing::subscriber::with_default(NoSubscriber::default(), || -> Result<_, MediaError> {
        let mut reader = VideoReader::open(input)?;
        if let Some(start) = span.start {
            reader.seek(start)?;
        }
        let pool = Pool::new(1);
        let mut frames = Vec::new();
        for number in 0..FIELD_FRAMES * FIELD_STEP {
            let Ok(Some(frame)) = reader.next_frame(&pool) else { break };
            if number % FIELD_STEP == 0 {
                frames.push(frame.image);
            }
        }
        Ok(frames)
    })?;
    let seen: Vec<&Image<Rgb8>> = frames.iter().map(|frame| &**frame).collect();
    Ok(field_of_view::find(&seen, &config.field_of_view).map(|field| field.mask))
}

fn check_outputs(args: &Args, recording: &Recording, context: &Context) -> anyhow::Result<()> {
    let mut outputs = Outputs::default();
    outputs.add("--output", Some(&args.output));
    outputs.add("--mask-out", args.mask_out.as_deref());
    outputs.add("--side-by-side", args.side_by_side.as_deref());
    outputs.add("--report", args.report.as_deref());
    let mut inputs = vec![args.input.as_path(), recording.video.path()];
    inputs.extend(args.light_field.as_deref());
    outputs.check(&inputs, context)
}

/// The part of the video that is asked for, in the container's time.
#[derive(Clone, Copy, Debug, Default)]
struct TimeSpan {
    start: Option<Timestamp>,
    end: Option<Timestamp>,
}

impl TimeSpan {
    fn checked(args: &Args) -> anyhow::Result<Self> {
        for (option, seconds) in [("--start", args.start), ("--end", args.end)] {
            if seconds.is_some_and(|s| !s.is_finite() || s < 0.0) {
                bail!(UsageError(format!(
                    "{option}: expected seconds from 0 on, found {}",
                    seconds.unwrap_or_default()
                )));
            }
        }
        if let (Some(start), Some(end)) = (args.start, args.end)
            && end <= start
        {
            bail!(UsageError(format!(
                "--end: expected more than --start's {start} s, found {end} s"
            )));
        }
        Ok(Self {
            start: args.start.map(Timestamp::from_seconds),
            end: args.end.map(Timestamp::from_seconds),
        })
    }

    /// How many frames that will be, as far as can be told; 0 = unknown.
    fn frames(&self, count: Option<u64>, duration_s: Option<f64>, per_second: f64) -> u64 {
        if self.start.is_none() && self.end.is_none() {
            return count.unwrap_or(0);
        }
        let length = duration_s.or_else(|| Some(count? as f64 / per_second)).unwrap_or(0.0);
        let end = self.end.map_or(length, |end| end.seconds().min(length));
        let start = self.start.map_or(0.0, Timestamp::seconds);
        ((end - start).max(0.0) * per_second).round() as u64
    }
}

/// `camera.yaml` beside the output. Another camera's file that lies there is left alone; ours then takes the output's name.
fn write_camera(camera: &CameraModel, args: &Args, recording: &Recording, context: &Context) -> anyhow::Result<()> {
    let Some(mut path) = beside(&args.output, "camera.yaml") else {
        return Ok(());
    };
    if let Ok(present) = camera_file::read(&path) {
        if present == *camera {
            return Ok(());
        }
        // A recording's own calibration is never written over, even with --force.
        let own = recording.camera.as_ref() == Some(&present) || matches!(camera_file::read_oblique(&path), Ok(Some(_)));
        if own || !context.force {
            let stem = args
                .output
                .file_stem()
                .map(|stem| stem.to_string_lossy().into_owned())
                .unwrap_or_default();
            path.set_file_name(format!("{stem}.camera.yaml"));
            tracing::warn!(
                "camera.yaml beside the output belongs to another camera and stays; the output's is {}",
                path.display()
            );
        }
    }
    camera_file::write(&path, camera, "undistorted").with_context(|| format!("writing {}", path.display()))
}
