//! Everything sought as one least-squares problem: residuals on the pixels, and priors where angles were told.

use std::ops::Range;

use nalgebra::{Unit, UnitQuaternion, Vector3, Vector6};

use crate::calibration::board::detection::BoardCorner;
use crate::calibration::camera::lens::{self, LensModel};
use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::camera::oblique::Oblique;
use crate::geometry::space::{Board, Camera};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::Problem;
use crate::solver::robust_loss::RobustLoss;

/// A picture of the board.
#[derive(Clone, Debug)]
pub struct Sighting {
    /// Head and board lay alike in all pictures of a station.
    pub station: usize,
    /// The telescope was turned alike in all pictures of a rotation.
    pub rotation: usize,
    /// What is seen.
    pub corners: Vec<BoardCorner>,
}

/// What is known of the angles.
#[derive(Clone, Debug)]
pub struct Angles {
    /// As told, one for each rotation, rad; none where nobody read it.
    pub given_rad: Vec<Option<f64>>,
    /// Their standard deviation, rad.
    pub sigma_rad: f64,
}

/// Two directions across an axis, each a continuous function of it.
pub fn across(axis: &Unit<Vector3<f64>>) -> [Vector3<f64>; 2] {
    // Never parallel to an axis that points forward, up to 109° aside.
    let reference = UnitQuaternion::rotation_between(&Vector3::z(), axis).unwrap_or_else(UnitQuaternion::identity);
    [reference * Vector3::x(), reference * Vector3::y()]
}

#[derive(Clone, Debug)]
pub(super) struct State {
    /// At angle 0.
    pub camera: CameraModel,
    /// The joint.
    pub oblique: Oblique,
    /// One for each rotation, rad.
    pub angles: Vec<f64>,
    /// One for each station, from the camera at angle 0.
    pub boards: Vec<Transform<Camera, Board>>,
}

impl State {
    fn seen(
        &self,
        camera: &CameraModel,
        motion: &Transform<Camera, Camera>,
        station: usize,
        corner: &BoardCorner,
    ) -> Option<Pixel> {
        camera.project(*motion * (*self.boards.get(station)? * corner.board))
    }

    /// Residual vectors of a sighting, px.
    pub fn errors(&self, sighting: &Sighting) -> Vec<Option<[f64; 2]>> {
        let angle = self.angles.get(sighting.rotation).copied().unwrap_or(0.0);
        let (camera, motion) = (
            self.oblique.camera_at(&self.camera, angle),
            self.oblique.turned_from_zero(angle),
        );
        (sighting.corners.iter())
            .map(|corner| {
                let seen = self.seen(&camera, &motion, sighting.station, corner)?;
                Some([seen.x - corner.pixel.x, seen.y - corner.pixel.y])
            })
            .collect()
    }
}

/// Least squares of everything.
pub(super) struct Joint<'a> {
    model: LensModel,
    sightings: &'a [Sighting],
    offsets: Vec<usize>,
    angles: &'a Angles,
    /// Rotations and stations.
    counts: [usize; 2],
    /// Of the corners, px: what priors are measured by.
    sigma_px: f64,
    loss: RobustLoss,
    scale: f64,
}

/// Numbers of the axis's direction and point, and of the centre.
const JOINT: usize = 6;

impl<'a> Joint<'a> {
    pub fn new(
        model: LensModel,
        sightings: &'a [Sighting],
        angles: &'a Angles,
        stations: usize,
        sigma_px: f64,
        loss: RobustLoss,
        scale: f64,
    ) -> Self {
        let mut offsets = vec![0];
        let mut sum = 0;
        for sighting in sightings {
            sum += 2 * sighting.corners.len();
            offsets.push(sum);
        }
        Self {
            model,
            sightings,
            offsets,
            angles,
            counts: [angles.given_rad.len(), stations],
            sigma_px,
            loss,
            scale,
        }
    }

    fn lens(&self) -> usize {
        self.model.names().len()
    }

    /// Numbers before the boards'.
    pub fn shared(&self) -> usize {
        self.lens() + JOINT + self.counts[0] - 1
    }
}

impl Problem for Joint<'_> {
    type State = State;

    fn directions(&self) -> usize {
        self.shared() + 6 * self.counts[1]
    }
    fn measured(&self) -> usize {
        self.offsets.last().copied().unwrap_or(0)
    }
    fn priors(&self) -> usize {
        self.counts[0] - 1
    }
    fn loss(&self) -> RobustLoss {
        self.loss
    }
    fn residuals(&self, state: &State, rows: Range<usize>, out: &mut [f64]) {
        let seen = rows.end.min(self.measured()).saturating_sub(rows.start);
        let (out, priors) = out.split_at_mut(seen);
        let first = rows.start.saturating_sub(self.measured());
        for (number, out) in priors.iter_mut().enumerate() {
            let rotation = first + number + 1;
            let off = |given: f64| state.angles.get(rotation).copied().unwrap_or(0.0) - given;
            let given = self.angles.given_rad.get(rotation).copied().flatten();
            *out = given.map_or(0.0, |given| off(given) / self.angles.sigma_rad * self.sigma_px);
        }
        let mut out = out.iter_mut();
        for (number, sighting) in self.sightings.iter().enumerate() {
            let (begin, end) = (self.offsets[number], self.offsets[number + 1]);
            if end <= rows.start || begin >= rows.end.min(self.measured()) {
                continue;
            }
            let wanted = rows.start.max(begin) - begin..rows.end.min(end) - begin;
            let errors = state.errors(sighting);
            let all = errors.iter().flat_map(|error| error.unwrap_or([f64::NAN; 2]));
            // The errors first: at their end zip has then taken nothing from `out`.
            for (error, out) in all.skip(wanted.start).take(wanted.len()).zip(out.by_ref()) {
                *out = error;
            }
        }
    }
    fn moved(&self, state: &State, step: &[f64]) -> State {
        let mut moved = state.clone();
        let (lens_step, rest) = step.split_at(self.lens());
        let (joint, rest) = rest.split_at(JOINT);
        let (angles, boards) = rest.split_at(self.counts[0] - 1);
        for (place, amount) in lens_step.iter().enumerate() {
            lens::add(&mut moved.camera, self.model, place, *amount);
        }
        let [u, v] = across(&state.oblique.axis);
        let turn = UnitQuaternion::from_scaled_axis(joint[0] * u + joint[1] * v);
        let axis = Unit::new_normalize(turn * state.oblique.axis.into_inner());
        let point = state.oblique.point_mm + joint[2] * u + joint[3] * v;
        moved.oblique = Oblique {
            axis,
            point_mm: point - axis.into_inner() * axis.dot(&point),
            center: Pixel {
                x: state.oblique.center.x + joint[4],
                y: state.oblique.center.y + joint[5],
            },
        };
        for (angle, amount) in moved.angles.iter_mut().skip(1).zip(angles) {
            *angle += amount;
        }
        for (board, step) in moved.boards.iter_mut().zip(boards.chunks_exact(6)) {
            if step.iter().any(|v| *v != 0.0) {
                *board = board.perturbed_right(&Vector6::from_column_slice(step));
            }
        }
        moved
    }
    fn support(&self, direction: usize) -> Vec<Range<usize>> {
        let rows = |wanted: &dyn Fn(&Sighting) -> bool| -> Vec<Range<usize>> {
            (self.sightings.iter().enumerate())
                .filter(|(_, sighting)| wanted(sighting))
                .map(|(number, _)| self.offsets[number]..self.offsets[number + 1])
                .collect()
        };
        if let Some(board) = direction.checked_sub(self.shared()) {
            return rows(&|sighting| sighting.station == board / 6);
        }
        match direction.checked_sub(self.lens() + JOINT) {
            Some(angle) => {
                let mut rows = rows(&|sighting| sighting.rotation == angle + 1);
                rows.push(self.measured() + angle..self.measured() + angle + 1);
                rows
            }
            None => std::iter::once(0..self.measured()).collect(),
        }
    }
    fn small_step(&self, direction: usize) -> f64 {
        let joint = self.lens();
        if direction < joint {
            return if direction < 4 { 5e-6 * self.scale } else { 5e-6 };
        }
        match direction - joint {
            0 | 1 => 5e-6,
            2 | 3 => 3e-4,
            4 | 5 => 5e-6 * self.scale,
            _ => match direction.checked_sub(self.shared()) {
                Some(board) if board % 6 < 3 => 3e-4,
                _ => 5e-6,
            },
        }
    }
}
