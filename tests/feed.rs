//! The arm's feed through real pseudo-terminals: damage, pulled cables, and the sender's ledger of what came through unharmed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use crossbeam::channel::bounded;
use endofield::robot::feed::driver::{Driver, DriverCounts, Joined};
use endofield::robot::feed::faults::{BadLine, Damage};
use endofield::robot::feed::line::LineSource;
use endofield::robot::feed::message::{DeviceTime, JointValues, Message, Reading, Sample};
use endofield::robot::feed::parser::Parser;
use endofield::robot::feed::pseudo_terminal::PseudoTerminal;
use endofield::robot::feed::reader::ArmFeed;
use endofield::robot::feed::settings::{PoseClock, Settings};
use endofield::robot::feed::statistics::{FeedStatistics, LinkState};
use endofield::robot::feed::wire::{decode, encode};
use endofield::robot::pose_buffer::{self, PoseLookupError};
use endofield::time::{Clock as _, MonotonicClock, Span, Timestamp};

use crate::support::command::{endofield, told};

/// 1 % of all bytes corrupted, 1 % lost, 1 % followed by one that was not sent: of packets of 48 bytes about one in four survives.
const DAMAGE: Damage = Damage {
    corrupt: 0.01,
    drop: 0.01,
    insert: 0.01,
};

fn packet(sequence: u32) -> Vec<u8> {
    let t = f64::from(sequence) * 0.01;
    let joints = [
        190.0 + 20.0 * (0.5 * t).sin(),
        0.45 + 0.1 * (0.7 * t).sin(),
        -0.95,
        0.2,
        0.35 + 0.1 * (1.1 * t).cos(),
        -0.6,
        0.2 * (0.3 * t).sin(),
    ];
    let message = Message {
        sequence: Some(sequence),
        device_time: DeviceTime::Microseconds32(sequence.wrapping_mul(10_000)),
        status: 0,
        faults: 0,
        reading: Reading::Joints(JointValues::new(&joints).unwrap()),
        fingerprint: 0,
    };
    let mut packet = Vec::new();
    encode(&message, &mut packet);
    packet
}

/// What went over the line, and which packets are still in there, byte for byte.
#[derive(Default)]
struct Ledger {
    stream: Vec<u8>,
    spans: Vec<(u32, std::ops::Range<usize>)>,
}

impl Ledger {
    /// Send a packet over a bad line; what came out of it.
    fn send(&mut self, line: &mut BadLine, sequence: u32) -> Vec<u8> {
        let bytes = line.pass(&packet(sequence));
        let start = self.stream.len();
        self.stream.extend_from_slice(&bytes);
        self.spans.push((sequence, start..self.stream.len()));
        bytes
    }

    /// Sequence number of every packet that came through, and the position behind it. What was lost at an edge may be made up for by a
    /// neighbour's byte that happens to be the same: then the packet is there all the same.
    fn intact(&self) -> Vec<(u32, usize)> {
        let mut intact = Vec::new();
        for (sequence, span) in &self.spans {
            let packet = packet(*sequence);
            let from = span.start.saturating_sub(4);
            let near = &self.stream[from..(span.end + 4).min(self.stream.len())];
            if let Some(at) = near.windows(packet.len()).position(|window| window == packet) {
                intact.push((*sequence, from + at + packet.len()));
            }
        }
        intact
    }
}

/// Every unharmed packet is delivered with its last byte, whatever came before it: recovery takes no packet at all.
#[test]
fn an_unharmed_packet_is_delivered_with_its_last_byte() {
    let (mut ledger, mut line) = (Ledger::default(), BadLine::new(DAMAGE, 11));
    for sequence in 0..60_000 {
        ledger.send(&mut line, sequence);
    }
    let intact = ledger.intact();
    assert!((10_000..20_000).contains(&intact.len()), "{}", intact.len());
    let mut parser = Parser::default();
    let mut delivered = Vec::new();
    for (position, byte) in (1..).zip(&ledger.stream) {
        parser.take(&[*byte], |packet| {
            delivered.push((decode(packet).unwrap().sequence.unwrap(), position))
        });
    }
    assert_eq!(delivered, intact);
}

/// What was sent, when, and what became of it.
struct Outcome {
    intact: BTreeSet<u32>,
    /// Sent whole just before a pull, not waited for.
    at_risk: BTreeSet<u32>,
    came: Vec<Sample>,
    statistics: FeedStatistics,
    /// Longest from the last byte to the notice that the line is silent, ms.
    silence_noticed_ms: f64,
}

struct Play {
    packets: u32,
    /// As fast as the line goes, or so many a second.
    rate_hz: Option<f64>,
    /// So many times the cable is pulled, evenly spread.
    pulls: u32,
    seed: u64,
    clock: PoseClock,
}

fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    for _ in 0..30_000 {
        if condition() {
            return;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    panic!("waited half a minute for {what}");
}

fn write_all(arm: &mut PseudoTerminal, mut bytes: &[u8]) {
    while !bytes.is_empty() {
        let written = arm.write(bytes).unwrap();
        bytes = &bytes[written..];
        if written == 0 {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

fn play(play: &Play) -> Outcome {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("arm");
    let settings = Settings {
        reopen_ms: 10.0,
        clock: play.clock,
        ..Settings::default()
    };
    let clock = Arc::new(MonotonicClock);
    let (tap, samples) = bounded(play.packets as usize);
    let poses = pose_buffer::Settings::default();
    let feed = ArmFeed::start(LineSource::Port(link.clone()), &settings, &poses, clock, Some(tap)).unwrap();
    let mut line = BadLine::new(DAMAGE, play.seed);
    let mut outcome = Outcome {
        intact: BTreeSet::new(),
        at_risk: BTreeSet::new(),
        came: Vec::new(),
        statistics: FeedStatistics::default(),
        silence_noticed_ms: 0.0,
    };
    let started = MonotonicClock.now();
    let mut sent_bytes = 0;
    let mut last_arm = None;
    for stretch in 0..=play.pulls {
        let mut arm = PseudoTerminal::open(Some(&link)).unwrap();
        wait_for("the port to be opened", || {
            feed.status().statistics.opened == u64::from(stretch + 1)
        });
        // What a pull swallowed was never heard, so count from here.
        let heard_before = feed.status().statistics.bytes;
        let bound = |k: u32| (u64::from(play.packets) * u64::from(k) / u64::from(play.pulls + 1)) as u32;
        let (from, to) = (bound(stretch), bound(stretch + 1));
        // The last ones are for the pull.
        let last = to - if stretch < play.pulls { 6 } else { 0 };
        let mut ledger = Ledger::default();
        for sequence in from..last {
            if let Some(rate) = play.rate_hz {
                let due = started + Span::from_seconds(f64::from(sequence) / rate);
                let left = (due - MonotonicClock.now()).0.max(0).unsigned_abs();
                std::thread::sleep(Duration::from_nanos(left));
            }
            write_all(&mut arm, &ledger.send(&mut line, sequence));
        }
        let stretch_bytes = ledger.stream.len() as u64;
        sent_bytes += stretch_bytes;
        wait_for("the reader to drain the line", || {
            feed.status().statistics.bytes == heard_before + stretch_bytes
        });
        if play.rate_hz.is_some() {
            let quiet_since = MonotonicClock.now();
            wait_for("silence to be noticed", || feed.status().link == LinkState::Silent);
            let noticed = feed.status().since - quiet_since;
            outcome.silence_noticed_ms = outcome.silence_noticed_ms.max(noticed.milliseconds());
        }
        if stretch < play.pulls {
            let mut good_line = BadLine::new(Damage::default(), 0);
            for sequence in last..to - 1 {
                write_all(&mut arm, &ledger.send(&mut good_line, sequence));
            }
            write_all(&mut arm, &packet(to - 1)[..30]);
            drop(arm);
            assert!(!link.exists());
            wait_for("the pull to be noticed", || {
                feed.status().statistics.hang_ups == u64::from(stretch + 1)
            });
        } else {
            last_arm = Some(arm);
        }
        for (sequence, end) in ledger.intact() {
            if end as u64 <= stretch_bytes {
                outcome.intact.insert(sequence);
            } else {
                outcome.at_risk.insert(sequence);
            }
        }
    }
    outcome.statistics = feed.stop();
    drop(last_arm);
    outcome.came = samples.try_iter().collect();
    assert!(outcome.statistics.bytes >= sent_bytes);
    outcome
}

fn check(outcome: &Outcome, pulls: u32) {
    let mut came: BTreeMap<u32, usize> = BTreeMap::new();
    for sample in &outcome.came {
        let sequence = sample.message.sequence.unwrap();
        *came.entry(sequence).or_default() += 1;
        // None invented: what came is, number for number, what was sent under this sequence number.
        assert_eq!(sample.message, decode(&packet(sequence)).unwrap());
    }
    assert!(came.values().all(|times| *times == 1), "delivered more than once");
    let delivered: BTreeSet<u32> = came.keys().copied().collect();
    let missed: Vec<&u32> = outcome.intact.difference(&delivered).collect();
    assert!(missed.is_empty(), "unharmed but not delivered: {missed:?}");
    let allowed: BTreeSet<u32> = outcome.intact.union(&outcome.at_risk).copied().collect();
    let invented: Vec<&u32> = delivered.difference(&allowed).collect();
    assert!(invented.is_empty(), "delivered but never sent whole: {invented:?}");
    let counts = &outcome.statistics;
    assert_eq!(counts.poses, delivered.len() as u64);
    assert_eq!((counts.hang_ups, counts.opened), (u64::from(pulls), u64::from(pulls + 1)));
    assert_eq!(
        (counts.repeated, counts.restarts, counts.overrun, counts.unknown),
        (0, 0, 0, 0)
    );
    let (first, last) = (delivered.first().unwrap(), delivered.last().unwrap());
    assert_eq!(counts.lost, u64::from(last - first + 1) - delivered.len() as u64);
    assert!(counts.bad_check > 0 && counts.bytes_skipped > 0);
}

#[test]
fn sixty_thousand_packets_through_a_bad_line_and_twenty_pulls() {
    let outcome = play(&Play {
        packets: 60_000,
        rate_hz: None,
        pulls: 20,
        seed: 5,
        // The arm's time runs far faster than the host's here.
        clock: PoseClock::Device,
    });
    check(&outcome, 20);
}

/// `ENDOFIELD_FEED_SECONDS=600 cargo test --release --test integration a_hundred_hertz -- --ignored --nocapture`
#[test]
#[ignore = "takes as long as it plays: ten minutes"]
fn a_hundred_hertz_for_ten_minutes() {
    let seconds: u32 = std::env::var("ENDOFIELD_FEED_SECONDS").map_or(600, |text| text.parse().unwrap());
    let outcome = play(&Play {
        packets: seconds * 100,
        rate_hz: Some(100.0),
        pulls: 20,
        seed: 6,
        clock: PoseClock::Host,
    });
    let counts = &outcome.statistics;
    // Against the truth: a packet's pose is true 10 ms·sequence after the first.
    let mut late: Vec<f64> = outcome
        .came
        .iter()
        .map(|sample| sample.pose.stamp.milliseconds() - 10.0 * f64::from(sample.message.sequence.unwrap()))
        .collect();
    late.sort_by(f64::total_cmp);
    let median = late[late.len() / 2];
    let away = |share: f64| late[((late.len() - 1) as f64 * share) as usize] - median;
    println!(
        "{} sent, {} unharmed, {} delivered, {} hang-ups, {} bad checks, {} of {} bytes skipped; silence noticed after at most {:.1} ms; \
         stamps around the truth: 1 % {:.3}, 99 % {:.3}, max {:.3} ms",
        seconds * 100,
        outcome.intact.len(),
        outcome.came.len(),
        counts.hang_ups,
        counts.bad_check,
        counts.bytes_skipped,
        counts.bytes,
        outcome.silence_noticed_ms,
        away(0.01),
        away(0.99),
        away(1.0)
    );
    check(&outcome, 20);
}

#[test]
fn poses_are_there_at_exposure_time_and_a_miss_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("arm");
    let poses = pose_buffer::Settings::default();
    let clock = Arc::new(MonotonicClock);
    let feed = ArmFeed::start(LineSource::Port(link.clone()), &Settings::default(), &poses, clock, None).unwrap();
    assert_eq!(
        feed.poses().pose_at(MonotonicClock.now()).unwrap_err(),
        PoseLookupError::Empty
    );
    wait_for("the missing port to be told", || {
        matches!(feed.status().link, LinkState::Absent(_))
    });
    let mut arm = PseudoTerminal::open(Some(&link)).unwrap();
    wait_for("the port to be opened", || feed.status().statistics.opened == 1);
    for sequence in 0..30 {
        write_all(&mut arm, &packet(sequence));
        std::thread::sleep(Duration::from_millis(10));
    }
    wait_for("all poses", || feed.status().statistics.poses == 30);
    let status = feed.status();
    let last = status.last.unwrap().pose.stamp;
    assert!(feed.poses().pose_at(last - Span::from_milliseconds(33.0)).is_ok());
    assert!(matches!(
        feed.poses().pose_at(last + Span::from_milliseconds(500.0)),
        Err(PoseLookupError::NotYet(_))
    ));
    assert!(matches!(
        feed.poses().pose_at(last - Span::from_milliseconds(5000.0)),
        Err(PoseLookupError::NoLonger(_))
    ));
    assert!(status.clock.is_some());
    wait_for("silence to be noticed", || feed.status().link == LinkState::Silent);
    // A path that comes to lead to another device, though the old one did not hang up.
    let mut other = PseudoTerminal::open(Some(&link)).unwrap();
    wait_for("the other device to be opened", || feed.status().statistics.opened == 2);
    write_all(&mut other, &packet(40));
    wait_for("its pose", || feed.status().statistics.poses == 31);
    assert_eq!(feed.stop().lost, 10);
    drop(arm);
}

fn recorded_poses(path: &Path) -> usize {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.starts_with("# T_base_hand, mm\n"));
    text.lines().filter(|line| !line.starts_with('#')).count()
}

#[test]
fn two_terminals_simulate_and_monitor() {
    let folder = tempfile::tempdir().unwrap();
    for (format, protocol) in [("binary", "endofield"), ("text", "text_joints")] {
        let simulate = ["arm", "simulate", "--port", "arm", "--corrupt", "0.0005", "--format", format];
        let mut arm = Command::new(env!("CARGO_BIN_EXE_endofield"))
            .args(simulate)
            .current_dir(folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let record = format!("{format}.tum");
        let monitor = [
            "arm",
            "monitor",
            "--port",
            "arm",
            "--duration",
            "1.5",
            "--record",
            &record,
            "--protocol",
            protocol,
            "--progress",
            "json",
        ];
        wait_for("the line", || folder.path().join("arm").exists());
        let output = endofield(&monitor, folder.path());
        // As Ctrl-C does.
        let pid = rustix::process::Pid::from_child(&arm);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
        assert_eq!(arm.wait().unwrap().code(), Some(130));
        assert_eq!(output.status.code(), Some(0), "{}", told(&output));
        assert!(recorded_poses(&folder.path().join(&record)) > 10);
        let summary = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(summary.contains("poses") && summary.contains("lost"), "{summary}");
        let end = told(&output).lines().last().map(str::to_owned).unwrap();
        let end: serde_json::Value = serde_json::from_str(&end).unwrap();
        assert_eq!(end["event"], "end");
        assert!(end["statistics"]["poses"].as_u64().unwrap() > 10, "{end}");
        assert!(!folder.path().join("arm").exists(), "the line is taken away with the arm");
    }
}

#[test]
fn files_and_pipes_are_monitored() {
    let folder = tempfile::tempdir().unwrap();
    let lines: String = (0..50)
        .map(|i| format!("{:.2} {i} 0 0 0 0 0 1\n", f64::from(i) * 0.02))
        .collect();
    std::fs::write(folder.path().join("poses.tum"), format!("# T_base_hand, m\n{lines}")).unwrap();
    let output = endofield(
        &["arm", "monitor", "--port", "poses.tum", "--record", "again.tum"],
        folder.path(),
    );
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("50, 50.0 a second"));
    let again = std::fs::read_to_string(folder.path().join("again.tum")).unwrap();
    assert!(again.contains("\n0.980000000 49000.000000 "), "{again}");
    // Nothing is overwritten unasked, and nothing comes from nothing.
    let refused = endofield(
        &["arm", "monitor", "--port", "poses.tum", "--record", "again.tum"],
        folder.path(),
    );
    assert_eq!(refused.status.code(), Some(1));
    assert!(told(&refused).contains("--force"));
    std::fs::write(folder.path().join("noise.bin"), [0xA5; 500]).unwrap();
    let nothing = endofield(&["arm", "monitor", "--port", "noise.bin"], folder.path());
    assert_eq!(nothing.status.code(), Some(1));
    assert!(told(&nothing).contains("no message"), "{}", told(&nothing));
    let usage = endofield(&["arm", "monitor"], folder.path());
    assert_eq!(usage.status.code(), Some(2), "{}", told(&usage));
    let usage = endofield(&["arm", "simulate", "--pull", "5:1"], folder.path());
    assert_eq!(usage.status.code(), Some(2), "{}", told(&usage));
}

/// Another maker's arm: a letter, the slide in 1/100 mm, a letter, and no more; its time is counted in samples.
#[derive(Default)]
struct SlideDriver {
    digits: Vec<u8>,
    count: i64,
    counts: DriverCounts,
}

impl Driver for SlideDriver {
    fn name(&self) -> &'static str {
        "slide"
    }

    fn take(&mut self, bytes: &[u8], deliver: &mut dyn FnMut(Message)) {
        self.counts.bytes += bytes.len() as u64;
        for byte in bytes {
            match byte {
                b'0'..=b'9' if self.digits.len() < 6 => self.digits.push(*byte),
                _ => {
                    let text = String::from_utf8(std::mem::take(&mut self.digits)).unwrap();
                    let Ok(hundredths) = text.parse::<f64>() else { continue };
                    self.count += 1;
                    let joints = [hundredths / 100.0, 0.5, -0.7, 0.2, 0.3, -0.4, 0.1];
                    deliver(Message {
                        sequence: None,
                        device_time: DeviceTime::Nanoseconds(self.count * 10_000_000),
                        status: 0,
                        faults: 0,
                        reading: Reading::Joints(JointValues::new(&joints).unwrap()),
                        fingerprint: 0,
                    });
                }
            }
        }
    }

    fn reset(&mut self, _joined: Joined) {
        self.digits.clear();
    }

    fn counts(&self) -> DriverCounts {
        self.counts
    }

    fn greeting(&self) -> &[u8] {
        b"talk\n"
    }
}

#[test]
fn another_arm_is_one_driver() {
    let mut arm = PseudoTerminal::open(None).unwrap();
    let source = LineSource::Port(arm.path().to_owned());
    let driver = Box::<SlideDriver>::default();
    let poses = pose_buffer::Settings::default();
    let feed = ArmFeed::start_with(driver, source, &Settings::default(), &poses, Arc::new(MonotonicClock), None).unwrap();
    let mut greeting = Vec::new();
    wait_for("the greeting", || {
        let mut buffer = [0; 16];
        let count = arm.read(&mut buffer).unwrap_or(0);
        greeting.extend_from_slice(&buffer[..count]);
        greeting == b"talk\n"
    });
    write_all(&mut arm, b"s20000e99999e20100e");
    // 999.99 mm is beyond the slide's end.
    wait_for("two poses", || feed.status().statistics.poses == 2);
    let last = feed.status().last.unwrap().pose.base_from_hand.translation();
    assert!(
        (last - nalgebra::Vector3::new(715.126, 141.102, 162.636)).amax() < 1e-3,
        "{last}"
    );
    assert!(feed.status().refusal.unwrap().contains("slide"));
    assert_eq!(feed.stop().refused_joints, 1);
}

/// The stamps of a binary capture go on over the 32-bit wrap.
#[test]
fn a_capture_is_read_on_the_devices_own_clock() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("capture.bin");
    let first = u32::MAX / 10_000 - 20;
    let bytes: Vec<u8> = (first..first + 40).flat_map(packet).collect();
    std::fs::write(&path, bytes).unwrap();
    let (tap, samples) = bounded(4);
    let settings = Settings {
        clock: PoseClock::Device,
        ..Settings::default()
    };
    let poses = pose_buffer::Settings::default();
    let feed = ArmFeed::start(LineSource::File(path), &settings, &poses, Arc::new(MonotonicClock), Some(tap)).unwrap();
    // A queue of four, and yet a file loses nothing.
    let stamps: Vec<Timestamp> = samples.iter().map(|sample| sample.pose.stamp).collect();
    assert_eq!(stamps.len(), 40);
    assert!(
        stamps
            .windows(2)
            .all(|pair| pair[1] - pair[0] == Span::from_milliseconds(10.0))
    );
    assert_eq!(feed.status().link, LinkState::Ended);
    assert_eq!(feed.stop().overrun, 0);
}
