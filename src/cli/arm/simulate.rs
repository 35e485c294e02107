//! `arm simulate`: plays an arm on a serial line, good or bad.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use anyhow::Context as _;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Exp};

use crate::cli::arm::motion::Motion;
use crate::cli::arm::port::{ArmPort, PortChoice, Sent};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::progress::Progress as _;
use crate::robot::feed::faults::{BadLine, Damage};
use crate::robot::feed::message::{DeviceTime, Message, Reading, fault_bit, status_bit};
use crate::robot::feed::reader::arm_of;
use crate::robot::feed::settings::Settings;
use crate::robot::feed::wire;
use crate::time::{Clock as _, MonotonicClock, Span, Timestamp};

/// Play an arm on a serial port or a pseudo-terminal.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example, in two terminals:\n  endofield arm simulate --port /tmp/arm --corrupt 0.01 --pull 20:2\n  endofield arm monitor --port /tmp/arm\n\n\
    The path to listen at is printed on stdout. The format is described in docs/arm_feed.md; it is not the maker's.\n\
    The serial line's parameters are settings: --set arm.baud=57600."
)]
pub struct Args {
    /// A serial port (/dev/ttyX), a new path at which a pseudo-terminal appears, or `pty` for one without a path of its own.
    #[arg(long, value_name = "PORT", default_value = "pty")]
    port: String,
    /// Play the joints or poses of a recording.
    #[arg(long, value_name = "FOLDER", group = "what")]
    recording: Option<PathBuf>,
    /// Play poses (TUM layout).
    #[arg(long, value_name = "FILE", group = "what")]
    poses: Option<PathBuf>,
    /// Play joint values (timestamp_s,q1,…,qn).
    #[arg(long, value_name = "FILE", group = "what")]
    joints: Option<PathBuf>,
    /// Readings a second; without it a file plays at its own times, and the built-in motion at 100.
    #[arg(long, value_name = "HZ")]
    rate: Option<f64>,
    /// The arm's table of joints [default: arm.kinematics].
    #[arg(long, value_name = "FILE")]
    arm: Option<PathBuf>,
    /// How it is sent.
    #[arg(long, value_enum, default_value_t = Format::Binary)]
    format: Format,
    /// Begin again at the end of the file (the arm jumps there); the built-in motion never ends.
    #[arg(long = "loop")]
    again: bool,
    /// End after so many seconds.
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
    /// Everything random follows from it.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Share of bytes that are changed, 0–1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    corrupt: f64,
    /// Share of bytes that are lost, 0–1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    drop: f64,
    /// Share of bytes after which one comes that was not sent, 0–1.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    insert: f64,
    /// Say nothing every so often for so long, s.
    #[arg(long, value_name = "EVERY:FOR")]
    silence: Option<Periodic>,
    /// Pull the cable every so often for so long, s.
    #[arg(long, value_name = "EVERY:FOR")]
    pull: Option<Periodic>,
    /// Report an encoder fault every so often for so long, s.
    #[arg(long, value_name = "EVERY:FOR")]
    fault: Option<Periodic>,
    /// Send later than due by so much on average (exponential), ms.
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    jitter_ms: f64,
    /// The device's clock is slow by so much, ppm.
    #[arg(long, value_name = "PPM", default_value_t = 0.0, allow_negative_numbers = true)]
    drift_ppm: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    /// Packets of docs/arm_feed.md.
    Binary,
    /// A line per reading.
    Text,
}

/// Something that happens every so often for so long.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Periodic {
    every_s: f64,
    for_s: f64,
}

impl FromStr for Periodic {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once(':').and_then(|(every, length)| {
            let (every_s, for_s) = (every.parse().ok()?, length.parse().ok()?);
            (every_s > 0.0 && for_s > 0.0 && for_s < every_s).then_some(Self { every_s, for_s })
        });
        parsed.ok_or_else(|| format!("expected EVERY:FOR in seconds, such as 20:2 (FOR shorter than EVERY), found `{text}`"))
    }
}

impl Periodic {
    fn is_on(self, t: f64) -> bool {
        t >= self.every_s && t % self.every_s < self.for_s
    }
}

fn share(text: &str) -> Result<f64, String> {
    let parsed = text.parse().ok().filter(|value| (0.0..=1.0).contains(value));
    parsed.ok_or_else(|| format!("expected a share from 0 to 1, found `{text}`"))
}

#[derive(Debug, Default)]
struct Tally {
    sent: u64,
    unheard: u64,
    overrun: u64,
    damaged: u64,
    pulls: u64,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let settings = settings_of(args, context)?;
    let motion = motion_of(args, &settings)?;
    let mut player = Player::new(args, &settings, &motion)?;
    let port = ArmPort::open(&player.choice, &settings)?;
    console::print(&format!("{}\n", port.path().display()))?;
    let format = if args.format == Format::Text {
        match motion.at(0.0) {
            Some(Reading::Joints(_)) => " --protocol text_joints",
            _ => " --protocol text_poses",
        }
    } else {
        ""
    };
    match &player.choice {
        PortChoice::Serial(path) => {
            tracing::info!("the arm speaks into {}; listen at the other end of that line", path.display())
        }
        PortChoice::Pseudo(_) => tracing::info!(
            "the arm speaks; listen with: endofield arm monitor --port {}{format}",
            port.path().display()
        ),
    }
    player.port = Some(port);
    let (total, endless) = player.total(args);
    context.console.begin("arm", if endless { 0 } else { total });
    let result = player.play(args, context, total);
    context.console.end();
    let ended = result?;
    let Tally {
        sent,
        unheard,
        overrun,
        damaged,
        pulls,
    } = player.tally;
    tracing::info!(
        "sent {sent} readings ({damaged} of them damaged, {pulls} pulls); {unheard} while nobody listened, {overrun} while the \
         listener was too slow"
    );
    Ok(ended)
}

fn settings_of(args: &Args, context: &Context) -> anyhow::Result<Settings> {
    let mut settings = context.config.arm.clone();
    if let Some(arm) = &args.arm {
        settings.kinematics = arm.to_string_lossy().into_owned();
    }
    for (name, value, highest) in [
        ("--rate", args.rate, 2000.0),
        ("--duration", args.duration, 1e9),
        ("--jitter-ms", Some(args.jitter_ms).filter(|ms| *ms != 0.0), 10_000.0),
    ] {
        if let Some(value) = value.filter(|value| !(*value > 0.0 && *value <= highest)) {
            return Err(UsageError(format!("{name}: expected more than 0 and at most {highest}, found {value}")).into());
        }
    }
    if args.drift_ppm.is_nan() || args.drift_ppm.abs() > 10_000.0 {
        return Err(UsageError(format!("--drift-ppm: expected -10000 to 10000, found {}", args.drift_ppm)).into());
    }
    if args.corrupt + args.drop + args.insert > 1.0 {
        return Err(UsageError("--corrupt, --drop and --insert: expected a sum of at most 1".to_owned()).into());
    }
    Ok(settings)
}

fn motion_of(args: &Args, settings: &Settings) -> anyhow::Result<Motion> {
    let arm = arm_of(settings)?;
    match (&args.recording, &args.poses, &args.joints) {
        (Some(folder), _, _) => Motion::from_recording(folder, &arm),
        (_, Some(path), _) => Motion::from_poses(path),
        (_, _, Some(path)) => Motion::from_joints(path, &arm),
        _ if settings.kinematics.is_empty() => Motion::look_around(args.seed),
        _ => Motion::sway(&arm),
    }
}

struct Player<'a> {
    motion: &'a Motion,
    settings: &'a Settings,
    choice: PortChoice,
    port: Option<ArmPort>,
    bad_line: BadLine,
    random: ChaCha8Rng,
    jitter: Option<Exp<f64>>,
    tally: Tally,
    /// Times of the readings within one pass; empty where they come at `rate_hz`.
    times: Vec<f64>,
    rate_hz: f64,
}

impl<'a> Player<'a> {
    fn new(args: &Args, settings: &'a Settings, motion: &'a Motion) -> anyhow::Result<Self> {
        let choice = PortChoice::from_word(&args.port)?;
        if args.pull.is_some() && choice == PortChoice::Pseudo(None) {
            let message = "--pull: expected --port with a path such as /tmp/arm, so that the line comes back under the same name";
            return Err(UsageError(message.to_owned()).into());
        }
        let damage = Damage {
            corrupt: args.corrupt,
            drop: args.drop,
            insert: args.insert,
        };
        let own_times = args.rate.is_none() && !motion.returns;
        Ok(Self {
            motion,
            settings,
            choice,
            port: None,
            bad_line: BadLine::new(damage, args.seed),
            random: ChaCha8Rng::seed_from_u64(args.seed ^ 0x6A09_E667),
            jitter: Exp::new(1000.0 / args.jitter_ms).ok().filter(|_| args.jitter_ms > 0.0),
            tally: Tally::default(),
            times: if own_times { motion.times() } else { Vec::new() },
            rate_hz: args.rate.unwrap_or(100.0),
        })
    }

    /// Time from the first reading of a pass to the first of the next.
    fn pass_s(&self) -> f64 {
        let steps = self.times.len().saturating_sub(1).max(1) as f64;
        let step = if self.times.is_empty() {
            1.0 / self.rate_hz
        } else {
            self.motion.length_s() / steps
        };
        self.motion.length_s() + step.max(1e-3)
    }

    /// When reading `index` is due, s from the start.
    fn due_s(&self, index: u64) -> f64 {
        if self.times.is_empty() {
            return index as f64 / self.rate_hz;
        }
        let count = self.times.len() as u64;
        let within = usize::try_from(index % count).ok().and_then(|i| self.times.get(i)).copied();
        (index / count) as f64 * self.pass_s() + within.unwrap_or(0.0)
    }

    /// How many readings there will be, and whether there is no end to them.
    fn total(&self, args: &Args) -> (u64, bool) {
        let endless = self.motion.returns || args.again;
        let of_the_file = if self.times.is_empty() {
            (self.motion.length_s() * self.rate_hz).floor() as u64 + 1
        } else {
            self.times.len() as u64
        };
        let mut total = if endless { u64::MAX } else { of_the_file };
        if let Some(duration) = args.duration {
            let rate = if self.times.is_empty() {
                self.rate_hz
            } else {
                self.times.len() as f64 / self.pass_s()
            };
            total = total.min((duration * rate).ceil() as u64);
        }
        (total, total == u64::MAX)
    }

    fn play(&mut self, args: &Args, context: &Context, total: u64) -> anyhow::Result<Ended> {
        let clock = MonotonicClock;
        let start = clock.now();
        let mut pulled = false;
        if args.format == Format::Text {
            self.send(heading(self.motion.at(0.0)).as_bytes())?;
        }
        for index in 0..total {
            let t = self.due_s(index);
            let late_s = self.jitter.map_or(0.0, |jitter| jitter.sample(&mut self.random));
            if !wait_until(start + Span::from_seconds(t + late_s), context) {
                return Ok(Ended::Interrupted);
            }
            let pull = args.pull.is_some_and(|pull| pull.is_on(t));
            if pull && !pulled {
                self.port = None;
                self.tally.pulls += 1;
                tracing::info!("the cable is pulled");
            } else if pulled && !pull {
                self.port = Some(ArmPort::open(&self.choice, self.settings)?);
                tracing::info!("the cable is back");
            }
            pulled = pull;
            context.console.advance(1);
            if pull || args.silence.is_some_and(|silence| silence.is_on(t)) {
                continue;
            }
            let bytes = self.reading_bytes(args, index, t)?;
            let damaged = self.bad_line.pass(&bytes);
            self.tally.damaged += u64::from(damaged != bytes);
            self.send(&damaged)?;
        }
        Ok(Ended::Complete)
    }

    fn reading_bytes(&self, args: &Args, index: u64, t: f64) -> anyhow::Result<Vec<u8>> {
        let within = if self.motion.returns { t } else { t % self.pass_s() };
        let reading = self.motion.at(within).context("expected a motion, found none")?;
        let device_s = self.motion.first_s() + t / (1.0 + args.drift_ppm * 1e-6);
        let faults = if args.fault.is_some_and(|fault| fault.is_on(t)) {
            fault_bit::ENCODER
        } else {
            0
        };
        let message = Message {
            // Wraps as the format says.
            sequence: Some(index as u32),
            device_time: DeviceTime::Nanoseconds((device_s * 1e9).round() as i64),
            status: status_bit::MOVING,
            faults,
            reading,
            fingerprint: 0,
        };
        let mut bytes = Vec::new();
        match args.format {
            Format::Binary => wire::encode(&message, &mut bytes),
            Format::Text => bytes = text_line(device_s, &reading).into_bytes(),
        }
        Ok(bytes)
    }

    fn send(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        let Some(port) = &mut self.port else { return Ok(()) };
        match port
            .send(bytes)
            .with_context(|| format!("writing to {}", port.path().display()))?
        {
            Sent::Whole => self.tally.sent += 1,
            Sent::Unheard => self.tally.unheard += 1,
            Sent::Overrun => self.tally.overrun += 1,
        }
        Ok(())
    }
}

fn heading(first: Option<Reading>) -> String {
    match first {
        Some(Reading::Joints(joints)) => {
            let names: Vec<String> = (1..=joints.as_slice().len()).map(|i| format!("q{i}")).collect();
            format!("timestamp_s,{}\n", names.join(","))
        }
        _ => "# T_base_hand, mm\n".to_owned(),
    }
}

fn text_line(device_s: f64, reading: &Reading) -> String {
    let (values, separator): (Vec<f64>, &str) = match reading {
        Reading::Joints(joints) => (joints.as_slice().to_vec(), ","),
        Reading::Pose { translation, rotation } => (translation.iter().chain(rotation).copied().collect(), " "),
    };
    let words: Vec<String> = values.iter().map(|value| format!("{value:.9}")).collect();
    format!("{device_s:.6}{separator}{}\n", words.join(separator))
}

/// False when the user has had enough.
fn wait_until(instant: Timestamp, context: &Context) -> bool {
    loop {
        if context.console.stopping() {
            return false;
        }
        let left = instant - MonotonicClock.now();
        if left.0 <= 0 {
            return true;
        }
        std::thread::sleep(Duration::from_nanos(left.0.unsigned_abs()).min(Duration::from_millis(50)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_happens_now_and_then() {
        let pull: Periodic = "20:2".parse().unwrap();
        assert!(!pull.is_on(1.0) && !pull.is_on(19.9));
        assert!(pull.is_on(20.0) && pull.is_on(21.9) && !pull.is_on(22.1) && pull.is_on(40.5));
        for wrong in ["20", "2:3", "0:0", "a:b", "20:-1"] {
            assert!(wrong.parse::<Periodic>().unwrap_err().contains("EVERY:FOR"), "{wrong}");
        }
        assert!(share("1.5").is_err() && share("0.01").is_ok());
    }
}
