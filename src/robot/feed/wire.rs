//! The binary format of an arm's feed, byte by byte as in `docs/arm_feed.md`. It is our own, not any maker's.
//!
//! | offset | bytes | content |
//! |---|---|---|
//! | 0 | 2 | sync: A5 5A |
//! | 2 | 1 | version: 1 |
//! | 3 | 1 | type: 1 joints, 2 pose |
//! | 4 | 1 | n: bytes of payload, 0–64 |
//! | 5 | 1 | status bits |
//! | 6 | 2 | fault bits |
//! | 8 | 4 | sequence number |
//! | 12 | 4 | device time, µs |
//! | 16 | n | payload: f32 each; joints in mm or rad, or a pose as x y z (mm) qx qy qz qw |
//! | 16+n | 4 | CRC-32C of bytes 2 … 15+n |
//!
//! Numbers are little-endian. Offsets 0–4 and the check at the end are the same in every version, so that a reader can step over
//! what it does not know.

use crate::robot::feed::check::crc32c;
use crate::robot::feed::message::{DeviceTime, JointValues, MOST_JOINTS, Message, Reading};

/// Every packet begins with these.
pub const SYNC: [u8; 2] = [0xA5, 0x5A];
/// The version described here.
pub const VERSION: u8 = 1;
/// Bytes before the payload.
pub const HEADER_BYTES: usize = 16;
/// Bytes of the check.
pub const CHECK_BYTES: usize = 4;
/// Most bytes of payload.
pub const MOST_PAYLOAD_BYTES: usize = 4 * MOST_JOINTS;
/// Longest packet.
pub const LONGEST_PACKET_BYTES: usize = HEADER_BYTES + MOST_PAYLOAD_BYTES + CHECK_BYTES;
/// Where the payload's length stands.
pub const LENGTH_OFFSET: usize = 4;

const JOINTS: u8 = 1;
const POSE: u8 = 2;
const POSE_NUMBERS: usize = 7;

/// Why a packet that came through unharmed cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unusable {
    /// Of another version or type.
    Unknown,
    /// Its length does not fit its type.
    Malformed,
}

/// Append the packet of a message: its status, faults, sequence number (0 if none) and device time (in µs, modulo 2³²).
pub fn encode(message: &Message, packet: &mut Vec<u8>) {
    let start = packet.len();
    let (kind, count) = match &message.reading {
        Reading::Joints(joints) => (JOINTS, joints.as_slice().len()),
        Reading::Pose { .. } => (POSE, POSE_NUMBERS),
    };
    let microseconds = match message.device_time {
        DeviceTime::Microseconds32(ticks) => ticks,
        // Wraps on purpose.
        DeviceTime::Nanoseconds(nanoseconds) => nanoseconds.div_euclid(1000) as u32,
    };
    packet.extend_from_slice(&SYNC);
    // At most 64: a reading holds at most 16 numbers.
    packet.extend_from_slice(&[VERSION, kind, (4 * count) as u8, message.status]);
    packet.extend_from_slice(&message.faults.to_le_bytes());
    packet.extend_from_slice(&message.sequence.unwrap_or(0).to_le_bytes());
    packet.extend_from_slice(&microseconds.to_le_bytes());
    let mut put = |values: &[f64]| {
        values
            .iter()
            .for_each(|v| packet.extend_from_slice(&(*v as f32).to_le_bytes()))
    };
    match &message.reading {
        Reading::Joints(joints) => put(joints.as_slice()),
        Reading::Pose { translation, rotation } => {
            put(translation);
            put(rotation);
        }
    }
    let check = crc32c(packet.iter().skip(start + SYNC.len()).copied());
    packet.extend_from_slice(&check.to_le_bytes());
}

/// Bytes of the whole packet, told by its length byte; `None` where that cannot be.
pub fn packet_bytes(length_byte: u8) -> Option<usize> {
    let payload = usize::from(length_byte);
    (payload <= MOST_PAYLOAD_BYTES).then_some(HEADER_BYTES + payload + CHECK_BYTES)
}

/// True when the bytes are a packet from sync to check.
pub fn is_whole(packet: &[u8]) -> bool {
    let Some((rest, check)) = packet.split_last_chunk::<CHECK_BYTES>() else {
        return false;
    };
    let Some(checked) = rest.strip_prefix(&SYNC) else {
        return false;
    };
    let length_fits = packet.get(LENGTH_OFFSET).copied().and_then(packet_bytes) == Some(packet.len());
    length_fits && crc32c(checked.iter().copied()) == u32::from_le_bytes(*check)
}

/// The message in a packet that [`is_whole`].
pub fn decode(packet: &[u8]) -> Result<Message, Unusable> {
    let byte = |at: usize| packet.get(at).copied().ok_or(Unusable::Malformed);
    let word = |at: usize| {
        let bytes = packet.get(at..).and_then(<[u8]>::first_chunk::<4>);
        bytes.map(|bytes| u32::from_le_bytes(*bytes)).ok_or(Unusable::Malformed)
    };
    if byte(2)? != VERSION {
        return Err(Unusable::Unknown);
    }
    let payload = packet
        .get(HEADER_BYTES..packet.len().saturating_sub(CHECK_BYTES))
        .ok_or(Unusable::Malformed)?;
    let (numbers, rest) = payload.as_chunks::<4>();
    let mut values = [0.0; MOST_JOINTS];
    let values = values.get_mut(..numbers.len()).ok_or(Unusable::Malformed)?;
    for (value, number) in values.iter_mut().zip(numbers) {
        *value = f64::from(f32::from_le_bytes(*number));
    }
    let reading = match (byte(3)?, &*values) {
        (JOINTS, joints) if !joints.is_empty() && rest.is_empty() => {
            Reading::Joints(JointValues::new(joints).ok_or(Unusable::Malformed)?)
        }
        (POSE, &[x, y, z, qx, qy, qz, qw]) if rest.is_empty() => Reading::Pose {
            translation: [x, y, z],
            rotation: [qx, qy, qz, qw],
        },
        (JOINTS | POSE, _) => return Err(Unusable::Malformed),
        _ => return Err(Unusable::Unknown),
    };
    Ok(Message {
        sequence: Some(word(8)?),
        device_time: DeviceTime::Microseconds32(word(12)?),
        status: byte(5)?,
        faults: u16::from_le_bytes([byte(6)?, byte(7)?]),
        reading,
        fingerprint: word(packet.len().saturating_sub(CHECK_BYTES))?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::feed::message::{fault_bit, status_bit};

    fn example() -> Message {
        Message {
            sequence: Some(258),
            device_time: DeviceTime::Microseconds32(1_000_000),
            status: status_bit::MOVING,
            faults: fault_bit::JOINT_LIMIT,
            reading: Reading::Joints(JointValues::new(&[200.0, 0.5, -0.75, 0.25, 0.375, -0.5, 0.125]).unwrap()),
            fingerprint: 0,
        }
    }

    /// The worked example of `docs/arm_feed.md`, as it stands there.
    #[test]
    fn the_document_tells_the_truth() {
        let document = include_str!("../../../docs/arm_feed.md");
        let block = document.split("```hex\n").nth(1).unwrap().split("```").next().unwrap();
        let written: Vec<u8> = block
            .lines()
            .flat_map(|line| line.split('|').next().unwrap().split_whitespace())
            .map(|byte| u8::from_str_radix(byte, 16).unwrap())
            .collect();
        let mut packet = Vec::new();
        encode(&example(), &mut packet);
        let hex = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ");
        assert_eq!(hex(&packet), hex(&written));
        assert!(is_whole(&written));
        let read = decode(&written).unwrap();
        assert_eq!(read.reading, example().reading);
        assert_eq!((read.sequence, read.faults), (Some(258), fault_bit::JOINT_LIMIT));
    }

    #[test]
    fn a_pose_comes_back() {
        let pose = Message {
            reading: Reading::Pose {
                translation: [1.5, -2.25, 1000.0],
                rotation: [0.5, -0.5, 0.5, 0.5],
            },
            ..example()
        };
        let mut packet = Vec::new();
        encode(&pose, &mut packet);
        assert_eq!(packet.len(), HEADER_BYTES + 28 + CHECK_BYTES);
        assert_eq!(decode(&packet).unwrap().reading, pose.reading);
    }

    #[test]
    fn what_cannot_be_used_is_told_apart() {
        let remade = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut packet = Vec::new();
            encode(&example(), &mut packet);
            packet.truncate(packet.len() - CHECK_BYTES);
            change(&mut packet);
            packet[LENGTH_OFFSET] = (packet.len() - HEADER_BYTES) as u8;
            let check = crc32c(packet.iter().skip(2).copied());
            packet.extend_from_slice(&check.to_le_bytes());
            assert!(is_whole(&packet));
            decode(&packet)
        };
        assert!(remade(&|_| ()).is_ok());
        assert_eq!(remade(&|packet| packet[2] = 2), Err(Unusable::Unknown));
        assert_eq!(remade(&|packet| packet[3] = 9), Err(Unusable::Unknown));
        assert_eq!(remade(&|packet| packet.push(0)), Err(Unusable::Malformed));
        assert_eq!(remade(&|packet| packet.truncate(HEADER_BYTES)), Err(Unusable::Malformed));
        assert_eq!(
            remade(&|packet| {
                packet[3] = 2;
                packet.truncate(HEADER_BYTES + 24);
            }),
            Err(Unusable::Malformed)
        );
        assert!(packet_bytes(65).is_none());
        for length in 0..40 {
            assert!(!is_whole(&vec![0xA5; length]));
            assert!(decode(&vec![2; length]).is_err());
        }
    }
}
