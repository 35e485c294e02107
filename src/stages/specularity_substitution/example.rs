//! A textured plane seen by a live camera and a few views beside it: the truth is known everywhere.

use std::sync::Arc;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::Intrinsics;
use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::distance::chamfer_distance;
use crate::light_field::view::{LightField, View};
use crate::stages::specularity_substitution::grid::{Division, Grid};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::{Vantage, Views};
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::time::Timestamp;

pub const SIZE: (usize, usize) = (480, 272);
/// Of the plane, mm.
pub const DEPTH: f32 = 80.0;
/// The hole: a disc of this radius in the middle of the picture, px.
pub const HOLE_RADIUS: f32 = 9.0;
pub const HOLE: (usize, usize) = (240, 136);
const FOCAL: f64 = 480.0;

/// What a frame and its light field are made of.
#[derive(Debug)]
pub struct Example {
    pub light_field: LightField,
    pub small_views: Vec<SmallView>,
    pub image: Image<Rgb8>,
    depth: Image<f32>,
    distance: Image<u16>,
    forbidden: Mask,
    camera: Arc<CameraModel>,
    eye: Transform<World, Camera>,
}

/// The tissue's colour at a point of the plane, mm.
pub fn tissue(x: f32, y: f32) -> [f32; 3] {
    let wave = 18.0 * (0.9 * x + 0.3 * y).sin() + 14.0 * (1.1 * y - 0.4 * x).cos() + 9.0 * (0.5 * x).sin() * (0.7 * y).sin();
    let wave = wave + 8.0 * (3.1 * x + 1.3 * y).sin() + 6.0 * (2.7 * y - 1.1 * x).cos();
    [140.0 + wave, 90.0 + 0.8 * wave, 80.0 + 0.6 * wave]
}

/// The point of the plane at a pixel of a camera moved by (`right`, `down`) mm.
fn point(x: f32, y: f32, (right, down): (f32, f32)) -> (f32, f32) {
    let scale = DEPTH / FOCAL as f32;
    (scale * (x - 239.5) + right, scale * (y - 135.5) + down)
}

pub fn in_hole(x: usize, y: usize) -> bool {
    (x as f32 - HOLE.0 as f32).hypot(y as f32 - HOLE.1 as f32) <= HOLE_RADIUS
}

fn painted(color: impl Fn(usize, usize) -> [f32; 3]) -> Image<Rgb8> {
    let pixels = (0..SIZE.0 * SIZE.1).map(|i| color(i % SIZE.0, i / SIZE.0).map(|c| (c + 0.5).clamp(0.0, 255.0) as u8));
    Image::from_vec(SIZE.0, SIZE.1, pixels.collect()).unwrap()
}

impl Example {
    /// Views moved by so many mm right and down. The live picture is the tissue times `gain`, and shows at each pixel what lies `shift`
    /// px farther right and down than its pose says.
    pub fn new(moves: &[(f32, f32)], gain: [f32; 3], shift: (f32, f32)) -> Self {
        let camera = Arc::new(CameraModel {
            width: SIZE.0,
            height: SIZE.1,
            intrinsics: Intrinsics {
                fx: FOCAL,
                fy: FOCAL,
                cx: 239.5,
                cy: 135.5,
            },
            distortion: Distortion::None,
        });
        let views = (0..).zip(moves).map(|(frame_number, &at)| View {
            frame_number,
            image: painted(|x, y| {
                let (x, y) = point(x as f32, y as f32, at);
                tissue(x, y)
            }),
            confidence: Image::filled(SIZE.0, SIZE.1, 255),
            depth: Image::filled(SIZE.0, SIZE.1, DEPTH),
            camera: Arc::clone(&camera),
            world_from_camera: Transform::from_isometry(Isometry3::from_parts(
                Translation3::new(f64::from(at.0), f64::from(at.1), 0.0),
                UnitQuaternion::identity(),
            )),
            gain: [1.0; 3],
            exposed_at: Timestamp(0),
        });
        let image = painted(|x, y| {
            let (u, v) = point(x as f32 + shift.0, y as f32 + shift.1, (0.0, 0.0));
            let color = tissue(u, v);
            if in_hole(x, y) {
                [250.0; 3]
            } else {
                std::array::from_fn(|c| color[c] * gain[c])
            }
        });
        let mut mask = Image::filled(SIZE.0, SIZE.1, 0);
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                mask.set(x, y, if in_hole(x, y) { 255 } else { 0 });
            }
        }
        let mut distance = Image::filled(0, 0, 0);
        chamfer_distance(&mask, 200, &mut distance);
        let light_field = LightField {
            views: views.collect(),
            ..LightField::default()
        };
        let mut example = Self {
            small_views: Vec::new(),
            light_field,
            image,
            depth: Image::filled(SIZE.0, SIZE.1, DEPTH),
            distance,
            forbidden: Image::filled(SIZE.0, SIZE.1, 0),
            camera,
            eye: Transform::identity(),
        };
        example.look_again();
        example
    }

    /// To be called when a view was changed.
    pub fn look_again(&mut self) {
        self.small_views = self.light_field.views.iter().map(SmallView::of).collect();
    }

    pub fn scene(&self) -> Scene<'_> {
        Scene {
            light_field: &self.light_field,
            image: &self.image,
            depth: &self.depth,
            distance: &self.distance,
            forbidden: &self.forbidden,
            depth_step: Division::by(1),
            scale: 0.5,
            grid: Grid::over(SIZE),
            reach: Scene::distance_of(8.0),
            guard: Scene::distance_of(2.5),
            ring: Scene::distance_of(20.0),
        }
    }

    pub fn vantages(&self) -> Vec<Option<Vantage>> {
        let views = self.light_field.views.iter().zip(&self.small_views);
        views
            .map(|(view, small)| Vantage::new(&self.camera, &self.eye, view, small))
            .collect()
    }

    pub fn views<'a>(&'a self, vantages: &'a [Option<Vantage>]) -> Views<'a> {
        Views {
            full: &self.light_field.views,
            small: &self.small_views,
            vantages,
        }
    }

    /// What the live picture would show without the lamp.
    pub fn truth(&self, x: usize, y: usize) -> [f32; 3] {
        let (x, y) = point(x as f32, y as f32, (0.0, 0.0));
        tissue(x, y)
    }
}
