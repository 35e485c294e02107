//! The camera's path laid over the arm's readings: a robust least-squares fit of clock, similarity and hand-eye transform.

use nalgebra::{Isometry3, SMatrix, SVector, UnitQuaternion, Vector3, Vector6};

use crate::calibration::time_offset::camera_path::CameraPath;
use crate::geometry::alignment::{PosePair, Scale, Similarity};
use crate::robot::trajectory::TimedPose;
use crate::time::{Span, Timestamp};

/// τ (ms), G (rotation, translation, logarithm of the scale), X (rotation, translation).
pub(super) const UNKNOWNS: usize = 14;
/// Of the coarse search, ms.
pub(super) const COARSE_MS: f64 = 10.0;
/// How well the hand-eye transform is known at least, mm and rad.
const HAND_EYE_MM: f64 = 2.0;
const HAND_EYE_RAD: f64 = 0.009;
/// Weights of mm against rad in the first alignment only: noise of a typical arm.
const FIRST_MM: f64 = 0.3;
const FIRST_RAD: f64 = 0.0015;
/// Squared residual of a reading (χ² of 6) at which its weight has halved.
const HALF_WEIGHT: f64 = 25.0;
const ROUNDS: usize = 25;
const COARSE_ROUNDS: usize = 3;
const COARSE_READINGS: usize = 200;
/// Fewer readings than this tell nothing.
pub(super) const FEWEST_READINGS: usize = 24;
/// Looked at for the derivative by τ, ms.
const NEAR_MS: f64 = 2.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OffsetIs {
    Held,
    Sought,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    pub(super) offset_ms: f64,
    pub(super) gauge: Similarity,
    pub(super) hand_from_camera: Isometry3<f64>,
}

impl State {
    fn moved(&self, step: &SVector<f64, UNKNOWNS>) -> Self {
        let three = |from: usize| Vector3::new(step[from], step[from + 1], step[from + 2]);
        let turned = |by: Vector3<f64>, rotation: UnitQuaternion<f64>| UnitQuaternion::from_scaled_axis(by) * rotation;
        Self {
            offset_ms: self.offset_ms + step[0],
            gauge: Similarity {
                rotation: turned(three(1), self.gauge.rotation),
                translation: self.gauge.translation + three(4),
                scale: self.gauge.scale * step[7].clamp(-1.0, 1.0).exp(),
            },
            hand_from_camera: Isometry3::from_parts(
                (self.hand_from_camera.translation.vector + three(11)).into(),
                turned(three(8), self.hand_from_camera.rotation),
            ),
        }
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    pub(super) state: State,
    /// Of a reading per axis, mm and rad.
    pub(super) noise: [f64; 2],
    /// Mean logarithm of the residuals' variances, summed over the six axes.
    pub(super) mean_log_noise: f64,
    pub(super) count: usize,
}

pub(super) struct Matching<'a> {
    pub(super) path: &'a CameraPath,
    pub(super) arm: &'a [TimedPose],
    pub(super) hand_from_camera: Isometry3<f64>,
}

/// The normal equations and what they were made of.
pub(super) struct Normal {
    pub(super) matrix: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    pub(super) side: SVector<f64, UNKNOWNS>,
    pub(super) readings: Vec<Heard>,
}

/// A reading in the normal equations.
pub(super) struct Heard {
    pub(super) at: Timestamp,
    /// In deviations.
    pub(super) residual: Vector6<f64>,
    /// Times its weight.
    pub(super) slopes: SMatrix<f64, 6, UNKNOWNS>,
}

impl Matching<'_> {
    /// Readings at which the camera's path is known, with room for the derivative.
    pub(super) fn readings(&self, offset_ms: f64) -> impl Iterator<Item = &TimedPose> {
        let at = move |reading: &TimedPose, ms: f64| reading.stamp + Span::from_milliseconds(offset_ms + ms);
        let poses = self.path.poses();
        let ends = poses.first().zip(poses.last()).map(|(first, last)| (first.at, last.at));
        let inside = move |instant: Timestamp| ends.is_some_and(|(first, last)| instant >= first && instant <= last);
        // The path's end pieces are bent by what is beyond them; a step inside is enough room for the search as well.
        (self.arm.iter()).filter(move |reading| inside(at(reading, -NEAR_MS)) && inside(at(reading, NEAR_MS)))
    }

    pub(super) fn fitted(&self, offset_ms: f64, offset_is: OffsetIs) -> Option<Fit> {
        // The coarse search looks at some of the readings only, and need not settle.
        let (every, rounds) = match offset_is {
            OffsetIs::Held => (self.arm.len().div_ceil(COARSE_READINGS).max(1), COARSE_ROUNDS),
            OffsetIs::Sought => (1, ROUNDS),
        };
        let used: Vec<TimedPose> = (self.readings(offset_ms))
            .step_by(every)
            .copied()
            .filter(|reading| self.path.at(reading.stamp + Span::from_milliseconds(offset_ms)).is_some())
            .collect();
        if used.len() < FEWEST_READINGS {
            return None;
        }
        let pairs: Vec<PosePair> = (used.iter())
            .filter_map(|reading| {
                let camera = self.path.at(reading.stamp + Span::from_milliseconds(offset_ms))?;
                Some(PosePair {
                    fixed: reading.base_from_hand.isometry() * self.hand_from_camera,
                    moving: *camera.isometry(),
                    per_mm2: FIRST_MM.powi(-2),
                    per_rad2: FIRST_RAD.powi(-2),
                })
            })
            .collect();
        let mut state = State {
            offset_ms,
            gauge: Similarity::between(&pairs, Scale::Free)?,
            hand_from_camera: self.hand_from_camera,
        };
        let mut noise = self.noise(&state, &used)?;
        for _ in 0..rounds {
            let mut normal = self.normal(&state, &used, noise);
            if offset_is == OffsetIs::Held {
                normal.matrix.row_mut(0).fill(0.0);
                normal.matrix.column_mut(0).fill(0.0);
                normal.matrix[(0, 0)] = 1.0;
                normal.side[0] = 0.0;
            }
            let mut step = -normal.matrix.cholesky()?.solve(&normal.side);
            if !step.iter().all(|s| s.is_finite()) || step[0].abs() > 500.0 {
                return None;
            }
            step[0] = step[0].clamp(-COARSE_MS, COARSE_MS);
            state = state.moved(&step);
            let before = noise;
            noise = self.noise(&state, &used)?;
            let settled = step[0].abs() < 1e-3 && (noise[0] / before[0]).ln().abs() + (noise[1] / before[1]).ln().abs() < 1e-4;
            if settled {
                break;
            }
        }
        let residuals: Vec<Vector6<f64>> = used.iter().filter_map(|reading| self.residual(&state, reading)).collect();
        Some(Fit {
            state,
            noise,
            mean_log_noise: mean_log_noise(&residuals),
            count: residuals.len(),
        })
    }

    /// Of a reading: place (mm) and turn (rad) in the hand's axes, as they should be less as they are read.
    pub(super) fn residual(&self, state: &State, reading: &TimedPose) -> Option<Vector6<f64>> {
        let camera = self.path.at(reading.stamp + Span::from_milliseconds(state.offset_ms))?;
        let hand = state.gauge.moved(camera.isometry()) * state.hand_from_camera.inverse();
        let read = reading.base_from_hand.isometry();
        let inverse = read.rotation.inverse();
        let place = inverse * (hand.translation.vector - read.translation.vector);
        let turn = (inverse * hand.rotation).scaled_axis();
        Some(Vector6::new(place.x, place.y, place.z, turn.x, turn.y, turn.z))
    }

    /// Robust deviations of a reading, mm and rad: 1.4826 times the median size of a Gaussian's residuals.
    fn noise(&self, state: &State, used: &[TimedPose]) -> Option<[f64; 2]> {
        let mut sizes = [Vec::new(), Vec::new()];
        for residual in used.iter().filter_map(|reading| self.residual(state, reading)) {
            for (axis, value) in residual.iter().enumerate() {
                sizes[axis / 3].push(value.abs());
            }
        }
        let [mm, rad] = sizes.map(|mut sizes| {
            sizes.sort_by(f64::total_cmp);
            sizes.get(sizes.len() / 2).copied()
        });
        Some([(1.4826 * mm?).max(1e-4), (1.4826 * rad?).max(1e-6)])
    }

    pub(super) fn normal(&self, state: &State, used: &[TimedPose], noise: [f64; 2]) -> Normal {
        let steps: [f64; UNKNOWNS] = [
            NEAR_MS, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2,
        ];
        let near: Vec<[State; 2]> = (0..UNKNOWNS)
            .map(|unknown| {
                [1.0, -1.0].map(|sign| {
                    let mut step = SVector::<f64, UNKNOWNS>::zeros();
                    step[unknown] = sign * steps[unknown];
                    state.moved(&step)
                })
            })
            .collect();
        let mut normal = Normal {
            matrix: SMatrix::zeros(),
            side: SVector::zeros(),
            readings: Vec::with_capacity(used.len()),
        };
        let whitening = Vector6::from_fn(|axis, _| 1.0 / noise[axis / 3]);
        for reading in used {
            let Some(residual) = self.residual(state, reading) else {
                continue;
            };
            let residual = residual.component_mul(&whitening);
            let mut slopes = SMatrix::<f64, 6, UNKNOWNS>::zeros();
            for (unknown, [plus, minus]) in near.iter().enumerate() {
                if let (Some(plus), Some(minus)) = (self.residual(plus, reading), self.residual(minus, reading)) {
                    slopes.set_column(unknown, &((plus - minus).component_mul(&whitening) / (2.0 * steps[unknown])));
                }
            }
            let weight = 1.0 / (1.0 + residual.norm_squared() / HALF_WEIGHT);
            normal.matrix += weight * slopes.transpose() * slopes;
            normal.side += weight * slopes.transpose() * residual;
            normal.readings.push(Heard {
                at: reading.stamp,
                residual,
                slopes: slopes * weight,
            });
        }
        // What is known of the hand-eye transform.
        let turned = (state.hand_from_camera.rotation * self.hand_from_camera.rotation.inverse()).scaled_axis();
        let moved = state.hand_from_camera.translation.vector - self.hand_from_camera.translation.vector;
        for axis in 0..3 {
            for (unknown, value, sigma) in [(8 + axis, turned[axis], HAND_EYE_RAD), (11 + axis, moved[axis], HAND_EYE_MM)] {
                normal.matrix[(unknown, unknown)] += sigma.powi(-2);
                normal.side[unknown] += value * sigma.powi(-2);
            }
        }
        normal
    }
}

/// Mean logarithm of the variances of place and turn, three axes each, without the worst tenth.
fn mean_log_noise(residuals: &[Vector6<f64>]) -> f64 {
    [0, 3]
        .map(|first| {
            let mut squares: Vec<f64> = residuals.iter().map(|r| r.fixed_rows::<3>(first).norm_squared()).collect();
            squares.sort_by(f64::total_cmp);
            squares.truncate((squares.len() - squares.len() / 10).max(1));
            3.0 * (squares.iter().sum::<f64>() / squares.len() as f64).max(1e-18).ln()
        })
        .iter()
        .sum()
}
