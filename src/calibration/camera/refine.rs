//! The camera from its views of a board: intrinsics, lens and all board poses together, by least squares on the pixels.
//!
//! A closed-form start ([`crate::calibration::camera::zhang`]) and a few focal lengths beside it are each refined with one radial term; the best
//! goes on with all parameters under a Huber loss, whose width follows the residuals (Triggs et al. 2000). Corners farther off than six
//! deviations are then left out, with their names kept, and the rest is solved by plain least squares: its covariance is
//! σ²(JᵀJ)⁻¹, σ² from the residuals. Dots: the middle of a dot's picture is not the picture of its middle; the difference follows from
//! the camera found so far and is taken off (Heikkilä 2000, doi:10.1109/34.879788), until it settles.

use std::ops::Range;

use nalgebra::{DMatrix, Matrix3, Vector6};
use rayon::prelude::*;

use crate::calibration::board::detection::BoardCorner;
use crate::calibration::camera::lens::{self, LensModel};
use crate::calibration::camera::{pose, zhang};
use crate::calibration::error::{CalibrationError, LEAST_VIEWS};
use crate::calibration::homography;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Board, Camera};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{Problem, Settings, Solution, minimize};
use crate::solver::robust_loss::RobustLoss;

/// Corners farther off than this many deviations are left out.
const OUTLIER_DEVIATIONS: f64 = 6.0;
/// Huber's width in deviations: 95 % efficient on normal noise (Huber 1964).
const HUBER_DEVIATIONS: f64 = 1.345;
/// Deviations below this are as good as corners get: none is left out for being the worst of the best, px.
const LEAST_DEVIATION_PX: f64 = 0.04;
/// Views and corners per view that a start is judged by.
const TRIAL_VIEWS: usize = 16;
const TRIAL_CORNERS: usize = 40;
/// k4, k5 and k6 of the rational model can run away together with k1, k2 and k3, the picture staying the same: a deviation of so much
/// keeps them where coefficients of lenses are, and weighs nothing beside corners that tell them.
const DENOMINATOR_DEVIATION: f64 = 100.0;
/// The deviation of corners that this prior is measured by, px.
const PRIOR_PX: f64 = 0.2;
/// Place of k4 in the rational model.
const FIRST_DENOMINATOR: usize = 9;
/// A view keeps at least so many corners, or it is left out as a whole.
const FEWEST_CORNERS: usize = 6;

/// One picture's board.
#[derive(Clone, Debug)]
pub struct View {
    /// What is seen.
    pub corners: Vec<BoardCorner>,
    /// Radius of its dots, mm, if it has dots.
    pub dot_radius_mm: Option<f64>,
}

/// One corner of a view in the result.
#[derive(Clone, Copy, Debug)]
pub struct Residual {
    /// What was seen; of dots, the picture of the middle.
    pub corner: BoardCorner,
    /// Predicted − observed, px.
    pub error_px: [f64; 2],
    /// Took part in the solution.
    pub used: bool,
}

/// A view in the result.
#[derive(Clone, Debug)]
pub struct ViewResult {
    /// Where the board was; `None` if it could not be found at all.
    pub camera_from_board: Option<Transform<Camera, Board>>,
    /// Its corners.
    pub residuals: Vec<Residual>,
}

/// The camera and how sure it is.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The camera.
    pub camera: CameraModel,
    /// Its kind.
    pub model: LensModel,
    /// Of the parameters in the order of [`LensModel::names`].
    pub covariance: Option<DMatrix<f64>>,
    /// Standard deviation of a corner per axis, px.
    pub sigma_px: f64,
    /// Over residual vectors of the corners used, px.
    pub rms_px: f64,
    /// One for each view given.
    pub views: Vec<ViewResult>,
    /// Steps of the last search.
    pub iterations: usize,
}

#[derive(Clone, Debug)]
struct State {
    camera: CameraModel,
    poses: Vec<Transform<Camera, Board>>,
}

struct AllViews<'a> {
    model: LensModel,
    /// Places of the lens's parameters that may move.
    free: Vec<usize>,
    views: &'a [Vec<BoardCorner>],
    /// Of each view's first corner.
    offsets: Vec<usize>,
    loss: RobustLoss,
    scale: f64,
}

impl<'a> AllViews<'a> {
    fn new(model: LensModel, free: Vec<usize>, views: &'a [Vec<BoardCorner>], loss: RobustLoss, scale: f64) -> Self {
        let mut offsets = vec![0];
        let mut sum = 0;
        for view in views {
            sum += view.len();
            offsets.push(sum);
        }
        Self {
            model,
            free,
            views,
            offsets,
            loss,
            scale,
        }
    }

    fn corners(&self) -> usize {
        self.offsets.last().copied().unwrap_or(0)
    }
}

impl Problem for AllViews<'_> {
    type State = State;

    fn directions(&self) -> usize {
        self.free.len() + 6 * self.views.len()
    }
    fn measured(&self) -> usize {
        2 * self.corners()
    }
    fn priors(&self) -> usize {
        if self.model == LensModel::RationalPolynomial { 3 } else { 0 }
    }
    fn loss(&self) -> RobustLoss {
        self.loss
    }
    fn residuals(&self, state: &State, rows: Range<usize>, out: &mut [f64]) {
        let seen = rows.end.min(self.measured()).saturating_sub(rows.start);
        let (out, priors) = out.split_at_mut(seen);
        // The first prior asked for; a range that ends among the corners asks for none.
        let first_prior = rows.start.saturating_sub(self.measured());
        for (number, out) in priors.iter_mut().enumerate() {
            let k = lens::parameter(&state.camera, self.model, FIRST_DENOMINATOR + first_prior + number);
            *out = k / DENOMINATOR_DEVIATION * PRIOR_PX;
        }
        let (first, last) = (rows.start / 2, rows.end.min(self.measured()) / 2);
        let mut out = out.chunks_exact_mut(2);
        for (number, view) in self.views.iter().enumerate() {
            let (begin, end) = (self.offsets[number], self.offsets[number + 1]);
            if end <= first || begin >= last {
                continue;
            }
            for corner in &view[first.max(begin) - begin..last.min(end) - begin] {
                let seen = state.camera.project(state.poses[number] * corner.board);
                if let Some(out) = out.next() {
                    out[0] = seen.map_or(f64::NAN, |seen| seen.x - corner.pixel.x);
                    out[1] = seen.map_or(f64::NAN, |seen| seen.y - corner.pixel.y);
                }
            }
        }
    }
    fn moved(&self, state: &State, step: &[f64]) -> State {
        let mut moved = state.clone();
        let (lens, poses) = step.split_at(self.free.len());
        for (place, amount) in self.free.iter().zip(lens) {
            lens::add(&mut moved.camera, self.model, *place, *amount);
        }
        for (pose, step) in moved.poses.iter_mut().zip(poses.chunks_exact(6)) {
            if step.iter().any(|v| *v != 0.0) {
                *pose = pose.perturbed_right(&Vector6::from_column_slice(step));
            }
        }
        moved
    }
    fn support(&self, direction: usize) -> Vec<Range<usize>> {
        let rows = match direction.checked_sub(self.free.len()) {
            Some(pose) => 2 * self.offsets[pose / 6]..2 * self.offsets[pose / 6 + 1],
            None => 0..self.measured() + self.priors(),
        };
        std::iter::once(rows).collect()
    }
    fn small_step(&self, direction: usize) -> f64 {
        match self.free.get(direction) {
            Some(place) if *place < 4 => 5e-6 * self.scale,
            Some(_) => 5e-6,
            None if (direction - self.free.len()) % 6 < 3 => 3e-4,
            None => 5e-6,
        }
    }
}

/// The camera of `views`, pictures of `size` (columns, rows).
pub fn calibrate(views: &[View], size: (usize, usize), model: LensModel) -> Result<Calibration, CalibrationError> {
    let usable: Vec<usize> = (0..views.len())
        .filter(|i| views[*i].corners.len() >= FEWEST_CORNERS)
        .collect();
    let mut corners: Vec<Vec<BoardCorner>> = usable.iter().map(|i| views[*i].corners.clone()).collect();
    if usable.len() < LEAST_VIEWS {
        return Err(CalibrationError::TooFewViews {
            found: usable.len(),
            pictures: views.len(),
            advice: "take more pictures of the board from other sides".into(),
        });
    }
    let start = best_start(&corners, size, model)?;
    let has_dots = views.iter().any(|view| view.dot_radius_mm.is_some());
    let rounds = if has_dots { 3 } else { 1 };
    let mut state = start;
    let mut solved = None;
    for _ in 0..rounds {
        let (solution, kept) = robustly(&corners, &state, model)?;
        state = solution.state.clone();
        if has_dots {
            for (number, view) in usable.iter().enumerate() {
                let Some(radius_mm) = views[*view].dot_radius_mm else {
                    continue;
                };
                let originals = &views[*view].corners;
                for (corner, original) in corners[number].iter_mut().zip(originals) {
                    if let Some(bias) = dot_bias_px(&state.camera, &state.poses[number], corner.board, radius_mm) {
                        corner.pixel = Pixel {
                            x: original.pixel.x - bias[0],
                            y: original.pixel.y - bias[1],
                        };
                    }
                }
            }
        }
        solved = Some((solution, kept));
    }
    let (solution, kept) = solved.ok_or(CalibrationError::Undetermined("no round of refinement"))?;
    Ok(result(views, &usable, &corners, &solution, &kept, model))
}

fn result(
    views: &[View],
    usable: &[usize],
    corners: &[Vec<BoardCorner>],
    solution: &Solution<State>,
    kept: &[Vec<bool>],
    model: LensModel,
) -> Calibration {
    let used: usize = kept.iter().flatten().filter(|kept| **kept).count();
    let scaled = solution.scaled_covariance(2 * used);
    let lens_count = model.names().len();
    let covariance = scaled
        .as_ref()
        .map(|full| full.view((0, 0), (lens_count, lens_count)).into_owned());
    let squares: f64 = solution.residuals.iter().take(2 * used).map(|r| r * r).sum();
    let free = 2.0 * used as f64 - lens_count as f64 - 6.0 * usable.len() as f64;
    let mut results: Vec<ViewResult> = views
        .iter()
        .map(|view| ViewResult {
            camera_from_board: None,
            residuals: (view.corners.iter())
                .map(|corner| Residual {
                    corner: *corner,
                    error_px: [f64::NAN; 2],
                    used: false,
                })
                .collect(),
        })
        .collect();
    for (number, view) in usable.iter().enumerate() {
        let pose = solution.state.poses[number];
        results[*view] = ViewResult {
            camera_from_board: Some(pose),
            residuals: (corners[number].iter().zip(&kept[number]))
                .map(|(corner, used)| {
                    let seen = solution.state.camera.project(pose * corner.board);
                    Residual {
                        corner: *corner,
                        error_px: seen.map_or([f64::NAN; 2], |seen| [seen.x - corner.pixel.x, seen.y - corner.pixel.y]),
                        used: *used,
                    }
                })
                .collect(),
        };
    }
    Calibration {
        camera: solution.state.camera.clone(),
        model,
        covariance,
        sigma_px: (squares / free.max(1.0)).sqrt(),
        rms_px: (squares / used.max(1) as f64).sqrt(),
        views: results,
        iterations: solution.iterations,
    }
}

/// Huber's loss first; then without the outliers, plainly. The second result says which corners were kept.
fn robustly(
    corners: &[Vec<BoardCorner>],
    start: &State,
    model: LensModel,
) -> Result<(Solution<State>, Vec<Vec<bool>>), CalibrationError> {
    let all: Vec<usize> = (0..model.names().len()).collect();
    let scale = start.camera.intrinsics.fx;
    let mut state = start.clone();
    let lost = CalibrationError::Undetermined("the refinement left the range of the lens model");
    for _ in 0..3 {
        let width = HUBER_DEVIATIONS * pose::deviation(&lengths(corners, &state)).max(LEAST_DEVIATION_PX);
        let problem = AllViews::new(model, all.clone(), corners, RobustLoss::Huber { width }, scale);
        let settings = Settings {
            max_iterations: 40,
            least_gain: 1e-7,
        };
        state = minimize(&problem, state, &settings).ok_or_else(|| lost.clone())?.state;
    }
    let mut kept: Vec<Vec<bool>> = corners.iter().map(|view| vec![true; view.len()]).collect();
    let mut solution = None;
    // Twice: without the worst, others may turn out to be good, or bad.
    for _ in 0..2 {
        let limit = OUTLIER_DEVIATIONS * pose::deviation(&lengths(corners, &state)).max(LEAST_DEVIATION_PX);
        let mut used = Vec::with_capacity(corners.len());
        for (number, view) in corners.iter().enumerate() {
            kept[number] = view
                .iter()
                .map(|corner| error_px(&state, number, corner).is_some_and(|error| error <= limit))
                .collect();
            let mut remaining: Vec<BoardCorner> = view
                .iter()
                .zip(&kept[number])
                .filter(|(_, kept)| **kept)
                .map(|(c, _)| *c)
                .collect();
            if remaining.len() < FEWEST_CORNERS.max(view.len() / 3) {
                kept[number].fill(false);
                remaining.clear();
            }
            used.push(remaining);
        }
        let present: Vec<usize> = (0..used.len()).filter(|number| !used[*number].is_empty()).collect();
        if present.len() < LEAST_VIEWS {
            return Err(CalibrationError::Undetermined("most corners contradict one another"));
        }
        // A view without corners must not stand in the system.
        let views: Vec<Vec<BoardCorner>> = present.iter().map(|number| used[*number].clone()).collect();
        let problem = AllViews::new(model, all.clone(), &views, RobustLoss::Squared, scale);
        let within = State {
            camera: state.camera.clone(),
            poses: present.iter().map(|number| state.poses[*number]).collect(),
        };
        let found = minimize(&problem, within, &Settings::default()).ok_or_else(|| lost.clone())?;
        state.camera = found.state.camera.clone();
        for (pose, number) in found.state.poses.iter().zip(&present) {
            state.poses[*number] = *pose;
        }
        solution = Some(Solution {
            state: state.clone(),
            cost: found.cost,
            residuals: found.residuals,
            weights: found.weights,
            covariance: found.covariance,
            iterations: found.iterations,
            converged: found.converged,
        });
    }
    let solution = solution.ok_or(lost)?;
    if !solution.state.camera.intrinsics.fx.is_finite() || solution.state.camera.intrinsics.fx <= 0.0 {
        return Err(CalibrationError::Undetermined("the focal length ran away"));
    }
    Ok((solution, kept))
}

fn error_px(state: &State, view: usize, corner: &BoardCorner) -> Option<f64> {
    let seen = state.camera.project(state.poses[view] * corner.board)?;
    Some((seen.x - corner.pixel.x).hypot(seen.y - corner.pixel.y))
}

fn lengths(corners: &[Vec<BoardCorner>], state: &State) -> Vec<f64> {
    (corners.iter().enumerate())
        .flat_map(|(number, view)| view.iter().filter_map(move |corner| error_px(state, number, corner)))
        .collect()
}

/// Several focal lengths tried on a part of the corners.
fn best_start(corners: &[Vec<BoardCorner>], size: (usize, usize), model: LensModel) -> Result<State, CalibrationError> {
    let center = [(size.0 as f64 - 1.0) / 2.0, (size.1 as f64 - 1.0) / 2.0];
    let homographies: Vec<Matrix3<f64>> = corners
        .iter()
        .filter_map(|view| {
            let pairs: Vec<_> = view
                .iter()
                .map(|corner| {
                    (
                        [corner.board.coords.x, corner.board.coords.y],
                        [corner.pixel.x, corner.pixel.y],
                    )
                })
                .collect();
            homography::from_pairs(&pairs)
        })
        .collect();
    if homographies.len() < LEAST_VIEWS {
        return Err(CalibrationError::Undetermined("the corners of most views lie on a line"));
    }
    let width = size.0 as f64;
    let plausible = |k: &Intrinsics| {
        (0.15 * width..20.0 * width).contains(&k.fx)
            && (0.5..2.0).contains(&(k.fx / k.fy))
            && (k.cx - center[0]).abs() < 0.4 * width
            && (k.cy - center[1]).abs() < 0.4 * width
    };
    let centered = |f: f64| Intrinsics {
        fx: f,
        fy: f,
        cx: center[0],
        cy: center[1],
    };
    let mut starts: Vec<Intrinsics> = Vec::new();
    starts.extend(zhang::intrinsics(&homographies).filter(plausible));
    starts.extend(zhang::focal_length(&homographies, center).map(centered).filter(plausible));
    starts.extend([0.5, 0.9, 1.6].map(|share| centered(share * width)));
    let step = corners.len().div_ceil(TRIAL_VIEWS);
    let trial: Vec<Vec<BoardCorner>> = corners
        .iter()
        .step_by(step)
        .map(|view| {
            let every = view.len().div_ceil(TRIAL_CORNERS);
            view.iter().step_by(every).copied().collect()
        })
        .collect();
    let tried: Vec<(f64, CameraModel)> = starts
        .par_iter()
        .filter_map(|intrinsics| tried(&trial, model.camera(size.0, size.1, *intrinsics), model))
        .collect();
    let (_, camera) = tried
        .into_iter()
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .ok_or(CalibrationError::Undetermined("no focal length explains the views"))?;
    let poses = poses(corners, &camera).ok_or(CalibrationError::Undetermined("a view has no pose"))?;
    Ok(State { camera, poses })
}

fn poses(corners: &[Vec<BoardCorner>], camera: &CameraModel) -> Option<Vec<Transform<Camera, Board>>> {
    corners
        .iter()
        .map(|view| {
            let refined = pose::board_pose(camera, view).map(|pose| pose.camera_from_board);
            refined.or_else(|| pose::initial(camera, view))
        })
        .collect()
}

/// One start, refined: first focal lengths and k1, then what the model needs for strong lenses.
fn tried(trial: &[Vec<BoardCorner>], camera: CameraModel, model: LensModel) -> Option<(f64, CameraModel)> {
    let scale = camera.intrinsics.fx;
    let poses: Option<Vec<_>> = trial.iter().map(|view| pose::initial(&camera, view)).collect();
    let mut state = State { poses: poses?, camera };
    let mut cost = f64::INFINITY;
    for free in [vec![0, 1, 4], vec![0, 1, 2, 3, 4, 5]] {
        let width = HUBER_DEVIATIONS * pose::deviation(&lengths(trial, &state)).max(0.3);
        let problem = AllViews::new(model, free, trial, RobustLoss::Huber { width }, scale);
        let settings = Settings {
            max_iterations: 30,
            least_gain: 1e-5,
        };
        let solution = minimize(&problem, state, &settings)?;
        state = solution.state;
        cost = pose::deviation(&lengths(trial, &state));
    }
    let k = &state.camera.intrinsics;
    (k.fx > 0.0 && k.fy > 0.0 && k.fx.is_finite()).then_some((cost, state.camera))
}

/// Points on the rim of a dot.
const RIM_POINTS: usize = 32;

/// The middle (centre of area) of a dot's picture minus the picture of its middle, px.
fn dot_bias_px(camera: &CameraModel, pose: &Transform<Camera, Board>, middle: Point<Board>, radius_mm: f64) -> Option<[f64; 2]> {
    let seen = camera.project(*pose * middle)?;
    let rim: Option<Vec<[f64; 2]>> = (0..RIM_POINTS)
        .map(|k| {
            let (sin, cos) = (std::f64::consts::TAU * k as f64 / RIM_POINTS as f64).sin_cos();
            let at = Point::<Board>::new(middle.coords.x + radius_mm * cos, middle.coords.y + radius_mm * sin, 0.0);
            camera.project(*pose * at).map(|p| [p.x - seen.x, p.y - seen.y])
        })
        .collect();
    let rim = rim?;
    let (mut area, mut sum) = (0.0, [0.0; 2]);
    for (a, b) in rim.iter().zip(rim.iter().cycle().skip(1)) {
        let cross = a[0] * b[1] - a[1] * b[0];
        area += cross / 2.0;
        sum[0] += (a[0] + b[0]) * cross / 6.0;
        sum[1] += (a[1] + b[1]) * cross / 6.0;
    }
    (area.abs() > 1e-9).then(|| [sum[0] / area, sum[1] / area])
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn the_middle_of_a_dots_picture_is_where_the_ellipse_has_its_centre() {
        let intrinsics = Intrinsics {
            fx: 800.0,
            fy: 800.0,
            cx: 320.0,
            cy: 240.0,
        };
        let camera = LensModel::PlumbBob.camera(640, 480, intrinsics);
        let turn = UnitQuaternion::from_euler_angles(0.7, 0.4, 0.2);
        let pose: Transform<Camera, Board> = Transform::new(turn, Vector3::new(-3.0, 2.0, 60.0));
        let (x, y, r) = (4.0, -3.0, 3.0);
        let bias = dot_bias_px(&camera, &pose, Point::new(x, y, 0.0), r).unwrap();
        let rotation = turn.to_rotation_matrix();
        let columns = [
            rotation.matrix().column(0).into(),
            rotation.matrix().column(1).into(),
            pose.translation(),
        ];
        let map = intrinsics.matrix() * Matrix3::from_columns(&columns);
        let dual = Matrix3::new(x * x - r * r, x * y, x, x * y, y * y - r * r, y, x, y, 1.0);
        let pole = map * dual * map.transpose() * Vector3::z();
        let seen = camera.project(pose * Point::<Board>::new(x, y, 0.0)).unwrap();
        let truth = [pole.x / pole.z - seen.x, pole.y / pole.z - seen.y];
        assert!(truth[0].hypot(truth[1]) > 0.5, "a case that matters: {truth:?}");
        assert!((bias[0] - truth[0]).hypot(bias[1] - truth[1]) < 0.02, "{bias:?} {truth:?}");
    }
}
