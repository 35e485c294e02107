//! Lines of text: a pose a line as in `poses.tum`, or joint values a line as in `joints.csv`.
//!
//! For arms whose makers give a script to play with, for files and for pipes. Numbers are separated by blanks or commas. A comment
//! `# T_base_hand, m` sets the unit, a heading `timestamp_s,q1,…` or `timestamp_s,tx,…` says what the lines hold, wherever in the
//! stream it comes. Text has no check: a damaged digit is a wrong pose. On a real wire use the binary format.

use crate::robot::feed::driver::{Driver, DriverCounts, Joined};
use crate::robot::feed::message::{DeviceTime, JointValues, MOST_JOINTS, Message, Reading};

/// A line longer than this is garbage.
const LONGEST_LINE_BYTES: usize = 1024;

/// What lines hold until a heading says otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TextContent {
    /// `timestamp_s tx ty tz qx qy qz qw`
    Poses,
    /// `timestamp_s,q1,…,qn`
    Joints,
}

/// Reads lines.
#[derive(Debug)]
pub struct TextDriver {
    content: TextContent,
    mm_per_unit: f64,
    line: Vec<u8>,
    /// The rest of a line of which the beginning is missing or which is too long.
    skipping: bool,
    counts: DriverCounts,
}

impl TextDriver {
    /// Lines that hold `content` until a heading says otherwise.
    pub fn new(content: TextContent) -> Self {
        Self {
            content,
            mm_per_unit: 1.0,
            line: Vec::new(),
            skipping: false,
            counts: DriverCounts::default(),
        }
    }

    fn end_of_line(&mut self, deliver: &mut dyn FnMut(Message)) {
        let bytes = std::mem::take(&mut self.line);
        if self.skipping {
            self.skipping = false;
            self.counts.bytes_skipped += bytes.len() as u64;
        } else if let Ok(text) = std::str::from_utf8(&bytes) {
            self.understand(text.trim(), deliver);
        } else {
            self.counts.malformed += 1;
        }
        self.line = bytes;
        self.line.clear();
    }

    fn understand(&mut self, line: &str, deliver: &mut dyn FnMut(Message)) {
        if line.is_empty() {
            return;
        }
        if let Some(comment) = line.strip_prefix('#') {
            for word in comment.split(|c: char| !c.is_alphanumeric() && c != '_') {
                match word {
                    "mm" => self.mm_per_unit = 1.0,
                    "m" => self.mm_per_unit = 1000.0,
                    _ => {}
                }
            }
            return;
        }
        if line.starts_with("timestamp") {
            let holds_joints = line.split([',', ' ', '\t']).any(|word| word == "q1");
            self.content = if holds_joints {
                TextContent::Joints
            } else {
                TextContent::Poses
            };
            return;
        }
        match self.message(line) {
            Some(message) => {
                self.counts.intact += 1;
                deliver(message);
            }
            None => self.counts.malformed += 1,
        }
    }

    fn message(&self, line: &str) -> Option<Message> {
        let mut values = [0.0_f64; MOST_JOINTS + 1];
        let mut count = 0;
        let words = line.split(|c: char| c.is_whitespace() || c == ',');
        for word in words.filter(|word| !word.is_empty()) {
            // NaN and infinity are numbers here; whoever believes them is not.
            *values.get_mut(count)? = word.parse().ok()?;
            count += 1;
        }
        let (stamp, values) = values.get(..count)?.split_first()?;
        // Seconds as f64 hold microseconds for centuries, and a stamp of 292 years does not fit.
        let device_time = (stamp.abs() < 9e9).then(|| DeviceTime::Nanoseconds((stamp * 1e9).round() as i64))?;
        let reading = match (self.content, values) {
            (TextContent::Joints, values) if !values.is_empty() => Reading::Joints(JointValues::new(values)?),
            (TextContent::Poses, &[x, y, z, qx, qy, qz, qw]) => Reading::Pose {
                translation: [x, y, z].map(|v| v * self.mm_per_unit),
                rotation: [qx, qy, qz, qw],
            },
            _ => return None,
        };
        Some(Message {
            sequence: None,
            device_time,
            status: 0,
            faults: 0,
            reading,
            fingerprint: 0,
        })
    }
}

impl Driver for TextDriver {
    fn name(&self) -> &'static str {
        match self.content {
            TextContent::Poses => "text_poses",
            TextContent::Joints => "text_joints",
        }
    }

    fn take(&mut self, bytes: &[u8], deliver: &mut dyn FnMut(Message)) {
        self.counts.bytes += bytes.len() as u64;
        for byte in bytes {
            match byte {
                b'\n' | b'\r' => self.end_of_line(deliver),
                _ if self.line.len() == LONGEST_LINE_BYTES => {
                    self.counts.malformed += u64::from(!self.skipping);
                    self.counts.bytes_skipped += self.line.len() as u64;
                    self.line.clear();
                    self.skipping = true;
                }
                _ => self.line.push(*byte),
            }
        }
    }

    fn reset(&mut self, joined: Joined) {
        self.line.clear();
        self.skipping = joined == Joined::Midway;
    }

    fn counts(&self) -> DriverCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(content: TextContent, joined: Joined, text: &[u8], cut: usize) -> (Vec<Message>, DriverCounts) {
        let mut driver = TextDriver::new(content);
        driver.reset(joined);
        let mut found = Vec::new();
        for part in text.chunks(cut) {
            driver.take(part, &mut |message| found.push(message));
        }
        (found, driver.counts())
    }

    #[test]
    fn poses_in_metres_however_cut() {
        let text = b"# T_base_hand, m\r\n# timestamp_s tx ty tz qx qy qz qw\r\n0.5 0.1 0 0 0 0 0 1\r\n0.52,0.2,0,0,0,0,0,1\r\n";
        for cut in [1, 7, 1000] {
            let (found, counts) = read(TextContent::Joints, Joined::AtStart, text, cut);
            // Seven numbers after the stamp are joints, too, until a heading says otherwise.
            assert!(matches!(found[0].reading, Reading::Joints(_)));
            assert_eq!(counts.intact, 2);
            let (found, _) = read(TextContent::Poses, Joined::AtStart, text, cut);
            assert_eq!(found[0].device_time, DeviceTime::Nanoseconds(500_000_000));
            let expected = Reading::Pose {
                translation: [200.0, 0.0, 0.0],
                rotation: [0.0, 0.0, 0.0, 1.0],
            };
            assert_eq!(found[1].reading, expected);
        }
    }

    #[test]
    fn a_heading_tells_joints() {
        let text = b"timestamp_s,q1,q2\n0.0,10,0.5\n0.01,11,nan\n";
        let (found, _) = read(TextContent::Poses, Joined::AtStart, text, 4);
        assert_eq!(found[0].reading, Reading::Joints(JointValues::new(&[10.0, 0.5]).unwrap()));
        assert!(matches!(&found[1].reading, Reading::Joints(values) if values.as_slice()[1].is_nan()));
    }

    #[test]
    fn half_a_line_is_no_line() {
        let text = b"5 1 2 3 0 0 0 1\n2.5 1 2 3 0 0 0 1\n";
        assert_eq!(read(TextContent::Poses, Joined::Midway, text, 3).0.len(), 1);
        assert_eq!(read(TextContent::Poses, Joined::AtStart, text, 3).0.len(), 2);
    }

    #[test]
    fn garbage_is_counted_and_bounded() {
        let mut text = b"0.1 1 2 3\nhello\n\xff\xfe\n1e300 0 0 0 0 0 0 1\n".to_vec();
        text.extend(std::iter::repeat_n(b'7', 5000));
        text.extend_from_slice(b"\n0.3 0 0 0 0 0 0 1\n0.4 ");
        text.extend(std::iter::repeat_n(b"1 ", 30).flatten());
        text.push(b'\n');
        let (found, counts) = read(TextContent::Poses, Joined::AtStart, &text, 11);
        assert_eq!((found.len(), counts.intact, counts.malformed), (1, 1, 6));
        let mut driver = TextDriver::new(TextContent::Poses);
        driver.take(&text, &mut |_| ());
        assert!(driver.line.capacity() <= 2 * LONGEST_LINE_BYTES);
    }
}
