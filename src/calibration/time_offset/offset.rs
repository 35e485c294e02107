//! The shift of the arm's clock at which the arm's motion explains the picture's best.
//!
//! Over windows of some tenths of a second, the picture's motion (four numbers) is a linear function of the hand's motion (six), whatever the
//! camera's place on the hand and as long as the tissue's distance changes little. At each shift τ that function is found by least
//! squares; the likelihood of τ is −n/2·Σ ln(1 − R²) over those of the four numbers that it explains at some τ, R² being the share
//! explained (Bates and Watts 1988, on profile likelihoods). Coarse, then fine; the deviation of τ from the likelihood's curvature. n counts windows as far as their residuals
//! are independent. Long windows time better, short ones are more: the length that tells most is taken.
//! PLUS (Lasso et al. 2014) correlates one number of each instead, and needs a phantom for it.

use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

use crate::calibration::time_offset::image_motion::ImageMotion;
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::pose_buffer::{Origin, PoseBuffer};
use crate::time::{Span, Timestamp};

/// Motion is summed over at least so long, s.
const WINDOWS_S: [f64; 4] = [0.2, 0.4, 0.8, 1.6];
/// A rival likelihood this near to the peak is the peak's own slope, ms.
const PEAK_MS: f64 = 200.0;
/// Coarse steps, ms.
const COARSE_MS: f64 = 10.0;
/// Fine steps, ms …
const FINE_MS: f64 = 1.0;
/// … to this far from the coarse best, ms; a parabola is laid through the fine ones.
const FINE_REACH_MS: f64 = 12.0;
/// A number of which the arm leaves more than this unexplained at its best is not heard, unless it is the best there is.
const HEARD_UNEXPLAINED: f64 = 0.5;
/// Into how many parts a recording is cut to see whether they agree.
const PARTS: usize = 3;
/// The hand's motion: six numbers, and one for what the picture does of itself.
const INPUTS: usize = 7;
/// With fewer independent windows the linear function bends to whatever the camera did: some ten seconds are wanted.
const SURE_WINDOWS: f64 = 50.0;
/// Overlapping windows may be independent in what they err, but not in how the hand moved: in less time than this it has moved in too few
/// ways, s.
const SURE_S: f64 = 6.0;
/// Fewer windows than this that do not overlap tell nothing.
const LEAST_WINDOWS: f64 = 12.0;

/// How a picture moved since the one before.
#[derive(Clone, Copy, Debug)]
pub struct TimedMotion {
    /// Exposure of the one before.
    pub from: Timestamp,
    /// Exposure of the picture.
    pub to: Timestamp,
    /// Its motion.
    pub motion: ImageMotion,
}

/// The offset found, and how sure it is.
#[derive(Clone, Debug)]
pub struct Offset {
    /// Add to a pose stamp to get the camera's clock.
    pub offset: Span,
    /// Standard deviation, ms.
    pub sigma_ms: f64,
    /// Share of the picture's motion that the arm's explains there, 0–1, of the number that is explained best.
    pub explained: f64,
    /// By how much the logarithm of the likelihood is higher than anywhere farther off than a window.
    pub distinctness: f64,
    /// Length of the windows, s, and how many of them are independent.
    pub windows: [f64; 2],
    /// From the first window's begin to the last one's end, s.
    pub seconds: f64,
    /// Offsets tried (ms) and the logarithms of their likelihoods.
    pub curve: Vec<[f64; 2]>,
    /// Seconds since the first picture, and the number that is explained best, per window: of the picture, and by the arm.
    pub traces: Vec<[f64; 3]>,
}

impl Offset {
    /// Whether it may be relied on.
    pub fn is_sure(&self) -> bool {
        self.sigma_ms < 20.0
            && self.explained > 0.3
            && self.distinctness > 3.0
            && self.windows[1] > SURE_WINDOWS
            && self.seconds > SURE_S
    }
}

/// Why no offset can be told.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum OffsetError {
    /// Too short, or hardly any pose at its pictures.
    #[error(
        "expected at least {:.0} s of pictures with arm poses around them, found {seconds:.1} s: record longer, and check that poses and \
        frames.csv are on clocks less than {range_s:.1} s apart", LEAST_WINDOWS * WINDOWS_S[0]
    )]
    TooShort {
        /// Found.
        seconds: f64,
        /// Searched.
        range_s: f64,
    },
    /// Nothing moved.
    #[error(
        "the picture's motion tells nothing about the arm's: move the arm, in several directions and not evenly, while recording"
    )]
    NoMotion,
    /// The best fit lies at the end of what was searched.
    #[error("the best offset lies at the end of the range searched, {at_ms:.0} ms: search farther with --range-ms")]
    AtTheEnd {
        /// Where.
        at_ms: f64,
    },
}

/// Find the offset within ± `range` around `about`.
pub fn estimate(motions: &[TimedMotion], arm: &PoseBuffer, about: Span, range: Span) -> Result<Offset, OffsetError> {
    let arm = &Path::of(arm);
    let mut found = best_window(motions, arm, about, range)?;
    // That a linear function does for the whole is only assumed. Where it does not, parts of the recording tell it by what they say.
    let count = motions.len().div_ceil(PARTS).max(1);
    let parts: Vec<f64> = (motions.chunks(count))
        .filter_map(|part| Some(best_window(part, arm, about, range).ok()?.offset.milliseconds()))
        .collect();
    if parts.len() >= 2 {
        let n = parts.len() as f64;
        let mean = parts.iter().sum::<f64>() / n;
        let of_mean = parts.iter().map(|part| (part - mean).powi(2)).sum::<f64>() / (n * (n - 1.0));
        found.sigma_ms = found.sigma_ms.max(of_mean.sqrt());
    }
    Ok(found)
}

/// The same over a few seconds, too few to be cut into parts.
pub fn glance(motions: &[TimedMotion], arm: &PoseBuffer, about: Span, range: Span) -> Result<Offset, OffsetError> {
    best_window(motions, &Path::of(arm), about, range)
}

fn best_window(motions: &[TimedMotion], arm: &Path, about: Span, range: Span) -> Result<Offset, OffsetError> {
    let estimates = WINDOWS_S.map(|window_s| estimate_over(window_s, motions, arm, about, range));
    let best = (estimates.iter().flatten())
        .min_by(|a, b| a.sigma_ms.total_cmp(&b.sigma_ms))
        .cloned();
    let [shortest, ..] = estimates;
    best.map_or(shortest, Ok)
}

fn estimate_over(window_s: f64, motions: &[TimedMotion], arm: &Path, about: Span, range: Span) -> Result<Offset, OffsetError> {
    let all = windows(motions, window_s);
    let (center_ms, range_ms) = (about.milliseconds(), range.milliseconds());
    let steps = (range_ms / COARSE_MS).ceil() as i32;
    // Only windows that have poses at every offset tried: else the number of windows decides, not their fit.
    let ends = [center_ms - range_ms - FINE_REACH_MS, center_ms + range_ms + FINE_REACH_MS];
    let windows: Vec<&Window> = (all.iter())
        .filter(|window| ends.iter().all(|&ms| hand_motion(arm, window, ms).is_some()))
        .collect();
    let apart = windows_apart(&windows);
    if apart < LEAST_WINDOWS {
        return Err(OffsetError::TooShort {
            seconds: apart * window_s,
            range_s: range.seconds(),
        });
    }
    let fits = |around_ms: f64, step_ms: f64, steps: i32| -> Vec<(f64, Fit)> {
        let fit_at = |k: i32| around_ms + f64::from(k) * step_ms;
        let fits = (-steps..=steps).into_par_iter().map(fit_at);
        fits.filter_map(|ms| Some((ms, fit(&windows, arm, ms)?))).collect()
    };
    let coarse = fits(center_ms, COARSE_MS, steps);
    // A number that the arm does not explain at any offset moves for reasons of its own, and at times of its own.
    let least: [f64; 4] = std::array::from_fn(|c| coarse.iter().map(|(_, fit)| fit.unexplained_logs[c]).fold(0.0, f64::min));
    let bar = HEARD_UNEXPLAINED.ln().max(least.iter().copied().fold(0.0, f64::min));
    let unexplained_log = |fit: &Fit| {
        (0..4)
            .filter(|&c| least[c] <= bar)
            .map(|c| fit.unexplained_logs[c])
            .sum::<f64>()
    };
    let (coarse_ms, _) = (coarse.iter())
        .min_by(|a, b| unexplained_log(&a.1).total_cmp(&unexplained_log(&b.1)))
        .ok_or(OffsetError::NoMotion)?;
    if (coarse_ms - center_ms).abs() > range_ms - COARSE_MS {
        return Err(OffsetError::AtTheEnd { at_ms: *coarse_ms });
    }
    let fine = fits(*coarse_ms, FINE_MS, (FINE_REACH_MS / FINE_MS) as i32);
    let points: Vec<[f64; 2]> = fine.iter().map(|(ms, fit)| [ms - coarse_ms, unexplained_log(fit)]).collect();
    let [lowest, curvature] = parabola(&points)
        .filter(|[_, curvature]| *curvature > 0.0)
        .ok_or(OffsetError::NoMotion)?;
    let offset_ms = coarse_ms + lowest.clamp(-FINE_REACH_MS, FINE_REACH_MS);
    let at_best = fit(&windows, arm, offset_ms).ok_or(OffsetError::NoMotion)?;
    let count = independent(&windows, arm, offset_ms, &at_best).ok_or(OffsetError::NoMotion)?;
    let likelihood = |fit: &Fit| -0.5 * count * unexplained_log(fit);
    let rivals = coarse
        .iter()
        .filter(|(ms, _)| (ms - offset_ms).abs() > PEAK_MS.min(0.5 * range_ms));
    let rival = rivals.map(|(_, fit)| likelihood(fit)).fold(f64::NEG_INFINITY, f64::max);
    Ok(Offset {
        offset: Span::from_milliseconds(offset_ms),
        sigma_ms: (2.0 / (count * curvature)).sqrt(),
        explained: at_best.explained,
        distinctness: likelihood(&at_best) - rival,
        windows: [window_s, count],
        seconds: windows
            .first()
            .zip(windows.last())
            .map_or(0.0, |(first, last)| (last.to - first.from).seconds()),
        curve: coarse.iter().map(|(ms, fit)| [*ms, likelihood(fit)]).collect(),
        traces: traces(&windows, arm, offset_ms, &at_best),
    })
}

fn traces(windows: &[&Window], arm: &Path, offset_ms: f64, fit: &Fit) -> Vec<[f64; 3]> {
    let start = windows.first().map_or(Timestamp(0), |first| first.from);
    (windows.iter())
        .filter_map(|window| {
            let by_arm = fit.picture_from_hand.transpose() * hand_motion(arm, window, offset_ms)?;
            let middle_s = 0.5 * ((window.from - start).seconds() + (window.to - start).seconds());
            Some([middle_s, window.motion[fit.best], by_arm[fit.best]])
        })
        .collect()
}

/// How many of the overlapping windows count as independent: their number over the sum of their residuals' correlations (Bartlett 1946).
fn independent(windows: &[&Window], arm: &Path, offset_ms: f64, fit: &Fit) -> Option<f64> {
    let residuals: Vec<[f64; 4]> = windows
        .iter()
        .map(|window| {
            let explained = fit.picture_from_hand.transpose() * hand_motion(arm, window, offset_ms)?;
            Some(std::array::from_fn(|c| window.motion[c] - explained[c]))
        })
        .collect::<Option<_>>()?;
    // As far as windows that begin later overlap.
    let reach = windows.partition_point(|window| window.from < windows[0].to) + 2;
    let correlation = |lag: usize| {
        let pairs = residuals.iter().zip(&residuals[lag.min(residuals.len())..]);
        let sums = pairs.fold([0.0; 4], |mut sums, (a, b)| {
            (0..4).for_each(|c| sums[c] += a[c] * b[c]);
            sums
        });
        let whole = residuals.iter().fold([1e-30; 4], |mut whole, a| {
            (0..4).for_each(|c| whole[c] += a[c] * a[c]);
            whole
        });
        (0..4).map(|c| sums[c] / whole[c]).sum::<f64>() / 4.0
    };
    let sum: f64 = (1..=reach).map(correlation).sum();
    let count = windows.len() as f64;
    Some((count / (1.0 + 2.0 * sum).max(1.0)).max(windows_apart(windows)).min(count))
}

/// The arm's path, smoothed once and read between near steps: it is asked for thousands of instants.
#[derive(Debug)]
struct Path {
    start: Timestamp,
    poses: Vec<Option<Transform<RobotBase, Hand>>>,
}

/// Between steps of the path, ms.
const PATH_STEP_MS: f64 = 4.0;

impl Path {
    fn of(arm: &PoseBuffer) -> Self {
        let mut stamps = arm.samples().map(|sample| sample.stamp);
        let start = stamps.next().unwrap_or(Timestamp(0));
        let length_ms = (stamps.last().unwrap_or(start) - start).milliseconds();
        let steps = (length_ms / PATH_STEP_MS) as usize + 1;
        let pose = |step: usize| {
            let found = arm
                .pose_at(start + Span::from_milliseconds(step as f64 * PATH_STEP_MS))
                .ok()?;
            (found.origin == Origin::Measured).then_some(found.base_from_hand)
        };
        Self {
            start,
            poses: (0..steps).into_par_iter().map(pose).collect(),
        }
    }

    fn at(&self, instant: Timestamp) -> Option<Transform<RobotBase, Hand>> {
        let steps = (instant - self.start).milliseconds() / PATH_STEP_MS;
        if steps < 0.0 {
            return None;
        }
        let before = steps as usize;
        let [a, b] = [before, before + 1].map(|index| self.poses.get(index).copied().flatten());
        Some(a?.interpolated(&b?, steps - before as f64))
    }
}

/// The picture's motion over a window.
#[derive(Clone, Copy, Debug)]
struct Window {
    from: Timestamp,
    to: Timestamp,
    motion: [f64; 4],
}

/// Windows that begin at each picture and end at the first one far enough from it, if no picture between is missing.
fn windows(motions: &[TimedMotion], window_s: f64) -> Vec<Window> {
    let from_each = (0..motions.len()).filter_map(|first| {
        let mut sum = [0.0; 4];
        for index in first..motions.len() {
            if index > first && motions[index].from != motions[index - 1].to {
                return None;
            }
            for (sum, part) in sum.iter_mut().zip(motions[index].motion.components()) {
                *sum += part;
            }
            let (from, to) = (motions[first].from, motions[index].to);
            if (to - from).seconds() >= window_s {
                return Some(Window { from, to, motion: sum });
            }
        }
        None
    });
    from_each.collect()
}

/// How many windows would fit into the time they cover without overlapping.
fn windows_apart(windows: &[&Window]) -> f64 {
    let mut count = 0.0;
    let mut end: Option<Timestamp> = None;
    for window in windows {
        if end.is_none_or(|end| window.from >= end) {
            count += 1.0;
            end = Some(window.to);
        }
    }
    count
}

/// The hand's motion during a window if the offset is `offset_ms`: mm and rad in the hand's own axes at its start.
fn hand_motion(arm: &Path, window: &Window, offset_ms: f64) -> Option<SVector<f64, INPUTS>> {
    let offset = Span::from_milliseconds(offset_ms);
    let moved = arm.at(window.from - offset)?.inverse() * arm.at(window.to - offset)?;
    let (shift, turn) = (moved.translation(), moved.rotation().scaled_axis());
    // In units of like size, so that the normal equations are well conditioned.
    Some(SVector::from([
        shift.x,
        shift.y,
        shift.z,
        100.0 * turn.x,
        100.0 * turn.y,
        100.0 * turn.z,
        1.0,
    ]))
}

/// How well the arm's motion explains the picture's.
#[derive(Clone, Copy, Debug)]
struct Fit {
    /// ln(1 − R²) of the four numbers.
    unexplained_logs: [f64; 4],
    /// The largest R², and of which number.
    explained: f64,
    best: usize,
    /// The linear function.
    picture_from_hand: SMatrix<f64, INPUTS, 4>,
}

fn fit(windows: &[&Window], arm: &Path, offset_ms: f64) -> Option<Fit> {
    let mut normal = SMatrix::<f64, INPUTS, INPUTS>::zeros();
    let mut side = SMatrix::<f64, INPUTS, 4>::zeros();
    let (mut sums, mut squares) = ([0.0; 4], [0.0; 4]);
    for window in windows {
        let input = hand_motion(arm, window, offset_ms)?;
        normal += input * input.transpose();
        side += input * nalgebra::RowVector4::from(window.motion);
        for c in 0..4 {
            sums[c] += window.motion[c];
            squares[c] += window.motion[c].powi(2);
        }
    }
    let count = windows.len() as f64;
    // A direction in which the hand does not move must not decide.
    for i in 0..INPUTS {
        normal[(i, i)] += 1e-6 * count;
    }
    let solution = normal.cholesky()?.solve(&side);
    let mut fit = Fit {
        unexplained_logs: [0.0; 4],
        explained: 0.0,
        best: 0,
        picture_from_hand: solution,
    };
    for c in 0..4 {
        let total = squares[c] - sums[c].powi(2) / count;
        let rest = (squares[c] - solution.column(c).dot(&side.column(c))).max(1e-9 * total);
        if total > 0.0 {
            let unexplained = (rest / total).clamp(1e-9, 1.0);
            fit.unexplained_logs[c] = unexplained.ln();
            if 1.0 - unexplained > fit.explained {
                (fit.explained, fit.best) = (1.0 - unexplained, c);
            }
        }
    }
    Some(fit)
}

/// Where the parabola through the points (least squares) peaks, and its second derivative.
fn parabola(points: &[[f64; 2]]) -> Option<[f64; 2]> {
    let mut normal = nalgebra::Matrix3::zeros();
    let mut side = nalgebra::Vector3::zeros();
    for [x, y] in points {
        let row = nalgebra::Vector3::new(1.0, *x, x * x);
        normal += row * row.transpose();
        side += *y * row;
    }
    let solution = normal.cholesky()?.solve(&side);
    let curvature = 2.0 * solution[2];
    Some([-solution[1] / curvature, curvature])
}

#[cfg(test)]
pub(super) mod tests {
    use nalgebra::{UnitQuaternion, Vector3};
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;
    use crate::robot::pose_buffer::Settings;
    use crate::robot::trajectory::TimedPose;

    /// An arm that wanders, read 100 times a second with noise, its stamps late by `late_ms`, and the picture's motion at `rate_hz`.
    pub fn wandering(seed: u64, seconds: f64, rate_hz: f64, late_ms: impl Fn(f64) -> f64) -> (Vec<TimedMotion>, PoseBuffer) {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut noise = |size: f64| size * random.sample::<f64, _>(StandardNormal);
        let phase: Vec<f64> = (0..12).map(|_| noise(3.0)).collect();
        let pose = |t: f64| {
            let wave = |i: usize, hz: f64| {
                (std::f64::consts::TAU * hz * t + phase[i]).sin()
                    + 0.6 * (std::f64::consts::TAU * 1.7 * hz * t + phase[i + 6]).sin()
            };
            (
                Vector3::new(12.0 * wave(0, 0.21), 9.0 * wave(1, 0.17), 6.0 * wave(2, 0.13)),
                Vector3::new(0.08 * wave(3, 0.11), 0.06 * wave(4, 0.19), 0.1 * wave(5, 0.15)),
            )
        };
        let mut buffer = PoseBuffer::new(&Settings {
            kept_ms: 1e6,
            ..Settings::default()
        })
        .unwrap();
        for i in 0..((seconds + 2.0) * 100.0) as i64 {
            let t = i as f64 * 0.01 - 1.0;
            let (place, turn) = pose(t);
            let place = place + Vector3::from_fn(|_, _| noise(0.25));
            let turn = turn + Vector3::from_fn(|_, _| noise(0.0014));
            buffer.push(TimedPose {
                // A stamp that is late is larger than the truth; the offset to be added is negative.
                stamp: Timestamp::from_seconds(t + late_ms(t) / 1000.0),
                base_from_hand: Transform::new(UnitQuaternion::from_scaled_axis(turn), place),
            });
        }
        let frames = (seconds * rate_hz) as usize;
        let hand = |t: f64| {
            let (place, turn) = pose(t);
            Transform::<RobotBase, Hand>::new(UnitQuaternion::from_scaled_axis(turn), place)
        };
        let motions = (1..frames).map(|k| {
            let (a, b) = ((k - 1) as f64 / rate_hz, k as f64 / rate_hz);
            let moved = hand(a).inverse() * hand(b);
            let (shift, turn) = (moved.translation(), moved.rotation().scaled_axis());
            TimedMotion {
                from: Timestamp::from_seconds(a),
                to: Timestamp::from_seconds(b),
                motion: ImageMotion {
                    right: 0.011 * shift.x - 0.9 * turn.y + noise(1e-4),
                    down: 0.011 * shift.y + 0.9 * turn.x + noise(1e-4),
                    turn: turn.z + noise(2e-4),
                    growth: 0.012 * shift.z + noise(2e-4),
                },
            }
        });
        (motions.collect(), buffer)
    }

    #[test]
    fn the_offset_is_found_within_its_stated_deviation() {
        let cases = [
            (1, 25.0, 40.0),
            (2, 50.0, -63.0),
            (3, 25.0, 0.0),
            (4, 30.0, 117.0),
            (5, 50.0, 40.0),
            (6, 25.0, -20.0),
        ];
        let mut squares = 0.0;
        for (seed, rate_hz, late_ms) in cases {
            let (motions, arm) = wandering(seed, 30.0, rate_hz, |_| late_ms);
            let found = estimate(&motions, &arm, Span(0), Span::from_milliseconds(300.0)).unwrap();
            let error = found.offset.milliseconds() + late_ms;
            assert!(error.abs() < 4.0 * found.sigma_ms, "{seed}: {error} ± {} ms", found.sigma_ms);
            assert!(found.is_sure() && found.sigma_ms < 3.0, "{found:?}");
            squares += error * error;
        }
        let rms = (squares / cases.len() as f64).sqrt();
        assert!(rms < 3.0, "{rms} ms");
    }

    #[test]
    fn an_arm_at_rest_or_of_another_recording_tells_nothing() {
        let (motions, _) = wandering(5, 12.0, 25.0, |_| 0.0);
        let (_, other) = wandering(6, 12.0, 25.0, |_| 0.0);
        let unsure = |found: Result<Offset, OffsetError>| found.map_or(true, |found| !found.is_sure());
        assert!(unsure(estimate(&motions, &other, Span(0), Span::from_milliseconds(300.0))));
        let short = estimate(&motions[..30], &other, Span(0), Span::from_milliseconds(300.0));
        assert!(matches!(short, Err(OffsetError::TooShort { .. })), "{short:?}");
        // Rightly or not, but four seconds are not enough to know.
        let (motions, arm) = wandering(8, 4.0, 50.0, |_| 40.0);
        let brief = estimate(&motions, &arm, Span(0), Span::from_milliseconds(300.0));
        assert!(unsure(brief.clone()), "{brief:?}");
        let (motions, arm) = wandering(7, 12.0, 25.0, |_| 180.0);
        let narrow = estimate(&motions, &arm, Span(0), Span::from_milliseconds(150.0));
        assert!(matches!(narrow, Err(OffsetError::AtTheEnd { .. })), "{narrow:?}");
    }
}
