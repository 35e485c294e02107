//! Hand-eye without a board: any still scene will do, if the arm's own motion makes its tracks fit together.
//!
//! Two views i and j of a scene point bind the camera's motion between them by x_jᵀ·E·x_i = 0, E = [t]×·R (Longuet-Higgins 1981). The
//! motion is (H_j·X·C_j)⁻¹·(H_i·X·C_i), all of it told by the arm but X and the arm's errors C: so X is what makes Sampson's distances
//! (Sampson 1982; Hartley and Zisserman 2004, eq. 11.9) least, with the metre given by the arm (compare Andreff, Horaud and Espiau 2001,
//! who go by way of a structure from motion and its unknown scale). No point of the scene has to be reconstructed.
//!
//! The first X is searched ([`epipolar_search`](super::epipolar_search)), the best answers are refined.

use std::ops::Range;

use nalgebra::{DMatrix, Matrix6, Vector6};
use rayon::prelude::*;

use crate::calibration::hand_eye::epipolar_search::REACH_MM;
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::reprojection::shifted;
use crate::calibration::hand_eye::view_pairs::{ViewPair, essential, sampson};
use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{self, Problem, Solution, minimize};
use crate::solver::robust_loss::RobustLoss;

/// Of the answers begun with, so many are tried with errors of the arm.
const TRIED_IN_FULL: usize = 6;

/// What is known before.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Whether the arm's clock may differ from the camera's.
    pub time_offset: bool,
    /// First guess of how far the arm's pose is off along an axis, mm.
    pub place_sigma_mm: f64,
    /// The same of its rotation, rad.
    pub turn_sigma_rad: f64,
    /// First guess of the deviation of Sampson's distance, px.
    pub pixel_sigma: f64,
    /// Rounds of finding these deviations.
    pub rounds: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            time_offset: false,
            place_sigma_mm: 0.3,
            turn_sigma_rad: 0.0015,
            pixel_sigma: 0.3,
            rounds: 12,
        }
    }
}

/// The answer, with its errors.
#[derive(Clone, Debug)]
pub struct FromScene {
    /// X.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// Of X: a shift of the camera's centre in the hand's space (mm), then a rotation vector in the hand's space (rad).
    pub covariance: Matrix6<f64>,
    /// To be added to the arm's stamps, s, and its deviation; zero if not sought.
    pub time_offset_s: [f64; 2],
    /// Per view, what the arm told wrongly of the camera: shift (mm) and rotation vector (rad) in the camera's space.
    pub corrections: Vec<Vector6<f64>>,
    /// Deviations found: of the camera's place as the arm tells it along an axis (mm), of its rotation about an axis (rad), of Sampson's
    /// distance (px).
    pub sigmas: [f64; 3],
    /// Root mean square of Sampson's distances of tracks that fit, with corrections, px.
    pub rms_px: f64,
    /// Per view, the same of all its pairs without them: what the arm alone leaves, px; NaN for a view without pairs.
    pub predicted_px: Vec<f64>,
}

/// What is known of a time offset before, s.
const TIME_OFFSET_SIGMA_S: f64 = 0.2;
/// Deviations never fall below these, mm, rad, px.
const LEAST_SIGMAS: [f64; 3] = [1e-3, 1e-6, 1e-3];
/// A distance counts in full up to so many deviations.
const WIDTH: f64 = 2.5;
/// Directions of X.
const POSE: usize = 6;
/// The deviations found no longer move by more than this share.
const SETTLED: f64 = 0.02;

/// Refine the best of some first answers. `None` where none leads anywhere or the views do not determine the answer.
pub fn refine(
    pairs: &[ViewPair],
    views: usize,
    hands: &dyn HandPoses,
    camera: &CameraModel,
    starts: &[Transform<Hand, Camera>],
    settings: &Settings,
) -> Option<FromScene> {
    let mut first = vec![0];
    for pair in pairs {
        first.push(first.last()? + pair.rays.len());
    }
    let mut of_view = vec![Vec::new(); views];
    for (number, pair) in pairs.iter().enumerate() {
        for view in [pair.first, pair.second] {
            of_view.get_mut(view)?.push(number);
        }
    }
    let focal_px = 0.5 * (camera.intrinsics.fx + camera.intrinsics.fy);
    let mut problem = Epipolar {
        pairs,
        views,
        hands,
        focal_px,
        first: &first,
        of_view: &of_view,
        time_offset: settings.time_offset,
        corrected: false,
        sigmas: [settings.place_sigma_mm, settings.turn_sigma_rad, 10.0 * settings.pixel_sigma],
    };
    // The arm's errors are not given room before the answer is near.
    let rough = least_squares::Settings {
        max_iterations: 40,
        least_gain: 1e-6,
    };
    let begun = (starts.par_iter()).filter_map(|&x| minimize(&problem, problem.begun(x), &rough));
    let mut begun: Vec<Solution<State>> = begun.collect();
    begun.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    // Many starts end at one answer.
    begun.dedup_by(|a, b| (a.cost / b.cost).ln().abs() < 1e-3);
    problem.corrected = true;
    problem.sigmas[2] = settings.pixel_sigma;
    let few = least_squares::Settings {
        max_iterations: 8,
        least_gain: 1e-8,
    };
    let tried = (begun.into_par_iter().take(TRIED_IN_FULL)).filter_map(|begun| minimize(&problem, begun.state, &few));
    let mut solution = tried.min_by(|a, b| a.cost.total_cmp(&b.cost))?;
    for _ in 0..settings.rounds {
        let before = problem.sigmas;
        problem.learn_deviations(&solution)?;
        solution = minimize(&problem, solution.state, &few)?;
        let moved = before
            .iter()
            .zip(problem.sigmas)
            .map(|(a, b): (&f64, f64)| (a / b).ln().abs());
        if moved.fold(0.0, f64::max) < SETTLED {
            break;
        }
    }
    let solution = minimize(&problem, solution.state, &least_squares::Settings::default())?;
    problem.answer(&solution)
}

#[derive(Clone, Debug)]
struct State {
    told: Vec<Option<Transform<RobotBase, Hand>>>,
    hand_from_camera: Transform<Hand, Camera>,
    time_offset_s: f64,
    corrections: Vec<Vector6<f64>>,
}

struct Epipolar<'a> {
    pairs: &'a [ViewPair],
    views: usize,
    hands: &'a dyn HandPoses,
    focal_px: f64,
    /// First residual of each pair, and one past the last.
    first: &'a [usize],
    /// Pairs that a view is part of.
    of_view: &'a [Vec<usize>],
    time_offset: bool,
    corrected: bool,
    /// Place mm, turn rad, distance px.
    sigmas: [f64; 3],
}

impl Epipolar<'_> {
    fn told(&self, offset_s: f64) -> Vec<Option<Transform<RobotBase, Hand>>> {
        let offsets = vec![0.0; self.hands.joints()];
        (0..self.views)
            .map(|view| self.hands.base_from_hand(view, offset_s, &offsets))
            .collect()
    }

    fn begun(&self, hand_from_camera: Transform<Hand, Camera>) -> State {
        State {
            told: self.told(0.0),
            hand_from_camera,
            time_offset_s: 0.0,
            corrections: vec![Vector6::zeros(); self.views],
        }
    }

    fn common(&self) -> usize {
        POSE + usize::from(self.time_offset)
    }

    fn corrections(&self) -> usize {
        if self.corrected { 6 * self.views } else { 0 }
    }

    fn eye(&self, state: &State, view: usize) -> Option<Transform<RobotBase, Camera>> {
        let told = state.told.get(view).copied()??;
        let correction: Transform<Camera, Camera> = shifted(&Transform::identity(), state.corrections[view].as_slice());
        Some(told * state.hand_from_camera * correction)
    }

    fn learn_deviations(&mut self, solution: &Solution<State>) -> Option<()> {
        let covariance = solution.covariance.as_ref()?;
        let (mut place, mut turn, mut held) = (0.0, 0.0, 0.0);
        for (view, correction) in solution.state.corrections.iter().enumerate() {
            for axis in 0..6 {
                let at = self.common() + 6 * view + axis;
                let doubt = covariance[(at, at)];
                let square = correction[axis] * correction[axis] + doubt;
                *(if axis < 3 { &mut place } else { &mut turn }) += square;
                held += doubt / self.sigmas[usize::from(axis >= 3)].powi(2);
            }
        }
        let count = 3.0 * self.views as f64;
        let unknowns = (self.common() + 6 * self.views) as f64 - held;
        let (mut rest, mut heard) = (0.0, 0.0);
        for (row, (weight, residual)) in solution.weights.iter().zip(solution.residuals.iter()).enumerate() {
            rest += weight * residual * residual;
            heard += weight * self.share(row);
        }
        let [old_place, old_turn, old_px] = self.sigmas;
        // Views without pairs tell nothing new: their doubt is the prior itself, which leaves the deviations as they are.
        self.sigmas = [
            (place / count).sqrt().max(LEAST_SIGMAS[0]).min(3.0 * old_place),
            (turn / count).sqrt().max(LEAST_SIGMAS[1]).min(3.0 * old_turn),
            (old_px * (rest / (heard - unknowns).max(1.0)).sqrt()).max(LEAST_SIGMAS[2]),
        ];
        Some(())
    }

    fn share(&self, row: usize) -> f64 {
        let pair = self.first.partition_point(|&first| first <= row).saturating_sub(1);
        self.pairs[pair].shares[row - self.first[pair]]
    }

    fn answer(&self, solution: &Solution<State>) -> Option<FromScene> {
        let covariance: &DMatrix<f64> = solution.covariance.as_ref()?;
        let state = &solution.state;
        let (mut sum, mut heard) = (0.0, 0.0);
        for (row, (weight, residual)) in solution.weights.iter().zip(solution.residuals.iter()).enumerate() {
            sum += weight * residual * residual;
            heard += weight * self.share(row);
        }
        let without = State {
            corrections: vec![Vector6::zeros(); self.views],
            ..state.clone()
        };
        let predicted_px = (0..self.views)
            .map(|view| {
                let mut squares: Vec<f64> = (self.of_view[view].iter())
                    .flat_map(|&pair| self.distances(&without, pair))
                    .map(|distance| distance * distance)
                    .collect();
                squares.sort_by(f64::total_cmp);
                // Tracks of what moves by itself are not the arm's fault.
                squares.truncate(squares.len() - squares.len() / 10);
                (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
            })
            .collect();
        Some(FromScene {
            hand_from_camera: state.hand_from_camera,
            covariance: covariance.fixed_view::<6, 6>(0, 0).into_owned(),
            time_offset_s: if self.time_offset {
                [state.time_offset_s, covariance[(POSE, POSE)].sqrt()]
            } else {
                [0.0; 2]
            },
            corrections: state.corrections.clone(),
            sigmas: self.sigmas,
            rms_px: self.sigmas[2] * (sum / heard.max(1e-12)).sqrt(),
            predicted_px,
        })
    }

    /// Sampson's distances of a pair, px; NaN where the arm does not say.
    fn distances(&self, state: &State, pair: usize) -> Vec<f64> {
        let pair = &self.pairs[pair];
        let motion = self
            .eye(state, pair.second)
            .zip(self.eye(state, pair.first))
            .map(|(second, first)| essential(&(second.inverse() * first)));
        (pair.rays.iter())
            .map(|rays| motion.map_or(f64::NAN, |motion| self.focal_px * sampson(&motion, rays)))
            .collect()
    }
}

impl Problem for Epipolar<'_> {
    type State = State;

    fn directions(&self) -> usize {
        self.common() + self.corrections()
    }

    fn measured(&self) -> usize {
        self.first[self.pairs.len()]
    }

    fn block(&self) -> usize {
        1
    }

    fn priors(&self) -> usize {
        self.corrections() + usize::from(self.time_offset) + 3
    }

    fn loss(&self) -> RobustLoss {
        RobustLoss::Cauchy { width: WIDTH }
    }

    fn residuals(&self, state: &State, rows: Range<usize>, out: &mut [f64]) {
        let measured = self.measured();
        let mut row = rows.start;
        while row < rows.end.min(measured) {
            let pair = self.first.partition_point(|&first| first <= row) - 1;
            let skipped = row - self.first[pair];
            let distances = self.distances(state, pair);
            let wanted = distances.iter().zip(&self.pairs[pair].shares).skip(skipped);
            for (distance, share) in wanted.take(rows.end.min(measured) - row) {
                out[row - rows.start] = share.sqrt() * distance / self.sigmas[2];
                row += 1;
            }
        }
        for row in row..rows.end {
            let prior = row - measured;
            out[row - rows.start] = if prior < self.corrections() {
                let (view, axis) = (prior / 6, prior % 6);
                state.corrections[view][axis] / self.sigmas[usize::from(axis >= 3)]
            } else if prior < self.corrections() + 3 {
                state.hand_from_camera.translation()[prior - self.corrections()] / REACH_MM
            } else {
                state.time_offset_s / TIME_OFFSET_SIGMA_S
            };
        }
    }

    fn moved(&self, state: &State, step: &[f64]) -> State {
        let common = self.common();
        let late = step[POSE..common].first().copied().unwrap_or(0.0);
        let time_offset_s = state.time_offset_s + late;
        let mut corrections = state.corrections.clone();
        for (correction, step) in corrections.iter_mut().zip(step[common..].chunks(6)) {
            *correction += Vector6::from_column_slice(step);
        }
        State {
            told: if late == 0.0 {
                state.told.clone()
            } else {
                self.told(time_offset_s)
            },
            hand_from_camera: shifted(&state.hand_from_camera, &step[..POSE]),
            time_offset_s,
            corrections,
        }
    }

    fn support(&self, direction: usize) -> Vec<Range<usize>> {
        let (measured, common) = (self.measured(), self.common());
        match direction.checked_sub(common) {
            Some(correction) => {
                let view = correction / 6;
                let mut rows: Vec<Range<usize>> = (self.of_view[view].iter())
                    .map(|&pair| self.first[pair]..self.first[pair + 1])
                    .collect();
                rows.push(measured + correction..measured + correction + 1);
                rows
            }
            None if direction == POSE => {
                let own = measured + self.corrections() + 3;
                vec![0..measured, own..own + 1]
            }
            None if direction < 3 => {
                let own = measured + self.corrections() + direction;
                vec![0..measured, own..own + 1]
            }
            None => vec![0..measured],
        }
    }

    fn small_step(&self, direction: usize) -> f64 {
        // Samples of the arm lie milliseconds apart; a shift of a micrometre is nothing to a baseline of millimetres.
        if self.time_offset && direction == POSE { 1e-4 } else { 1e-5 }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibration::hand_eye::epipolar_search::search;
    use crate::calibration::hand_eye::example::{Example, Noise, camera};
    use crate::calibration::hand_eye::feature_tracks::FeatureTrack;
    use crate::calibration::hand_eye::view_pairs::pairs;
    use crate::camera::intrinsics::Pixel;
    use crate::geometry::point::Point;
    use crate::geometry::space::Board;

    const PIXEL_SIGMA: f64 = 0.1;

    /// Stations over a bumpy scene of which each place is seen in five views one after the other; the arm's noise is in `noise`.
    fn seen(seed: u64, count: usize, noise: Noise) -> (Example, Vec<FeatureTrack>) {
        let example = Example::new(seed, count, noise);
        let exact = Example::new(seed, count, Noise::NONE);
        let mut random = ChaCha8Rng::seed_from_u64(seed ^ 0xE919);
        let mut tracks = Vec::new();
        for begin in 0..count.saturating_sub(4) {
            for _ in 0..14 {
                let mut draw = |size: f64| size * random.sample::<f64, _>(StandardNormal);
                let place: Point<Board> = Point::new(16.0 + draw(12.0), 10.0 + draw(8.0), draw(4.0));
                let places = (begin..begin + 5).filter_map(|view| {
                    let pixel = camera().project(exact.stations[view].camera_from_board * place)?;
                    let pixel = Pixel {
                        x: pixel.x + draw(PIXEL_SIGMA),
                        y: pixel.y + draw(PIXEL_SIGMA),
                    };
                    let inside = (0.0..960.0).contains(&pixel.x) && (0.0..540.0).contains(&pixel.y);
                    inside.then_some((view, pixel))
                });
                tracks.push(FeatureTrack {
                    places: places.collect(),
                });
            }
        }
        tracks.retain(|track| track.places.len() > 1);
        (example, tracks)
    }

    fn hands(example: &Example) -> Vec<Transform<RobotBase, Hand>> {
        example.stations.iter().map(|station| station.base_from_hand).collect()
    }

    fn found(example: &Example, tracks: &[FeatureTrack]) -> FromScene {
        let (pairs, hands) = (pairs(tracks, &camera()), hands(example));
        let starts = search(&pairs, &hands);
        refine(&pairs, hands.len(), &hands, &camera(), &starts, &Settings::default()).unwrap()
    }

    #[test]
    fn nothing_need_be_known_of_the_answer_to_find_it() {
        for seed in 0..4 {
            let (example, tracks) = seen(seed, 24, Noise::NONE);
            let found = found(&example, &tracks);
            let [mm, rad] = example.error_of(&found.hand_from_camera);
            // Tracks of 0.1 px at 100 mm and 800 px: 0.013 mm a place, some hundred places a view.
            assert!(mm < 0.2 && rad.to_degrees() < 0.05, "{seed}: {mm} mm, {}°", rad.to_degrees());
        }
    }

    #[test]
    fn the_truth_lies_within_the_stated_deviations_of_a_noisy_arm() {
        let runs = 16;
        let (mut inside, mut square) = (0, 0.0);
        for seed in 0..runs {
            let noise = Noise {
                place_mm: 0.1,
                turn_rad: 0.0005,
                ..Noise::NONE
            };
            let (example, tracks) = seen(50 + seed, 24, noise);
            let found = found(&example, &tracks);
            let (truth, told) = (example.hand_from_camera, found.hand_from_camera);
            let turn = (truth.rotation() * told.rotation().inverse()).scaled_axis();
            let shift = truth.translation() - told.translation();
            let error = Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z);
            inside += u32::from((0..6).all(|i| error[i].abs() < 3.0 * found.covariance[(i, i)].sqrt()));
            square += error.dot(&(found.covariance.try_inverse().unwrap() * error));
        }
        // χ² of six: its mean over the runs is 6 ± 4·√(12/runs); the deviations are found from 24 views, which adds a fourth part.
        let mean = square / runs as f64;
        assert!(mean < 7.5 + 4.0 * (12.0 / runs as f64).sqrt(), "{mean}");
        assert!(inside >= 15, "{inside} of {runs}");
    }

    #[test]
    fn tracks_that_move_by_themselves_are_borne() {
        let (example, mut tracks) = seen(3, 24, Noise::NONE);
        let mut random = ChaCha8Rng::seed_from_u64(5);
        for track in tracks.iter_mut().step_by(8) {
            for (_, pixel) in &mut track.places {
                pixel.x += 15.0 * random.sample::<f64, _>(StandardNormal);
                pixel.y += 15.0 * random.sample::<f64, _>(StandardNormal);
            }
        }
        let found = found(&example, &tracks);
        let [mm, rad] = example.error_of(&found.hand_from_camera);
        assert!(mm < 0.4 && rad.to_degrees() < 0.1, "{mm} mm, {}°", rad.to_degrees());
    }
}
