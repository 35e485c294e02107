//! The shift of the arm's clock at which the arm's path looks most like the camera's.
//!
//! Structure from motion knows the camera's path c(t), R(t) to hundredths of a millimetre and of a degree, but neither place nor
//! scale of the whole; the arm says every few ms where the hand is, with a white noise far larger. So the smooth path is read at the
//! noisy instants and not the other way round: a reading stamped s belongs to the camera's instant s + τ, where the hand should be at
//! G·(R, c)·X⁻¹ with a similarity G (7 unknowns) and the hand-eye transform X (6, held near what is known of it). All 14 are found
//! together by iteratively reweighted least squares (Cauchy's weights); noise of place and turn are told by the residuals.
//!
//! What can be known: a reading of deviation σ moving at v tells the time to σ/v, n of them to σ/(v√n), less what G and X can imitate;
//! that is the covariance of the fit. Errors that are alike over neighbouring readings (backlash, tissue that breathes) tell less. The
//! deviation reported is the largest of that covariance, of the one by the residuals' own autocorrelation, and of sandwich
//! covariances H⁻¹SH⁻¹ whose S sums the scores' products over windows of several lengths (Newey and West 1987, "A simple, positive
//! semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", doi:10.2307/1913610).

use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::calibration::time_offset::camera_path::CameraPath;
use crate::calibration::time_offset::path_matching::{COARSE_MS, FEWEST_READINGS, Fit, Matching, OffsetIs};
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;
use crate::robot::trajectory::TimedPose;
use crate::time::{Span, Timestamp};

/// Half width of what counts as the peak itself when rivals are looked for, ms.
const PEAK_MS: f64 = 60.0;

/// The offset found, and how sure it is.
#[derive(Clone, Debug)]
pub struct PathOffset {
    /// Add to a pose stamp to get the camera's clock.
    pub offset: Span,
    /// Standard deviation, ms.
    pub sigma_ms: f64,
    /// What it would be if the readings' errors were independent, ms.
    pub white_sigma_ms: f64,
    /// Share of the hand's motion (place and turn, the worse of the two) that the camera's path explains.
    pub explained: f64,
    /// By how much the logarithm of the likelihood is higher than anywhere off the peak.
    pub distinctness: f64,
    /// What the arm errs per axis there, mm and rad.
    pub arm_noise: [f64; 2],
    /// Readings used.
    pub readings: usize,
    /// Offsets tried (ms) and the logarithms of their likelihoods, relative to the best.
    pub curve: Vec<[f64; 2]>,
    /// Seconds since the first picture, and where the hand was along the axis in which it moved most, mm: by the pictures, by the arm.
    pub traces: Vec<[f64; 3]>,
}

impl PathOffset {
    /// Whether it may be relied on.
    pub fn is_sure(&self) -> bool {
        self.sigma_ms < 10.0 && self.explained > 0.5 && self.distinctness > 4.5
    }

    /// The mean of two that one arm's readings and two paths through the same pictures told: the readings' errors are the same in both, and
    /// by how much they differ the paths err.
    pub fn averaged(self, other: &Self) -> Self {
        let (one_ms, other_ms) = (self.offset.milliseconds(), other.offset.milliseconds());
        // Of two with deviation s each, the mean has s/√2 and the difference √2·s: the mean's deviation is half the difference.
        let paths_ms = 0.5 * (one_ms - other_ms).abs();
        Self {
            offset: Span::from_milliseconds(0.5 * (one_ms + other_ms)),
            sigma_ms: self.sigma_ms.max(other.sigma_ms).hypot(paths_ms),
            ..self
        }
    }
}

/// Offsets of several stretches of a recording taken together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Combined {
    /// Add to a pose stamp to get the camera's clock.
    pub offset: Span,
    /// Standard deviation, ms.
    pub sigma_ms: f64,
    /// By how many times the stretches differ more than their deviations allow; 1 where they agree.
    pub scatter: f64,
}

/// The weighted mean; if the stretches differ by more than they should, its deviation grows by as much (Birge 1932).
pub fn combined(offsets: &[PathOffset]) -> Option<Combined> {
    let weights: f64 = offsets.iter().map(|found| found.sigma_ms.powi(-2)).sum();
    if offsets.is_empty() || !weights.is_finite() {
        return None;
    }
    let mean = (offsets.iter())
        .map(|found| found.offset.milliseconds() * found.sigma_ms.powi(-2))
        .sum::<f64>()
        / weights;
    let misfit: f64 = (offsets.iter())
        .map(|found| ((found.offset.milliseconds() - mean) / found.sigma_ms).powi(2))
        .sum();
    let scatter = (misfit / (offsets.len().max(2) - 1) as f64).sqrt().max(1.0);
    Some(Combined {
        offset: Span::from_milliseconds(mean),
        sigma_ms: scatter / weights.sqrt(),
        scatter,
    })
}

/// Why no offset can be told.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PathOffsetError {
    /// Path and readings hardly overlap.
    #[error(
        "expected at least {FEWEST_READINGS} of the arm's readings while the camera's path is known, found {found}: record longer, and \
        check that poses and frames.csv are on clocks less than the range searched apart"
    )]
    TooFewReadings {
        /// Found.
        found: usize,
    },
    /// Nothing moved, or evenly.
    #[error(
        "the motion does not tell the offset: swing the scope to and fro in several directions, and not evenly, while recording"
    )]
    NotObserved,
    /// The best fit lies at the end of what was searched.
    #[error("the best offset lies at the end of the range searched, {at_ms:.0} ms: search farther with --range-ms")]
    AtTheEnd {
        /// Where.
        at_ms: f64,
    },
}

/// Find the offset within ± `range` around `about`.
pub fn estimate(
    path: &CameraPath,
    arm: &[TimedPose],
    hand_from_camera: &Transform<Hand, Camera>,
    about: Span,
    range: Span,
) -> Result<PathOffset, PathOffsetError> {
    let matching = Matching {
        path,
        arm,
        hand_from_camera: *hand_from_camera.isometry(),
    };
    let (center_ms, range_ms) = (about.milliseconds(), range.milliseconds());
    let steps = (range_ms / COARSE_MS).ceil().max(2.0) as i32;
    let offsets: Vec<f64> = (-steps..=steps).map(|k| center_ms + f64::from(k) * COARSE_MS).collect();
    let most = (offsets.iter()).map(|&ms| matching.readings(ms).count()).max().unwrap_or(0);
    if most < FEWEST_READINGS {
        return Err(PathOffsetError::TooFewReadings { found: most });
    }
    // Where most of the path has no reading, what is left fits too easily.
    let coarse: Vec<(f64, Fit)> = (offsets.into_par_iter())
        .filter(|&ms| 10 * matching.readings(ms).count() > 6 * most)
        .filter_map(|ms| Some((ms, matching.fitted(ms, OffsetIs::Held)?)))
        .collect();
    let (best_ms, _) = (coarse.iter())
        .min_by(|a, b| a.1.mean_log_noise.total_cmp(&b.1.mean_log_noise))
        .ok_or(PathOffsetError::NotObserved)?;
    let ends = [coarse.first(), coarse.last()].map(|end| end.map_or(*best_ms, |(ms, _)| *ms));
    if ends.contains(best_ms) {
        return Err(PathOffsetError::AtTheEnd { at_ms: *best_ms });
    }
    let best = matching
        .fitted(*best_ms, OffsetIs::Sought)
        .ok_or(PathOffsetError::NotObserved)?;
    let offset_ms = best.state.offset_ms;
    if (offset_ms - best_ms).abs() > 3.0 * COARSE_MS {
        return Err(PathOffsetError::NotObserved);
    }
    let [white_sigma_ms, alike_sigma_ms] = matching.deviations(&best).ok_or(PathOffsetError::NotObserved)?;
    let sigma_ms = alike_sigma_ms * matching.scatter_of_parts(offset_ms);
    // Readings count as far as they tell something new.
    let count = best.count as f64 * (white_sigma_ms / sigma_ms).powi(2);
    let curve: Vec<[f64; 2]> = (coarse.iter())
        .map(|(ms, fit)| [*ms, -0.5 * count * (fit.mean_log_noise - best.mean_log_noise)])
        .collect();
    let rivals = curve
        .iter()
        .filter(|[ms, _]| (ms - offset_ms).abs() > PEAK_MS.min(0.5 * range_ms));
    Ok(PathOffset {
        offset: Span::from_milliseconds(offset_ms),
        sigma_ms,
        white_sigma_ms,
        explained: matching.explained(&best),
        distinctness: -rivals.map(|[_, likelihood]| *likelihood).fold(f64::NEG_INFINITY, f64::max),
        arm_noise: best.noise,
        readings: best.count,
        traces: matching.traces(&best),
        curve,
    })
}

impl Matching<'_> {
    /// Share of the variance of place and of turn that is no residual; the worse of the two.
    fn explained(&self, fit: &Fit) -> f64 {
        let used: Vec<&TimedPose> = self.readings(fit.state.offset_ms).collect();
        let mean = used.iter().map(|r| r.base_from_hand.translation()).sum::<Vector3<f64>>() / used.len().max(1) as f64;
        let middle = used
            .get(used.len() / 2)
            .map_or(UnitQuaternion::identity(), |r| r.base_from_hand.rotation());
        let turns: Vec<Vector3<f64>> = (used.iter())
            .map(|r| (middle.inverse() * r.base_from_hand.rotation()).scaled_axis())
            .collect();
        let mean_turn = turns.iter().sum::<Vector3<f64>>() / turns.len().max(1) as f64;
        let (mut all, mut rest) = ([0.0; 2], [0.0; 2]);
        for (reading, turn) in used.iter().zip(&turns) {
            let Some(residual) = self.residual(&fit.state, reading) else {
                continue;
            };
            all[0] += (reading.base_from_hand.translation() - mean).norm_squared();
            all[1] += (turn - mean_turn).norm_squared();
            rest[0] += residual.fixed_rows::<3>(0).norm_squared();
            rest[1] += residual.fixed_rows::<3>(3).norm_squared();
        }
        (0..2).map(|kind| 1.0 - rest[kind] / all[kind].max(1e-12)).fold(1.0, f64::min)
    }

    fn traces(&self, fit: &Fit) -> Vec<[f64; 3]> {
        let used: Vec<&TimedPose> = self.readings(fit.state.offset_ms).collect();
        let mean = used.iter().map(|r| r.base_from_hand.translation()).sum::<Vector3<f64>>() / used.len().max(1) as f64;
        let spread: nalgebra::Matrix3<f64> = (used.iter())
            .map(|r| {
                let away = r.base_from_hand.translation() - mean;
                away * away.transpose()
            })
            .sum();
        let axes = spread.symmetric_eigen();
        let axis = axes.eigenvectors.column(axes.eigenvalues.imax()).into_owned();
        let start = self.path.poses().first().map_or(Timestamp(0), |first| first.at);
        (used.iter())
            .filter_map(|reading| {
                let at = reading.stamp + Span::from_milliseconds(fit.state.offset_ms);
                let camera = self.path.at(at)?;
                let hand = fit.state.gauge.moved(camera.isometry()) * fit.state.hand_from_camera.inverse();
                let along = |place: Vector3<f64>| axis.dot(&(place - mean));
                let read = reading.base_from_hand.translation();
                Some([(at - start).seconds(), along(hand.translation.vector), along(read)])
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::calibration::time_offset::camera_path::PosedPicture;
    use crate::geometry::alignment::Similarity;
    use crate::geometry::space::{RobotBase, World};

    const LATE_MS: f64 = 37.0;

    fn hand_from_camera() -> Transform<Hand, Camera> {
        Transform::new(
            UnitQuaternion::from_euler_angles(0.2, -0.4, 1.3),
            Vector3::new(2.0, -3.0, 300.0),
        )
    }

    /// A scope swung about a trocar 200 mm from its tip, at `pace` times a survey's.
    fn camera(t: f64, pace: f64) -> Transform<RobotBase, Camera> {
        let a = pace * t;
        let turn = UnitQuaternion::from_euler_angles(0.2 * (2.3 * a).sin(), 0.16 * (1.3 * a + 0.4).sin(), 0.06 * (0.9 * a).sin());
        let depth = 150.0 + 12.0 * (1.7 * a + 1.0).sin();
        Transform::new(turn, turn * Vector3::new(0.0, 0.0, depth) + Vector3::new(50.0, 20.0, -100.0))
    }

    /// Six seconds: the pictures' path in a space and scale of its own, 25 poses a second; readings 50 a second, late, with errors of
    /// 0.25 mm and 0.08° that forget themselves over `alike_s`.
    fn recorded(seed: u64, pace: f64, alike_s: f64) -> (CameraPath, Vec<TimedPose>) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut deviate = |sigma: f64| sigma * random.sample::<f64, _>(StandardNormal);
        let world = Similarity {
            rotation: UnitQuaternion::from_euler_angles(1.0, 0.3, -2.0),
            translation: Vector3::new(5.0, -8.0, 3.0),
            scale: 0.7,
        };
        let poses = (0..=150).map(|i| {
            let t = f64::from(i) * 0.04;
            let seen: Transform<World, Camera> = Transform::from_isometry(world.moved(camera(t, pace).isometry()));
            let noise = Vector6::from_fn(|axis, _| deviate(if axis < 3 { 0.01 } else { 5e-5 }));
            PosedPicture {
                at: Timestamp::from_seconds(t),
                world_from_camera: seen.perturbed_right(&noise),
            }
        });
        let path = CameraPath::new(poses.collect(), Span::from_milliseconds(200.0));
        let keep: f64 = if alike_s > 0.0 { (-0.02 / alike_s).exp() } else { 0.0 };
        let mut error = Vector6::zeros();
        let arm = (-15..320).map(|i| {
            let t = f64::from(i) * 0.02;
            let fresh = Vector6::from_fn(|axis, _| deviate(if axis < 3 { 0.25 } else { 0.0014 }));
            error = error * keep + fresh * (1.0 - keep * keep).sqrt();
            TimedPose {
                stamp: Timestamp::from_seconds(t + LATE_MS / 1000.0),
                base_from_hand: (camera(t, pace) * hand_from_camera().inverse()).perturbed_right(&error),
            }
        });
        let arm = arm.collect();
        (path, arm)
    }

    fn found(seed: u64, pace: f64, alike_s: f64) -> Result<PathOffset, PathOffsetError> {
        let (path, arm) = recorded(seed, pace, alike_s);
        let range = Span::from_milliseconds(300.0);
        estimate(&path, &arm, &hand_from_camera(), Span(0), range)
    }

    /// The hand swings at about 0.25 rad/s and turns 0.0014 rad awry per axis: 5.6 ms a reading, 0.3 ms from 300 of them; the hand's
    /// own place tells as much again, G and X take some of it. Stated and true deviations must agree: of 24 seeds the mean square of
    /// error over deviation is within 1 ± 3·√(2/24), and the white noise is found to be white.
    #[test]
    fn the_offset_is_as_good_as_it_says() {
        let (mut ratio, mut squares) = (0.0, 0.0);
        for seed in 0..24 {
            let found = found(seed, 1.0, 0.0).unwrap();
            let error = found.offset.milliseconds() + LATE_MS;
            assert!(found.is_sure(), "{seed}: {found:?}");
            assert!(
                found.sigma_ms < 1.0 && error.abs() < 4.0 * found.sigma_ms,
                "{seed}: {error} ± {}",
                found.sigma_ms
            );
            assert!((found.arm_noise[0] / 0.25).ln().abs() < 0.2 && (found.arm_noise[1] / 0.0014).ln().abs() < 0.2);
            ratio += (error / found.sigma_ms).powi(2) / 24.0;
            squares += error * error / 24.0;
        }
        assert!(ratio < 1.0 + 3.0 * (2.0_f64 / 24.0).sqrt(), "{ratio}");
        assert!(ratio > 0.25, "the deviation is far too large: {ratio}");
        assert!(squares.sqrt() < 0.6, "{}", squares.sqrt());
    }

    #[test]
    fn errors_that_last_are_owned_up_to() {
        for alike_s in [0.05, 0.2] {
            let mut ratio = 0.0;
            for seed in 100..124 {
                let found = found(seed, 1.0, alike_s).unwrap();
                let error = found.offset.milliseconds() + LATE_MS;
                assert!(error.abs() < 4.5 * found.sigma_ms, "{seed}: {error} ± {}", found.sigma_ms);
                ratio += (error / found.sigma_ms).powi(2) / 24.0;
            }
            assert!(ratio < 1.0 + 3.0 * (2.0_f64 / 24.0).sqrt(), "{alike_s} s: {ratio}");
        }
    }

    #[test]
    fn rest_another_arm_and_a_range_too_narrow_are_not_taken_for_an_answer() {
        let unsure = |found: Result<PathOffset, PathOffsetError>| found.as_ref().map_or(true, |found| !found.is_sure());
        let rest = found(1, 0.01, 0.0);
        assert!(unsure(rest.clone()), "{rest:?}");
        let range = Span::from_milliseconds(300.0);
        let (path, _) = recorded(2, 1.0, 0.0);
        let (_, other) = recorded(2, 1.37, 0.0);
        let mixed = estimate(&path, &other, &hand_from_camera(), Span(0), range);
        assert!(unsure(mixed.clone()), "{mixed:?}");
        let (path, arm) = recorded(3, 1.0, 0.0);
        let narrow = estimate(&path, &arm, &hand_from_camera(), Span(0), Span::from_milliseconds(20.0));
        assert!(unsure(narrow.clone()), "{narrow:?}");
        let none = estimate(&path, &arm[..10], &hand_from_camera(), Span(0), range);
        assert!(matches!(none, Err(PathOffsetError::TooFewReadings { .. })), "{none:?}");
    }

    #[test]
    fn stretches_that_disagree_are_less_sure_together() {
        let stretches: Vec<PathOffset> = [7, 8, 9].into_iter().map(|seed| found(seed, 1.0, 0.0).unwrap()).collect();
        let agreeing = combined(&stretches).unwrap();
        assert!((agreeing.offset.milliseconds() + LATE_MS).abs() < 4.0 * agreeing.sigma_ms);
        let mut torn = stretches;
        torn[2].offset = Span::from_milliseconds(-77.0);
        let torn = combined(&torn).unwrap();
        assert!(
            torn.scatter > 10.0 && torn.sigma_ms > 10.0 && agreeing.sigma_ms < 0.6,
            "{torn:?} {agreeing:?}"
        );
        assert!(combined(&[]).is_none());
    }

    /// A hand-eye transform that is 1 mm and half a degree off is within what is allowed for.
    #[test]
    fn a_hand_eye_transform_that_is_not_quite_right_does_no_harm() {
        let (path, arm) = recorded(4, 1.0, 0.0);
        let wrong = hand_from_camera().perturbed_right(&Vector6::new(0.8, -0.5, 0.3, 0.006, -0.005, 0.004));
        let found = estimate(&path, &arm, &wrong, Span(0), Span::from_milliseconds(300.0)).unwrap();
        assert!(
            (found.offset.milliseconds() + LATE_MS).abs() < 4.0 * found.sigma_ms,
            "{found:?}"
        );
    }
}
