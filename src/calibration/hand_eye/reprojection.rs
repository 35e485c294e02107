//! Corners of the board where hand, camera and board put them, against where they are seen: the least-squares problem of the refinement.

use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector3, Vector6};

use crate::calibration::camera::lens;
use crate::calibration::hand_eye::camera_prior::CameraPrior;
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::spread::Spread;
use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::Problem;
use crate::solver::robust_loss::RobustLoss;

/// A corner of the board, and where a view shows it.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    /// On the board, mm.
    pub corner: Point<Board>,
    /// In the picture, with the lens.
    pub pixel: Pixel,
}

/// A corner's residual counts in full up to so many deviations.
const HUBER: f64 = 2.5;
/// What is known of a time offset before, so that stations at rest do not leave it undetermined, s.
const TIME_OFFSET_SIGMA_S: f64 = 0.2;
/// Directions of X and Z.
pub(super) const POSES: usize = 12;

#[derive(Clone, Debug)]
pub(super) struct State {
    /// Where the arm puts the hand at each view, at the time and joint offsets below.
    pub(super) told: Vec<Option<Transform<RobotBase, Hand>>>,
    pub(super) hand_from_camera: Transform<Hand, Camera>,
    pub(super) base_from_board: Transform<RobotBase, Board>,
    pub(super) time_offset_s: f64,
    pub(super) joints: Vec<f64>,
    pub(super) camera: CameraModel,
    pub(super) corrections: Vec<Vector6<f64>>,
}

pub(super) fn told(
    hands: &dyn HandPoses,
    views: usize,
    offset_s: f64,
    offsets: &[f64],
) -> Vec<Option<Transform<RobotBase, Hand>>> {
    (0..views).map(|view| hands.base_from_hand(view, offset_s, offsets)).collect()
}

pub(super) struct Reprojection<'a> {
    pub(super) views: &'a [Vec<Sighting>],
    pub(super) hands: &'a dyn HandPoses,
    /// As given.
    pub(super) camera: &'a CameraModel,
    /// None: it stays as given.
    pub(super) camera_prior: Option<&'a CameraPrior>,
    /// First residual of each view, and one past the last.
    pub(super) first: &'a [usize],
    pub(super) joint_sigma: &'a [f64],
    pub(super) time_offset: bool,
    pub(super) spread: Spread,
    pub(super) pixel_sigma: f64,
    /// Weight of each view's prior.
    pub(super) trust: Vec<f64>,
    pub(super) outlier: Vec<bool>,
    pub(super) distance: Vec<f64>,
    /// Degrees of freedom of Student's t; none: normal.
    pub(super) tail: Option<f64>,
}

impl Reprojection<'_> {
    /// Numbers of the camera that are adjusted.
    pub(super) fn lens(&self) -> usize {
        self.camera_prior.map_or(0, CameraPrior::count)
    }

    /// Directions before the camera's: X, Z, time, joints.
    pub(super) fn first_lens(&self) -> usize {
        POSES + usize::from(self.time_offset) + self.joint_sigma.len()
    }

    /// Directions before the corrections: X, Z, time, joints, camera.
    pub(super) fn common(&self) -> usize {
        self.first_lens() + self.lens()
    }

    /// First row of the camera's prior.
    fn first_lens_prior(&self) -> usize {
        self.measured() + 6 * self.views.len() + self.joint_sigma.len() + usize::from(self.time_offset)
    }

    /// Where the camera was at a view.
    pub(super) fn eye(&self, state: &State, view: usize) -> Option<Transform<RobotBase, Camera>> {
        let told = state.told.get(view).copied()??;
        let correction: Transform<Camera, Camera> = shifted(&Transform::identity(), state.corrections[view].as_slice());
        Some(told * state.hand_from_camera * correction)
    }

    /// Where a view shows a corner from a camera's pose, minus where it was seen, px.
    pub(super) fn residual(
        &self,
        state: &State,
        base_from_camera: &Transform<RobotBase, Camera>,
        sighting: &Sighting,
    ) -> Option<[f64; 2]> {
        let camera_from_board = base_from_camera.inverse() * state.base_from_board;
        let pixel = state.camera.project(camera_from_board * sighting.corner)?;
        Some([pixel.x - sighting.pixel.x, pixel.y - sighting.pixel.y])
    }

    /// Place mm, turn rad, corner px.
    pub(super) fn sigmas(&self) -> [f64; 3] {
        let variance = |first: usize| self.spread.covariance.fixed_view::<3, 3>(first, first).trace() / 3.0;
        [variance(0).sqrt(), variance(3).sqrt(), self.pixel_sigma]
    }

    /// Root mean square of a view's residual vectors, px.
    pub(super) fn rms_of(&self, state: &State, view: usize) -> f64 {
        let Some(eye) = self.eye(state, view) else {
            return f64::NAN;
        };
        let squares = (self.views[view].iter())
            .map(|sighting| (self.residual(state, &eye, sighting)).map_or(f64::NAN, |[x, y]| x * x + y * y));
        (squares.sum::<f64>() / self.views[view].len() as f64).sqrt()
    }
}

impl Problem for Reprojection<'_> {
    type State = State;

    fn directions(&self) -> usize {
        self.common() + 6 * self.views.len()
    }

    fn measured(&self) -> usize {
        self.first[self.views.len()]
    }

    fn priors(&self) -> usize {
        6 * self.views.len() + self.joint_sigma.len() + usize::from(self.time_offset) + self.lens()
    }

    fn loss(&self) -> RobustLoss {
        RobustLoss::Huber { width: HUBER }
    }

    fn residuals(&self, state: &State, rows: Range<usize>, out: &mut [f64]) {
        let measured = self.measured();
        let mut row = rows.start;
        while row < rows.end.min(measured) {
            let view = self.first.partition_point(|&first| first <= row) - 1;
            let eye = self.eye(state, view);
            let end = self.first[view + 1].min(rows.end);
            while row < end {
                let sighting = &self.views[view][(row - self.first[view]) / 2];
                let residual = eye
                    .and_then(|eye| self.residual(state, &eye, sighting))
                    .unwrap_or([f64::NAN; 2]);
                // Blocks are asked for whole.
                out[row - rows.start] = residual[0] / self.pixel_sigma;
                out[row + 1 - rows.start] = residual[1] / self.pixel_sigma;
                row += 2;
            }
        }
        let first_lens_prior = self.first_lens_prior();
        if let Some(prior) = self.camera_prior.filter(|_| rows.end > first_lens_prior) {
            let difference = prior.difference(&state.camera, self.camera);
            for row in row.max(first_lens_prior)..rows.end {
                out[row - rows.start] = prior.residual(row - first_lens_prior, &difference);
            }
        }
        for row in row..rows.end.min(first_lens_prior) {
            let prior = row - measured;
            out[row - rows.start] = match prior.checked_sub(6 * self.views.len()) {
                Some(joint) if joint < self.joint_sigma.len() => state.joints[joint] / self.joint_sigma[joint],
                Some(_) => state.time_offset_s / TIME_OFFSET_SIGMA_S,
                None => {
                    let (view, axis) = (prior / 6, prior % 6);
                    let whitened = self.spread.whitening.row(axis).transpose().dot(&state.corrections[view]);
                    self.trust[view].sqrt() * whitened
                }
            };
        }
    }

    fn moved(&self, state: &State, step: &[f64]) -> State {
        let (common, first_lens) = (self.common(), self.first_lens());
        let first_joint = POSES + usize::from(self.time_offset);
        let time_offset_s = state.time_offset_s + if self.time_offset { step[POSES] } else { 0.0 };
        let joints: Vec<f64> = (state.joints.iter().zip(&step[first_joint..]))
            .map(|(joint, step)| joint + step)
            .collect();
        let mut camera = state.camera.clone();
        if let Some(prior) = self.camera_prior {
            for (place, step) in step[first_lens..common].iter().enumerate() {
                lens::add(&mut camera, prior.model(), place, *step);
            }
        }
        // Asking the arm costs more than all the rest.
        let told = if step[POSES..first_lens].iter().all(|step| *step == 0.0) {
            state.told.clone()
        } else {
            told(self.hands, self.views.len(), time_offset_s, &joints)
        };
        State {
            told,
            hand_from_camera: shifted(&state.hand_from_camera, &step[..6]),
            base_from_board: shifted(&state.base_from_board, &step[6..POSES]),
            time_offset_s,
            joints,
            camera,
            corrections: (state.corrections.iter().zip(step[common..].chunks(6)))
                .map(|(correction, step)| correction + Vector6::from_column_slice(step))
                .collect(),
        }
    }

    fn support(&self, direction: usize) -> Vec<Range<usize>> {
        let (measured, common) = (self.measured(), self.common());
        let own = |prior: usize| measured + prior..measured + prior + 1;
        match direction.checked_sub(common) {
            Some(correction) => {
                let view = correction / 6;
                let first = measured + 6 * view;
                vec![self.first[view]..self.first[view + 1], first..first + 6]
            }
            None if direction >= self.first_lens() => {
                let first = self.first_lens_prior();
                vec![0..measured, first..first + self.lens()]
            }
            None => match direction.checked_sub(POSES + usize::from(self.time_offset)) {
                Some(joint) => vec![0..measured, own(6 * self.views.len() + joint)],
                None if direction == POSES && self.time_offset => {
                    vec![0..measured, own(6 * self.views.len() + self.joint_sigma.len())]
                }
                None => vec![0..measured],
            },
        }
    }

    fn small_step(&self, direction: usize) -> f64 {
        if let Some(prior) = self.camera_prior
            && let Some(place) = direction.checked_sub(self.first_lens())
            && place < prior.count()
        {
            return prior.small_step(place, self.camera);
        }
        // Samples of the arm lie milliseconds apart.
        if self.time_offset && direction == POSES { 1e-4 } else { 1e-5 }
    }
}

/// A pose whose origin is moved by the first three numbers (mm), and that is turned about it by the rotation vector of the others (rad),
/// both in the space it leads to.
pub(crate) fn shifted<To, From>(pose: &Transform<To, From>, by: &[f64]) -> Transform<To, From> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(by[3], by[4], by[5]));
    Transform::new(turn * pose.rotation(), pose.translation() + Vector3::new(by[0], by[1], by[2]))
}
