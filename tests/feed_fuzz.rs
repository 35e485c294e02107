//! Mutational fuzzing of all that reads the arm's bytes: whatever comes, nothing breaks, nothing is invented, and how the stream was
//! cut makes no difference. `ENDOFIELD_FUZZ_SECONDS=600 cargo test --release --test integration fuzz -- --nocapture`

use endofield::robot::feed::check::crc32c;
use endofield::robot::feed::driver::{Driver, DriverCounts, EndofieldDriver, Joined};
use endofield::robot::feed::intake::Intake;
use endofield::robot::feed::message::{DeviceTime, JointValues, Message, Reading};
use endofield::robot::feed::parser::Parser;
use endofield::robot::feed::settings::{PoseClock, Settings};
use endofield::robot::feed::text::{TextContent, TextDriver};
use endofield::robot::feed::wire::{LONGEST_PACKET_BYTES, encode, is_whole, packet_bytes};
use endofield::robot::kinematics::Arm;
use endofield::time::{Clock as _, MonotonicClock, Span, Timestamp};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

fn seed_packet(random: &mut ChaCha8Rng) -> Vec<u8> {
    let reading = if random.random() {
        let values: Vec<f64> = (0..random.random_range(1..=16))
            .map(|_| random.random_range(-3.0..3.0))
            .collect();
        Reading::Joints(JointValues::new(&values).unwrap())
    } else {
        Reading::Pose {
            translation: [random.random(), 2.0, 3.0],
            rotation: [0.0, 0.6, 0.0, 0.8],
        }
    };
    let message = Message {
        sequence: Some(random.random_range(0..100)),
        device_time: DeviceTime::Microseconds32(random.random()),
        status: random.random(),
        faults: random.random_range(0..4),
        reading,
        fingerprint: 0,
    };
    let mut packet = Vec::new();
    encode(&message, &mut packet);
    packet
}

const LINES: [&[u8]; 6] = [
    b"0.5 1 2 3 0 0 0 1\n",
    b"# T_base_hand, m\n",
    b"timestamp_s,q1,q2,q3,q4,q5,q6,q7\r\n",
    b"12.34,200,0.5,-0.75,0.25,0.375,-0.5,0.125\n",
    b"1e308 nan inf -0 1e-320 0 0 1\n",
    b"\xff\xc3\x28 7\n",
];

fn mutate(random: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    for _ in 0..random.random_range(0..6) {
        let at = random.random_range(0..=bytes.len());
        let some = at < bytes.len();
        let to = random.random_range(at..=(at + 12).min(bytes.len()));
        match random.random_range(0..8) {
            0 if some => bytes[at] ^= 1 << random.random_range(0..8),
            1 if some => bytes[at] = random.random(),
            2 => drop(bytes.drain(at..to)),
            3 => bytes.insert(at, random.random()),
            4 => {
                let part = bytes[at..to].to_vec();
                bytes.splice(at..at, part);
            }
            5 => drop(bytes.splice(at..at, [0xA5, 0x5A])),
            6 if some => bytes[at] = [0, 1, 64, 65, 0x7F, 0xFF][random.random_range(0..6)],
            7 => bytes.truncate(at),
            _ => {}
        }
    }
}

/// A packet that was changed and given the right check again: only such a one gets past the parser.
fn sealed(random: &mut ChaCha8Rng, mut packet: Vec<u8>) -> Vec<u8> {
    packet.truncate(packet.len() - 4);
    for _ in 0..random.random_range(0..5) {
        let at = random.random_range(2..packet.len());
        // Not the length: the packet would be longer than it is.
        if at != 4 {
            packet[at] = [random.random(), 0xFF, 0x7F, 0x80][random.random_range(0..4)];
        }
    }
    let check = crc32c(packet.iter().skip(2).copied());
    packet.extend_from_slice(&check.to_le_bytes());
    packet
}

fn stream(random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut stream = Vec::new();
    for _ in 0..random.random_range(1..12) {
        let mut piece = match random.random_range(0..5) {
            0 | 1 => seed_packet(random),
            2 => {
                let packet = seed_packet(random);
                sealed(random, packet)
            }
            3 => LINES[random.random_range(0..LINES.len())].to_vec(),
            _ => (0..random.random_range(0..60)).map(|_| random.random()).collect(),
        };
        if random.random() {
            mutate(random, &mut piece);
        }
        stream.extend(piece);
    }
    stream
}

fn cut<'a>(random: &mut ChaCha8Rng, mut stream: &'a [u8]) -> Vec<&'a [u8]> {
    let longest = [1, 3, 50, 5000][random.random_range(0..4)];
    let mut parts = Vec::new();
    while !stream.is_empty() {
        let (part, rest) = stream.split_at(random.random_range(1..=longest).min(stream.len()));
        parts.push(part);
        stream = rest;
    }
    parts
}

/// Every packet in a stream by plain search, those first that end first; what lies in another one is not looked for.
fn reference_packets(stream: &[u8]) -> Vec<Vec<u8>> {
    let mut found: Vec<(usize, usize)> = Vec::new();
    for start in 0..stream.len() {
        let length = stream.get(start + 4).copied().and_then(packet_bytes);
        if let Some(packet) = length.and_then(|length| stream.get(start..start + length))
            && is_whole(packet)
        {
            found.push((start + packet.len(), start));
        }
    }
    found.sort_unstable();
    let mut end_of_last = 0;
    found.retain(|(end, start)| {
        let apart = start + 1 >= end_of_last;
        if apart {
            end_of_last = *end;
        }
        apart
    });
    found.iter().map(|(end, start)| stream[*start..*end].to_vec()).collect()
}

fn heard(driver: &mut dyn Driver, parts: &[&[u8]]) -> (Vec<Message>, DriverCounts) {
    let mut found = Vec::new();
    for part in parts {
        driver.take(part, &mut |message| found.push(message));
    }
    (found, driver.counts())
}

/// NaN is not equal to itself, so messages are compared as text.
fn text(messages: &[Message]) -> String {
    format!("{messages:?}")
}

fn one_round(random: &mut ChaCha8Rng, intakes: &mut [Intake]) -> u64 {
    let stream = stream(random);
    let parts = cut(random, &stream);
    let mut packets = Vec::new();
    let mut parser = Parser::default();
    for part in &parts {
        parser.take(part, |packet| packets.push(packet.to_vec()));
    }
    assert_eq!(packets, reference_packets(&stream));
    let counts = parser.counts();
    assert_eq!((counts.bytes, counts.packets), (stream.len() as u64, packets.len() as u64));
    let accounted = counts.bytes_skipped + packets.iter().map(|packet| packet.len() as u64).sum::<u64>();
    assert!(accounted <= counts.bytes + counts.packets && counts.bytes <= accounted + LONGEST_PACKET_BYTES as u64);
    let makers: [fn() -> Box<dyn Driver>; 3] = [
        || Box::<EndofieldDriver>::default(),
        || Box::new(TextDriver::new(TextContent::Poses)),
        || Box::new(TextDriver::new(TextContent::Joints)),
    ];
    for make in makers {
        let joined = if random.random() { Joined::Midway } else { Joined::AtStart };
        let (mut whole, mut pieces) = (make(), make());
        whole.reset(joined);
        pieces.reset(joined);
        let (a, counts_a) = heard(&mut *whole, &[&stream]);
        let (b, counts_b) = heard(&mut *pieces, &parts);
        assert_eq!((text(&a), counts_a), (text(&b), counts_b));
        assert!(counts_a.bytes_skipped <= counts_a.bytes);
        for message in a {
            let arrival = Timestamp(random.random_range(0..i64::MAX / 4));
            for intake in &mut *intakes {
                if let Ok(accepted) = intake.take(message, arrival) {
                    assert!(accepted.sample.pose.base_from_hand.is_finite());
                    assert!(accepted.delay >= Span(0));
                }
            }
        }
    }
    packets.len() as u64
}

#[test]
fn fuzz_whatever_comes_nothing_breaks() {
    let seconds: f64 = std::env::var("ENDOFIELD_FUZZ_SECONDS").map_or(3.0, |text| text.parse().unwrap());
    let seed: u64 = std::env::var("ENDOFIELD_FUZZ_SEED").map_or(1, |text| text.parse().unwrap());
    let end = MonotonicClock.now() + Span::from_seconds(seconds);
    let arm = Arm::aesop_3000().unwrap();
    let on_the_devices_clock = Settings {
        clock: PoseClock::Device,
        ..Settings::default()
    };
    let mut intakes = [
        Intake::new(arm.clone(), &Settings::default()),
        Intake::new(arm, &on_the_devices_clock),
    ];
    let (mut rounds, mut packets) = (0, 0);
    // At least some, however slow the machine; a failing round repeats with its number as the seed.
    while rounds < 200 || MonotonicClock.now() < end {
        let mut random = ChaCha8Rng::seed_from_u64(seed.wrapping_mul(1 << 40) + rounds);
        packets += one_round(&mut random, &mut intakes);
        rounds += 1;
    }
    println!("{rounds} streams, {packets} packets among them");
    assert!(packets > rounds);
}
