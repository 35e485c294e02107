//! A hand with a camera going from station to station over a board: the truth is known.

use nalgebra::{UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::calibration::hand_eye::motion::Station;
use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::Intrinsics;
use crate::camera::model::CameraModel;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;

/// What is wrong at each station, standard deviations.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    /// Of the hand's place, mm.
    pub place_mm: f64,
    /// Of the hand's rotation, rad.
    pub turn_rad: f64,
    /// Of the board's place in the camera, mm.
    pub seen_mm: f64,
    /// Of the board's rotation, rad.
    pub seen_rad: f64,
}

impl Noise {
    pub const NONE: Self = Self {
        place_mm: 0.0,
        turn_rad: 0.0,
        seen_mm: 0.0,
        seen_rad: 0.0,
    };
}

/// The camera that sees it.
pub fn camera() -> CameraModel {
    CameraModel {
        width: 960,
        height: 540,
        intrinsics: Intrinsics {
            fx: 800.0,
            fy: 800.0,
            cx: 480.0,
            cy: 270.0,
        },
        distortion: Distortion::None,
    }
}

#[derive(Debug)]
pub struct Example {
    pub stations: Vec<Station>,
    pub hand_from_camera: Transform<Hand, Camera>,
    pub base_from_board: Transform<RobotBase, Board>,
}

impl Example {
    /// Stations tilted by up to about 30° to each side.
    pub fn new(seed: u64, count: usize, noise: Noise) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut draw = |size: f64| Vector3::from_fn(|_, _| size * random.sample::<f64, _>(StandardNormal));
        let tilts: Vec<Vector3<f64>> = (0..count).map(|_| draw(0.3)).collect();
        let mut example = Self::turning(count, |i| tilts[i]);
        for station in &mut example.stations {
            station.base_from_hand = moved(station.base_from_hand, draw(noise.place_mm), draw(noise.turn_rad));
            station.camera_from_board = moved(station.camera_from_board, draw(noise.seen_mm), draw(noise.seen_rad));
        }
        example
    }

    /// Stations turned as told (rotation vectors in the hand's space).
    pub fn turning(count: usize, turn: impl Fn(usize) -> Vector3<f64>) -> Self {
        let hand_from_camera = Transform::new(
            UnitQuaternion::from_euler_angles(0.1, -0.2, 2.1),
            Vector3::new(6.0, -11.0, 300.0),
        );
        let base_from_board: Transform<RobotBase, Board> = Transform::new(
            UnitQuaternion::from_euler_angles(0.02, 0.1, 0.7),
            Vector3::new(420.0, 150.0, 20.0),
        );
        let stations = (0..count).map(|i| {
            let place = Vector3::new(
                10.0 * (i as f64).sin() - 16.0,
                8.0 * (1.7 * i as f64).cos() - 10.0,
                90.0 + 10.0 * (0.6 * i as f64).sin(),
            );
            let upright: Transform<Camera, Board> = Transform::new(UnitQuaternion::identity(), place);
            // Turned about the camera's own centre, as seen from the hand.
            let turned =
                hand_from_camera.rotation().inverse() * UnitQuaternion::from_scaled_axis(turn(i)) * hand_from_camera.rotation();
            let camera_from_board =
                Transform::<Camera, Camera>::new(turned.inverse(), turned.inverse() * -place + place) * upright;
            Station {
                base_from_hand: base_from_board * camera_from_board.inverse() * hand_from_camera.inverse(),
                camera_from_board,
            }
        });
        Self {
            stations: stations.collect(),
            hand_from_camera,
            base_from_board,
        }
    }

    /// Give one station a wrong hand pose.
    pub fn disturb(&mut self, station: usize, place_mm: Vector3<f64>, turn_rad: Vector3<f64>) {
        let pose = &mut self.stations[station].base_from_hand;
        *pose = moved(*pose, place_mm, turn_rad);
    }

    /// How far an answer is from the truth, mm and rad.
    pub fn error_of(&self, found: &Transform<Hand, Camera>) -> [f64; 2] {
        [
            (found.translation() - self.hand_from_camera.translation()).norm(),
            found.rotation().angle_to(&self.hand_from_camera.rotation()),
        ]
    }
}

fn moved<A, B>(pose: Transform<A, B>, place: Vector3<f64>, turn: Vector3<f64>) -> Transform<A, B> {
    Transform::new(
        pose.rotation() * UnitQuaternion::from_scaled_axis(turn),
        pose.translation() + place,
    )
}
