//! Camera, joint, angles and board poses together, by least squares on the pixels.
//!
//! Sought are the camera at angle 0, the axis's direction (two numbers) and point (two), the picture's centre (two), an angle for each
//! rotation but the first, and a board pose for each station. The first rotation defines angle 0, or is what it was said to be: otherwise
//! all angles could be shifted together, the camera of angle 0 with them. Huber's loss first; then corners farther off than six
//! deviations are left out, and the rest is solved plainly: the covariance is σ²(JᵀJ)⁻¹.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, Unit};

use crate::calibration::camera::lens::LensModel;
use crate::calibration::camera::pose::{board_pose, deviation};
use crate::calibration::camera::refine::{Residual, View, calibrate as calibrate_camera};
use crate::calibration::error::CalibrationError;
use crate::calibration::oblique::joint::{Angles, Joint, Sighting, State};
use crate::calibration::oblique::start::{Turned, searched};
use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::camera::oblique::Oblique;
use crate::geometry::space::{Board, Camera};
use crate::geometry::transform::Transform;
use crate::solver::least_squares::{Problem as _, Settings, Solution, minimize};
use crate::solver::robust_loss::RobustLoss;

/// Corners farther off than this many deviations are left out.
const OUTLIER_DEVIATIONS: f64 = 6.0;
/// Huber's width in deviations.
const HUBER_DEVIATIONS: f64 = 1.345;
/// Deviations below this are as good as corners get, px.
const LEAST_DEVIATION_PX: f64 = 0.04;
/// A telescope that looks aside by less is straight: turning it shows nothing, rad.
const LEAST_OBLIQUENESS: f64 = 0.05;
/// A start that leaves more than this does not fit the model, rad.
const MOST_MISFIT: f64 = 0.25;
/// A start that leaves more than this may come from angles of the wrong sense, rad.
const DOUBTFUL_MISFIT: f64 = 0.02;
/// A solution that leaves more than this is none, px.
const MOST_RMS_PX: f64 = 5.0;
/// Rotations needed: without given angles two would leave the axis open.
const LEAST_ROTATIONS: usize = 3;

/// Why there is no joint.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ObliqueError {
    /// Not enough rotations.
    #[error(
        "expected the board at {LEAST_ROTATIONS} or more rotations of the telescope at the same stations, found {0}; leave head and board \
         where they are, and turn the telescope by 30° or more between pictures"
    )]
    TooFewRotations(usize),
    /// The first rotation has too few pictures, or they do not tell a camera.
    #[error("the pictures at the first rotation give no camera: {0}")]
    Camera(#[from] CalibrationError),
    /// A straight telescope, or one that was not turned.
    #[error(
        "expected a telescope that looks aside, found one whose picture hardly moves when it is turned ({0:.1}°); a straight scope needs no \
         such calibration: use `calibrate camera`"
    )]
    Straight(f64),
    /// Angles of the other sense.
    #[error("the angles given grow as the picture turns counter-clockwise: change their signs")]
    OppositeSense,
    /// The motions are no turning of a telescope.
    #[error(
        "expected the board to move as if the telescope was turned, found motions that differ by {0:.1}° from it; did head or board move \
         between the pictures of a station?"
    )]
    NoTurning(f64),
    /// The refinement failed.
    #[error("the views do not determine the joint; take more stations, with the board tilted in several directions")]
    Undetermined,
}

/// The joint, and how sure it is.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// At angle 0.
    pub camera: CameraModel,
    /// Its kind.
    pub model: LensModel,
    /// The joint.
    pub oblique: Oblique,
    /// One for each rotation, rad.
    pub angles_rad: Vec<f64>,
    /// Of the lens's parameters, then: axis (turn about the two directions of [`crate::calibration::oblique::joint::across`], rad), point (mm along them), centre (px), angles
    /// of all rotations but the first (rad).
    pub covariance: DMatrix<f64>,
    /// One for each station.
    pub camera_from_board: Vec<Transform<Camera, Board>>,
    /// Over residual vectors of the corners used, px.
    pub rms_px: f64,
    /// The same for each sighting.
    pub sighting_rms_px: Vec<f64>,
    /// For each sighting, of its corners that the solution can see, used or not.
    pub residuals: Vec<Vec<Residual>>,
    /// Corners used, of all.
    pub used: [usize; 2],
    /// RMS if the telescope's turning were not modelled but each rotation had the first one's camera, px.
    pub fixed_rms_px: f64,
}

impl Calibration {
    /// Standard deviation by place in the covariance.
    pub fn sigma(&self, place: usize) -> f64 {
        self.covariance.get((place, place)).map_or(f64::NAN, |v| v.max(0.0).sqrt())
    }

    /// Where the joint's numbers begin in the covariance.
    pub fn first_joint_place(&self) -> usize {
        self.model.names().len()
    }
}

/// The joint, from pictures of `size`; the first of the rotations is the reference.
pub fn calibrate(
    sightings: &[Sighting],
    angles: &Angles,
    size: (usize, usize),
    model: LensModel,
) -> Result<Calibration, ObliqueError> {
    let rotations = angles.given_rad.len();
    if rotations < LEAST_ROTATIONS {
        return Err(ObliqueError::TooFewRotations(rotations));
    }
    let stations = sightings.iter().map(|sighting| sighting.station + 1).max().unwrap_or(0);
    let (start, fixed_rms_px) = started(sightings, angles, size, model, stations)?;
    let mut state = start;
    let scale = state.camera.intrinsics.fx;
    let lengths = |state: &State| -> Vec<f64> {
        (sightings.iter().flat_map(|sighting| state.errors(sighting)))
            .map(|error| error.map_or(f64::INFINITY, |e| e[0].hypot(e[1])))
            .collect()
    };
    let settings = Settings {
        max_iterations: 60,
        least_gain: 1e-8,
    };
    let mut sigma_px = 1.0;
    for _ in 0..3 {
        sigma_px = deviation(&lengths(&state)).max(LEAST_DEVIATION_PX);
        let loss = RobustLoss::Huber {
            width: HUBER_DEVIATIONS * sigma_px,
        };
        let problem = Joint::new(model, sightings, angles, stations, sigma_px, loss, scale);
        state = minimize(&problem, state, &settings).ok_or(ObliqueError::Undetermined)?.state;
    }
    let limit = OUTLIER_DEVIATIONS * sigma_px;
    let kept: Vec<Sighting> = (sightings.iter())
        .map(|sighting| {
            let errors = state.errors(sighting);
            let near = |error: &Option<[f64; 2]>| error.is_some_and(|e| e[0].hypot(e[1]) <= limit);
            let corners = sighting.corners.iter().zip(&errors).filter(|(_, error)| near(error));
            Sighting {
                corners: corners.map(|(corner, _)| *corner).collect(),
                ..*sighting
            }
        })
        .collect();
    let problem = Joint::new(model, &kept, angles, stations, sigma_px, RobustLoss::Squared, scale);
    let solution = minimize(&problem, state, &Settings::default()).ok_or(ObliqueError::Undetermined)?;
    let covariance = solution
        .scaled_covariance(problem.measured())
        .ok_or(ObliqueError::Undetermined)?;
    let shared = problem.shared();
    let obliqueness = solution.state.oblique.obliqueness_rad();
    if obliqueness < LEAST_OBLIQUENESS {
        return Err(ObliqueError::Straight(obliqueness.to_degrees()));
    }
    let [used, all] = [&kept[..], sightings].map(|all| all.iter().map(|sighting| sighting.corners.len()).sum::<usize>());
    let found = Calibration {
        residuals: residuals(&solution.state, sightings, &kept),
        ..finished(&solution, covariance, shared, &kept, model, [used, all], fixed_rms_px)
    };
    // Written so that a figure that is no number is refused too.
    if found.rms_px <= MOST_RMS_PX {
        Ok(found)
    } else {
        Err(ObliqueError::Undetermined)
    }
}

fn finished(
    solution: &Solution<State>,
    covariance: DMatrix<f64>,
    shared: usize,
    kept: &[Sighting],
    model: LensModel,
    used: [usize; 2],
    fixed_rms_px: f64,
) -> Calibration {
    let state = &solution.state;
    let squares = |sighting: &Sighting| -> f64 {
        let errors = state.errors(sighting);
        errors.iter().flatten().map(|e| e[0] * e[0] + e[1] * e[1]).sum()
    };
    let total: f64 = kept.iter().map(squares).sum();
    Calibration {
        camera: state.camera.clone(),
        model,
        oblique: state.oblique,
        angles_rad: state.angles.clone(),
        covariance: covariance.view((0, 0), (shared, shared)).into_owned(),
        camera_from_board: state.boards.clone(),
        rms_px: (total / used[0].max(1) as f64).sqrt(),
        sighting_rms_px: (kept.iter())
            .map(|sighting| (squares(sighting) / sighting.corners.len().max(1) as f64).sqrt())
            .collect(),
        residuals: Vec::new(),
        used,
        fixed_rms_px,
    }
}

/// What the solution leaves of each corner; those of `kept` were used.
fn residuals(state: &State, sightings: &[Sighting], kept: &[Sighting]) -> Vec<Vec<Residual>> {
    let of_one = |(sighting, kept): (&Sighting, &Sighting)| -> Vec<Residual> {
        let errors = state.errors(sighting);
        (sighting.corners.iter().zip(errors))
            .filter_map(|(corner, error_px)| {
                Some(Residual {
                    corner: *corner,
                    error_px: error_px?,
                    used: kept.corners.iter().any(|used| used.site == corner.site),
                })
            })
            .collect()
    };
    sightings.iter().zip(kept).map(of_one).collect()
}

/// The camera of the first rotation, the board at each station, axis and angles; and the RMS without turning, px.
fn started(
    sightings: &[Sighting],
    angles: &Angles,
    size: (usize, usize),
    model: LensModel,
    stations: usize,
) -> Result<(State, f64), ObliqueError> {
    let at_first: Vec<&Sighting> = sightings.iter().filter(|sighting| sighting.rotation == 0).collect();
    let views: Vec<View> = (at_first.iter())
        .map(|sighting| View {
            corners: sighting.corners.clone(),
            dot_radius_mm: None,
        })
        .collect();
    let first = calibrate_camera(&views, size, model)?;
    let reference: BTreeMap<usize, Transform<Camera, Board>> = (at_first.iter().zip(&first.views))
        .filter_map(|(sighting, view)| Some((sighting.station, view.camera_from_board?)))
        .collect();
    let told = |rotation: usize| angles.given_rad.get(rotation).copied().flatten();
    let zero = told(0).unwrap_or(0.0);
    let turned: Vec<Turned> = (1..angles.given_rad.len())
        .map(|rotation| Turned {
            motions: (sightings.iter())
                .filter(|sighting| sighting.rotation == rotation)
                .filter_map(|sighting| {
                    let board = board_pose(&first.camera, &sighting.corners)?;
                    Some(board.camera_from_board * reference.get(&sighting.station)?.inverse())
                })
                .collect(),
            given_rad: told(rotation).map(|angle| angle - zero),
        })
        .collect();
    let seen = turned.iter().filter(|turned| !turned.motions.is_empty()).count();
    if seen < turned.len() {
        return Err(ObliqueError::TooFewRotations(seen + 1));
    }
    let largest = (turned.iter().flat_map(|turned| &turned.motions))
        .map(|motion| motion.rotation().angle())
        .fold(0.0, f64::max);
    if largest < LEAST_OBLIQUENESS {
        return Err(ObliqueError::Straight(largest.to_degrees()));
    }
    let k = first.camera.intrinsics;
    let center = Pixel { x: k.cx, y: k.cy };
    let start = searched(&turned, center).ok_or(ObliqueError::Undetermined)?;
    if start.misfit_rad > DOUBTFUL_MISFIT && turned.iter().any(|turned| turned.given_rad.is_some()) {
        let mut other = turned.clone();
        for turned in &mut other {
            turned.given_rad = turned.given_rad.map(|angle| -angle);
        }
        if searched(&other, center).is_some_and(|other| other.misfit_rad < 0.3 * start.misfit_rad) {
            return Err(ObliqueError::OppositeSense);
        }
    }
    if start.misfit_rad > MOST_MISFIT {
        return Err(ObliqueError::NoTurning(start.misfit_rad.to_degrees()));
    }
    let fixed_rms_px = rms_without_turning(sightings, &first.camera, &reference);
    let mut state = State {
        camera: first.camera,
        oblique: start.oblique,
        angles: std::iter::once(0.0).chain(start.angles_rad).collect(),
        boards: Vec::new(),
    };
    for station in 0..stations {
        let board = match reference.get(&station) {
            Some(board) => *board,
            // Not seen at the first rotation: by way of another.
            None => (sightings.iter())
                .filter(|sighting| sighting.station == station)
                .find_map(|sighting| {
                    let angle = *state.angles.get(sighting.rotation)?;
                    let camera = state.oblique.camera_at(&state.camera, angle);
                    let board = board_pose(&camera, &sighting.corners)?;
                    Some(state.oblique.turned_from_zero(angle).inverse() * board.camera_from_board)
                })
                .ok_or(ObliqueError::Undetermined)?,
        };
        state.boards.push(board);
    }
    // The joint found belongs to the first rotation; carried to angle 0, if that was said to be another.
    Ok((shifted(state, zero), fixed_rms_px))
}

/// The same with all angles larger by `zero`: camera and boards of an angle that is smaller by it.
fn shifted(state: State, zero: f64) -> State {
    if zero == 0.0 {
        return state;
    }
    let back = state.oblique.turned_from_zero(-zero);
    State {
        camera: state.oblique.camera_at(&state.camera, -zero),
        oblique: Oblique {
            axis: Unit::new_normalize(back.rotation() * state.oblique.axis.into_inner()),
            point_mm: {
                let axis = back.rotation() * state.oblique.axis.into_inner();
                let point = back.rotation() * state.oblique.point_mm + back.translation();
                point - axis * axis.dot(&point)
            },
            center: state.oblique.center,
        },
        angles: state.angles.iter().map(|angle| angle + zero).collect(),
        boards: state.boards.iter().map(|board| back * *board).collect(),
    }
}

/// Every rotation taken for the first: what ignoring the joint costs, px.
fn rms_without_turning(sightings: &[Sighting], camera: &CameraModel, boards: &BTreeMap<usize, Transform<Camera, Board>>) -> f64 {
    let errors: Vec<f64> = (sightings.iter())
        .filter_map(|sighting| Some((sighting, boards.get(&sighting.station)?)))
        .flat_map(|(sighting, board)| {
            sighting.corners.iter().filter_map(move |corner| {
                let seen = camera.project(*board * corner.board)?;
                Some((seen.x - corner.pixel.x).powi(2) + (seen.y - corner.pixel.y).powi(2))
            })
        })
        .collect();
    (errors.iter().sum::<f64>() / errors.len().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;
    use rayon::prelude::*;

    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::calibration::board::detection::BoardCorner;
    use crate::calibration::board::pattern::BoardLayout;
    use crate::calibration::camera::lens;
    use crate::calibration::oblique::joint::across;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;
    use crate::geometry::point::Point;

    const NOISE_PX: f64 = 0.1;
    const STATIONS: usize = 8;

    fn camera() -> CameraModel {
        CameraModel {
            width: 1280,
            height: 960,
            intrinsics: Intrinsics {
                fx: 760.0,
                fy: 764.0,
                cx: 652.0,
                cy: 471.0,
            },
            distortion: Distortion::BrownConrady {
                k: [-0.22, 0.06, 0.0, 0.0, 0.0, 0.0],
                p: [0.0008, -0.0005],
            },
        }
    }

    fn joint(tilt: f64) -> Oblique {
        let toward = 1.4_f64;
        let axis = Unit::new_normalize(Vector3::new(tilt.sin() * toward.cos(), tilt.sin() * toward.sin(), tilt.cos()));
        let point = Vector3::new(0.8, -0.5, 0.3);
        Oblique {
            axis,
            point_mm: point - axis.into_inner() * axis.dot(&point),
            center: Pixel { x: 640.0, y: 483.0 },
        }
    }

    /// Eight stations, the board before the camera of angle 0, seen at all angles as far as it lies in the picture.
    fn sightings(truth: &Oblique, angles: &[f64], seed: u64) -> Vec<Sighting> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let layout = BoardLayout::new("checkerboard:9x6", 4.0).unwrap();
        let sites = layout.sites();
        let mut all = Vec::new();
        for station in 0..STATIONS {
            let mut draw = |size: f64| size * random.random_range(-1.0..1.0);
            let turn = UnitQuaternion::from_euler_angles(draw(0.6), draw(0.6), draw(1.5));
            let place = Vector3::new(draw(6.0), draw(5.0), 62.0 + draw(14.0));
            let board: Transform<Camera, Board> = Transform::new(turn, place - turn * Vector3::new(16.0, 10.0, 0.0));
            for (rotation, angle) in angles.iter().enumerate() {
                let (camera, motion) = (truth.camera_at(&camera(), *angle), truth.turned_from_zero(*angle));
                let corners: Vec<BoardCorner> = (sites.iter().enumerate())
                    .filter_map(|(site, at)| {
                        let point = Point::new(at.board_mm[0], at.board_mm[1], 0.0);
                        let seen = camera
                            .project(motion * (board * point))
                            .filter(|p| camera.contains(*p, 4.0))?;
                        let mut noise = || NOISE_PX * random.sample::<f64, _>(StandardNormal);
                        let pixel = Pixel {
                            x: seen.x + noise(),
                            y: seen.y + noise(),
                        };
                        Some(BoardCorner {
                            site,
                            board: point,
                            pixel,
                            sigma_px: NOISE_PX,
                        })
                    })
                    .collect();
                if corners.len() >= 12 {
                    all.push(Sighting {
                        station,
                        rotation,
                        corners,
                    });
                }
            }
        }
        all
    }

    /// Truth − estimate in the order of the covariance.
    fn errors(found: &Calibration, truth: &Oblique, angles: &[f64]) -> Vec<f64> {
        let mut errors: Vec<f64> = (0..found.model.names().len())
            .map(|place| lens::parameter(&camera(), found.model, place) - lens::parameter(&found.camera, found.model, place))
            .collect();
        let [u, v] = across(&found.oblique.axis);
        let turn = found.oblique.axis.cross(&truth.axis);
        let shift = truth.point_mm - found.oblique.point_mm;
        errors.extend([turn.dot(&u), turn.dot(&v), shift.dot(&u), shift.dot(&v)]);
        errors.extend([
            truth.center.x - found.oblique.center.x,
            truth.center.y - found.oblique.center.y,
        ]);
        errors.extend(
            angles
                .iter()
                .zip(&found.angles_rad)
                .skip(1)
                .map(|(truth, found)| truth - found),
        );
        errors
    }

    fn degrees<const N: usize>(angles: [f64; N]) -> [f64; N] {
        angles.map(f64::to_radians)
    }

    #[test]
    fn the_joint_of_oblique_scopes_is_found_within_its_covariance() {
        for (tilt, angles) in [
            (30.0_f64, degrees([0.0, -40.0, -20.0, 20.0, 40.0])),
            (70.0, degrees([0.0, -20.0, -10.0, 10.0, 20.0])),
        ] {
            let truth = joint(tilt.to_radians());
            let runs: u64 = 24;
            let results: Vec<(Vec<f64>, f64)> = (0..runs)
                .into_par_iter()
                .map(|seed| {
                    let unknown = Angles {
                        given_rad: vec![None; angles.len()],
                        sigma_rad: 1.0,
                    };
                    let seen = sightings(&truth, &angles, 1000 + seed);
                    let found = calibrate(&seen, &unknown, (1280, 960), LensModel::PlumbBob).unwrap();
                    assert!(
                        (found.rms_px / (NOISE_PX * 2.0_f64.sqrt()) - 1.0).abs() < 0.1,
                        "{}",
                        found.rms_px
                    );
                    assert!(found.fixed_rms_px > 50.0);
                    let errors = errors(&found, &truth, &angles);
                    let covariance = found.covariance.clone();
                    let e = nalgebra::DVector::from_vec(errors.clone());
                    let squared = e.dot(&(covariance.try_inverse().unwrap() * &e));
                    let deviations = errors.iter().enumerate().map(|(place, e)| e / found.sigma(place)).collect();
                    (deviations, squared)
                })
                .collect();
            let n = results[0].0.len();
            let within = |place: usize| results.iter().filter(|(d, _)| d[place].abs() <= 3.0).count();
            for place in 0..n {
                assert!(
                    within(place) * 100 >= 95 * runs as usize,
                    "{tilt}°: number {place} within 3σ {} of {runs}",
                    within(place)
                );
            }
            // The mean of 24 χ² of n degrees is n ± 4·√(2n/24).
            let mean = results.iter().map(|(_, squared)| squared).sum::<f64>() / runs as f64;
            let bound = 4.0 * (2.0 * n as f64 / runs as f64).sqrt();
            assert!((mean - n as f64).abs() < bound + 1.0, "{tilt}°: {mean} {n}");
        }
    }

    #[test]
    fn given_angles_count_and_their_sense_is_checked() {
        let truth = joint(0.52);
        let angles = degrees([15.0, -10.0, 35.0, 50.0]);
        let seen = sightings(&truth, &angles.map(|a| a - angles[0]), 5);
        let given = |sign: f64| Angles {
            given_rad: angles.iter().map(|angle| Some(sign * angle)).collect(),
            sigma_rad: 0.25_f64.to_radians(),
        };
        let found = calibrate(&seen, &given(1.0), (1280, 960), LensModel::PlumbBob).unwrap();
        for (place, (found, truth)) in found.angles_rad.iter().zip(angles).enumerate() {
            assert!((found - truth).abs() < 0.01, "{place} {found} {truth}");
        }
        // Camera and joint are those of angle 0: at the first rotation's angle they are the camera of the pictures there.
        let there = found.oblique.camera_at(&found.camera, angles[0]);
        let sigma = found.sigma(2).hypot(found.sigma(3));
        assert!(
            (there.intrinsics.cx - camera().intrinsics.cx).abs() < 4.0 * sigma,
            "{there:?} {sigma}"
        );
        let reversed = calibrate(&seen, &given(-1.0), (1280, 960), LensModel::PlumbBob);
        assert!(matches!(reversed, Err(ObliqueError::OppositeSense)), "{reversed:?}");
    }

    #[test]
    fn a_straight_scope_is_refused() {
        let truth = Oblique {
            axis: Vector3::z_axis(),
            point_mm: Vector3::zeros(),
            center: Pixel { x: 652.0, y: 471.0 },
        };
        let angles = degrees([0.0, 30.0, 60.0]);
        let unknown = Angles {
            given_rad: vec![None; 3],
            sigma_rad: 1.0,
        };
        let found = calibrate(&sightings(&truth, &angles, 2), &unknown, (1280, 960), LensModel::PlumbBob);
        assert!(matches!(found, Err(ObliqueError::Straight(_))), "{found:?}");
    }
}
