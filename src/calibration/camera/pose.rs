//! Where a board is before a camera that is known: `camera_from_board` from the corners seen.
//!
//! Corners are turned into directions by the camera's lens; a homography from the board's plane to the plane z = 1 is [r₁ r₂ t] up to
//! scale (Zhang 2000, section 3.1), its sign such that the board lies before the camera. A small or distant board looks almost the
//! same when tilted the other way (Schweighofer and Pinz 2006, doi:10.1109/TPAMI.2006.252), so both are refined on the pixels and the
//! better one is taken.

use std::ops::Range;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::calibration::board::detection::BoardCorner;
use crate::calibration::homography;
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Board, Camera};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{Problem, Settings, minimize};
use crate::solver::robust_loss::RobustLoss;

/// A board's pose and how sure it is.
#[derive(Clone, Debug)]
pub struct BoardPose {
    /// Where the board is.
    pub camera_from_board: Transform<Camera, Board>,
    /// Root mean square over residual vectors, px, of the corners in standing.
    pub rms_px: f64,
    /// Of a small motion in board space (translation mm, rotation rad) before `camera_from_board`
    /// ([`Transform::perturbed_right`]), scaled by what the corners leave over.
    pub covariance: Matrix6<f64>,
    /// Corners that lie far off, as indices into what was given.
    pub outliers: Vec<usize>,
    /// RMS of the board tilted the other way, px: where it is not much larger, the tilt is a guess.
    pub other_tilt_rms_px: Option<f64>,
}

/// Corners farther off than this many median deviations count as outliers.
const OUTLIER_DEVIATIONS: f64 = 6.0;
/// Below this, corners are as good as they get and none is an outlier, px.
const LEAST_DEVIATION_PX: f64 = 0.05;

/// The pose from corners seen with `camera`; `None` for fewer than four, or where they do not tell.
pub fn board_pose(camera: &CameraModel, corners: &[BoardCorner]) -> Option<BoardPose> {
    let first = initial(camera, corners)?;
    let mut best: Option<BoardPose> = None;
    let mut other: Option<f64> = None;
    for start in [first, tilted_other_way(&first, corners)] {
        let Some(pose) = refined(camera, corners, start) else {
            continue;
        };
        match &best {
            Some(known) if known.rms_px <= pose.rms_px => other = Some(pose.rms_px),
            _ => {
                other = best.as_ref().map(|best| best.rms_px);
                best = Some(pose);
            }
        }
    }
    best.map(|best| BoardPose {
        other_tilt_rms_px: other,
        ..best
    })
}

/// The pose from the homography alone.
pub fn initial(camera: &CameraModel, corners: &[BoardCorner]) -> Option<Transform<Camera, Board>> {
    let pairs: Vec<([f64; 2], [f64; 2])> = corners
        .iter()
        .filter_map(|corner| {
            let direction = camera.unproject(corner.pixel)?.coords;
            Some(([corner.board.coords.x, corner.board.coords.y], [direction.x, direction.y]))
        })
        .collect();
    let h = homography::from_pairs(&pairs)?;
    from_homography(&h)
}

/// [r₁ r₂ t] up to scale, made a rigid motion with the board before the camera.
fn from_homography(h: &Matrix3<f64>) -> Option<Transform<Camera, Board>> {
    let scale = (h.column(0).norm() * h.column(1).norm()).sqrt();
    let h = h / if h[(2, 2)] < 0.0 { -scale } else { scale };
    let (r1, r2): (Vector3<f64>, Vector3<f64>) = (h.column(0).into(), h.column(1).into());
    let rough = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]);
    let svd = rough.svd(true, true);
    let mut rotation = svd.u? * svd.v_t?;
    if rotation.determinant() < 0.0 {
        rotation = -rotation;
    }
    let pose = Transform::from_matrix(&rotation, h.column(2).into());
    (pose.is_finite() && pose.translation().z > 0.0).then_some(pose)
}

/// The same middle, the plane mirrored in depth: what looks alike from afar.
fn tilted_other_way(pose: &Transform<Camera, Board>, corners: &[BoardCorner]) -> Transform<Camera, Board> {
    let n = corners.len().max(1) as f64;
    let middle: Vector3<f64> = corners.iter().map(|corner| corner.board.coords).sum::<Vector3<f64>>() / n;
    let seen = (*pose * Point::<Board>::from_coords(middle)).coords;
    let toward = seen.normalize();
    let r = pose.rotation().to_rotation_matrix();
    let flipped = |k: usize| -> Vector3<f64> {
        let column: Vector3<f64> = r.matrix().column(k).into();
        column - toward * (2.0 * toward.dot(&column))
    };
    let (r1, r2) = (flipped(0), flipped(1));
    let rotation = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]);
    let turned: Transform<Camera, Board> = Transform::from_matrix(&rotation, Vector3::zeros());
    Transform::new(turned.rotation(), seen - turned.rotation() * middle)
}

struct OneBoard<'a> {
    camera: &'a CameraModel,
    corners: &'a [BoardCorner],
    loss: RobustLoss,
}

impl Problem for OneBoard<'_> {
    type State = Transform<Camera, Board>;

    fn directions(&self) -> usize {
        6
    }
    fn measured(&self) -> usize {
        2 * self.corners.len()
    }
    fn loss(&self) -> RobustLoss {
        self.loss
    }
    fn residuals(&self, pose: &Self::State, rows: Range<usize>, out: &mut [f64]) {
        let corners = self.corners.get(rows.start / 2..rows.end / 2).unwrap_or_default();
        for (corner, out) in corners.iter().zip(out.chunks_exact_mut(2)) {
            let seen = self.camera.project(*pose * corner.board);
            out[0] = seen.map_or(f64::NAN, |seen| seen.x - corner.pixel.x);
            out[1] = seen.map_or(f64::NAN, |seen| seen.y - corner.pixel.y);
        }
    }
    fn moved(&self, pose: &Self::State, step: &[f64]) -> Self::State {
        pose.perturbed_right(&Vector6::from_column_slice(step))
    }
}

fn refined(camera: &CameraModel, corners: &[BoardCorner], start: Transform<Camera, Board>) -> Option<BoardPose> {
    let settings = Settings::default();
    // A weak start: a loss that hardly cares for the far ones, then the width that the residuals ask for.
    let mut pose = start;
    for width in [5.0, 1.0] {
        let problem = OneBoard {
            camera,
            corners,
            loss: RobustLoss::Huber { width },
        };
        pose = minimize(&problem, pose, &settings)?.state;
    }
    let errors = errors_px(camera, corners, &pose)?;
    let limit = OUTLIER_DEVIATIONS * deviation(&errors).max(LEAST_DEVIATION_PX);
    let outliers: Vec<usize> = (0..errors.len()).filter(|i| errors[*i] > limit).collect();
    let kept: Vec<BoardCorner> = (0..corners.len())
        .filter(|i| errors[*i] <= limit)
        .map(|i| corners[i])
        .collect();
    if kept.len() < 4 {
        return None;
    }
    let problem = OneBoard {
        camera,
        corners: &kept,
        loss: RobustLoss::Squared,
    };
    let solution = minimize(&problem, pose, &settings)?;
    let covariance = solution.scaled_covariance(problem.measured())?;
    Some(BoardPose {
        camera_from_board: solution.state,
        rms_px: (solution.cost / kept.len() as f64).sqrt(),
        covariance: Matrix6::from_iterator(covariance.iter().copied()),
        outliers,
        other_tilt_rms_px: None,
    })
}

/// Lengths of the residual vectors, px.
fn errors_px(camera: &CameraModel, corners: &[BoardCorner], pose: &Transform<Camera, Board>) -> Option<Vec<f64>> {
    corners
        .iter()
        .map(|corner| {
            let seen = camera.project(*pose * corner.board)?;
            Some((seen.x - corner.pixel.x).hypot(seen.y - corner.pixel.y))
        })
        .collect()
}

/// Standard deviation per axis of residual vectors, from the median of their lengths: of two normal axes it is σ·√(2 ln 2).
pub(crate) fn deviation(lengths: &[f64]) -> f64 {
    let mut sorted = lengths.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0) / (2.0 * std::f64::consts::LN_2).sqrt()
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibration::board::pattern::BoardLayout;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::{Intrinsics, Pixel};

    fn camera() -> CameraModel {
        CameraModel {
            width: 960,
            height: 540,
            intrinsics: Intrinsics {
                fx: 700.0,
                fy: 705.0,
                cx: 470.0,
                cy: 280.0,
            },
            distortion: Distortion::BrownConrady {
                k: [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0],
                p: [0.001, -0.002],
            },
        }
    }

    fn seen(pose: &Transform<Camera, Board>, noise_px: f64, random: &mut ChaCha8Rng) -> Vec<BoardCorner> {
        let layout = BoardLayout::new("checkerboard:9x6", 4.0).unwrap();
        let sites = layout.sites();
        let corner = |site: usize| {
            let board = Point::new(sites[site].board_mm[0], sites[site].board_mm[1], 0.0);
            let at = camera().project(*pose * board).unwrap();
            let mut noise = || noise_px * random.sample::<f64, _>(StandardNormal);
            let pixel = Pixel {
                x: at.x + noise(),
                y: at.y + noise(),
            };
            BoardCorner {
                site,
                board,
                pixel,
                sigma_px: noise_px,
            }
        };
        (0..sites.len()).map(corner).collect()
    }

    #[test]
    fn the_pose_is_found_within_its_covariance_whatever_the_tilt() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let runs = 100;
        let mut sum = 0.0;
        for run in 0..runs {
            let i = f64::from(run);
            let turn = UnitQuaternion::from_euler_angles(0.8 * (0.7 * i).sin(), 0.8 * (1.1 * i).cos(), 0.3 * i);
            let truth = Transform::new(turn, Vector3::new(0.0, 2.0, 90.0) - turn * Vector3::new(16.0, 10.0, 0.0));
            let mut corners = seen(&truth, 0.1, &mut random);
            corners[7].pixel.x += 9.0;
            let found = board_pose(&camera(), &corners).unwrap();
            assert!(
                found.outliers.contains(&7) && found.outliers.len() <= 2,
                "{:?}",
                found.outliers
            );
            assert!((0.09..0.18).contains(&found.rms_px), "{}", found.rms_px);
            // truth = found · exp(d).
            let d = found.camera_from_board.inverse() * truth;
            let d = Vector6::from_column_slice(&[d.translation().as_slice(), d.rotation().scaled_axis().as_slice()].concat());
            sum += d.dot(&(found.covariance.try_inverse().unwrap() * d));
        }
        // The mean of 100 χ² of six degrees is 6 ± 4·√12/10; estimated scale and clipped tails add a little.
        let mean = sum / f64::from(runs);
        assert!((4.6..8.0).contains(&mean), "{mean}");
    }

    #[test]
    fn too_few_or_straight_corners_give_no_pose() {
        let truth = Transform::new(UnitQuaternion::identity(), Vector3::new(-16.0, -10.0, 90.0));
        let corners = seen(&truth, 0.0, &mut ChaCha8Rng::seed_from_u64(1));
        assert!(board_pose(&camera(), &corners[..3]).is_none());
        assert!(board_pose(&camera(), &corners[..9]).is_none());
    }
}
