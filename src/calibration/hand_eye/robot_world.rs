//! The camera on the hand and the board on the base at once: A·X = Z·B with A = base_from_hand and B = board_from_camera.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix};

use crate::calibration::hand_eye::motion::Station;
use crate::calibration::hand_eye::rotation_first::proper;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;

/// Both unknowns of a robot that looks at a board.
#[derive(Clone, Copy, Debug)]
pub struct RobotWorld {
    /// X: how the camera sits on the hand.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// Z: where the board lies.
    pub base_from_board: Transform<RobotBase, Board>,
}

/// Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker product", 2013: Σ R_B ⊗ R_A maps vec R_X to n·vec R_Z.
pub fn shah(stations: &[Station]) -> Option<RobotWorld> {
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for station in stations {
        let (a, b) = rotations(station);
        sum += b.kronecker(&a);
    }
    let svd = sum.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let most = svd.singular_values.imax();
    let z = Matrix3::from_iterator(u.column(most).iter().copied());
    let x = Matrix3::from_iterator(v.row(most).iter().copied());
    // Both vectors have the same unknown sign.
    let sign = x.determinant().signum();
    let (x, z) = (proper(x * sign)?, proper(z * sign)?);
    // R_A·t_X − t_Z = R_Z·t_B − t_A.
    let mut matrix = DMatrix::zeros(3 * stations.len(), 6);
    let mut side = DVector::zeros(3 * stations.len());
    for (index, station) in stations.iter().enumerate() {
        let (a, _) = rotations(station);
        matrix.view_mut((3 * index, 0), (3, 3)).copy_from(&a);
        matrix.view_mut((3 * index, 3), (3, 3)).copy_from(&-Matrix3::identity());
        let board_from_camera = station.camera_from_board.inverse();
        let right = z * board_from_camera.translation() - station.base_from_hand.translation();
        side.rows_mut(3 * index, 3).copy_from(&right);
    }
    let solution = matrix.svd(true, true).solve(&side, 1e-9).ok()?;
    let found = RobotWorld {
        hand_from_camera: Transform::new(x, solution.fixed_rows::<3>(0).into_owned()),
        base_from_board: Transform::new(z, solution.fixed_rows::<3>(3).into_owned()),
    };
    (found.hand_from_camera.is_finite() && found.base_from_board.is_finite()).then_some(found)
}

fn rotations(station: &Station) -> (Matrix3<f64>, Matrix3<f64>) {
    (
        station.base_from_hand.rotation().to_rotation_matrix().into_inner(),
        station
            .camera_from_board
            .inverse()
            .rotation()
            .to_rotation_matrix()
            .into_inner(),
    )
}

/// Where the board lies if the camera sits on the hand as told: the mean of what the stations say, which a few wrong ones hardly move.
pub fn board_of(stations: &[Station], hand_from_camera: &Transform<Hand, Camera>) -> Option<Transform<RobotBase, Board>> {
    let told: Vec<Transform<RobotBase, Board>> = stations
        .iter()
        .map(|station| station.base_from_hand * *hand_from_camera * station.camera_from_board)
        .collect();
    // The one that is nearest to the others, then the mean of those near it.
    let apart = |a: &Transform<RobotBase, Board>, b: &Transform<RobotBase, Board>| {
        (a.translation() - b.translation()).norm() + LEVER_MM * a.rotation().angle_to(&b.rotation())
    };
    let middle = told.iter().min_by(|a, b| {
        let sum = |one: &Transform<RobotBase, Board>| told.iter().map(|other| apart(one, other)).sum::<f64>();
        sum(a).total_cmp(&sum(b))
    })?;
    let mut distances: Vec<f64> = told.iter().map(|one| apart(one, middle)).collect();
    distances.sort_by(f64::total_cmp);
    let near = 3.0 * distances[distances.len() / 2] + 1e-9;
    let close: Vec<_> = told.iter().filter(|one| apart(one, middle) <= near).collect();
    let count = close.len() as f64;
    let translation = close.iter().map(|one| one.translation()).sum::<nalgebra::Vector3<f64>>() / count;
    let turns = close
        .iter()
        .map(|one| (middle.rotation().inverse() * one.rotation()).scaled_axis());
    let turn = turns.sum::<nalgebra::Vector3<f64>>() / count;
    Some(Transform::new(
        middle.rotation() * nalgebra::UnitQuaternion::from_scaled_axis(turn),
        translation,
    ))
}

/// A board's half size: what a rotation moves it by, mm per rad.
pub const LEVER_MM: f64 = 30.0;
