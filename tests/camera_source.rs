//! A camera that misbehaves in every way that is known, played by hand: the source says what is wrong, counts it, and goes on.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

use endofield::frame::Frame;
use endofield::image::pool::Pool;
use endofield::pipeline::stage::Source as _;
use endofield::sources::camera::capture::{CameraState, CaptureSource, CaptureWatch};
use endofield::sources::camera::device::Wish;
use endofield::time::{Clock as _, ManualClock, Span, Timestamp};

use crate::support::played_camera::{Act, PERIOD_MS, Played, Script};

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
    let script = Arc::new(Mutex::new(Script::new(acts, (8, 4), &stop)));
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
        absent_until: Timestamp::from_seconds(3.0),
        ..Script::new([Act::Frame(7)], (8, 4), &stop)
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
