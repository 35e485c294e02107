//! A camera that misbehaves in every way that is known, as a script says.

use std::collections::VecDeque;
use std::io;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crossbeam::channel::Receiver;
use endofield::media::layout::{Layout, Matrix, Range};
use endofield::sources::camera::device::{Camera, CameraError, Mode, Stamp, Stream, Wish};
use endofield::time::{Clock as _, ManualClock, Span, Timestamp};

/// What the camera does next.
#[derive(Clone, Debug)]
pub enum Act {
    /// A frame of this level, so long after the one before it.
    Frame(u8),
    /// The same, but it waited in the driver for so long.
    Old(u8, f64),
    /// The driver leaves out so many.
    Skip(u32),
    /// A frame that the driver marks.
    Damaged,
    /// A frame with too few bytes.
    Short,
    /// Nothing for so many milliseconds.
    Silence(f64),
    /// Nothing comes in at the other end, but noise does.
    Signal(bool),
    /// The device is gone; opening fails for so many milliseconds.
    Unplugged(f64),
    /// From the next opening on, pictures have this many columns.
    Mode(usize),
    /// The driver wants the stream to be opened anew.
    Changed,
    /// The crate's stream panics when it is dropped.
    PanicsWhenDropped,
}

#[derive(Debug)]
pub struct Script {
    pub acts: VecDeque<Act>,
    /// When all is played: who tells what comes next. Without it the camera then stops the source.
    pub more: Option<Receiver<Act>>,
    pub absent_until: Timestamp,
    /// Columns and rows.
    pub size: (usize, usize),
    pub signal: bool,
    pub sequence: u32,
    pub panics: bool,
    pub openings: u32,
    pub stop: Arc<AtomicBool>,
}

impl Script {
    /// Play these, then stop the source by `stop`.
    pub fn new(acts: impl IntoIterator<Item = Act>, size: (usize, usize), stop: &Arc<AtomicBool>) -> Self {
        Self {
            acts: acts.into_iter().collect(),
            more: None,
            absent_until: Timestamp(0),
            size,
            signal: true,
            sequence: 0,
            panics: false,
            openings: 0,
            stop: Arc::clone(stop),
        }
    }
}

pub struct Played {
    pub script: Arc<Mutex<Script>>,
    pub clock: Arc<ManualClock>,
}

struct PlayedStream {
    script: Arc<Mutex<Script>>,
    clock: Arc<ManualClock>,
    mode: Mode,
    sequence: u32,
}

pub const PERIOD_MS: f64 = 40.0;

impl Camera for Played {
    fn name(&self) -> String {
        "played".to_owned()
    }

    fn open(&mut self, _wish: &Wish) -> Result<Box<dyn Stream>, CameraError> {
        let mut script = self.script.lock().unwrap();
        if self.clock.now() < script.absent_until {
            return Err(CameraError::Absent("played is not there".to_owned()));
        }
        script.openings += 1;
        let mode = Mode {
            width: script.size.0,
            height: script.size.1,
            layout: Layout::Rgb24,
            stride: 3 * script.size.0,
            matrix: Matrix::Bt709,
            range: Range::Full,
            frame_rate_hz: 1e3 / PERIOD_MS,
            interlaced: false,
        };
        Ok(Box::new(PlayedStream {
            script: Arc::clone(&self.script),
            clock: Arc::clone(&self.clock),
            mode,
            sequence: 0,
        }))
    }

    fn pause(&mut self, length: Duration) {
        self.clock.advance(Span::from_seconds(length.as_secs_f64()));
    }
}

impl Stream for PlayedStream {
    fn mode(&self) -> Mode {
        self.mode
    }

    fn wait(&mut self, patience: Duration) -> io::Result<bool> {
        let patience_ms = patience.as_secs_f64() * 1e3;
        let mut script = self.script.lock().unwrap();
        loop {
            match script.acts.front().cloned() {
                None if script.more.is_some() => {
                    match script.more.as_ref().map(|more| more.recv()) {
                        Some(Ok(act)) => script.acts.push_back(act),
                        _ => script.more = None,
                    }
                    continue;
                }
                None => {
                    script.stop.store(true, std::sync::atomic::Ordering::Release);
                    return Ok(false);
                }
                Some(Act::Silence(left)) => {
                    self.clock.advance(Span::from_milliseconds(patience_ms.min(left)));
                    script.acts.pop_front();
                    if left > patience_ms {
                        script.acts.push_front(Act::Silence(left - patience_ms));
                    }
                    return Ok(false);
                }
                Some(Act::Signal(signal)) => script.signal = signal,
                Some(Act::Skip(count)) => {
                    self.sequence += count;
                    self.clock.advance(Span::from_milliseconds(f64::from(count) * PERIOD_MS));
                }
                Some(Act::Unplugged(ms)) => {
                    script.acts.pop_front();
                    script.absent_until = self.clock.now() + Span::from_milliseconds(ms);
                    return Err(io::Error::from_raw_os_error(19));
                }
                Some(Act::Mode(width)) => script.size.0 = width,
                Some(Act::PanicsWhenDropped) => script.panics = true,
                Some(Act::Changed) => return Ok(false),
                Some(Act::Old(..)) => return Ok(true),
                Some(Act::Frame(_) | Act::Damaged | Act::Short) => {
                    if !patience.is_zero() {
                        self.clock.advance(Span::from_milliseconds(PERIOD_MS));
                    }
                    return Ok(!patience.is_zero());
                }
            }
            script.acts.pop_front();
        }
    }

    fn take(&mut self, taken: &mut dyn FnMut(&[u8], Stamp)) -> io::Result<()> {
        let mut script = self.script.lock().unwrap();
        let act = script.acts.pop_front().unwrap();
        let (level, age_ms) = match act {
            Act::Frame(level) => (level, 2.0),
            Act::Old(level, age_ms) => (level, age_ms),
            _ => (0, 2.0),
        };
        let mut bytes = vec![level; self.mode.bytes()];
        if matches!(act, Act::Short) {
            bytes.truncate(7);
        }
        let stamp = Stamp {
            at: Some(self.clock.now() - Span::from_milliseconds(age_ms)),
            sequence: self.sequence,
            damaged: matches!(act, Act::Damaged),
        };
        self.sequence += 1;
        script.sequence = self.sequence;
        drop(script);
        taken(&bytes, stamp);
        Ok(())
    }

    fn has_signal(&mut self) -> Option<bool> {
        Some(self.script.lock().unwrap().signal)
    }

    fn wants_other_mode(&mut self) -> bool {
        let mut script = self.script.lock().unwrap();
        let wants = matches!(script.acts.front(), Some(Act::Changed));
        if wants {
            script.acts.pop_front();
        }
        wants
    }
}

impl Drop for PlayedStream {
    fn drop(&mut self) {
        if std::mem::take(&mut self.script.lock().unwrap().panics) {
            panic!("the driver's crate does this");
        }
    }
}
