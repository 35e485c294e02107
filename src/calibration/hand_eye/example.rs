//! A hand with a camera going from station to station over a board: the truth is known.

use nalgebra::{DVector, UnitQuaternion, Vector3, Vector6};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::calibration::hand_eye::method::Method;
use crate::calibration::hand_eye::motion::Station;
use crate::calibration::hand_eye::refinement::{Refined, Settings, refine};
use crate::calibration::hand_eye::reprojection::{Sighting, shifted};
use crate::calibration::hand_eye::robot_world::board_of;
use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::kinematics::{Arm, JointKind};

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

/// Deviation of a corner along an axis, px.
pub const PIXEL_SIGMA: f64 = 0.1;

/// What arm and camera tell of an example.
#[derive(Debug)]
pub struct Recorded {
    pub example: Example,
    pub views: Vec<Vec<Sighting>>,
    pub hands: Vec<Transform<RobotBase, Hand>>,
}

impl Recorded {
    /// By the example's own camera.
    pub fn new(seed: u64, count: usize, joint_rad: f64) -> Self {
        Self::by(&camera(), seed, count, joint_rad)
    }

    /// Corners of a small board with noise, and hands whose joints were off by so much (0.1 mm in the slide), seen through the arm's
    /// Jacobian at random postures.
    pub fn by(camera: &CameraModel, seed: u64, count: usize, joint_rad: f64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed ^ 0x5EED);
        let example = Example::new(seed, count, Noise::NONE);
        let arm = Arm::aesop_3000().unwrap();
        let mut views = Vec::new();
        let mut hands = Vec::new();
        for station in &example.stations {
            let corners = (0..20).map(|i| Point::new(f64::from(i % 5) * 8.0, f64::from(i / 5) * 8.0, 0.0));
            let sightings = corners.map(|corner| {
                let pixel = camera.project(station.camera_from_board * corner).unwrap();
                let mut noise = || PIXEL_SIGMA * random.sample::<f64, _>(StandardNormal);
                let pixel = Pixel {
                    x: pixel.x + noise(),
                    y: pixel.y + noise(),
                };
                Sighting { corner, pixel }
            });
            views.push(sightings.collect());
            let posture: Vec<f64> = (arm.joints().iter())
                .map(|joint| joint.limits[0] + random.random::<f64>() * (joint.limits[1] - joint.limits[0]))
                .collect();
            let off = DVector::from_iterator(
                posture.len(),
                arm.joints().iter().map(|joint| {
                    let sigma = if joint.kind == JointKind::Prismatic && joint_rad > 0.0 {
                        0.1
                    } else {
                        joint_rad
                    };
                    sigma * random.sample::<f64, _>(StandardNormal)
                }),
            );
            let twist = arm.jacobian(&posture).unwrap() * off;
            hands.push(shifted(&station.base_from_hand, twist.as_slice()));
        }
        Self { example, views, hands }
    }

    /// A closed form's answer.
    pub fn start(&self) -> (Transform<Hand, Camera>, Transform<RobotBase, Board>) {
        let stations: Vec<Station> = (self.example.stations.iter().zip(&self.hands))
            .map(|(station, &base_from_hand)| Station {
                base_from_hand,
                ..*station
            })
            .collect();
        let hand_from_camera = Method::Park.solve(&stations).unwrap();
        (hand_from_camera, board_of(&stations, &hand_from_camera).unwrap())
    }

    pub fn refined(&self, settings: &Settings) -> Refined {
        self.refined_by(&camera(), settings)
    }

    /// With a camera that need not be the one that took the pictures.
    pub fn refined_by(&self, camera: &CameraModel, settings: &Settings) -> Refined {
        refine(&self.views, &self.hands, camera, self.start(), settings).unwrap()
    }

    /// The truth minus the answer, in the directions of the covariance.
    pub fn error(&self, refined: &Refined) -> Vector6<f64> {
        let (truth, found) = (self.example.hand_from_camera, refined.hand_from_camera);
        let turn = (truth.rotation() * found.rotation().inverse()).scaled_axis();
        let shift = truth.translation() - found.translation();
        Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
    }
}
