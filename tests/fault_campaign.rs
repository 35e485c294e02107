//! A thousand faults, injected into live lines one after the other: stages that fail, panic and stall, an arm that is silent or talks
//! nonsense, a camera that is pulled out, stalls or changes its mode, a disk that takes nothing more, a virtual camera that is lost.
//! The picture goes on: within a frame after a stage's fault, within half a second after a device's. The clock is turned by hand.
//!
//! `ENDOFIELD_FAULTS=100000` plays more of them.

use std::fs;
use std::io;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded};
use endofield::frame::Frame;
use endofield::geometry::transform::Transform;
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::media::layout::Layout;
use endofield::media::reader::{Input, VideoReader};
use endofield::media::writer::Content;
use endofield::pipeline::builder::Pipeline;
use endofield::pipeline::live::Limits;
use endofield::pipeline::outcome::Outcome;
use endofield::pipeline::queue::Queue;
use endofield::pipeline::runner::RunningPipeline;
use endofield::pipeline::seat::Condition;
use endofield::pipeline::stage::{Stage, StageError};
use endofield::recording::folder::Recording;
use endofield::robot::feed::line::LineSource;
use endofield::robot::feed::pseudo_terminal::PseudoTerminal;
use endofield::robot::feed::reader::ArmFeed;
use endofield::robot::feed::settings::Settings as ArmSettings;
use endofield::robot::hand_eye::HandEye;
use endofield::sinks::recorder::{RecorderReading, RecorderSettings, RecorderSink, Track};
use endofield::sinks::virtual_camera::{Screen, VirtualCameraReading, VirtualCameraSink};
use endofield::sources::camera::capture::{CaptureSource, CaptureWatch};
use endofield::sources::camera::device::Wish;
use endofield::stages::pose_stamping::{PoseStamping, Poses};
use endofield::time::{Clock as _, ManualClock, MonotonicClock, Span};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::support::line::{Doing, Keeping, Seen};
use crate::support::played_camera::{Act, PERIOD_MS, Played, Script};

const FAULTS: usize = 1000;
/// A line plays so many; then it ends and its books are looked at.
const FAULTS_A_LINE: usize = 50;
const STAGES: [&str; 3] = ["first", "second", "third"];
const SIZE: (usize, usize) = (48, 32);
/// A frame that a stage or a device holds up must be there after this, ms.
const AFTER_STAGE_MS: f64 = 2.0 * PERIOD_MS;
const AFTER_DEVICE_MS: f64 = 500.0;
/// What never comes ends the test.
const PATIENCE_S: f64 = 30.0;

/// What a stage does with its next frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Order {
    #[default]
    Work,
    Fail,
    Panic,
    Stall,
}

/// A stage's strings.
struct Puppet {
    order: Arc<Mutex<Order>>,
    stalled: Receiver<()>,
    go: Sender<()>,
    /// It panicked, and is passed by for good.
    broken: bool,
}

fn puppet(name: &'static str) -> (Box<dyn Stage>, Puppet) {
    let order = Arc::new(Mutex::new(Order::Work));
    let ((begun, stalled), (go, may_go)) = (bounded(1), bounded(1));
    let orders = Arc::clone(&order);
    let stage = Doing::boxed(name, move |frame: &mut Frame| {
        let order = std::mem::take(&mut *orders.lock().unwrap());
        match order {
            Order::Work => frame
                .image
                .pixels_mut()
                .iter_mut()
                .for_each(|pixel| pixel[1] = pixel[1].wrapping_add(1)),
            Order::Fail => return Err(StageError("injected".to_owned())),
            Order::Panic => panic!("injected"),
            Order::Stall => {
                let _test_ended = begun.send(());
                let _test_ended = may_go.recv();
            }
        }
        Ok(())
    });
    let puppet = Puppet {
        order,
        stalled,
        go,
        broken: false,
    };
    (stage, puppet)
}

/// A virtual camera that is lost when it is told.
struct Fragile(Arc<Mutex<bool>>);

impl Screen for Fragile {
    fn name(&self) -> String {
        "fragile".to_owned()
    }

    fn open(&mut self, _size: (usize, usize), _layout: Layout) -> Result<(), String> {
        Ok(())
    }

    fn show(&mut self, _picture: &Image<Rgb8>, _patience: Duration) -> io::Result<bool> {
        if std::mem::take(&mut *self.0.lock().unwrap()) {
            return Err(io::Error::from_raw_os_error(19));
        }
        Ok(true)
    }

    fn close(&mut self) {}
}

/// A live line with everything that can break.
struct Theatre {
    clock: Arc<ManualClock>,
    acts: Sender<Act>,
    line: RunningPipeline,
    puppets: Vec<Puppet>,
    seen: Seen,
    camera: CaptureWatch,
    arm_end: PseudoTerminal,
    arm: ArmFeed,
    recorder: RecorderReading,
    virtual_camera: VirtualCameraReading,
    screen_lost: Arc<Mutex<bool>>,
    width: usize,
    sent: u64,
}

impl Theatre {
    fn open(folder: &Path) -> Self {
        let clock = Arc::new(ManualClock::default());
        clock.advance(Span::from_seconds(100.0));
        let stop = Arc::new(AtomicBool::new(false));
        let (acts, more) = bounded(16);
        let script = Script {
            more: Some(more),
            ..Script::new([], SIZE, &stop)
        };
        let camera = Played {
            script: Arc::new(Mutex::new(script)),
            clock: Arc::clone(&clock),
        };
        let source = CaptureSource::new(
            Box::new(camera),
            Wish::default(),
            Arc::clone(&clock) as Arc<_>,
            Pool::new(16),
            stop,
        );
        let watch = source.watch();
        let arm_end = PseudoTerminal::open(None).unwrap();
        let arm = ArmFeed::start(
            LineSource::from_word(arm_end.path().to_str().unwrap()),
            &ArmSettings::default(),
            &endofield::robot::pose_buffer::Settings::default(),
            Arc::clone(&clock) as Arc<_>,
            None,
        )
        .unwrap();
        let hand_eye = HandEye {
            hand_from_camera: Transform::identity(),
            time_offset: None,
            covariance: None,
            report: None,
        };
        let limits = Limits {
            rest: Span::from_milliseconds(100.0),
            longest_rest: Span::from_milliseconds(400.0),
            ..Limits::default()
        };
        let (sink, seen) = Keeping::new("display");
        let recorder = RecorderSink::new(
            RecorderSettings {
                track: Track::Raw,
                content: Content::Lossless,
                folder: folder.to_owned(),
                frame_rate_hz: 1e3 / PERIOD_MS,
                beside: Vec::new(),
            },
            None,
        )
        .unwrap();
        let recorded = recorder.reading();
        let screen_lost = Arc::new(Mutex::new(false));
        let screen = VirtualCameraSink::new(Box::new(Fragile(Arc::clone(&screen_lost))), Layout::Rgb24);
        let virtual_camera = screen.reading();
        let mut builder = Pipeline::builder(Box::new(source), Arc::clone(&clock) as Arc<_>)
            .entry(Queue::newest_only())
            .between_stages(1)
            .live(limits)
            .tap(Box::new(recorder), Queue::drop_oldest(100_000))
            .stage(Box::new(PoseStamping::new(Poses::Live(arm.poses().clone()), hand_eye)));
        let mut puppets = Vec::new();
        for name in STAGES {
            let (stage, puppet) = puppet(name);
            builder = builder.stage(stage);
            puppets.push(puppet);
        }
        let line = builder
            .sink(Box::new(sink), Queue::drop_oldest(100_000))
            .sink(Box::new(screen), Queue::newest_only())
            .build()
            .unwrap()
            .start()
            .unwrap();
        Self {
            clock,
            acts,
            line,
            puppets,
            seen,
            camera: watch,
            arm_end,
            arm,
            recorder: recorded,
            virtual_camera,
            screen_lost,
            width: SIZE.0,
            sent: 0,
        }
    }

    fn count(&self) -> usize {
        self.seen.frames.lock().unwrap().len()
    }

    /// Until it is so.
    fn wait(&self, what: &str, is_so: impl Fn(&Self) -> bool) {
        let began = MonotonicClock.now();
        while !is_so(self) {
            assert!((MonotonicClock.now() - began).seconds() < PATIENCE_S, "in vain for {what}");
            std::thread::yield_now();
        }
    }

    /// Acts of the camera, the last of them a good frame; how long after the first a frame came out, ms.
    fn play(&mut self, acts: impl IntoIterator<Item = Act>) -> f64 {
        let (before, began) = (self.count(), self.clock.now());
        for act in acts {
            self.acts.send(act).unwrap();
        }
        self.sent += 1;
        self.acts.send(Act::Frame((self.sent % 200) as u8)).unwrap();
        self.wait("a frame", |theatre| theatre.count() > before);
        (self.clock.now() - began).milliseconds()
    }

    /// A frame as every day; all of the line has seen it before this returns.
    fn frame(&mut self) {
        let took = self.play([]);
        assert!(took <= AFTER_STAGE_MS, "{took} ms for a frame");
    }

    fn condition(&self, stage: usize) -> Condition {
        let name = STAGES[stage];
        self.line
            .stages()
            .iter()
            .find(|status| status.name == name)
            .unwrap()
            .condition
    }

    /// A stage that works, after as many frames as that takes.
    fn working_stage(&mut self, random: &mut ChaCha8Rng) -> usize {
        loop {
            let able: Vec<usize> = (0..STAGES.len())
                .filter(|&stage| self.condition(stage) == Condition::Working)
                .collect();
            if !able.is_empty() {
                return able[random.random_range(0..able.len())];
            }
            self.frame();
        }
    }

    fn order(&self, stage: usize, order: Order) {
        *self.puppets[stage].order.lock().unwrap() = order;
    }

    /// Frames until the stage has done so: when time was short for one, it passed the stage by.
    fn have_done(&mut self, stage: usize, order: Order) {
        self.order(stage, order);
        for _ in 0..1000 {
            self.frame();
            if *self.puppets[stage].order.lock().unwrap() == Order::Work {
                return;
            }
        }
        panic!("{} was given no frame", STAGES[stage]);
    }

    /// 200 ms in which a stage does not return: each frame comes out at its deadline as it came, then they go around the stage.
    fn stall(&mut self, stage: usize) {
        self.order(stage, Order::Stall);
        let before = loop {
            let before = self.count();
            self.acts.send(Act::Frame(0)).unwrap();
            let mut stalled = false;
            let began = MonotonicClock.now();
            while !stalled && self.count() == before {
                assert!((MonotonicClock.now() - began).seconds() < PATIENCE_S, "in vain for a frame");
                stalled = self.puppets[stage].stalled.try_recv().is_ok();
                std::thread::yield_now();
            }
            // Else the frame passed the stage by.
            if stalled {
                break before;
            }
        };
        for frame in 0..3 {
            let entered = self.clock.now();
            if frame > 0 {
                let known = self.line.status().frames_in;
                self.acts.send(Act::Frame(0)).unwrap();
                self.wait("the frame to enter", |theatre| {
                    theatre.line.status().frames_in > known || theatre.count() > before + frame
                });
            }
            self.clock.advance(Span::from_milliseconds(AFTER_STAGE_MS / 2.0));
            self.line.look();
            self.wait("a frame in spite of the stall", |theatre| theatre.count() > before + frame);
            let took = (self.clock.now() - entered).milliseconds();
            assert!(took <= AFTER_STAGE_MS + 1e-6, "{took} ms");
        }
        self.puppets[stage].go.send(()).unwrap();
        self.wait("the stage to come back", |theatre| {
            theatre.condition(stage) != Condition::Hanging
        });
    }

    /// End it; what came of it.
    fn close(self) -> (Outcome, CaptureWatch, Seen, RecorderReading, VirtualCameraReading) {
        drop(self.acts);
        let outcome = self.line.wait();
        drop(self.arm);
        (outcome, self.camera, self.seen, self.recorder, self.virtual_camera)
    }
}

/// Inject one fault, and see the picture go on.
fn inject(theatre: &mut Theatre, folder: &Path, random: &mut ChaCha8Rng) -> &'static str {
    let device = |theatre: &mut Theatre, acts: Vec<Act>, absent_ms: f64| {
        let took = theatre.play(acts) - absent_ms;
        assert!(took <= AFTER_DEVICE_MS, "{took} ms after the device was back");
    };
    match random.random_range(0..14) {
        0..=2 => {
            let stage = theatre.working_stage(random);
            theatre.have_done(stage, Order::Fail);
            "stage error"
        }
        3 => {
            let stage = theatre.working_stage(random);
            // The last one that is whole stays so.
            if theatre.puppets.iter().filter(|puppet| !puppet.broken).count() > 1 {
                theatre.have_done(stage, Order::Panic);
                theatre.puppets[stage].broken = true;
            } else {
                theatre.have_done(stage, Order::Fail);
            }
            "stage panic"
        }
        4 | 5 => {
            let stage = theatre.working_stage(random);
            theatre.stall(stage);
            "stall"
        }
        6 => {
            let ms = random.random_range(100.0..1500.0);
            device(theatre, vec![Act::PanicsWhenDropped, Act::Unplugged(ms)], ms);
            "camera pulled out"
        }
        7 => {
            let ms = random.random_range(300.0..1400.0);
            device(theatre, vec![Act::Silence(ms)], ms);
            "camera silent"
        }
        8 => {
            theatre.width = if theatre.width == SIZE.0 { SIZE.0 + 16 } else { SIZE.0 };
            device(theatre, vec![Act::Mode(theatre.width), Act::Changed], 0.0);
            "camera's mode changed"
        }
        9 => {
            let bad = random.random_range(1..5);
            device(
                theatre,
                vec![Act::Damaged, Act::Short, Act::Skip(bad)],
                f64::from(bad) * PERIOD_MS,
            );
            "camera's frames damaged"
        }
        10 => {
            let garbage: Vec<u8> = (0..200).map(|_| random.random()).collect();
            let _line_full = theatre.arm_end.write(&garbage);
            theatre.frame();
            "arm garbage"
        }
        11 => {
            // Longer than silence_ms.
            (0..3).for_each(|_| theatre.frame());
            "arm silent"
        }
        12 => {
            // Where the next part of the recording should lie, something else does.
            let places = (2..).map(|part| folder.with_file_name(format!("recorded.{part}")));
            if let Some(next) = places.into_iter().find(|place| !place.exists()) {
                fs::write(next, "in the way").unwrap();
            }
            theatre.width = if theatre.width == SIZE.0 { SIZE.0 + 16 } else { SIZE.0 };
            device(theatre, vec![Act::Mode(theatre.width), Act::Changed], 0.0);
            "disk refuses"
        }
        _ => {
            *theatre.screen_lost.lock().unwrap() = true;
            theatre.frame();
            "virtual camera lost"
        }
    }
}

/// Panics that are wanted are not told.
fn keep_injected_panics_quiet() {
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let said = panic.payload().downcast_ref::<&str>();
        if !said.is_some_and(|said| ["injected", "the driver's crate does this"].contains(said)) {
            usual(panic);
        }
    }));
}

#[test]
fn the_picture_outlives_a_thousand_faults() {
    let wanted: usize = std::env::var("ENDOFIELD_FAULTS").map_or(FAULTS, |text| text.parse().unwrap());
    keep_injected_panics_quiet();
    let mut random = ChaCha8Rng::seed_from_u64(2026);
    let mut told = std::collections::BTreeMap::<&str, usize>::new();
    let mut injected = 0;
    while injected < wanted {
        let folder = tempfile::tempdir().unwrap();
        let recorded = folder.path().join("recorded");
        let mut theatre = Theatre::open(&recorded);
        (0..3).for_each(|_| theatre.frame());
        for _ in 0..FAULTS_A_LINE {
            *told.entry(inject(&mut theatre, &recorded, &mut random)).or_default() += 1;
            // The picture is as it was: the stages that are whole work on it, or will after their rest.
            theatre.frame();
            injected += 1;
        }
        let panicked = theatre.puppets.iter().filter(|puppet| puppet.broken).count();
        let (outcome, camera, seen, recorder, virtual_camera) = theatre.close();
        assert_eq!(outcome.lost_threads, Vec::<String>::new());
        assert_eq!(outcome.source_failure, None);
        assert_eq!(
            outcome.frames_out + outcome.passed.overtaken,
            outcome.frames_in,
            "every frame is accounted for"
        );
        assert_eq!(
            outcome.frames_in,
            camera.status().frames,
            "as many went in as the camera gave"
        );
        let ids = seen.ids();
        assert!(ids.windows(2).all(|pair| pair[0] < pair[1]), "in order, none twice");
        assert_eq!(ids.len() as u64, outcome.frames_out);
        let broken = outcome.stages.iter().filter(|stage| stage.panic.is_some()).count();
        assert_eq!(broken, panicked);
        // What was recorded is there, whatever happened after; what is missing was counted.
        let record = recorder.get();
        assert_eq!(record.frames + record.lost, outcome.frames_in, "{record:?}");
        assert_eq!(readable(folder.path()), record.frames);
        let shown = virtual_camera.get();
        assert!(shown.shown > 0 && shown.failure.is_none() | (shown.lost > 0), "{shown:?}");
    }
    assert_eq!(told.values().sum::<usize>(), injected);
    assert!(told.len() >= 11, "every kind came up: {told:?}");
}

/// Frames that can be read from all parts of a recording.
fn readable(folder: &Path) -> u64 {
    let mut frames = 0;
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if !path.is_dir() || !path.join("video.mkv").exists() {
            continue;
        }
        let recording = Recording::open(&path).unwrap();
        let mut reader = VideoReader::open(&Input::from_argument(recording.video.path())).unwrap();
        let pool = Pool::new(1);
        while reader.next_frame(&pool).unwrap().is_some() {
            frames += 1;
        }
    }
    frames
}
