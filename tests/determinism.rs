//! The same input gives the same output, byte for byte, however the threads happen to run.

use std::sync::Arc;

use endofield::compose::{self, Choice, Equipment};
use endofield::config::Config;
use endofield::pipeline::builder::Pipeline;
use endofield::pipeline::queue::Queue;
use endofield::recording::folder::{Recording, Video};
use endofield::stages::color_normalization::settings::ReferenceSource;
use endofield::time::ManualClock;

use crate::support::line::{Keeping, Seen, Wandering};
use crate::support::scene::laparoscope;

fn run_once() -> Seen {
    let (width, height) = (192, 128);
    let recording = Recording {
        camera: Some(laparoscope(width, height)),
        ..Recording::plain(Video::File("none".into()))
    };
    let equipment = Equipment {
        recording: &recording,
        light_field: None,
        light_field_to_come: false,
        may_wait: false,
        poses: None,
        size: (width, height),
    };
    let mut config = Config::default();
    // There is no color.yaml; the stage shall work.
    config.color.reference = ReferenceSource::Start;
    let line = compose::line(&config, &Choice::ALL, &equipment).unwrap();
    assert!(line.stages.len() >= 3, "the line has its stages");
    let (sink, seen) = Keeping::new("sink");
    let mut builder = Pipeline::builder(Box::new(Wandering::new(width, height, 24)), Arc::new(ManualClock::default()));
    for stage in line.stages {
        builder = builder.stage(stage);
    }
    let outcome = builder
        .sink(Box::new(sink), Queue::blocking(2))
        .build()
        .unwrap()
        .start()
        .unwrap()
        .wait();
    assert!(outcome.faults().is_empty(), "{:?}", outcome.faults());
    assert!(outcome.stages.iter().all(|stage| stage.failures == 0), "{:?}", outcome.stages);
    seen
}

#[test]
fn twice_the_same_is_the_same() {
    let (first, second) = (run_once(), run_once());
    let (first, second) = (first.frames.lock().unwrap(), second.frames.lock().unwrap());
    assert_eq!(first.len(), 24);
    for (one, other) in first.iter().zip(second.iter()) {
        assert!(one == other, "frame {} differs", one.id);
    }
}
