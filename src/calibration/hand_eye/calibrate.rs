//! The whole hand-eye calibration: checked, agreed upon, refined, and tried on views it has not seen.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::calibration::board::detection::BoardCorner;
use crate::calibration::camera::pose::board_pose;
use crate::calibration::hand_eye::consensus::agreement;
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::method::Method;
use crate::calibration::hand_eye::motion::{Degenerate, Demands, Station, check};
use crate::calibration::hand_eye::refinement::{Refined, Settings, refine};
use crate::calibration::hand_eye::reprojection::Sighting;
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
    (views.iter().enumerate())
        .filter_map(|(index, view)| {
            Some(Station {
                base_from_hand: hands.as_told(index, 0.0)?,
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

/// More folds than this tell no more, and each costs a calibration.
const MOST_FOLDS: usize = 12;

/// Each view predicted from a calibration that has not seen it: by the refinement, or with a closed form by that. Few views are left out
/// one by one, many in folds. `None` where the others do not suffice.
pub fn leave_out(
    views: &[StationView],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    settings: &Settings,
    method: Option<Method>,
) -> Vec<Option<Held>> {
    let folds = views.len().min(MOST_FOLDS);
    let of_fold = |fold: usize| -> Vec<(usize, Held)> {
        let (left_out, numbers): (Vec<usize>, Vec<usize>) = (0..views.len()).partition(|view| view % folds == fold);
        let rest: Vec<StationView> = numbers.iter().map(|&view| views[view].clone()).collect();
        let Some(found) = calibrated(&rest, &Chosen { all: hands, numbers }, camera, settings, method) else {
            return Vec::new();
        };
        let predicted = |view: usize| {
            let hand = hands.base_from_hand(view, found.time_offset_s, &found.joint_offsets)?;
            let camera_from_board = (hand * found.hand_from_camera).inverse() * found.base_from_board;
            let seen = if found.camera == *camera {
                views[view].camera_from_board
            } else {
                seen_by(&found.camera, &views[view])?
            };
            Some((
                view,
                predicted(&views[view].sightings, &found.camera, camera_from_board, seen)?,
            ))
        };
        left_out.into_iter().filter_map(predicted).collect()
    };
    let mut held = vec![None; views.len()];
    for (view, told) in (0..folds).into_par_iter().flat_map_iter(of_fold).collect::<Vec<_>>() {
        held[view] = Some(told);
    }
    held
}

/// What predicts a view.
struct Calibrated {
    hand_from_camera: Transform<Hand, Camera>,
    base_from_board: Transform<RobotBase, Board>,
    time_offset_s: f64,
    joint_offsets: Vec<f64>,
    camera: CameraModel,
}

fn calibrated(
    views: &[StationView],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    settings: &Settings,
    method: Option<Method>,
) -> Option<Calibrated> {
    let Some(method) = method else {
        let refined = calibrate(views, hands, camera, settings).ok()?;
        return Some(Calibrated {
            hand_from_camera: refined.hand_from_camera,
            base_from_board: refined.base_from_board,
            time_offset_s: refined.time_offset_s[0],
            joint_offsets: refined.joint_offsets.iter().map(|[offset, _]| *offset).collect(),
            camera: refined.camera,
        });
    };
    let stations = stations(views, hands);
    let x = method.solve(&stations)?;
    Some(Calibrated {
        hand_from_camera: x,
        base_from_board: board_of(&stations, &x)?,
        time_offset_s: 0.0,
        joint_offsets: vec![0.0; hands.joints()],
        camera: camera.clone(),
    })
}

/// The board's pose from a view's picture alone, by another camera than the one that the view's own pose is from.
fn seen_by(camera: &CameraModel, view: &StationView) -> Option<Transform<Camera, Board>> {
    let corners = (view.sightings.iter().enumerate()).map(|(site, sighting)| BoardCorner {
        site,
        board: sighting.corner,
        pixel: sighting.pixel,
        sigma_px: 1.0,
    });
    Some(board_pose(camera, &corners.collect::<Vec<_>>())?.camera_from_board)
}

fn predicted(
    sightings: &[Sighting],
    camera: &CameraModel,
    camera_from_board: Transform<Camera, Board>,
    seen: Transform<Camera, Board>,
) -> Option<Held> {
    let mut squares = 0.0;
    let mut middle = Vector3::zeros();
    for sighting in sightings {
        let pixel = camera.project(camera_from_board * sighting.corner)?;
        squares += (pixel.x - sighting.pixel.x).powi(2) + (pixel.y - sighting.pixel.y).powi(2);
        middle += (camera_from_board * sighting.corner).coords - (seen * sighting.corner).coords;
    }
    let count = sightings.len() as f64;
    Some(Held {
        rms_px: (squares / count).sqrt(),
        board_mm: middle.norm() / count,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::hand_eye::camera_prior::CameraPrior;
    use crate::calibration::hand_eye::example::{Example, Noise, camera};
    use crate::geometry::point::Point;

    fn views_of(example: &Example) -> Vec<StationView> {
        let corners: Vec<Point<Board>> = (0..20)
            .map(|i| Point::new(f64::from(i % 5) * 8.0, f64::from(i / 5) * 8.0, 0.0))
            .collect();
        let view = |station: &Station| StationView {
            camera_from_board: station.camera_from_board,
            sightings: (corners.iter())
                .map(|&corner| Sighting {
                    corner,
                    pixel: camera().project(station.camera_from_board * corner).unwrap(),
                })
                .collect(),
        };
        example.stations.iter().map(view).collect()
    }

    #[test]
    fn exact_stations_predict_what_was_left_out_and_a_wrong_one_is_seen() {
        let mut example = Example::new(3, 14, Noise::NONE);
        let views = views_of(&example);
        example.disturb(5, Vector3::new(5.0, 0.0, -4.0), Vector3::new(0.02, 0.03, 0.0));
        let hands: Vec<_> = example.stations.iter().map(|station| station.base_from_hand).collect();
        let settings = Settings::default();
        let refined = calibrate(&views, &hands, &camera(), &settings).unwrap();
        let [mm, rad] = example.error_of(&refined.hand_from_camera);
        assert!(mm < 0.05 && rad < 3e-4, "{mm} mm, {rad} rad");
        assert!(
            (0..14).all(|view| refined.outlier[view] == (view == 5)),
            "{:?}",
            refined.distance
        );
        let held = leave_out(&views, &hands, &camera(), &settings, None);
        for (view, held) in held.iter().enumerate() {
            let held = held.unwrap();
            assert_eq!(held.rms_px > 5.0, view == 5, "{view}: {held:?}");
        }
    }

    /// Left out views are judged by the camera that the others led to, not by the one given.
    #[test]
    fn views_left_out_are_predicted_by_the_camera_that_was_adjusted() {
        let example = Example::new(6, 12, Noise::NONE);
        let hands: Vec<_> = example.stations.iter().map(|station| station.base_from_hand).collect();
        let mut given = camera();
        given.intrinsics.fx *= 1.007;
        given.intrinsics.fy *= 1.007;
        given.intrinsics.cx -= 5.0;
        let mut views = views_of(&example);
        for view in &mut views {
            view.camera_from_board = seen_by(&given, view).unwrap();
        }
        let adjusting = Settings {
            camera_prior: CameraPrior::assumed(&given),
            ..Settings::default()
        };
        let worst = |settings: &Settings| {
            let held = leave_out(&views, &hands, &given, settings, None);
            let of = |figure: fn(&Held) -> f64| held.iter().map(|held| figure(&held.unwrap())).fold(0.0, f64::max);
            [of(|held| held.rms_px), of(|held| held.board_mm)]
        };
        let ([held_px, _], [adjusted_px, adjusted_mm]) = (worst(&Settings::default()), worst(&adjusting));
        // Corners and hands are exact: but for the weak prior nothing is left. A wrong camera leaves what X cannot make up for.
        assert!(
            adjusted_px < 1e-3 && adjusted_mm < 1e-3 && held_px > 0.5,
            "{adjusted_px} px {adjusted_mm} mm, {held_px} px"
        );
    }

    #[test]
    fn inverted_poses_are_refused_as_contradictory_or_leave_much_over() {
        let example = Example::new(4, 10, Noise::NONE);
        let views = views_of(&example);
        let inverted: Vec<Transform<RobotBase, Hand>> = (example.stations.iter())
            .map(|station| Transform::from_isometry(station.base_from_hand.isometry().inverse()))
            .collect();
        if let Ok(refined) = calibrate(&views, &inverted, &camera(), &Settings::default()) {
            let least = refined.predicted_px.iter().copied().fold(f64::INFINITY, f64::min);
            assert!(refined.sigmas[0] > 1.0 || least > 2.0, "{:?}", refined.predicted_px);
        }
    }
}
