//! The line's promises: order, what drops, clean stop, and a picture that goes on whatever fails. No test sleeps.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam::channel::bounded;
use endofield::frame::Frame;
use endofield::pipeline::builder::{BuildError, Builder, Pipeline};
use endofield::pipeline::queue::Queue;
use endofield::pipeline::runner::Wish;
use endofield::pipeline::stage::{Stage, StageError};
use endofield::time::{ManualClock, Span};

use crate::support::line::{Doing, Keeping, Numbered, adding};

fn line(source: Numbered) -> Builder {
    Pipeline::builder(Box::new(source), Arc::new(ManualClock::default()))
}

#[test]
fn frames_come_out_in_order_through_every_stage_once() {
    let (sink, seen) = Keeping::new("sink");
    let built = line(Numbered::new(50))
        .stage(adding("one", 1))
        .stage(adding("two", 10))
        .sink(Box::new(sink), Queue::blocking(2));
    let outcome = built.build().unwrap().start().unwrap().wait();
    assert_eq!(seen.ids(), (0..50).collect::<Vec<_>>());
    assert_eq!(seen.levels(), (0..50).map(|n| n + 11).collect::<Vec<u8>>());
    assert_eq!((outcome.frames_in, outcome.frames_out, outcome.frames_dropped), (50, 50, 0));
    assert_eq!(outcome.stages.iter().map(|s| s.name).collect::<Vec<_>>(), ["one", "two"]);
    assert_eq!(outcome.stages[1].working.count(), 50);
    assert_eq!(outcome.end_to_end.count(), 50);
    assert!(outcome.faults().is_empty() && !outcome.stopped);
    assert_eq!(seen.finished(), 1);
}

#[test]
fn a_line_without_stages_is_a_copy() {
    let (sink, seen) = Keeping::new("sink");
    let outcome = line(Numbered::new(3))
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap()
        .wait();
    assert_eq!((seen.ids(), outcome.frames_out), (vec![0, 1, 2], 3));
}

#[test]
fn the_builder_refuses_a_line_that_cannot_run() {
    let keeping = |name| Box::new(Keeping::new(name).0);
    assert_eq!(line(Numbered::new(1)).build().unwrap_err(), BuildError::NoSink);
    let twice = line(Numbered::new(1))
        .stage(adding("one", 1))
        .stage(adding("one", 1))
        .sink(keeping("sink"), Queue::blocking(1));
    assert_eq!(twice.build().unwrap_err(), BuildError::SameName("one"));
    let no_room = line(Numbered::new(1)).sink(keeping("sink"), Queue::blocking(0));
    assert_eq!(no_room.build().unwrap_err(), BuildError::NoRoom("sink"));
    let nameless = line(Numbered::new(1)).sink(keeping(""), Queue::blocking(1));
    assert_eq!(nameless.build().unwrap_err(), BuildError::NoName);
}

#[test]
fn an_error_lets_the_frame_go_on_as_it_came_and_resets_the_stage() {
    let failing = Doing::boxed("failing", |frame: &mut Frame| match frame.id.0 {
        3..6 => Err(StageError("too dark".to_owned())),
        _ => {
            let level = frame.image.at(0, 0)[0];
            frame.image.fill([level + 100; 3]);
            Ok(())
        }
    });
    let resets = Arc::clone(&failing.resets);
    let (sink, seen) = Keeping::new("sink");
    let outcome = line(Numbered::new(8))
        .stage(failing)
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap()
        .wait();
    assert_eq!(seen.levels(), [100, 101, 102, 3, 4, 5, 106, 107]);
    assert_eq!((outcome.stages[0].failures, outcome.stages[0].working.count()), (3, 5));
    assert_eq!(outcome.stages[0].first_failure.as_deref(), Some("too dark"));
    assert_eq!(resets.lock().unwrap().len(), 3);
    assert!(
        outcome.faults().is_empty(),
        "single failed frames are what the line promises to live with"
    );
}

#[test]
fn a_panic_bypasses_the_stage_for_good_and_is_reported() {
    let calls = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&calls);
    let mut own = endofield::image::buffer::Image::filled(8, 4, [0; 3]);
    let panicking = Doing::boxed("panicking", move |frame: &mut Frame| {
        counted.fetch_add(1, Ordering::SeqCst);
        own.fill([200; 3]);
        assert!(frame.id.0 != 2, "a fault of ours");
        frame.image.swap(&mut own);
        Ok(())
    });
    let (sink, seen) = Keeping::new("sink");
    let built = line(Numbered::new(6))
        .stage(panicking)
        .stage(adding("after", 1))
        .sink(Box::new(sink), Queue::blocking(1));
    let outcome = built.build().unwrap().start().unwrap().wait();
    assert_eq!(seen.levels(), [201, 201, 3, 4, 5, 6]);
    assert_eq!(calls.load(Ordering::SeqCst), 3, "a stage that panicked is not called again");
    assert!(outcome.stages[0].panic.as_ref().unwrap().contains("a fault of ours"));
    assert_eq!(outcome.faults().len(), 1);
    assert!(outcome.stages[1].panic.is_none());
}

#[test]
fn a_failing_sink_ends_alone() {
    let (bad, bad_seen) = Keeping::new("bad");
    let (good, good_seen) = Keeping::new("good");
    let built = line(Numbered::new(20))
        .sink(Box::new(bad.failing_at(4)), Queue::blocking(1))
        .sink(Box::new(good), Queue::blocking(1));
    let outcome = built.build().unwrap().start().unwrap().wait();
    assert_eq!(bad_seen.ids(), [0, 1, 2, 3]);
    assert_eq!(bad_seen.finished(), 1, "what was written is made whole");
    assert_eq!(good_seen.ids().len(), 20);
    assert_eq!(outcome.sinks[0].failure.as_deref(), Some("the disk is full"));
    assert_eq!(outcome.sinks[1].failure, None);
    assert_eq!(outcome.faults().len(), 1);
}

#[test]
fn without_its_essential_sink_the_line_stops_cleanly() {
    let (permit, permission) = bounded(1);
    let (bad, _) = Keeping::new("bad");
    let (good, good_seen) = Keeping::new("good");
    let running = line(Numbered::new(1_000_000).on_permission(permission))
        .essential_sink(Box::new(bad.failing_at(4)), Queue::blocking(1))
        .sink(Box::new(good), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    // The source goes on for as long as it is let; the line ends by itself, after which nobody takes permissions.
    while permit.send(()).is_ok() {}
    let outcome = running.wait();
    assert!(outcome.stopped && outcome.frames_in < 1_000_000);
    assert_eq!(good_seen.ids().len() as u64, outcome.frames_out);
    assert_eq!(good_seen.finished(), 1);
}

#[test]
fn a_sink_that_panics_is_a_failed_sink() {
    struct Panicking;
    impl endofield::pipeline::stage::Sink for Panicking {
        fn name(&self) -> &'static str {
            "panicking"
        }
        fn consume(&mut self, _: &Arc<Frame>) -> Result<(), endofield::pipeline::stage::SinkError> {
            panic!("a fault of ours")
        }
    }
    let (good, seen) = Keeping::new("good");
    let built = line(Numbered::new(5))
        .sink(Box::new(Panicking), Queue::blocking(1))
        .sink(Box::new(good), Queue::blocking(1));
    let outcome = built.build().unwrap().start().unwrap().wait();
    assert_eq!(seen.ids().len(), 5);
    assert!(outcome.faults()[0].contains("a fault of ours"), "{:?}", outcome.faults());
}

#[test]
fn what_came_before_a_source_error_is_finished() {
    let (sink, seen) = Keeping::new("sink");
    let source = Numbered::new(7).then_error("the file ends in mid-frame");
    let outcome = line(source)
        .stage(adding("one", 1))
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap()
        .wait();
    assert_eq!((seen.ids().len(), seen.finished()), (7, 1));
    assert_eq!(outcome.faults(), ["the file ends in mid-frame"]);
}

#[test]
fn a_stop_finishes_what_is_under_way() {
    let (permit, permission) = bounded(0);
    let (sink, seen) = Keeping::new("sink");
    let running = line(Numbered::new(100).on_permission(permission))
        .stage(adding("one", 1))
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    for _ in 0..10 {
        permit.send(()).unwrap();
    }
    // The source may be waiting for its eleventh permission already; then it takes that one, and no other.
    running.stop();
    let eleventh = usize::from(permit.send(()).is_ok());
    let outcome = running.wait();
    assert!(outcome.stopped);
    assert_eq!((seen.ids().len(), seen.finished()), (10 + eleventh, 1));
    assert!(permit.send(()).is_err(), "the source is gone");
}

#[test]
fn whoever_waits_may_wish_for_the_end() {
    let (permit, permission) = bounded(0);
    let (sink, seen) = Keeping::new("sink");
    let running = line(Numbered::new(100).on_permission(permission))
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    permit.send(()).unwrap();
    let mut permit = Some(permit);
    let outcome = running.wait_looking(|line| {
        assert!(line.status().frames_in <= 1);
        drop(permit.take());
        Wish::Stop
    });
    assert_eq!((outcome.frames_out, seen.finished()), (1, 1));
}

#[test]
fn a_slow_live_sink_drops_its_oldest_and_nobody_waits() {
    let (begun, has_begun) = bounded(16);
    let (go, may_go) = bounded(16);
    let (slow, slow_seen) = Keeping::new("slow");
    let (fast, fast_seen) = Keeping::new("fast");
    let (permit, permission) = bounded(0);
    let running = line(Numbered::new(10).on_permission(permission))
        .sink(Box::new(slow.gated(begun, may_go)), Queue::newest_only())
        .sink(Box::new(fast), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    permit.send(()).unwrap();
    // The slow sink is at work on frame 0; all the others arrive meanwhile.
    assert_eq!(has_begun.recv(), Ok(0));
    for _ in 1..10 {
        permit.send(()).unwrap();
    }
    drop(permit);
    // The source asks for its next permission only after frame 9 was handed out; it is refused, so the line has ended but for
    // the slow sink. Only then is that let on.
    while running.status().frames_out < 10 {
        std::thread::yield_now();
    }
    for _ in 0..2 {
        go.send(()).unwrap();
    }
    let outcome = running.wait();
    assert_eq!(fast_seen.ids(), (0..10).collect::<Vec<_>>());
    assert_eq!(slow_seen.ids(), [0, 9], "the newest is what a display needs");
    assert_eq!((outcome.sinks[0].dropped, outcome.sinks[1].dropped), (8, 0));
}

#[test]
fn a_live_entry_drops_the_oldest_and_counts() {
    let (begun, has_begun) = bounded(0);
    let (go, may_go) = bounded::<()>(0);
    let waiting = Doing::boxed("waiting", move |frame: &mut Frame| {
        let _test_ended = begun.send(frame.id.0);
        let _test_ended = may_go.recv();
        Ok(())
    });
    let (permit, permission) = bounded(0);
    let (sink, seen) = Keeping::new("sink");
    let running = line(Numbered::new(8).on_permission(permission))
        .entry(Queue::newest_only())
        .stage(waiting)
        .sink(Box::new(sink), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    permit.send(()).unwrap();
    assert_eq!(has_begun.recv(), Ok(0));
    for _ in 1..8 {
        permit.send(()).unwrap();
    }
    // The ninth permission is taken only after frame 7 lies in the queue.
    permit.send(()).unwrap();
    go.send(()).unwrap();
    assert_eq!(has_begun.recv(), Ok(7));
    go.send(()).unwrap();
    let outcome = running.wait();
    assert_eq!(seen.ids(), [0, 7]);
    assert_eq!((outcome.frames_in, outcome.frames_out, outcome.frames_dropped), (8, 2, 6));
}

#[test]
fn switches_work_while_the_line_runs() {
    struct Scaled {
        strength: f32,
        resets: u32,
    }
    impl Stage for Scaled {
        fn name(&self) -> &'static str {
            "scaled"
        }
        fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
            let level = (100.0 * self.strength) as u8 + self.resets as u8;
            frame.image.fill([level; 3]);
            Ok(())
        }
        fn reset(&mut self) {
            self.resets += 1;
        }
        fn set_strength(&mut self, strength: f32) {
            self.strength = strength;
        }
    }
    let (permit, permission) = bounded(0);
    let (begun, has_begun) = bounded(1);
    let (go, may_go) = bounded::<()>(1);
    let (sink, seen) = Keeping::new("sink");
    let running = line(Numbered::new(4).on_permission(permission))
        .stage(Box::new(Scaled {
            strength: 1.0,
            resets: 0,
        }))
        .sink(Box::new(sink.gated(begun, may_go)), Queue::blocking(1))
        .build()
        .unwrap()
        .start()
        .unwrap();
    let controls = Arc::clone(running.controls());
    let one_frame = |before: &dyn Fn()| {
        before();
        permit.send(()).unwrap();
        has_begun.recv().unwrap();
        go.send(()).unwrap();
    };
    one_frame(&|| ());
    one_frame(&|| controls.bypass("scaled").unwrap());
    one_frame(&|| controls.resume("scaled").unwrap());
    one_frame(&|| controls.set_strength("scaled", 0.5).unwrap());
    drop(permit);
    let outcome = running.wait();
    assert_eq!(
        seen.levels(),
        [100, 1, 101, 51],
        "as set, bypassed, taken in again after a reset, half"
    );
    assert_eq!(outcome.stages[0].switched_off, 1);
}

#[test]
fn a_tap_sees_the_untouched_picture_and_the_original_is_kept_when_asked() {
    let (tap, tap_seen) = Keeping::new("tap");
    let (sink, seen) = Keeping::new("sink");
    let compares = Doing::boxed("compares", |frame: &mut Frame| {
        let original = frame.original.as_ref().ok_or_else(|| StageError("no original".to_owned()))?;
        (original.at(0, 0)[0] + 1 == frame.image.at(0, 0)[0])
            .then_some(())
            .ok_or_else(|| StageError("not the original".to_owned()))
    });
    let built = line(Numbered::new(5))
        .keep_original(true)
        .tap(Box::new(tap), Queue::blocking(1))
        .stage(adding("one", 1))
        .stage(compares)
        .sink(Box::new(sink), Queue::blocking(1));
    let outcome = built.build().unwrap().start().unwrap().wait();
    assert_eq!(tap_seen.levels(), [0, 1, 2, 3, 4]);
    assert_eq!(seen.levels(), [1, 2, 3, 4, 5]);
    assert_eq!(outcome.stages[1].failures, 0, "{:?}", outcome.stages[1].first_failure);
}

#[test]
fn times_are_those_of_the_clock() {
    let clock = Arc::new(ManualClock::default());
    let hand = Arc::clone(&clock);
    let slow = Doing::boxed("slow", move |_: &mut Frame| {
        hand.advance(Span::from_milliseconds(7.0));
        Ok(())
    });
    let (sink, _) = Keeping::new("sink");
    // One frame, so that no other thread's frame sees the clock turn.
    let built = Pipeline::builder(Box::new(Numbered::new(1)), clock)
        .stage(slow)
        .sink(Box::new(sink), Queue::blocking(1));
    let outcome = built.build().unwrap().start().unwrap().wait();
    let working = outcome.stages[0].working.summary();
    assert!((working.p50_ms - 7.0).abs() < 0.01 && working.count == 1, "{working:?}");
    assert!((outcome.end_to_end.summary().max_ms - 7.0).abs() < 0.01);
    assert_eq!(outcome.stages[0].waiting.summary().max_ms, 0.0);
}

#[test]
fn a_long_gap_makes_stages_forget() {
    struct Jumping(Numbered, u64);
    impl endofield::pipeline::stage::Source for Jumping {
        fn next_frame(&mut self) -> Result<Option<Frame>, endofield::pipeline::stage::SourceError> {
            Ok(self.0.next_frame()?.map(|mut frame| {
                frame.id.0 += if frame.id.0 >= 3 { self.1 } else { 0 };
                frame
            }))
        }
    }
    for (gap, resets_expected) in [(0, 0), (3, 0), (50, 1)] {
        let counting = Doing::boxed("counting", |_: &mut Frame| Ok(()));
        let resets = Arc::clone(&counting.resets);
        let (sink, _) = Keeping::new("sink");
        let source = Box::new(Jumping(Numbered::new(6), gap));
        let built = Pipeline::builder(source, Arc::new(ManualClock::default()))
            .stage(counting)
            .sink(Box::new(sink), Queue::blocking(1));
        built.build().unwrap().start().unwrap().wait();
        assert_eq!(resets.lock().unwrap().len(), resets_expected, "gap {gap}");
    }
}
