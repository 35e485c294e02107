//! No allocation in a stage's `process` once it is warm.
//!
//! Its own binary, for the allocator is the program's. The stages run one after the other on one thread of rayon's pool: work that is
//! handed to the pool from outside goes through a queue that takes a block of memory every few dozen jobs, which is not the
//! stages' doing.
#![expect(unsafe_code, reason = "a global allocator cannot be had without")]
#![expect(clippy::print_stdout, clippy::expect_used, reason = "it is its own test harness")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use endofield::compose::{self, Choice, Equipment};
use endofield::config::Config;
use endofield::image::pool::Pool;
use endofield::recording::folder::{Recording, Video};
use endofield::stages::color_normalization::settings::ReferenceSource;

#[path = "support/scene.rs"]
mod scene;

struct Counting;

static COUNT: AtomicU64 = AtomicU64::new(0);
static BYTES: AtomicU64 = AtomicU64::new(0);
static ON: AtomicBool = AtomicBool::new(false);

impl Counting {
    fn note(size: usize) {
        if ON.load(Ordering::Relaxed) {
            COUNT.fetch_add(1, Ordering::Relaxed);
            BYTES.fetch_add(size as u64, Ordering::Relaxed);
        }
    }
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        Self::note(layout.size());
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        Self::note(size);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const SIZE: (usize, usize) = (320, 240);
const WARM_UP: u64 = 40;
const MEASURED: u64 = 40;

fn main() -> std::process::ExitCode {
    let faults = rayon::scope(|_| allocations());
    let failed = usize::from(!faults.is_empty());
    for fault in &faults {
        println!("{fault}");
    }
    println!("no_allocation_per_frame ... {}", if failed == 0 { "ok" } else { "FAILED" });
    println!(
        "\ntest result: {}. {} passed; {failed} failed",
        if failed == 0 { "ok" } else { "FAILED" },
        1 - failed
    );
    std::process::ExitCode::from(failed as u8)
}

/// One line for each stage that allocated.
fn allocations() -> Vec<String> {
    let recording = Recording {
        camera: Some(scene::laparoscope(SIZE.0, SIZE.1)),
        ..Recording::plain(Video::File("none".into()))
    };
    let equipment = Equipment {
        recording: &recording,
        light_field: None,
        light_field_to_come: false,
        may_wait: false,
        poses: None,
        size: SIZE,
    };
    let mut config = Config::default();
    // There is no color.yaml; the stage shall work.
    config.color.reference = ReferenceSource::Start;
    let mut line = compose::line(&config, &Choice::ALL, &equipment).expect("the default line stands");
    let pictures: Vec<_> = (0..8).map(|number| scene::picture(SIZE.0, SIZE.1, number)).collect();
    let pool = Pool::new(4);
    let camera = Arc::new(scene::laparoscope(SIZE.0, SIZE.1));
    let mut counts = vec![(0_u64, 0_u64); line.stages.len()];
    for number in 0..WARM_UP + MEASURED {
        // There and back again, so that no frame looks like a scene cut.
        let phase = (number % 14) as usize;
        let mut frame = scene::frame(number, &pictures[phase.min(14 - phase)], &pool);
        frame.camera = Some(Arc::clone(&camera));
        for (stage, (count, bytes)) in line.stages.iter_mut().zip(&mut counts) {
            let before = (COUNT.load(Ordering::Relaxed), BYTES.load(Ordering::Relaxed));
            ON.store(number >= WARM_UP, Ordering::Relaxed);
            let result = stage.process(&mut frame);
            ON.store(false, Ordering::Relaxed);
            *count += COUNT.load(Ordering::Relaxed) - before.0;
            *bytes += BYTES.load(Ordering::Relaxed) - before.1;
            result.expect("no stage fails on these frames");
        }
    }
    let named = line.stages.iter().zip(&counts);
    named
        .filter(|(_, (count, _))| *count > 0)
        .map(|(stage, (count, bytes))| format!("{}: {count} allocations, {bytes} bytes in {MEASURED} frames", stage.name()))
        .collect()
}
