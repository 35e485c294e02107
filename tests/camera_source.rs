//! A camera that misbehaves in every way that is known, played by hand: the source says what is wrong, counts it, and goes on.

use std::collections::VecDeque;
use std::io;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use endofield::frame::Frame;
use endofield::image::pool::Pool;
use endofield::pipeline::stage::Source as _;
use endofield::sources::camera::capture::{CameraState, CaptureSource, CaptureWatch};
use endofield::sources::camera::device::{Camera, CameraError, Layout, Matrix, Mode, Range, Stamp, Stream, Wish};
use endofield::time::{Clock as _, ManualClock, Span, Timestamp};

/// What the camera does next.
#[derive(Clone, Debug)]
enum Act {
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
struct Script {
    acts: VecDeque<Act>,
    absent_until: Timestamp,
    width: usize,
    signal: bool,
    sequence: u32,
    panics: bool,
    openings: u32,
    stop: Arc<AtomicBool>,
}

struct Played {
    script: Arc<Mutex<Script>>,
    clock: Arc<ManualClock>,
}

struct PlayedStream {
    script: Arc<Mutex<Script>>,
    clock: Arc<ManualClock>,
    mode: Mode,
    sequence: u32,
}

const PERIOD_MS: f64 = 40.0;

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
            width: script.width,
            height: 4,
            layout: Layout::Rgb24,
            stride: 3 * script.width,
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
                Some(Act::Mode(width)) => script.width = width,
                Some(Act::PanicsWhenDropped) => script.panics = true,
                Some(Act::Changed) => return Ok(false),
                Some(Act::Old(..)) => return Ok(true),
                Some(Act::Frame(_) | Act::Damaged | Act::Short) => return Ok(!patience.is_zero()),
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
        if !matches!(act, Act::Old(..)) {
            self.clock.advance(Span::from_milliseconds(PERIOD_MS));
        }
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

struct Show {
    frames: Vec<Frame>,
    states: Vec<&'static str>,
    watch: CaptureWatch,
    openings: u32,
}

/// Play it all, looking at the state after each frame.
fn play(acts: impl IntoIterator<Item = Act>) -> Show {
    let clock = Arc::new(ManualClock::default());
    clock.advance(Span::from_seconds(100.0));
    let stop = Arc::new(AtomicBool::new(false));
    let script = Arc::new(Mutex::new(Script {
        acts: acts.into_iter().collect(),
        absent_until: Timestamp(0),
        width: 8,
        signal: true,
        sequence: 0,
        panics: false,
        openings: 0,
        stop: Arc::clone(&stop),
    }));
    let camera = Played {
        script: Arc::clone(&script),
        clock: Arc::clone(&clock),
    };
    let mut source = CaptureSource::new(Box::new(camera), Wish::default(), clock, Pool::new(4), stop);
    let watch = source.watch();
    let (mut frames, mut states) = (Vec::new(), Vec::new());
    while let Some(frame) = source.next_frame().unwrap() {
        frames.push(frame);
        states.push(watch.status().state.word());
    }
    drop(source);
    let openings = script.lock().unwrap().openings;
    Show {
        frames,
        states,
        watch,
        openings,
    }
}

fn levels(show: &Show) -> Vec<u8> {
    show.frames.iter().map(|frame| frame.image.at(0, 0)[0]).collect()
}

fn ids(show: &Show) -> Vec<u64> {
    show.frames.iter().map(|frame| frame.id.0).collect()
}

#[test]
fn frames_carry_the_drivers_stamps_and_their_numbers_show_gaps() {
    let show = play([Act::Frame(1), Act::Frame(2), Act::Skip(3), Act::Frame(3)]);
    assert_eq!((levels(&show), ids(&show)), (vec![1, 2, 3], vec![0, 1, 5]));
    let status = show.watch.status();
    assert_eq!((status.frames, status.missed, status.opened), (3, 3, 1));
    assert_eq!(show.frames[1].since_previous, Span::from_milliseconds(PERIOD_MS));
    assert_eq!(show.frames[2].since_previous, Span::from_milliseconds(4.0 * PERIOD_MS));
    // Stamps are taken after our clock was turned in `take`; arrival is when the frame was found waiting.
    assert!(show.frames.windows(2).all(|pair| pair[0].exposed_at < pair[1].exposed_at));
}

#[test]
fn damaged_and_short_frames_are_left_out_and_counted() {
    let show = play([Act::Frame(1), Act::Damaged, Act::Short, Act::Frame(2)]);
    assert_eq!((levels(&show), ids(&show)), (vec![1, 2], vec![0, 3]));
    let status = show.watch.status();
    assert_eq!((status.damaged, status.broken, status.missed), (1, 1, 0));
}

#[test]
fn frames_that_waited_too_long_are_left_out_unless_nothing_newer_is_there() {
    let old = [Act::Frame(1), Act::Old(2, 2000.0), Act::Old(3, 1960.0), Act::Old(4, 1920.0)];
    let show = play(old.into_iter().chain([Act::Frame(5), Act::Frame(6)]));
    // The driver refills while the third old one is looked at: nothing newer is there, and an old picture is better than none.
    assert_eq!(levels(&show), [1, 4, 5, 6]);
    assert_eq!(show.watch.status().stale, 2);
}

#[test]
fn a_camera_that_is_pulled_out_is_waited_for_and_its_gap_counted() {
    let show = play([
        Act::Frame(1),
        Act::PanicsWhenDropped,
        Act::Unplugged(1000.0),
        Act::Frame(2),
        Act::Frame(3),
    ]);
    assert_eq!(levels(&show), [1, 2, 3]);
    let status = show.watch.status();
    assert_eq!((status.opened, status.interruptions, show.openings), (2, 1, 2));
    // A second at 25 frames a second, found again within a fifth of a second and a nap.
    assert!((25..=31).contains(&status.missed), "{status:?}");
    assert_eq!(show.frames[1].id.0, status.missed + 1);
    assert_eq!(show.frames[2].id.0, status.missed + 2);
}

#[test]
fn a_stalled_stream_is_opened_anew() {
    let show = play([Act::Frame(1), Act::Silence(1500.0), Act::Frame(2)]);
    assert_eq!((levels(&show), show.states), (vec![1, 2], vec!["streaming", "streaming"]));
    let status = show.watch.status();
    assert_eq!((status.opened, status.interruptions), (2, 1));
    assert!(status.missed >= 36, "{status:?}");
    // A short silence is none.
    let show = play([Act::Frame(1), Act::Silence(200.0), Act::Frame(2)]);
    assert_eq!(show.watch.status().opened, 1);
    assert_eq!(show.watch.status().interruptions, 0);
}

#[test]
fn a_lost_signal_is_told_apart_from_a_stalled_stream() {
    let silent = play([Act::Frame(1), Act::Signal(false), Act::Silence(500.0)]);
    assert_eq!(silent.watch.status().state, CameraState::NoSignal);
    let stalled = play([Act::Frame(1), Act::Silence(500.0)]);
    assert_eq!(stalled.watch.status().state, CameraState::Stalled);
    // Some drivers deliver noise all the while.
    let noise = (0..60).map(|_| Act::Frame(9));
    let show = play(
        [Act::Frame(1), Act::Signal(false)]
            .into_iter()
            .chain(noise)
            .chain([Act::Signal(true)])
            .chain((0..60).map(|_| Act::Frame(9))),
    );
    assert_eq!(show.frames.len(), 121);
    assert_eq!(
        (show.states[0], show.states[50], show.states[120]),
        ("streaming", "no signal", "streaming")
    );
}

#[test]
fn a_change_of_mode_opens_the_stream_anew_in_the_new_size() {
    let show = play([Act::Frame(1), Act::Mode(16), Act::Changed, Act::Frame(2)]);
    let widths: Vec<usize> = show.frames.iter().map(|frame| frame.image.width()).collect();
    assert_eq!((widths, show.openings), (vec![8, 16], 2));
    assert_eq!(show.watch.status().mode.unwrap().width, 16);
}

#[test]
fn a_camera_that_is_not_there_at_first_is_waited_for() {
    let clock = Arc::new(ManualClock::default());
    let stop = Arc::new(AtomicBool::new(false));
    let script = Arc::new(Mutex::new(Script {
        acts: [Act::Frame(7)].into(),
        absent_until: Timestamp::from_seconds(3.0),
        width: 8,
        signal: true,
        sequence: 0,
        panics: false,
        openings: 0,
        stop: Arc::clone(&stop),
    }));
    let camera = Played {
        script,
        clock: Arc::clone(&clock),
    };
    let mut source = CaptureSource::new(
        Box::new(camera),
        Wish::default(),
        Arc::clone(&clock) as Arc<_>,
        Pool::new(4),
        stop,
    );
    assert_eq!(source.open_now().unwrap(), None);
    assert_eq!(source.watch().status().state.word(), "absent");
    assert_eq!(source.next_frame().unwrap().unwrap().image.at(0, 0), [7; 3]);
    assert!((3.0..3.3).contains(&clock.now().seconds()), "{:?}", clock.now());
}
