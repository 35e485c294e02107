//! `arm monitor`: how the arm's feed goes, and a recording of it.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use clap::ValueEnum;
use crossbeam::channel::{Receiver, RecvTimeoutError, bounded};
use serde_json::json;

use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::progress::Progress as _;
use crate::robot::feed::line::LineSource;
use crate::robot::feed::message::{Reading, Sample, fault_names, status_bit};
use crate::robot::feed::reader::ArmFeed;
use crate::robot::feed::settings::{PoseClock, Protocol, Settings};
use crate::robot::feed::statistics::{FeedStatistics, FeedStatus, LinkState};
use crate::robot::quaternion::xyzw_from_rotation;
use crate::robot::trajectory::{stamp_text, tum_head, tum_line};
use crate::time::{Clock as _, MonotonicClock, Span, Timestamp};

/// How often what is shown is brought up to date.
const SHOW_EVERY: Duration = Duration::from_millis(100);
/// Samples that may wait to be recorded: four seconds at 1 kHz.
const QUEUE: usize = 4096;

/// Watch an arm's feed: rate, delays, faults, losses, pose.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  endofield arm monitor --port /dev/ttyUSB0 --record poses.tum\n\n\
    Without hardware, in another terminal first: endofield arm simulate --port /tmp/arm\n\
    Ends with Ctrl-C, after --duration, or at the end of a file; a summary is printed on stdout. Exit code 1 if no pose came.\n\
    All parameters of the serial line are settings: --set arm.parity=even (see config/default.toml, [arm]).")]
pub struct Args {
    /// A serial port, `-` for standard input, or a file [default: arm.port].
    #[arg(long, value_name = "PORT|-|FILE")]
    port: Option<String>,
    /// What the arm speaks [default: arm.protocol; text for standard input and for .tum, .csv and .txt files].
    #[arg(long, value_enum)]
    protocol: Option<ProtocolName>,
    /// Bits a second [default: arm.baud].
    #[arg(long)]
    baud: Option<u32>,
    /// The arm's table of joints [default: arm.kinematics].
    #[arg(long, value_name = "FILE")]
    arm: Option<PathBuf>,
    /// Whose time the poses carry [default: the device's own for files and standard input, else arm.clock].
    #[arg(long, value_enum)]
    clock: Option<ClockName>,
    /// End after so many seconds.
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
    /// Write every reading: `….csv` as joint values, any other name as poses (TUM layout).
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum ProtocolName {
    /// Binary, docs/arm_feed.md.
    Endofield,
    /// A pose a line.
    TextPoses,
    /// Joint values a line.
    TextJoints,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ClockName {
    /// The host's monotonic clock.
    Host,
    /// The device's stamps as they are.
    Device,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let (source, settings) = chosen(args, context)?;
    let mut recorder = args.record.as_deref().map(|path| Recorder::new(path, context)).transpose()?;
    let (send, samples) = bounded(QUEUE);
    let clock = Arc::new(MonotonicClock);
    let feed = ArmFeed::start(source.clone(), &settings, &context.config.poses, clock, Some(send))?;
    let mut watched = Watched::default();
    let end = args.duration.map(|s| MonotonicClock.now() + Span::from_seconds(s));
    let mut live = context.console.live_line();
    while !context.console.stopping() && end.is_none_or(|end| MonotonicClock.now() < end) {
        let ended = feed.has_ended();
        take(&samples, SHOW_EVERY, &mut watched, recorder.as_mut())?;
        let status = feed.status();
        live.update(|| line(&status), || json_of("progress", &status));
        if ended && samples.is_empty() {
            break;
        }
    }
    let mut status = feed.status();
    status.statistics = feed.stop();
    take(&samples, Duration::ZERO, &mut watched, recorder.as_mut())?;
    live.last(|| json_of("end", &status));
    drop(live);
    if let Some(recorder) = recorder {
        recorder.finish()?;
    }
    console::print(&summary(&source, &status, &watched))?;
    if watched.count == 0 && !context.console.stopping() {
        tracing::error!("{}", why_nothing_came(&source, &status));
        return Ok(Ended::Incomplete);
    }
    Ok(Ended::Complete)
}

fn chosen(args: &Args, context: &Context) -> anyhow::Result<(LineSource, Settings)> {
    let mut settings = context.config.arm.clone();
    if let Some(port) = &args.port {
        settings.port.clone_from(port);
    }
    if settings.port.is_empty() {
        let message = "expected --port (a serial port, - or a file) or the setting arm.port; \
            `ls /dev/serial/by-id` names the adapters that are plugged in, `endofield arm simulate` plays one";
        return Err(UsageError(message.to_owned()).into());
    }
    if let Some(duration) = args.duration.filter(|s| !(*s > 0.0 && *s <= 1e9)) {
        return Err(UsageError(format!("--duration: expected more than 0 s, found {duration}")).into());
    }
    let source = LineSource::from_word(&settings.port);
    if let Some(protocol) = args.protocol {
        settings.protocol = match protocol {
            ProtocolName::Endofield => Protocol::Endofield,
            ProtocolName::TextPoses => Protocol::TextPoses,
            ProtocolName::TextJoints => Protocol::TextJoints,
        };
    } else if let Some(protocol) = usual_protocol(&source) {
        settings.protocol = protocol;
    }
    if let Some(baud) = args.baud {
        settings.baud = baud;
    }
    if let Some(arm) = &args.arm {
        settings.kinematics = arm.to_string_lossy().into_owned();
    }
    settings.clock = match (args.clock, &source) {
        (Some(ClockName::Host), _) => PoseClock::Host,
        (Some(ClockName::Device), _) => PoseClock::Device,
        (None, LineSource::Port(_)) => settings.clock,
        // When these bytes are read need not say when they were true.
        (None, LineSource::Input | LineSource::File(_)) => PoseClock::Device,
    };
    settings.check().map_err(UsageError)?;
    Ok((source, settings))
}

fn usual_protocol(source: &LineSource) -> Option<Protocol> {
    match source {
        LineSource::Port(_) => None,
        LineSource::Input => Some(Protocol::TextPoses),
        LineSource::File(path) => {
            let name = path.file_name()?.to_string_lossy().to_lowercase();
            let is_text = [".tum", ".csv", ".txt"].iter().any(|ending| name.ends_with(ending));
            let protocol = if name.contains("joints") {
                Protocol::TextJoints
            } else {
                Protocol::TextPoses
            };
            is_text.then_some(protocol)
        }
    }
}

/// What the samples themselves tell.
#[derive(Debug, Default)]
struct Watched {
    count: u64,
    first: Option<Timestamp>,
    last: Option<Timestamp>,
}

impl Watched {
    fn rate_hz(&self) -> f64 {
        match (self.first, self.last) {
            (Some(first), Some(last)) if last > first => (self.count - 1) as f64 / (last - first).seconds(),
            _ => 0.0,
        }
    }
}

/// Take what comes for a while.
fn take(
    samples: &Receiver<Sample>,
    length: Duration,
    watched: &mut Watched,
    mut recorder: Option<&mut Recorder>,
) -> anyhow::Result<()> {
    let end = MonotonicClock.now() + Span(i64::try_from(length.as_nanos()).unwrap_or(i64::MAX));
    loop {
        let left = Duration::from_nanos((end - MonotonicClock.now()).0.max(0).unsigned_abs());
        match samples.recv_timeout(left) {
            Ok(sample) => {
                watched.count += 1;
                watched.first.get_or_insert(sample.pose.stamp);
                watched.last = Some(sample.pose.stamp);
                if let Some(recorder) = recorder.as_deref_mut() {
                    recorder.write(&sample)?;
                }
            }
            Err(RecvTimeoutError::Timeout) => return Ok(()),
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(left);
                return Ok(());
            }
        }
    }
}

/// Writes samples to a file as they come.
#[derive(Debug)]
struct Recorder {
    path: PathBuf,
    file: BufWriter<File>,
    joints: bool,
    started: bool,
}

impl Recorder {
    fn new(path: &Path, context: &Context) -> anyhow::Result<Self> {
        context.refuse_overwriting(path)?;
        let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self {
            path: path.to_owned(),
            file: BufWriter::new(file),
            joints: path.extension().is_some_and(|extension| extension == "csv"),
            started: false,
        })
    }

    fn write(&mut self, sample: &Sample) -> anyhow::Result<()> {
        let mut text = String::new();
        if self.joints {
            let Reading::Joints(joints) = &sample.message.reading else {
                anyhow::bail!(
                    "{}: a .csv file takes joint values, the arm sends poses; record them under a name such as poses.tum",
                    self.path.display()
                );
            };
            let words = |prefix: &str, values: Vec<String>| format!("{prefix},{}\n", values.join(","));
            if !self.started {
                let names = (1..=joints.as_slice().len()).map(|i| format!("q{i}")).collect();
                text.push_str(&words("timestamp_s", names));
            }
            let values = joints.as_slice().iter().map(|value| format!("{value:.9}")).collect();
            text.push_str(&words(&stamp_text(sample.pose.stamp), values));
        } else {
            if !self.started {
                text.push_str(&tum_head("T_base_hand"));
            }
            text.push_str(&tum_line(sample.pose.stamp, sample.pose.base_from_hand.isometry()));
        }
        self.started = true;
        self.file
            .write_all(text.as_bytes())
            .with_context(|| format!("cannot write {}", self.path.display()))
    }

    fn finish(mut self) -> anyhow::Result<()> {
        self.file
            .flush()
            .with_context(|| format!("cannot write {}", self.path.display()))
    }
}

fn line(status: &FeedStatus) -> String {
    let link = match &status.link {
        // What to do about it has been told.
        LinkState::Absent(reason) => format!("absent ({})", reason.split(';').next().unwrap_or_default()),
        link => link.word().to_owned(),
    };
    let counts = &status.statistics;
    let refused = refused(counts);
    let mut text = format!(
        "{link} · {:.1} Hz · late {:.1} ms (99 %: {:.1}) · lost {} · bad {}",
        status.rate_hz,
        status.delays.p50.milliseconds(),
        status.delays.p99.milliseconds(),
        counts.lost,
        counts.bad_check + counts.malformed,
    );
    if refused > 0 {
        text.push_str(&format!(" · refused {refused}"));
    }
    if status.faults != 0 {
        text.push_str(&format!(" · FAULT: {}", fault_names(status.faults).join(", ")));
    }
    if let Some(sample) = &status.last {
        let t = sample.pose.base_from_hand.translation();
        let axis = sample.pose.base_from_hand.rotation() * nalgebra::Vector3::z();
        text.push_str(&format!(
            " · at {:.1} {:.1} {:.1} mm · points {:.2} {:.2} {:.2}",
            t.x, t.y, t.z, axis.x, axis.y, axis.z
        ));
    }
    text
}

fn refused(counts: &FeedStatistics) -> u64 {
    counts.refused_number + counts.refused_joints + counts.refused_fault
}

fn json_of(event: &str, status: &FeedStatus) -> serde_json::Value {
    let on = |bit: u8| status.status & bit != 0;
    let pose = status.last.as_ref().map(|sample| {
        let pose = &sample.pose.base_from_hand;
        let joints = match &sample.message.reading {
            Reading::Joints(joints) => Some(joints.as_slice().to_vec()),
            Reading::Pose { .. } => None,
        };
        json!({
            "timestamp_s": sample.pose.stamp.seconds(),
            "translation_mm": <[f64; 3]>::from(pose.translation()),
            "rotation_xyzw": xyzw_from_rotation(&pose.rotation()),
            "joints": joints,
        })
    });
    json!({
        "event": event,
        "task": "arm",
        "link": status.link.word(),
        "reason": match &status.link { LinkState::Absent(reason) => Some(reason), _ => None },
        "rate_hz": status.rate_hz,
        "delay_ms": {
            "p50": status.delays.p50.milliseconds(),
            "p99": status.delays.p99.milliseconds(),
            "max": status.delays.max.milliseconds(),
        },
        "clock": status.clock.map(|clock| json!({"offset_s": clock.offset.seconds(), "drift_ppm": clock.drift_ppm})),
        "moving": on(status_bit::MOVING),
        "braked": on(status_bit::BRAKED),
        "guided": on(status_bit::GUIDED),
        "faults": fault_names(status.faults),
        "refusal": status.refusal,
        "pose": pose,
        "statistics": status.statistics,
    })
}

fn summary(source: &LineSource, status: &FeedStatus, watched: &Watched) -> String {
    let name = match source {
        LineSource::Port(path) | LineSource::File(path) => path.display().to_string(),
        LineSource::Input => "standard input".to_owned(),
    };
    let c = &status.statistics;
    let mut rows = vec![
        ("poses", format!("{}, {:.1} a second on average", c.poses, watched.rate_hz())),
        ("lost", format!("{} by gaps in the sequence, {} repeated", c.lost, c.repeated)),
        (
            "refused",
            format!(
                "{} no number, {} joints out of bounds, {} for a fault",
                c.refused_number, c.refused_joints, c.refused_fault
            ),
        ),
        (
            "bytes",
            format!(
                "{}, {} of them skipped; {} bad checks, {} malformed, {} unknown",
                c.bytes, c.bytes_skipped, c.bad_check, c.malformed, c.unknown
            ),
        ),
    ];
    if matches!(source, LineSource::Port(_)) {
        rows.push((
            "line",
            format!(
                "opened {}×, broke {}×, fell silent {}×; the arm restarted {}×",
                c.opened, c.hang_ups, c.silences, c.restarts
            ),
        ));
        rows.push((
            "late",
            format!(
                "{:.2} ms median, {:.2} ms p99, {:.2} ms at most, beyond the quickest (last 2 s)",
                status.delays.p50.milliseconds(),
                status.delays.p99.milliseconds(),
                status.delays.max.milliseconds()
            ),
        ));
        let drift = match status.clock.and_then(|clock| clock.drift_ppm) {
            Some(ppm) if ppm < 0.0 => format!("the arm's runs fast by {:.1} ppm", -ppm),
            Some(ppm) => format!("the arm's runs slow by {ppm:.1} ppm"),
            None => "drift not known yet: it takes 10 s".to_owned(),
        };
        rows.push(("clock", drift));
    }
    if c.with_faults > 0 {
        rows.push(("faults", format!("in {} messages", c.with_faults)));
    }
    if let Some(refusal) = &status.refusal {
        rows.push(("last refusal", refusal.clone()));
    }
    if c.overrun + c.out_of_order > 0 {
        rows.push((
            "not kept",
            format!("{} too fast to record, {} out of order", c.overrun, c.out_of_order),
        ));
    }
    let mut text = format!("{name}\n");
    for (key, value) in rows {
        text.push_str(&format!("  {key:<13} {value}\n"));
    }
    text
}

fn why_nothing_came(source: &LineSource, status: &FeedStatus) -> String {
    let counts = &status.statistics;
    match &status.link {
        LinkState::Absent(reason) => reason.clone(),
        _ if counts.refused_joints > 0 => format!(
            "messages came, but {}; is --arm the right table of joints?",
            status.refusal.as_deref().unwrap_or("the joints cannot be")
        ),
        _ if refused(counts) > 0 => format!(
            "messages came, but no pose could be taken: {}",
            status.refusal.as_deref().unwrap_or("refused")
        ),
        _ if counts.bytes > 0 => "bytes came, but no message was among them; are --protocol and --baud right?".to_owned(),
        _ if matches!(source, LineSource::Port(_)) => {
            "the line is open, but nothing came; is the arm on, and the cable right?".to_owned()
        }
        _ => "nothing came".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_speak_text_by_their_names() {
        let usual = |name: &str| usual_protocol(&LineSource::File(name.into()));
        assert_eq!(usual("a/poses.tum"), Some(Protocol::TextPoses));
        assert_eq!(usual("a/joints.csv"), Some(Protocol::TextJoints));
        assert_eq!(usual("a/capture.bin"), None);
        assert_eq!(usual_protocol(&LineSource::Input), Some(Protocol::TextPoses));
        assert_eq!(usual_protocol(&LineSource::Port("/dev/ttyUSB0".into())), None);
    }
}
