//! X, Z and what else is unknown, where the board is seen again.
//!
//! Made least is Σ ρ(‖π((H_v(δ, q)·X·Cᵥ)⁻¹·Z·P) − u‖²/σ²) over corners P of views v, with the hand's pose H_v of view v at a time offset δ
//! and joint offsets q, and a small correction C_v of where that puts the camera. Corrections have a prior whose deviations are found from the data: the mean
//! squares of what the corrections are and of what they might be besides (expectation–maximization: Dempster, Laird and Rubin 1977).
//! First with heavy tails, so that a view whose hand was somewhere else is heard less (Student's t: Lange, Little and Taylor 1989); then
//! views far beyond the others are no longer heard at all and the rest counts in full, as normal errors should.
//!
//! Pose errors and reprojection errors as objectives are compared by Tabb and Ahmad Yousef 2017 and by Ali et al. 2019; with the arm's
//! errors as unknowns of their own the reprojection keeps the meaning that its covariance needs.

use nalgebra::{DMatrix, Matrix6, Vector6};

use crate::calibration::hand_eye::camera_prior::CameraPrior;
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::reprojection::{POSES, Reprojection, Sighting, State, told};
use crate::calibration::hand_eye::spread::{LEAST_SIGMAS, Spread};
use crate::camera::model::CameraModel;
use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{self, Problem as _, Solution, minimize};

/// What is sought besides X and Z, and what is known of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Whether the arm's clock may differ from the camera's.
    pub time_offset: bool,
    /// Prior deviation of each joint's offset (mm or rad); none: joints are right.
    pub joint_sigma: Vec<f64>,
    /// How far the camera's numbers may be off; none: it is right.
    pub camera_prior: Option<CameraPrior>,
    /// First guess of how far the camera is from where the arm puts it, along an axis, mm.
    pub place_sigma_mm: f64,
    /// The same of its rotation about an axis, rad.
    pub turn_sigma_rad: f64,
    /// First guess of a corner's deviation along an axis, px.
    pub pixel_sigma: f64,
    /// Rounds of finding the deviations; with none the guesses hold.
    pub rounds: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            time_offset: false,
            joint_sigma: Vec::new(),
            camera_prior: None,
            place_sigma_mm: 0.5,
            turn_sigma_rad: 0.003,
            pixel_sigma: 0.3,
            rounds: 25,
        }
    }
}

/// Degrees of freedom of Student's t: few enough that a wrong view is let go, enough that right ones count nearly in full.
const TAIL: f64 = 5.0;
/// A view is an outlier when the square of its correction, in deviations that the middle view tells, is above this: of six normal numbers
/// that happens once in two million, and still once in a thousand when ten views tell the deviations too small by 1.4.
const DISTANT: f64 = 40.0;
/// Median of χ² of three degrees of freedom: the middle view's squared shift, or turn, in variances along an axis.
const MIDDLE: f64 = 2.366;
/// Weight of an outlier's prior: its correction is free, so that it tells nothing of X and Z.
const UNHEARD: f64 = 1e-6;
/// The deviations found no longer move by more than this share.
const SETTLED: f64 = 0.01;

/// The answer, with its errors.
#[derive(Clone, Debug)]
pub struct Refined {
    /// X.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// Of X: a shift of the camera's centre in the hand's space (mm), then a rotation vector in the hand's space (rad).
    pub covariance: Matrix6<f64>,
    /// Z.
    pub base_from_board: Transform<RobotBase, Board>,
    /// Of Z, likewise in the base's space.
    pub board_covariance: Matrix6<f64>,
    /// To be added to the arm's stamps, s, and its deviation; zero if not sought.
    pub time_offset_s: [f64; 2],
    /// Per joint: offset to be added to its reading, and its deviation, mm or rad.
    pub joint_offsets: Vec<[f64; 2]>,
    /// As given, or as adjusted.
    pub camera: CameraModel,
    /// Of its numbers, if they were adjusted, in the order of their prior.
    pub camera_covariance: Option<DMatrix<f64>>,
    /// Per view, what the arm told wrongly of the camera: shift (mm) and rotation vector (rad) in the camera's space.
    pub corrections: Vec<Vector6<f64>>,
    /// Per view, whether its hand was elsewhere than the arm said: such a view is not heard.
    pub outlier: Vec<bool>,
    /// Per view, the square of its correction in deviations that the middle view tells: about 6 for one like the others.
    pub distance: Vec<f64>,
    /// Deviations found: of the camera's place as the arm tells it along an axis (mm), of its rotation about an axis (rad), of a corner along
    /// an axis (px).
    pub sigmas: [f64; 3],
    /// Root mean square of the residual vectors with the corrections, px.
    pub rms_px: f64,
    /// Per view, the same without them: what the arm alone predicts, px.
    pub predicted_px: Vec<f64>,
}

/// Refine from a first answer. `None` where a corner cannot be seen from there, or the views do not determine the answer.
pub fn refine(
    views: &[Vec<Sighting>],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    (hand_from_camera, base_from_board): (Transform<Hand, Camera>, Transform<RobotBase, Board>),
    settings: &Settings,
) -> Option<Refined> {
    let mut first = vec![0];
    for view in views {
        first.push(first.last()? + 2 * view.len());
    }
    let joints = hands.joints().min(settings.joint_sigma.len());
    let state = State {
        told: told(hands, views.len(), 0.0, &vec![0.0; joints]),
        hand_from_camera,
        base_from_board,
        time_offset_s: 0.0,
        joints: vec![0.0; joints],
        camera: (settings.camera_prior.as_ref()).map_or_else(|| camera.clone(), |prior| prior.begun(camera)),
        corrections: vec![Vector6::zeros(); views.len()],
    };
    let mut view_problem = Reprojection {
        views,
        hands,
        camera,
        camera_prior: settings.camera_prior.as_ref(),
        first: &first,
        joint_sigma: &settings.joint_sigma[..joints],
        time_offset: settings.time_offset,
        spread: Spread::isotropic(settings.place_sigma_mm, settings.turn_sigma_rad)?,
        pixel_sigma: settings.pixel_sigma,
        trust: vec![1.0; views.len()],
        outlier: vec![false; views.len()],
        distance: vec![0.0; views.len()],
        tail: Some(TAIL),
    };
    let search = least_squares::Settings {
        least_gain: 1e-10,
        ..least_squares::Settings::default()
    };
    let mut solution = minimize(&view_problem, state, &search)?;
    solution = view_problem.settled(solution, &search, settings.rounds)?;
    if settings.rounds > 0 {
        view_problem.leave_out_outliers(&solution)?;
        solution = view_problem.settled(solution, &search, settings.rounds)?;
    }
    view_problem.answer(solution)
}

impl Reprojection<'_> {
    /// The answer whose corrections spread as the prior says.
    fn settled(
        &mut self,
        mut solution: Solution<State>,
        search: &least_squares::Settings,
        rounds: usize,
    ) -> Option<Solution<State>> {
        // Until the deviations are found a few steps suffice.
        let few = least_squares::Settings {
            max_iterations: 8,
            ..*search
        };
        for _ in 0..rounds {
            let before = self.sigmas();
            self.learn_deviations(&solution)?;
            let state = solution.state.clone();
            solution = minimize(self, state, &few)?;
            let moved = before.iter().zip(self.sigmas()).map(|(a, b): (&f64, f64)| (a / b).ln().abs());
            if moved.fold(0.0, f64::max) < SETTLED {
                break;
            }
        }
        minimize(self, solution.state, search)
    }

    /// A view's correction squared: what it is, and what it might be besides.
    fn square(&self, solution: &Solution<State>, view: usize) -> Option<Matrix6<f64>> {
        let at = self.common() + 6 * view;
        let doubt: Matrix6<f64> = solution.covariance.as_ref()?.fixed_view::<6, 6>(at, at).into_owned();
        let correction = solution.state.corrections.get(view)?;
        Some(correction * correction.transpose() + doubt)
    }

    /// From here on, views far beyond the middle one are not heard, and errors of the others are normal.
    fn leave_out_outliers(&mut self, solution: &Solution<State>) -> Option<()> {
        let squares: Vec<[f64; 2]> = (0..self.views.len())
            .map(|view| {
                let square = self.square(solution, view)?;
                Some([0, 3].map(|first| square.fixed_view::<3, 3>(first, first).trace()))
            })
            .collect::<Option<_>>()?;
        let variance = |kind: usize| {
            let mut sorted: Vec<f64> = squares.iter().map(|square| square[kind]).collect();
            sorted.sort_by(f64::total_cmp);
            let middle = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
            (middle / MIDDLE).max(LEAST_SIGMAS[kind] * LEAST_SIGMAS[kind])
        };
        let variances = [variance(0), variance(1)];
        self.tail = None;
        for (view, square) in squares.iter().enumerate() {
            self.distance[view] = square[0] / variances[0] + square[1] / variances[1];
            self.outlier[view] = self.distance[view] > DISTANT;
            self.trust[view] = if self.outlier[view] { UNHEARD } else { 1.0 };
        }
        Some(())
    }

    /// Deviations and trust from what the corrections turned out to be.
    fn learn_deviations(&mut self, solution: &Solution<State>) -> Option<()> {
        let common = self.common();
        let (mut sum, mut held, mut views) = (Matrix6::zeros(), 0.0, 0);
        for view in 0..self.views.len() {
            let square = self.square(solution, view)?;
            let correction = &solution.state.corrections[view];
            let doubt = square - correction * correction.transpose();
            held += self.trust[view] * (self.spread.information * doubt).trace();
            if self.outlier[view] {
                continue;
            }
            if let Some(tail) = self.tail {
                self.trust[view] = (tail + 6.0) / (tail + (self.spread.information * square).trace());
            }
            sum += self.trust[view] * square;
            views += 1;
        }
        self.spread = Spread::learnt(sum, views)?;
        if let Some(prior) = self.camera_prior {
            held += prior.held(&self.camera_doubt(solution)?);
        }
        // A corner within Huber's width counts in full; the residuals of Gaussian noise lose as many squares as there are unknowns, and
        // of the corrections only as many are the picture's as the prior does not hold.
        let rest: f64 = (solution.residuals.rows(0, self.measured()).iter().enumerate())
            .map(|(row, r)| solution.weights[row / 2] * r * r)
            .sum();
        let heard = 2.0 * solution.weights.iter().sum::<f64>();
        let unknowns = common as f64 + (6 * self.views.len()) as f64 - held;
        let free = (heard - unknowns).max(1.0);
        self.pixel_sigma = (self.pixel_sigma * (rest / free).sqrt()).max(LEAST_SIGMAS[2]);
        Some(())
    }

    /// Covariance of the camera's numbers.
    fn camera_doubt(&self, solution: &Solution<State>) -> Option<DMatrix<f64>> {
        let (at, count) = (self.first_lens(), self.lens());
        Some(solution.covariance.as_ref()?.view((at, at), (count, count)).into_owned())
    }

    fn answer(&self, solution: Solution<State>) -> Option<Refined> {
        let covariance = solution.covariance.as_ref()?;
        let state = &solution.state;
        let six = |at: usize| -> Matrix6<f64> { covariance.fixed_view::<6, 6>(at, at).into_owned() };
        let deviation = |at: usize, covariance: &DMatrix<f64>| covariance[(at, at)].sqrt();
        let first_joint = POSES + usize::from(self.time_offset);
        let joint_offsets =
            (state.joints.iter().enumerate()).map(|(joint, &offset)| [offset, deviation(first_joint + joint, covariance)]);
        let measured = self.measured();
        let pixels: f64 = solution.residuals.rows(0, measured).norm_squared() * self.pixel_sigma.powi(2);
        let without = State {
            corrections: vec![Vector6::zeros(); self.views.len()],
            ..state.clone()
        };
        Some(Refined {
            hand_from_camera: state.hand_from_camera,
            covariance: six(0),
            base_from_board: state.base_from_board,
            board_covariance: six(6),
            time_offset_s: if self.time_offset {
                [state.time_offset_s, deviation(POSES, covariance)]
            } else {
                [0.0; 2]
            },
            joint_offsets: joint_offsets.collect(),
            camera: state.camera.clone(),
            camera_covariance: self.camera_prior.and_then(|_| self.camera_doubt(&solution)),
            corrections: state.corrections.clone(),
            outlier: self.outlier.clone(),
            distance: self.distance.clone(),
            sigmas: self.sigmas(),
            rms_px: (pixels / (measured / 2) as f64).sqrt(),
            predicted_px: (0..self.views.len()).map(|view| self.rms_of(&without, view)).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibration::hand_eye::example::{PIXEL_SIGMA, Recorded, camera};
    use crate::calibration::hand_eye::reprojection::shifted;

    #[test]
    fn with_an_exact_arm_only_the_corners_noise_is_left() {
        for seed in 0..5 {
            let recorded = Recorded::new(seed, 20, 0.0);
            let refined = recorded.refined(&Settings::default());
            let [mm, rad] = recorded.example.error_of(&refined.hand_from_camera);
            assert!(mm < 0.05 && rad.to_degrees() < 0.02, "{seed}: {mm} mm, {}°", rad.to_degrees());
            assert!(
                (refined.rms_px / (PIXEL_SIGMA * 2.0_f64.sqrt()) - 1.0).abs() < 0.15,
                "{}",
                refined.rms_px
            );
            let error = recorded.error(&refined);
            assert!(
                (0..6).all(|i| error[i].abs() < 4.5 * refined.covariance[(i, i)].sqrt()),
                "{error} {}",
                refined.covariance
            );
        }
    }

    #[test]
    fn with_noisy_joints_the_truth_lies_within_three_stated_deviations() {
        covered(40);
    }

    #[test]
    #[ignore = "a minute"]
    fn with_noisy_joints_the_truth_lies_within_three_stated_deviations_two_hundred_times() {
        covered(200);
    }

    fn covered(runs: u64) {
        let (mut inside, mut square) = (0, 0.0);
        for seed in 0..runs {
            let recorded = Recorded::new(100 + seed, 20, 0.05_f64.to_radians());
            let refined = recorded.refined(&Settings::default());
            let [mm, rad] = recorded.example.error_of(&refined.hand_from_camera);
            assert!(mm < 1.0 && rad.to_degrees() < 0.2, "{seed}: {mm} mm, {}°", rad.to_degrees());
            let error = recorded.error(&refined);
            inside += u32::from((0..6).all(|i| error[i].abs() < 3.0 * refined.covariance[(i, i)].sqrt()));
            square += error.dot(&(refined.covariance.try_inverse().unwrap() * error));
        }
        // χ² of six degrees: its mean over the runs is 6 ± 4·√(12/runs).
        let mean = square / runs as f64;
        assert!((mean - 6.0).abs() < 4.0 * (12.0 / runs as f64).sqrt(), "{mean}");
        assert!(f64::from(inside) >= 0.95 * runs as f64, "{inside} of {runs}");
    }

    #[test]
    fn a_view_whose_hand_was_elsewhere_is_found_and_let_go() {
        let mut recorded = Recorded::new(7, 12, 0.02_f64.to_radians());
        let right = recorded.refined(&Settings::default());
        recorded.hands[4] = shifted(&recorded.hands[4], &[4.0, -3.0, 2.0, 0.02, 0.0, -0.015]);
        let refined = recorded.refined(&Settings::default());
        assert!(
            (0..12).all(|view| refined.outlier[view] == (view == 4)),
            "{:?}",
            refined.distance
        );
        let moved = (refined.hand_from_camera.translation() - right.hand_from_camera.translation()).norm();
        assert!(
            moved < 3.0 * right.covariance.fixed_view::<3, 3>(0, 0).trace().sqrt(),
            "{moved} mm"
        );
    }

    #[test]
    fn offsets_of_joints_and_of_the_clock_are_found() {
        /// A hand whose place depends on a joint and on time, both read wrongly.
        struct Moving {
            told: Vec<Transform<RobotBase, Hand>>,
            velocity: Vec<Vector3<f64>>,
        }
        impl HandPoses for Moving {
            fn base_from_hand(&self, view: usize, offset_s: f64, offsets: &[f64]) -> Option<Transform<RobotBase, Hand>> {
                // A pose told for time t belongs to t + offset: at the picture's time the hand was where it is told offset earlier.
                let moved = self.velocity[view] * -offset_s;
                // The first joint turns the base, the second lifts along z.
                let turned = Transform::<RobotBase, RobotBase>::new(
                    UnitQuaternion::from_scaled_axis(Vector3::z() * 0.0),
                    Vector3::z() * offsets[1] * (view as f64 * 0.9).sin(),
                );
                let rolled = self.told[view].perturbed_right(&Vector6::new(
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                    offsets[0] * (1.0 + (view as f64).cos()),
                    0.0,
                ));
                Some(shifted(&(turned * rolled), &[moved.x, moved.y, moved.z, 0.0, 0.0, 0.0]))
            }
            fn joints(&self) -> usize {
                2
            }
        }
        let recorded = Recorded::new(9, 24, 0.0);
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let moving = Moving {
            told: recorded.hands.clone(),
            velocity: (0..24)
                .map(|_| Vector3::from_fn(|_, _| 20.0 * random.sample::<f64, _>(StandardNormal)))
                .collect(),
        };
        // What it tells if its clock and joints are wrong the other way.
        let (offset_s, offsets) = (0.040, [0.004, -0.8]);
        let wrong = Moving {
            told: (0..24)
                .map(|view| {
                    let right = recorded.hands[view];
                    let moved = moving.velocity[view] * offset_s;
                    let unrolled = shifted(
                        &right,
                        &[
                            moved.x,
                            moved.y,
                            moved.z - offsets[1] * (view as f64 * 0.9).sin(),
                            0.0,
                            0.0,
                            0.0,
                        ],
                    );
                    unrolled.perturbed_right(&Vector6::new(
                        0.0,
                        0.0,
                        0.0,
                        0.0,
                        -offsets[0] * (1.0 + (view as f64).cos()),
                        0.0,
                    ))
                })
                .collect(),
            velocity: moving.velocity,
        };
        let settings = Settings {
            time_offset: true,
            joint_sigma: vec![0.01, 1.0],
            ..Settings::default()
        };
        let refined = refine(&recorded.views, &wrong, &camera(), recorded.start(), &settings).unwrap();
        let [found, sigma] = refined.time_offset_s;
        assert!((found - offset_s).abs() < (4.0 * sigma).min(0.002), "{found} ± {sigma}");
        for (joint, offset) in offsets.iter().enumerate() {
            let [found, sigma] = refined.joint_offsets[joint];
            assert!(
                (found - offset).abs() < 4.0 * sigma && sigma < 0.2 * offset.abs(),
                "{joint}: {found} ± {sigma}"
            );
        }
    }
}
