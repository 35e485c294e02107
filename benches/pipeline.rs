//! How fast the whole line is on this machine: 1080p frames of a simulated operation through every stage.
//!
//! Prints ms per stage, frames per second and memory. `cargo bench --bench pipeline [-- FRAMES]`, 150 frames unless told.
//! Decoding and encoding are not in it; `endofield process --report` measures them too.
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::expect_used,
    reason = "it is its own harness"
)]

use std::sync::Arc;

use endofield::camera::intrinsics::Pixel;
use endofield::camera::model::CameraModel;
use endofield::compose::{self, Choice, Equipment};
use endofield::config::Config;
use endofield::frame::{Frame, FrameId};
use endofield::geometry::mesh::Mesh;
use endofield::geometry::point::Point;
use endofield::geometry::space::{Camera, Hand, RobotBase, World};
use endofield::geometry::transform::Transform;
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::light_field::view::{LightField, View};
use endofield::pipeline::builder::Pipeline;
use endofield::pipeline::queue::Queue;
use endofield::pipeline::runner::Wish;
use endofield::pipeline::stage::{Sink, SinkError, Source, SourceError};
use endofield::pipeline::timing::Summary;
use endofield::recording::folder::{Recording, Video};
use endofield::robot::hand_eye::HandEye;
use endofield::robot::trajectory::{TimedPose, Trajectory as ArmTrajectory};
use endofield::synthetic::organs::Anatomy;
use endofield::synthetic::renderer::{Obstacles, Renderer, Shot, Truth};
use endofield::synthetic::scene::{World3d, laparoscope};
use endofield::synthetic::trajectory::{Course, Trajectory};
use endofield::time::{Clock as _, MonotonicClock, Span, Timestamp};
use rayon::prelude::*;

const SIZE: (usize, usize) = (1920, 1080);
/// Rendered once, played there and back.
const PICTURES: usize = 12;
const VIEWS: usize = 16;
const PERIOD_S: f64 = 0.04;
/// Every so many pixels a vertex of the surface.
const MESH_STEP_PX: usize = 16;

/// Which picture frame `number` shows.
fn shown(number: u64) -> usize {
    let phase = (number % (2 * PICTURES as u64 - 2)) as usize;
    phase.min(2 * PICTURES - 2 - phase)
}

struct ThereAndBack {
    pictures: Vec<Image<Rgb8>>,
    pool: Pool<Rgb8>,
    next: u64,
    count: u64,
}

impl Source for ThereAndBack {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        if self.next == self.count {
            return Ok(None);
        }
        let number = self.next;
        self.next += 1;
        let at = Timestamp::from_seconds(number as f64 * PERIOD_S);
        let mut frame = Frame::new(FrameId(number), at, at, self.pool.take_copy(&self.pictures[shown(number)]));
        frame.since_previous = if number == 0 { Span(0) } else { Span::from_seconds(PERIOD_S) };
        Ok(Some(frame))
    }
}

struct Nowhere;

impl Sink for Nowhere {
    fn name(&self) -> &'static str {
        "nowhere"
    }
    fn consume(&mut self, _frame: &Arc<Frame>) -> Result<(), SinkError> {
        Ok(())
    }
}

fn rendered(renderer: &Renderer, course: Course, count: usize, with_truth: bool) -> Vec<(Shot, Image<Rgb8>, Option<Truth>)> {
    let duration_s = count as f64 * PERIOD_S;
    let path = Trajectory::new(course, duration_s, renderer.world().world_from_organs);
    (0..count)
        .into_par_iter()
        .map(|number| {
            let seconds = number as f64 * PERIOD_S;
            let shot = Shot {
                frame: number as u64,
                seconds,
                world_from_camera: path.world_from_camera(seconds),
                exposure: 1.0,
                noise_key: 1,
                obstacles: Obstacles::default(),
            };
            let picture = renderer.render(&shot, with_truth);
            (shot, picture.video, picture.truth)
        })
        .collect()
}

/// A light field as good as truth allows, so that the line does all of its work.
fn light_field(renderer: &Renderer, camera: &Arc<CameraModel>) -> LightField {
    let views: Vec<View> = rendered(renderer, Course::Survey, VIEWS, true)
        .into_iter()
        .filter_map(|(shot, _, truth)| {
            let truth = truth?;
            let depth = truth
                .depth
                .pixels()
                .iter()
                .map(|hundredths| f32::from(*hundredths) * 0.01)
                .collect();
            let confidence = truth
                .depth
                .pixels()
                .iter()
                .map(|depth| if *depth > 0 { 255 } else { 0 })
                .collect();
            Some(View {
                frame_number: shot.frame as u32,
                image: truth.diffuse,
                confidence: Image::from_vec(camera.width, camera.height, confidence)?,
                depth: Image::from_vec(camera.width, camera.height, depth)?,
                camera: Arc::clone(camera),
                world_from_camera: shot.world_from_camera,
                gain: [1.0; 3],
                exposed_at: Timestamp::from_seconds(shot.seconds),
            })
        })
        .collect();
    let surface = views.get(VIEWS / 2).map(surface_of).unwrap_or_default();
    LightField {
        views,
        surface,
        recipe: "bench".to_owned(),
        ..LightField::default()
    }
}

/// The surface that one view sees.
fn surface_of(view: &View) -> Mesh<World> {
    let (columns, rows) = (view.image.width() / MESH_STEP_PX, view.image.height() / MESH_STEP_PX);
    let mut index = vec![None; columns * rows];
    let mut mesh = Mesh::default();
    for row in 0..rows {
        for column in 0..columns {
            let (x, y) = (column * MESH_STEP_PX, row * MESH_STEP_PX);
            let depth = f64::from(view.depth.at(x, y));
            let ray = view.camera.unproject(Pixel {
                x: x as f64,
                y: y as f64,
            });
            if let (true, Some(ray)) = (depth > 0.0, ray) {
                index[row * columns + column] = Some(mesh.vertices.len() as u32);
                mesh.vertices
                    .push(view.world_from_camera * Point::<Camera>::from_coords(ray.coords * depth));
            }
        }
    }
    for row in 1..rows {
        for column in 1..columns {
            let at = |r: usize, c: usize| index[r * columns + c];
            let corners = [
                at(row - 1, column - 1),
                at(row - 1, column),
                at(row, column - 1),
                at(row, column),
            ];
            if let [Some(a), Some(b), Some(c), Some(d)] = corners {
                mesh.triangles.extend([[a, c, b], [b, c, d]]);
            }
        }
    }
    mesh
}

fn main() {
    // Cargo adds `--bench`.
    let count: u64 = std::env::args()
        .skip(1)
        .find_map(|argument| argument.parse().ok())
        .unwrap_or(150);
    let renderer = Renderer::new(
        World3d::new(Anatomy::GallBladder, 1, SIZE.0),
        laparoscope(SIZE.0, SIZE.1),
        Some(0.47),
        1.0,
    );
    eprintln!("rendering {} pictures of {}x{} …", PICTURES + VIEWS, SIZE.0, SIZE.1);
    let live = rendered(&renderer, Course::Live, PICTURES, false);
    let light_field = light_field(&renderer, &Arc::new(renderer.camera().pinhole()));

    // A perfect arm whose hand is the camera.
    let poses = (0..count + 20).map(|number| TimedPose {
        stamp: Timestamp::from_seconds(number as f64 * PERIOD_S),
        base_from_hand: Transform::<RobotBase, Hand>::from_isometry(*live[shown(number)].0.world_from_camera.isometry()),
    });
    let recording = Recording {
        camera: Some(renderer.camera().clone()),
        trajectory: ArmTrajectory::new(poses.collect()),
        hand_eye: Some(HandEye::new(Transform::identity())),
        ..Recording::plain(Video::File("simulated".into()))
    };
    let mut config = Config::default();
    // Colors of the start are the reference: a simulated recording has no color.yaml, and the stage shall work.
    config.color.reference = endofield::stages::color_normalization::settings::ReferenceSource::Start;
    let equipment = Equipment {
        recording: &recording,
        light_field: Some(Arc::new(light_field)),
        size: SIZE,
    };
    let line = compose::line(&config, &Choice::ALL, &equipment).expect("the default line stands");
    for part in &line.left_out {
        eprintln!("left out: {part}");
    }
    let pictures = live.into_iter().map(|(_, picture, _)| picture).collect();
    let source = ThereAndBack {
        pictures,
        pool: Pool::new(32),
        next: 0,
        count,
    };
    let mut builder = Pipeline::builder(Box::new(source), Arc::new(MonotonicClock));
    for stage in line.stages {
        builder = builder.stage(stage);
    }
    let began = MonotonicClock.now();
    let running = builder
        .sink(Box::new(Nowhere), Queue::blocking(2))
        .build()
        .expect("the line stands")
        .start()
        .expect("threads");
    let outcome = running.wait_looking(|_| Wish::GoOn);
    let seconds = (MonotonicClock.now() - began).seconds();

    let row = |name: &str, times: &Summary| {
        println!(
            "{name:<26}{:>9.2}{:>9.2}{:>9.2}{:>9.2}",
            times.p50_ms, times.p95_ms, times.p99_ms, times.max_ms
        );
    };
    println!(
        "\n{:<26}{:>9}{:>9}{:>9}{:>9}",
        "ms per frame, 1920x1080", "p50", "p95", "p99", "max"
    );
    row("source (a copy)", &outcome.source_working.summary());
    for stage in &outcome.stages {
        row(stage.name, &stage.working.summary());
        if let Some(failure) = &stage.first_failure {
            println!("  failed on {} frames: {failure}", stage.failures);
        }
    }
    row("end to end (with waiting)", &outcome.end_to_end.summary());
    println!(
        "\n{} frames in {seconds:.1} s: {:.1} fps on {} threads",
        outcome.frames_out,
        outcome.frames_out as f64 / seconds,
        threads()
    );
    println!("memory at its peak: {}", peak_memory());
    for fault in outcome.faults() {
        println!("fault: {fault}");
    }
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn peak_memory() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .map_or_else(|| "unknown".to_owned(), |value| value.trim().to_owned())
}
