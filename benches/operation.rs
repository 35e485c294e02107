//! A simulated operation at 1080p: its pictures, its arm, and a light field as good as truth allows.

use std::path::Path;
use std::sync::Arc;

use endofield::camera::intrinsics::Pixel;
use endofield::camera::model::CameraModel;
use endofield::frame::{Frame, FrameId};
use endofield::geometry::mesh::Mesh;
use endofield::geometry::point::Point;
use endofield::geometry::space::{Camera, Hand, RobotBase, World};
use endofield::geometry::transform::Transform;
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::light_field::file;
use endofield::light_field::view::{LightField, View};
use endofield::media::reader::{Input, VideoReader};
use endofield::pipeline::stage::{Source, SourceError};
use endofield::progress::Silent;
use endofield::recording::folder::{Recording, Video};
use endofield::robot::hand_eye::HandEye;
use endofield::robot::trajectory::{TimedPose, Trajectory as ArmTrajectory};
use endofield::synthetic::organs::Anatomy;
use endofield::synthetic::renderer::{Obstacles, Renderer, Shot, Truth};
use endofield::synthetic::scene::{World3d, laparoscope};
use endofield::synthetic::trajectory::{Course, Trajectory};
use endofield::time::{Span, Timestamp};
use rayon::prelude::*;

/// Of the pictures, px.
pub const SIZE: (usize, usize) = (1920, 1080);
/// Rendered once, played there and back.
const PICTURES: usize = 12;
/// Of the light field.
const VIEWS: usize = 8;
const PERIOD_S: f64 = 0.04;
/// Of a recording.
const RECORDED: usize = 40;
/// Every so many pixels a vertex of the surface.
const MESH_STEP_PX: usize = 16;

/// Which picture frame `number` shows.
fn shown(number: u64) -> usize {
    let phase = (number % (2 * PICTURES as u64 - 2)) as usize;
    phase.min(2 * PICTURES - 2 - phase)
}

/// What the benches run on.
pub struct Operation {
    /// Everything beside the pictures; a perfect arm whose hand is the camera.
    pub recording: Recording,
    /// What other views saw.
    pub light_field: Arc<LightField>,
    /// The live pictures, in order.
    pub pictures: Arc<Vec<Image<Rgb8>>>,
    /// Size of the pictures, px.
    pub size: (usize, usize),
    /// When each picture was taken; none for pictures that are played there and back.
    pub times: Option<Arc<Vec<Timestamp>>>,
}

impl Operation {
    /// Render it, with poses for `frames` frames.
    pub fn simulated(frames: u64) -> Self {
        let renderer = Renderer::new(
            World3d::new(Anatomy::GallBladder, 1, SIZE.0),
            laparoscope(SIZE.0, SIZE.1),
            Some(0.47),
            1.0,
        );
        eprintln!("rendering {} pictures of {}x{} …", PICTURES + VIEWS, SIZE.0, SIZE.1);
        let live = rendered(&renderer, Course::Live, PICTURES, false);
        let light_field = light_field(&renderer, &Arc::new(renderer.camera().pinhole()));
        let poses = (0..frames + 20).map(|number| TimedPose {
            stamp: Timestamp::from_seconds(number as f64 * PERIOD_S),
            base_from_hand: Transform::<RobotBase, Hand>::from_isometry(*live[shown(number)].0.world_from_camera.isometry()),
        });
        let recording = Recording {
            camera: Some(renderer.camera().clone()),
            trajectory: ArmTrajectory::new(poses.collect()),
            hand_eye: Some(HandEye::new(Transform::identity())),
            ..Recording::plain(Video::File("simulated".into()))
        };
        Self {
            recording,
            light_field: Arc::new(light_field),
            pictures: Arc::new(live.into_iter().map(|(_, picture, _)| picture).collect()),
            size: SIZE,
            times: None,
        }
    }

    /// A recording and its light field, from their folders; the first frames only. `enlargement` is by how much its pictures (not its
    /// views) are made larger.
    pub fn recorded(recording: &Path, light_field: &Path, enlargement: usize) -> Self {
        let mut recording = Recording::open(recording).expect("a recording");
        let input = Input::from_argument(recording.video.path());
        let mut reader = VideoReader::open(&input).expect("a video");
        let pool = Pool::new(1);
        let (mut pictures, mut times) = (Vec::new(), Vec::new());
        while let (true, Ok(Some(frame))) = (pictures.len() < RECORDED, reader.next_frame(&pool)) {
            let exact = recording.frame_times.as_ref().and_then(|times| times.get(pictures.len()));
            times.push(exact.copied().unwrap_or(frame.timestamp));
            pictures.push(enlarged(&frame.image, enlargement));
        }
        recording.camera = recording.camera.map(|camera| camera.scaled(enlargement as f64));
        let light_field = file::read(light_field, &Silent).expect("a light field").light_field;
        Self {
            size: pictures.first().map_or((0, 0), Image::size),
            recording,
            light_field: Arc::new(light_field),
            pictures: Arc::new(pictures),
            times: Some(Arc::new(times)),
        }
    }

    /// Its pictures, played there and back.
    pub fn source(&self, count: u64) -> ThereAndBack {
        ThereAndBack {
            pictures: Arc::clone(&self.pictures),
            times: self.times.clone(),
            camera: self.times.as_ref().and_then(|_| self.recording.camera.clone().map(Arc::new)),
            pool: Pool::new(32),
            next: 0,
            count: self.times.as_ref().map_or(count, |times| count.min(times.len() as u64)),
        }
    }
}

/// Plays pictures forth and back, so that neighbouring frames are neighbours in space.
pub struct ThereAndBack {
    pictures: Arc<Vec<Image<Rgb8>>>,
    times: Option<Arc<Vec<Timestamp>>>,
    camera: Option<Arc<CameraModel>>,
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
        let (at, picture) = match &self.times {
            Some(times) => (times[number as usize], number as usize),
            None => (Timestamp::from_seconds(number as f64 * PERIOD_S), shown(number)),
        };
        let mut frame = Frame::new(FrameId(number), at, at, self.pool.take_copy(&self.pictures[picture]));
        frame.camera.clone_from(&self.camera);
        frame.since_previous = if number == 0 { Span(0) } else { Span::from_seconds(PERIOD_S) };
        Ok(Some(frame))
    }
}

/// Every pixel repeated, and then smoothed, so that no edges stand between the copies.
fn enlarged(image: &Image<Rgb8>, by: usize) -> Image<Rgb8> {
    let (width, height) = (image.width() * by, image.height() * by);
    let mut out = Image::filled(width, height, [0; 3]);
    let axis = |at: usize, count: usize| {
        let place = ((at as f32 + 0.5) / by as f32 - 0.5).clamp(0.0, count as f32 - 1.0);
        (place as usize, (place as usize + 1).min(count - 1), place.fract())
    };
    for y in 0..height {
        for x in 0..width {
            let ((x0, x1, fx), (y0, y1, fy)) = (axis(x, image.width()), axis(y, image.height()));
            let value = |x: usize, y: usize, c: usize| f32::from(image.at(x, y)[c]);
            let color = std::array::from_fn(|c| {
                let top = value(x0, y0, c) * (1.0 - fx) + value(x1, y0, c) * fx;
                let bottom = value(x0, y1, c) * (1.0 - fx) + value(x1, y1, c) * fx;
                (top * (1.0 - fy) + bottom * fy + 0.5) as u8
            });
            out.set(x, y, color);
        }
    }
    out
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
