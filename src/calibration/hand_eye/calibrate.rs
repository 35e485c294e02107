//! The whole hand-eye calibration: checked, agreed upon, refined, and tried on views it has not seen.

use nalgebra::Vector3;

use crate::calibration::hand_eye::consensus::agreement;
use crate::calibration::hand_eye::method::Method;
use crate::calibration::hand_eye::motion::{Degenerate, Demands, Station, check};
use crate::calibration::hand_eye::refinement::{HandPoses, Refined, Settings, Sighting, refine};
use crate::calibration::hand_eye::robot_world::board_of;
use crate::camera::model::CameraModel;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;

/// What is seen at one station.
#[derive(Clone, Debug)]
pub struct StationView {
    /// The board's pose from this picture alone.
    pub camera_from_board: Transform<Camera, Board>,
    /// Corners seen.
    pub sightings: Vec<Sighting>,
}

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum HandEyeCalibrationError {
    /// The motion tells too little.
    #[error(transparent)]
    Degenerate(#[from] Degenerate),
    /// No subset of the stations agrees.
    #[error(
        "the arm's poses and the pictures do not agree anywhere: check that poses and pictures belong to the same stations, that the poses \
        are base_from_hand (not its inverse), and their unit"
    )]
    Contradictory,
    /// The refinement found no minimum.
    #[error("the corners do not determine the answer: record stations with larger and more different rotations")]
    Undetermined,
}

/// Find X, Z and whatever else `settings` ask for.
pub fn calibrate(
    views: &[StationView],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    settings: &Settings,
) -> Result<Refined, HandEyeCalibrationError> {
    let stations = stations(views, hands);
    check(&stations, &Demands::default())?;
    let agreed = agreement(&stations, SEED).ok_or(HandEyeCalibrationError::Contradictory)?;
    let trusted: Vec<Station> = (stations.iter().zip(&agreed.agrees))
        .filter_map(|(station, agrees)| agrees.then_some(*station))
        .collect();
    check(&trusted, &Demands::default()).map_err(|_| HandEyeCalibrationError::Contradictory)?;
    let board = board_of(&trusted, &agreed.hand_from_camera).ok_or(HandEyeCalibrationError::Contradictory)?;
    let sightings: Vec<Vec<Sighting>> = views.iter().map(|view| view.sightings.clone()).collect();
    refine(&sightings, hands, camera, (agreed.hand_from_camera, board), settings).ok_or(HandEyeCalibrationError::Undetermined)
}

/// Samples are drawn the same way every time.
const SEED: u64 = 1;

/// The stations as arm and picture tell them. Views without a hand are left out.
pub fn stations(views: &[StationView], hands: &dyn HandPoses) -> Vec<Station> {
    let offsets = vec![0.0; hands.joints()];
    (views.iter().enumerate())
        .filter_map(|(index, view)| {
            Some(Station {
                base_from_hand: hands.base_from_hand(index, 0.0, &offsets)?,
                camera_from_board: view.camera_from_board,
            })
        })
        .collect()
}

/// How well a calibration predicts a view that it was not made from.
#[derive(Clone, Copy, Debug)]
pub struct Held {
    /// Root mean square of residual vectors, px.
    pub rms_px: f64,
    /// How far the middle of the board is from where the picture shows it, mm.
    pub board_mm: f64,
}

/// Some of the views, by number.
struct Chosen<'a> {
    all: &'a dyn HandPoses,
    numbers: Vec<usize>,
}

impl HandPoses for Chosen<'_> {
    fn base_from_hand(&self, view: usize, offset_s: f64, offsets: &[f64]) -> Option<Transform<RobotBase, Hand>> {
        self.all.base_from_hand(*self.numbers.get(view)?, offset_s, offsets)
    }

    fn joints(&self) -> usize {
        self.all.joints()
    }
}

/// Each view predicted from a calibration on all others: by the refinement, or with a closed form by that. `None` where the others do not
/// suffice.
pub fn leave_one_out(
    views: &[StationView],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    settings: &Settings,
    method: Option<Method>,
) -> Vec<Option<Held>> {
    let held = |left_out: usize| {
        let numbers: Vec<usize> = (0..views.len()).filter(|&view| view != left_out).collect();
        let rest: Vec<StationView> = numbers.iter().map(|&view| views[view].clone()).collect();
        let chosen = Chosen { all: hands, numbers };
        let (x, z, offset_s, offsets) = match method {
            None => {
                let refined = calibrate(&rest, &chosen, camera, settings).ok()?;
                let offsets = refined.joint_offsets.iter().map(|[offset, _]| *offset).collect();
                (
                    refined.hand_from_camera,
                    refined.base_from_board,
                    refined.time_offset_s[0],
                    offsets,
                )
            }
            Some(method) => {
                let stations = stations(&rest, &chosen);
                let x = method.solve(&stations)?;
                (x, board_of(&stations, &x)?, 0.0, vec![0.0; hands.joints()])
            }
        };
        let hand = hands.base_from_hand(left_out, offset_s, &offsets)?;
        predicted(&views[left_out], camera, (hand * x).inverse() * z)
    };
    (0..views.len()).map(held).collect()
}

fn predicted(view: &StationView, camera: &CameraModel, camera_from_board: Transform<Camera, Board>) -> Option<Held> {
    let mut squares = 0.0;
    let mut middle = Vector3::zeros();
    for sighting in &view.sightings {
        let pixel = camera.project(camera_from_board * sighting.corner)?;
        squares += (pixel.x - sighting.pixel.x).powi(2) + (pixel.y - sighting.pixel.y).powi(2);
        middle += (camera_from_board * sighting.corner).coords - (view.camera_from_board * sighting.corner).coords;
    }
    let count = view.sightings.len() as f64;
    Some(Held {
        rms_px: (squares / count).sqrt(),
        board_mm: middle.norm() / count,
    })
}
