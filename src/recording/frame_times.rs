//! `frames.csv`: when each frame was exposed, on the recording's clock.

use crate::time::Timestamp;

/// What can be wrong with a line of `frames.csv`.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FrameTimeFault {
    /// Not two finite numbers.
    #[error("expected `frame,timestamp_s`, found `{0}`")]
    Line(String),
    /// A gap or a jump in the numbers.
    #[error("expected frame {expected}, found {found}: frames are numbered without gaps")]
    Number {
        /// What was due.
        expected: u64,
        /// What stands there.
        found: u64,
    },
    /// Not later than the line before.
    #[error("time runs backwards: {found_s:.6} s after {previous_s:.6} s")]
    Backwards {
        /// The line before.
        previous_s: f64,
        /// This line.
        found_s: f64,
    },
}

/// The exposure times of frames 0, 1, 2, … (numbers may start at 1); a fault comes with its line number.
pub fn parse(text: &str) -> Result<Vec<Timestamp>, (usize, FrameTimeFault)> {
    let mut times: Vec<Timestamp> = Vec::new();
    let mut first_number = 0;
    for (line_number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        let is_header = times.is_empty() && line.starts_with(char::is_alphabetic);
        if line.is_empty() || line.starts_with('#') || is_header {
            continue;
        }
        let fault = || (line_number, FrameTimeFault::Line(line.to_owned()));
        let (number, seconds) = line.split_once(',').ok_or_else(fault)?;
        let number: u64 = number.trim().parse().map_err(|_| fault())?;
        let seconds: f64 = seconds.trim().parse().map_err(|_| fault())?;
        if !seconds.is_finite() {
            return Err(fault());
        }
        if times.is_empty() && number == 1 {
            first_number = 1;
        }
        let expected = first_number + times.len() as u64;
        if number != expected {
            return Err((line_number, FrameTimeFault::Number { expected, found: number }));
        }
        let stamp = Timestamp::from_seconds(seconds);
        if let Some(previous) = times.last().filter(|previous| **previous >= stamp) {
            let fault = FrameTimeFault::Backwards {
                previous_s: previous.seconds(),
                found_s: seconds,
            };
            return Err((line_number, fault));
        }
        times.push(stamp);
    }
    Ok(times)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_lines_are_read() {
        let times = parse("frame,timestamp_s\n0,0.0\n1, 0.04\n2,0.08\n").unwrap();
        assert_eq!(times, [Timestamp(0), Timestamp(40_000_000), Timestamp(80_000_000)]);
        assert_eq!(parse("1,0.5\n2,0.6\n").unwrap().len(), 2);
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, line) in [
            ("0,0\n2,1\n", 2),
            ("0,0\n1,nan\n", 2),
            ("0,1\n1,0.5\n", 2),
            ("0;1\n", 1),
            ("0,0\n1\n", 2),
        ] {
            assert_eq!(parse(text).unwrap_err().0, line, "{text}");
        }
    }
}
