//! From a stream of bytes to packets, however much of it is garbage.
//!
//! Wherever two sync bytes and a possible length stand, a packet may have begun: a *candidate*. Many candidates may be open at
//! once, and each byte that comes is asked whether it ends one of them; if the check fits, that is a packet. So a damaged packet
//! never holds up an unharmed one after it, not even if its length byte was hit: recovery takes no packet at all. What is delivered
//! does not depend on how the bytes were cut into reads, and is exactly the set of whole packets in the stream
//! (`reference_packets` in the tests). A candidate lives at most one packet's length, so memory is bounded.

use std::collections::VecDeque;

use crate::robot::feed::wire::{LENGTH_OFFSET, LONGEST_PACKET_BYTES, SYNC, is_whole, packet_bytes};

/// What a parser has counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ParserCounts {
    /// All bytes.
    pub bytes: u64,
    /// Bytes that belong to no packet and never will.
    pub bytes_skipped: u64,
    /// Whole packets.
    pub packets: u64,
    /// What looked like a packet and had the wrong check.
    pub bad_check: u64,
}

/// Cuts packets out of a stream. Positions count all bytes since the start.
#[derive(Debug, Default)]
pub struct Parser {
    /// The last bytes, at most one packet's length.
    recent: VecDeque<u8>,
    /// Where packets may have begun and would end, in the order of beginning.
    candidates: VecDeque<Candidate>,
    position: u64,
    /// Behind the last packet delivered.
    delivered_to: u64,
    bytes_in_packets: u64,
    packets: u64,
    bad_check: u64,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    start: u64,
    /// Behind its last byte.
    end: u64,
}

impl Parser {
    /// Take bytes; every packet that they complete is delivered.
    pub fn take(&mut self, bytes: &[u8], mut deliver: impl FnMut(&[u8])) {
        for byte in bytes {
            self.step(*byte, &mut deliver);
        }
    }

    /// The line was cut: what is pending will not be completed.
    pub fn reset(&mut self) {
        self.recent.clear();
        self.candidates.clear();
    }

    fn step(&mut self, byte: u8, deliver: &mut impl FnMut(&[u8])) {
        if self.recent.len() == LONGEST_PACKET_BYTES {
            self.recent.pop_front();
        }
        self.recent.push_back(byte);
        self.position += 1;
        self.note_candidate(byte);
        // Candidates of different lengths overlap, so they do not end in the order in which they began.
        let mut index = 0;
        while let Some(candidate) = self.candidates.get(index).copied() {
            if candidate.end > self.position {
                index += 1;
                continue;
            }
            self.candidates.remove(index);
            let length = (candidate.end - candidate.start) as usize;
            let packet = self.recent.make_contiguous();
            let packet = packet.get(packet.len().saturating_sub(length)..).unwrap_or(&[]);
            if is_whole(packet) {
                deliver(packet);
                self.packets += 1;
                self.bytes_in_packets += candidate.end - candidate.start.max(self.delivered_to);
                self.delivered_to = candidate.end;
                // Two packets cannot share bytes but for a freak of a deletion, where one ends with the sync of the next.
                let ended = self.position;
                self.candidates.retain(|other| other.start + 1 >= ended);
                return;
            }
            self.bad_check += 1;
        }
    }

    /// If `byte` is the length byte of what may be a packet.
    fn note_candidate(&mut self, byte: u8) {
        let Some(start_in_recent) = self.recent.len().checked_sub(LENGTH_OFFSET + 1) else {
            return;
        };
        let at = |offset: usize| self.recent.get(start_in_recent + offset).copied();
        if at(0) == Some(SYNC[0])
            && at(1) == Some(SYNC[1])
            && let Some(length) = packet_bytes(byte)
        {
            let start = self.position - (LENGTH_OFFSET as u64 + 1);
            if start + 1 < self.delivered_to {
                return;
            }
            self.candidates.push_back(Candidate {
                start,
                end: start + length as u64,
            });
        }
    }

    /// What has been counted so far.
    pub fn counts(&self) -> ParserCounts {
        // A beginning of a header may yet become a packet.
        let header = (LENGTH_OFFSET.min(self.recent.len())) as u64;
        let open = self.candidates.front().map_or(self.position - header, |first| first.start);
        let pending = self.position - open.max(self.delivered_to).min(self.position);
        ParserCounts {
            bytes: self.position,
            bytes_skipped: self.position - self.bytes_in_packets - pending,
            packets: self.packets,
            bad_check: self.bad_check,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::feed::message::{DeviceTime, JointValues, Message, Reading};
    use crate::robot::feed::wire::{HEADER_BYTES, encode};
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    fn packet(sequence: u32, joints: usize) -> Vec<u8> {
        let values: Vec<f64> = (0..joints).map(|i| f64::from(sequence) * 0.1 + i as f64).collect();
        let message = Message {
            sequence: Some(sequence),
            device_time: DeviceTime::Microseconds32(sequence.wrapping_mul(10_000)),
            status: 0,
            faults: 0,
            reading: Reading::Joints(JointValues::new(&values).unwrap()),
            fingerprint: 0,
        };
        let mut packet = Vec::new();
        encode(&message, &mut packet);
        packet
    }

    /// Every stretch of the stream that is a packet, in the order of their ends: the plainest way to say it.
    fn reference_packets(stream: &[u8]) -> Vec<Vec<u8>> {
        let mut found = Vec::new();
        for end in 1..=stream.len() {
            for start in 0..end {
                if is_whole(&stream[start..end]) {
                    found.push(stream[start..end].to_vec());
                    break;
                }
            }
        }
        found
    }

    fn parsed(stream: &[u8], cut: usize) -> (Vec<Vec<u8>>, ParserCounts) {
        let mut parser = Parser::default();
        let mut found = Vec::new();
        for part in stream.chunks(cut) {
            parser.take(part, |packet| found.push(packet.to_vec()));
            assert!(parser.recent.len() <= LONGEST_PACKET_BYTES && parser.candidates.len() <= LONGEST_PACKET_BYTES);
        }
        (found, parser.counts())
    }

    #[test]
    fn packets_are_found_in_garbage_however_the_stream_is_cut() {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let mut stream = Vec::new();
        let mut sent = Vec::new();
        let mut garbage = 0;
        for sequence in 0..60 {
            for _ in 0..random.random_range(0..40) {
                // Much of it looks like a beginning.
                stream.push([0xA5, 0x5A, 1, 1, random.random(), 64, 0][random.random_range(0..7)]);
                garbage += 1;
            }
            let packet = packet(sequence, random.random_range(1..=16));
            stream.extend_from_slice(&packet);
            sent.push(packet);
        }
        assert_eq!(reference_packets(&stream), sent);
        for cut in [1, 2, 3, 17, 1000, usize::MAX] {
            let (found, counts) = parsed(&stream, cut);
            assert_eq!(found, sent);
            assert_eq!((counts.packets, counts.bytes_skipped), (60, garbage));
        }
    }

    #[test]
    fn a_broken_length_holds_nothing_up() {
        let mut stream = packet(1, 7);
        stream[LENGTH_OFFSET] = 64;
        let first = stream.len();
        stream.extend(packet(2, 7));
        let mut parser = Parser::default();
        let mut found = 0;
        parser.take(&stream[..stream.len() - 1], |_| found += 1);
        assert_eq!(found, 0);
        parser.take(&stream[stream.len() - 1..], |_| found += 1);
        assert_eq!(found, 1);
        assert_eq!(parser.counts().bytes_skipped, first as u64);
    }

    #[test]
    fn a_packet_that_ends_with_the_next_ones_sync_costs_neither() {
        // A's last byte was lost on the way and is the byte that B begins with.
        let a = (0..100_000)
            .map(|sequence| packet(sequence, 3))
            .find(|packet| packet.last() == Some(&SYNC[0]))
            .unwrap();
        let b = packet(7, 3);
        let mut stream = a.clone();
        stream.extend_from_slice(&b[1..]);
        for cut in [1, 5, usize::MAX] {
            assert_eq!(parsed(&stream, cut).0, [a.clone(), b.clone()]);
        }
        assert_eq!(reference_packets(&stream), [a, b]);
    }

    #[test]
    fn counts_add_up() {
        let mut parser = Parser::default();
        let whole = packet(1, 2);
        parser.take(b"garbage", |_| ());
        parser.take(&whole[..HEADER_BYTES], |_| ());
        assert_eq!(parser.counts().bytes_skipped, 7);
        parser.take(&whole[HEADER_BYTES..], |_| ());
        let mut bad = whole.clone();
        bad[HEADER_BYTES] ^= 1;
        parser.take(&bad, |_| ());
        parser.take(b"more", |_| ());
        parser.take(b"    ", |_| ());
        let counts = parser.counts();
        assert_eq!((counts.packets, counts.bad_check), (1, 1));
        assert_eq!(counts.bytes, (7 + 2 * whole.len() + 8) as u64);
        // The last four bytes might begin a packet.
        assert_eq!(counts.bytes_skipped, (7 + bad.len() + 4) as u64);
    }

    #[test]
    fn a_cut_line_does_not_join_what_was_never_together() {
        let whole = packet(1, 2);
        let mut parser = Parser::default();
        let mut found = 0;
        parser.take(&whole[..20], |_| found += 1);
        parser.reset();
        parser.take(&whole[20..], |_| found += 1);
        assert_eq!(found, 0);
        parser.take(&whole, |_| found += 1);
        assert_eq!(found, 1);
    }
}
