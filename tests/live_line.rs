//! A live line's promises: no frame waits longer than the limits say, whatever a stage does. The clock is turned by hand; no test
//! sleeps.

use std::sync::Arc;

use crossbeam::channel::{Receiver, Sender, bounded};
use endofield::frame::Frame;
use endofield::pipeline::builder::{BuildError, Builder, Pipeline};
use endofield::pipeline::live::Limits;
use endofield::pipeline::outcome::StageOutcome;
use endofield::pipeline::queue::Queue;
use endofield::pipeline::runner::RunningPipeline;
use endofield::pipeline::seat::Condition;
use endofield::time::{ManualClock, Span};

use crate::support::line::{Doing, Keeping, Numbered, Seen, adding};

/// A live line whose frames come when they are let.
struct Bench {
    clock: Arc<ManualClock>,
    permit: Sender<()>,
    seen: Seen,
    sent: usize,
}

impl Bench {
    fn new(stages: impl FnOnce(Builder, &Arc<ManualClock>) -> Builder) -> (Self, RunningPipeline) {
        let clock = Arc::new(ManualClock::default());
        let (permit, permission) = bounded(0);
        let (sink, seen) = Keeping::new("sink");
        let source = Numbered::new(100_000).on_permission(permission);
        let builder = Pipeline::builder(Box::new(source), Arc::clone(&clock) as Arc<_>)
            .entry(Queue::newest_only())
            .between_stages(1)
            .live(Limits::default());
        let running = stages(builder, &clock)
            .sink(Box::new(sink), Queue::drop_oldest(4096))
            .build()
            .unwrap()
            .start()
            .unwrap();
        let bench = Self {
            clock,
            permit,
            seen,
            sent: 0,
        };
        (bench, running)
    }

    fn send(&mut self) {
        self.permit.send(()).unwrap();
        self.sent += 1;
    }

    fn turn(&self, ms: f64) {
        self.clock.advance(Span::from_milliseconds(ms));
    }

    /// Until the sink has so many frames.
    fn wait_for(&self, count: usize) {
        while self.seen.frames.lock().unwrap().len() < count {
            std::thread::yield_now();
        }
    }

    /// A frame, all the way through, and then the time until the next.
    fn one_frame(&mut self) -> u8 {
        self.send();
        self.wait_for(self.sent);
        self.turn(33.0);
        *self.seen.levels().last().unwrap()
    }
}

/// A stage that tells when it begins and returns when it is let.
fn hanging(
    begun: Sender<u64>,
    go: Receiver<()>,
) -> Box<Doing<impl FnMut(&mut Frame) -> Result<(), endofield::pipeline::stage::StageError>>> {
    Doing::boxed("hanging", move |frame: &mut Frame| {
        let _test_ended = begun.send(frame.id.0);
        let _test_ended = go.recv();
        frame.image.fill([200; 3]);
        Ok(())
    })
}

fn condition(line: &RunningPipeline, name: &str) -> Condition {
    line.stages().iter().find(|stage| stage.name == name).unwrap().condition
}

fn outcome_of<'a>(stages: &'a [StageOutcome], name: &str) -> &'a StageOutcome {
    stages.iter().find(|stage| stage.name == name).unwrap()
}

#[test]
fn a_stage_that_hangs_delays_no_picture_beyond_the_deadline() {
    let (begun, has_begun) = bounded(16);
    let (go, may_go) = bounded(16);
    let (mut bench, line) = Bench::new(|builder, _| {
        builder
            .stage(adding("before", 1))
            .stage(hanging(begun, may_go))
            .stage(adding("after", 10))
    });
    bench.send();
    assert_eq!(has_begun.recv(), Ok(0));
    bench.turn(39.9);
    line.look();
    assert_eq!(bench.seen.ids().len(), 0);
    bench.turn(0.2);
    line.look();
    bench.wait_for(1);
    assert_eq!(bench.seen.levels(), [0], "the picture as it came");
    // The next waits in vain in the queue, and goes out at its deadline as well.
    bench.send();
    while line.status().frames_in < 2 {
        std::thread::yield_now();
    }
    bench.turn(40.0);
    line.look();
    bench.wait_for(2);
    assert_eq!(condition(&line, "hanging"), Condition::Working, "80 ms may be a bad moment");
    bench.turn(30.0);
    line.look();
    assert_eq!(condition(&line, "hanging"), Condition::Hanging);
    // From now on frames go around it at once, through everything else.
    for frame in 2..10 {
        assert_eq!(bench.one_frame(), frame + 11);
    }
    // It returns, with a frame nobody waits for. It rests, and works again.
    go.send(()).unwrap();
    while condition(&line, "hanging") != Condition::Resting {
        std::thread::yield_now();
    }
    assert_eq!(bench.one_frame(), 10 + 11);
    bench.turn(3000.0);
    go.send(()).unwrap();
    assert_eq!(bench.one_frame(), 200 + 10);
    line.stop();
    drop(bench.permit);
    drop(go);
    let outcome = line.wait();
    assert_eq!(bench.seen.ids(), (0..12).collect::<Vec<_>>());
    assert_eq!((outcome.passed.rescued, outcome.passed.overtaken), (2, 0));
    let stage = outcome_of(&outcome.stages, "hanging");
    assert_eq!((stage.hangs, stage.rests), (1, 1));
    assert!(outcome.lost_threads.is_empty());
}

#[test]
fn a_line_with_a_stage_that_never_returns_ends_all_the_same() {
    let (begun, has_begun) = bounded(16);
    let (go, may_go) = bounded(16);
    let (mut bench, line) = Bench::new(|builder, _| {
        builder
            .stage(adding("before", 1))
            .stage(hanging(begun, may_go))
            .stage(adding("after", 10))
    });
    bench.send();
    assert_eq!(has_begun.recv(), Ok(0));
    bench.send();
    bench.send();
    bench.turn(150.0);
    line.look();
    line.stop();
    drop(bench.permit);
    let outcome = line.wait();
    assert_eq!(outcome.frames_in, 3);
    assert_eq!(
        outcome.frames_out + outcome.passed.overtaken,
        3,
        "every frame is accounted for"
    );
    assert_eq!(bench.seen.finished(), 1, "what was written is made whole");
    assert_eq!(outcome.lost_threads, ["hanging"]);
    assert_eq!(outcome_of(&outcome.stages, "hanging").hangs, 1);
    drop(go);
}

#[test]
fn a_stage_too_slow_for_the_budget_is_passed_by_then_switched_off_then_tried_again() {
    let slow = |name: &'static str, ms: f64, clock: &Arc<ManualClock>| {
        let clock = Arc::clone(clock);
        Doing::boxed(name, move |frame: &mut Frame| {
            clock.advance(Span::from_milliseconds(ms));
            let level = frame.image.at(0, 0)[0] | if name == "slow" { 128 } else { 64 };
            frame.image.fill([level; 3]);
            Ok(())
        })
    };
    let (mut bench, line) =
        Bench::new(|builder, clock| builder.stage(slow("slow", 28.0, clock)).stage(slow("quick", 5.0, clock)));
    let mut levels = Vec::new();
    while condition(&line, "slow") != Condition::Resting {
        levels.push(bench.one_frame() & 0xc0);
        assert!(levels.len() < 32, "it overran every time");
    }
    // At first both worked and were late; then the quick one was what did not fit any more. The slow one is to blame.
    assert_eq!(levels[0], 128 | 64);
    assert!(levels.contains(&128));
    assert_eq!(condition(&line, "quick"), Condition::Working);
    assert_eq!((0..20).map(|_| bench.one_frame() & 0xc0).collect::<Vec<_>>(), [64; 20]);
    bench.turn(3000.0);
    assert_eq!(bench.one_frame() & 128, 128, "tried again");
    line.stop();
    drop(bench.permit);
    let outcome = line.wait();
    let stage = outcome_of(&outcome.stages, "slow");
    assert_eq!((stage.rests, stage.hangs, stage.skipped), (1, 0, 20));
    assert_eq!(outcome_of(&outcome.stages, "quick").rests, 0);
    assert_eq!((outcome.passed.rescued, outcome.frames_out), (0, outcome.frames_in));
}

#[test]
fn a_stage_that_panics_costs_its_one_frame_nothing() {
    let panicking = Doing::boxed("stage", |frame: &mut Frame| {
        assert!(frame.id.0 != 1, "a fault of ours");
        frame.image.fill([100; 3]);
        Ok(())
    });
    let (mut bench, line) = Bench::new(|builder, _| builder.stage(panicking).stage(adding("after", 1)));
    assert_eq!([(); 3].map(|()| bench.one_frame()), [101, 2, 3]);
    assert_eq!(condition(&line, "stage"), Condition::Broken);
    line.stop();
    drop(bench.permit);
    let outcome = line.wait();
    assert_eq!(outcome.passed.rescued, 0);
    assert!(outcome.stages[0].panic.is_some());
}

#[test]
fn a_stage_that_is_off_never_sees_a_frame() {
    let (mut bench, line) = Bench::new(|builder, _| builder.stage(adding("one", 1)).stage(adding("two", 10)));
    line.controls().bypass("one").unwrap();
    line.controls().bypass("two").unwrap();
    assert_eq!([(); 4].map(|()| bench.one_frame()), [0, 1, 2, 3]);
    line.controls().resume("two").unwrap();
    assert_eq!(bench.one_frame(), 14);
    line.stop();
    drop(bench.permit);
    let outcome = line.wait();
    let counts = |stage: &StageOutcome| (stage.switched_off, stage.waiting.count(), stage.working.count());
    assert_eq!(outcome.stages.iter().map(counts).collect::<Vec<_>>(), [(5, 0, 0), (4, 1, 1)]);
}

#[test]
fn a_live_line_waits_for_nobody_at_its_doors() {
    let line =
        || Pipeline::builder(Box::new(Numbered::new(1)), Arc::new(ManualClock::default()) as Arc<_>).live(Limits::default());
    let sink = || Box::new(Keeping::new("sink").0);
    let refused = line().entry(Queue::newest_only()).sink(sink(), Queue::blocking(2)).build();
    assert_eq!(refused.unwrap_err(), BuildError::Waits("sink"));
    let refused = line().entry(Queue::blocking(2)).sink(sink(), Queue::newest_only()).build();
    assert_eq!(refused.unwrap_err(), BuildError::Waits("source"));
}
