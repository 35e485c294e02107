//! Where the hand was at the instant of exposure.
//!
//! The arm reports at its own rate; the camera exposes in between. Translation is interpolated linearly and rotation along the
//! great arc (SLERP; Shoemake 1985). An arm's samples carry white noise (encoders, jitter of the stamps) while the scope moves
//! smoothly, so a local fit can average it away: translation and rotation vector are fitted by a line or a parabola over a window
//! of a few samples (Savitzky and Golay 1964, for uneven stamps; tricube weights as in Cleveland's LOESS 1979, which also gives
//! the robust second pass that disarms a single outlier). Fitted at its centre, a parabola follows any motion of constant
//! acceleration without bias; of N samples' noise about √(9/4N) is left, against √(1/2…1) for interpolation between two.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::trajectory::{TimedPose, Trajectory};
use crate::time::{Span, Timestamp};

/// How poses are found between samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Longest step between two samples that is bridged, ms.
    pub max_gap_ms: f64,
    /// How far beyond the first or last sample a pose is carried on, ms.
    pub max_extrapolation_ms: f64,
    /// Width of the window of the local fit, ms; 0 = interpolate the samples as they are.
    pub smoothing_ms: f64,
    /// How long samples are kept when they arrive one by one, ms.
    pub kept_ms: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_gap_ms: 200.0,
            max_extrapolation_ms: 50.0,
            smoothing_ms: 160.0,
            kept_ms: 20_000.0,
        }
    }
}

/// A setting out of its bounds.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("poses.{key}: expected a number from {lowest} to {highest}, found {found}")]
pub struct SettingsError {
    /// The setting.
    pub key: &'static str,
    /// Smallest value.
    pub lowest: f64,
    /// Largest value.
    pub highest: f64,
    /// The value given.
    pub found: f64,
}

/// How a pose was come by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Between samples.
    Measured,
    /// Carried on beyond the first or last sample.
    Predicted,
}

/// A pose at an instant.
#[derive(Clone, Copy, Debug)]
pub struct StampedPose {
    /// Where the hand was, mm.
    pub base_from_hand: Transform<RobotBase, Hand>,
    /// How it was come by.
    pub origin: Origin,
    /// Velocity of the hand's origin in the base, mm/s.
    pub velocity_mm_s: Vector3<f64>,
    /// Angular velocity in the base's axes, rad/s.
    pub angular_velocity_rad_s: Vector3<f64>,
}

/// Why there is no pose at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoseLookupError {
    /// Later than the last sample.
    #[error("no pose yet: the last sample is {} ms older", .0.milliseconds())]
    NotYet(Span),
    /// Earlier than the first sample kept.
    #[error("no pose any more: the first sample is {} ms younger", .0.milliseconds())]
    NoLonger(Span),
    /// Between two samples too far apart.
    #[error("no pose: the samples around it are {} ms apart", .0.milliseconds())]
    Gap(Span),
    /// No samples at all.
    #[error("no pose: the arm has not reported yet")]
    Empty,
}

/// The arm's samples in the order of time.
#[derive(Clone, Debug)]
pub struct PoseBuffer {
    settings: Settings,
    samples: std::collections::VecDeque<TimedPose>,
}

impl PoseBuffer {
    /// An empty buffer, to be filled sample by sample.
    pub fn new(settings: &Settings) -> Result<Self, SettingsError> {
        let bounds = [
            ("max_gap_ms", settings.max_gap_ms, 1.0, 10_000.0),
            ("max_extrapolation_ms", settings.max_extrapolation_ms, 0.0, 1_000.0),
            ("smoothing_ms", settings.smoothing_ms, 0.0, 2_000.0),
            ("kept_ms", settings.kept_ms, 100.0, 1e7),
        ];
        for (key, found, lowest, highest) in bounds {
            if !(lowest..=highest).contains(&found) {
                return Err(SettingsError {
                    key,
                    lowest,
                    highest,
                    found,
                });
            }
        }
        Ok(Self {
            settings: settings.clone(),
            samples: std::collections::VecDeque::new(),
        })
    }

    /// A buffer that holds a whole recorded trajectory.
    pub fn from_trajectory(trajectory: &Trajectory, settings: &Settings) -> Result<Self, SettingsError> {
        let mut buffer = Self::new(settings)?;
        buffer.samples.extend(trajectory.poses());
        Ok(buffer)
    }

    /// One more sample from the arm; one that is not later than the last is refused. Old ones are let go.
    pub fn push(&mut self, sample: TimedPose) -> bool {
        if self.samples.back().is_some_and(|last| last.stamp >= sample.stamp) || !sample.base_from_hand.is_finite() {
            return false;
        }
        let oldest_kept = sample.stamp - Span::from_milliseconds(self.settings.kept_ms);
        while self.samples.front().is_some_and(|first| first.stamp < oldest_kept) || self.samples.len() >= MOST_SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        true
    }

    /// Forget all samples: the arm's clock runs anew.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// The samples kept.
    pub fn samples(&self) -> impl Iterator<Item = &TimedPose> {
        self.samples.iter()
    }

    /// Where the hand was at `instant`, on the arm's clock.
    pub fn pose_at(&self, instant: Timestamp) -> Result<StampedPose, PoseLookupError> {
        let (Some(first), Some(last)) = (self.samples.front(), self.samples.back()) else {
            return Err(PoseLookupError::Empty);
        };
        let reach = Span::from_milliseconds(self.settings.max_extrapolation_ms);
        if instant < first.stamp - reach {
            return Err(PoseLookupError::NoLonger(first.stamp - instant));
        }
        if instant > last.stamp + reach {
            return Err(PoseLookupError::NotYet(instant - last.stamp));
        }
        let after = self.samples.partition_point(|sample| sample.stamp <= instant);
        let measured = instant >= first.stamp && instant <= last.stamp;
        // The pair around the instant, or the one nearest to it.
        let right = after.clamp(1, self.samples.len().max(2) - 1);
        let (Some(before), Some(behind)) = (self.samples.get(right - 1), self.samples.get(right)) else {
            return Ok(StampedPose {
                base_from_hand: first.base_from_hand,
                origin: if measured { Origin::Measured } else { Origin::Predicted },
                velocity_mm_s: Vector3::zeros(),
                angular_velocity_rad_s: Vector3::zeros(),
            });
        };
        let step = behind.stamp - before.stamp;
        let bridged = step.milliseconds() <= self.settings.max_gap_ms;
        let exact = instant == before.stamp || instant == behind.stamp;
        if measured && !bridged && !exact {
            return Err(PoseLookupError::Gap(step));
        }
        let origin = if measured { Origin::Measured } else { Origin::Predicted };
        if bridged && let Some(fitted) = self.fitted(instant, right - 1, origin) {
            return Ok(fitted);
        }
        Ok(interpolated(before, behind, instant, origin, bridged))
    }

    /// The local fit around `instant`; `None` when switched off or too few samples lie near.
    fn fitted(&self, instant: Timestamp, left: usize, origin: Origin) -> Option<StampedPose> {
        let half_ms = 0.5 * self.settings.smoothing_ms;
        let max_gap = Span::from_milliseconds(self.settings.max_gap_ms);
        let near = |sample: &TimedPose| (sample.stamp - instant).milliseconds().abs() < half_ms;
        // Grow outward from the instant; a gap ends the window.
        let mut from = left.min(self.samples.len() - 1);
        while from > 0 && near(&self.samples[from - 1]) && self.samples[from].stamp - self.samples[from - 1].stamp <= max_gap {
            from -= 1;
        }
        let mut to = left;
        while to + 1 < self.samples.len()
            && near(&self.samples[to + 1])
            && self.samples[to + 1].stamp - self.samples[to].stamp <= max_gap
        {
            to += 1;
        }
        if !near(&self.samples[from]) {
            from += 1;
        }
        if to < from || to - from + 1 < FEWEST_SAMPLES {
            return None;
        }
        let reference = self.samples[(from + to) / 2].base_from_hand.rotation();
        // Near the ends the window is one-sided: a parabola would swing, a line does not.
        let (first, last) = (self.samples[from].stamp, self.samples[to].stamp);
        let covered = |span: Span| span.milliseconds() >= 0.5 * half_ms;
        let parabola = to - from + 1 >= FEWEST_SAMPLES_OF_A_PARABOLA && covered(instant - first) && covered(last - instant);
        let deviations = |sample: &TimedPose| {
            let turned = (sample.base_from_hand.rotation() * reference.inverse()).scaled_axis();
            (sample.base_from_hand.translation(), turned)
        };
        let mut fits = None;
        // Weights from the residuals of the pass before (Cleveland 1979). The first pass has none, and in so short a window an
        // outlier would bend the fit to itself: there, a sample is held against the line between its two neighbours.
        for _ in 0..3 {
            let misfit = |i: usize| match &fits {
                Some(fits) => residuals(&self.samples[i], instant, half_ms, fits, deviations(&self.samples[i])),
                None => self.misfit_among_neighbours(i, from, to),
            };
            let scales = residual_scales((from..=to).map(misfit));
            let mut sums = (Sums::default(), Sums::default());
            for i in from..=to {
                let u = (self.samples[i].stamp - instant).milliseconds() / half_ms;
                let tricube = (1.0 - u.abs().powi(3)).powi(3);
                let (moved, turned) = deviations(&self.samples[i]);
                let (a, b) = misfit(i);
                sums.0.add(u, tricube * bisquare(a, scales.0), &moved);
                sums.1.add(u, tricube * bisquare(b, scales.1), &turned);
            }
            fits = Some((sums.0.solve(parabola)?, sums.1.solve(parabola)?));
        }
        let fits = fits?;
        let per_second = 1000.0 / half_ms;
        Some(StampedPose {
            base_from_hand: Transform::new(UnitQuaternion::from_scaled_axis(fits.1.value) * reference, fits.0.value),
            origin,
            velocity_mm_s: fits.0.slope * per_second,
            angular_velocity_rad_s: fits.1.slope * per_second,
        })
    }

    /// How far sample `i` lies from the line between its neighbours in the window, mm and rad.
    fn misfit_among_neighbours(&self, i: usize, from: usize, to: usize) -> (f64, f64) {
        let (before, after) = match i {
            _ if i == from => (i + 1, i + 2),
            _ if i == to => (i - 2, i - 1),
            _ => (i - 1, i + 1),
        };
        let (a, b, own) = (&self.samples[before], &self.samples[after], &self.samples[i]);
        let t = (own.stamp - a.stamp).seconds() / (b.stamp - a.stamp).seconds();
        let expected = a.base_from_hand.interpolated(&b.base_from_hand, t);
        let moved = (own.base_from_hand.translation() - expected.translation()).norm();
        (moved, (own.base_from_hand.rotation() * expected.rotation().inverse()).angle())
    }
}

/// However long samples are kept and however fast they come, an endless feed takes no more memory than this many (8 MB).
const MOST_SAMPLES: usize = 1 << 17;
/// Below this a fit averages nothing.
const FEWEST_SAMPLES: usize = 4;
/// A parabola through fewer would follow their noise.
const FEWEST_SAMPLES_OF_A_PARABOLA: usize = 6;
/// Samples so many times the median residual away count nothing (Cleveland 1979).
const BISQUARE_REACH: f64 = 6.0;

/// value + slope·u + bend·u², u in half windows from the instant.
#[derive(Clone, Copy, Debug, Default)]
struct LocalFit {
    value: Vector3<f64>,
    slope: Vector3<f64>,
    bend: Vector3<f64>,
}

/// Weighted moments of a window.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    powers: [f64; 5],
    values: [Vector3<f64>; 3],
}

impl Sums {
    fn add(&mut self, u: f64, weight: f64, value: &Vector3<f64>) {
        let mut factor = weight;
        for k in 0..5 {
            self.powers[k] += factor;
            if k < 3 {
                self.values[k] += value * factor;
            }
            factor *= u;
        }
    }

    fn solve(&self, parabola: bool) -> Option<LocalFit> {
        let s = &self.powers;
        if parabola {
            let normal = Matrix3::new(s[0], s[1], s[2], s[1], s[2], s[3], s[2], s[3], s[4]);
            let inverse = normal.try_inverse().filter(|m| m.iter().all(|v| v.is_finite()))?;
            let row = |i: usize| (0..3).map(|k| self.values[k] * inverse[(i, k)]).sum();
            return Some(LocalFit {
                value: row(0),
                slope: row(1),
                bend: row(2),
            });
        }
        let determinant = s[0] * s[2] - s[1] * s[1];
        if determinant <= 1e-9 * s[0] * s[0] {
            return None;
        }
        Some(LocalFit {
            value: (self.values[0] * s[2] - self.values[1] * s[1]) / determinant,
            slope: (self.values[1] * s[0] - self.values[0] * s[1]) / determinant,
            bend: Vector3::zeros(),
        })
    }
}

fn residuals(
    sample: &TimedPose,
    instant: Timestamp,
    half_ms: f64,
    fits: &(LocalFit, LocalFit),
    (moved, turned): (Vector3<f64>, Vector3<f64>),
) -> (f64, f64) {
    let u = (sample.stamp - instant).milliseconds() / half_ms;
    let at = |fit: &LocalFit| fit.value + fit.slope * u + fit.bend * (u * u);
    ((moved - at(&fits.0)).norm(), (turned - at(&fits.1)).norm())
}

/// Medians of the residuals; the window is small, so a fixed array holds them and nothing is allocated.
fn residual_scales(residuals: impl Iterator<Item = (f64, f64)>) -> (f64, f64) {
    let (mut moved, mut turned, mut count) = ([0.0; LARGEST_WINDOW], [0.0; LARGEST_WINDOW], 0);
    for (a, b) in residuals.take(LARGEST_WINDOW) {
        (moved[count], turned[count]) = (a, b);
        count += 1;
    }
    let median = |values: &mut [f64]| {
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    (
        median(&mut moved[..count]).max(FINEST_SCALE_MM),
        median(&mut turned[..count]).max(FINEST_SCALE_RAD),
    )
}

/// No arm is better than this: without a floor, the onset of a motion after perfect rest would count as an outlier.
const FINEST_SCALE_MM: f64 = 0.05;
/// The same for rotation.
const FINEST_SCALE_RAD: f64 = 2e-4;
/// Samples whose residuals take part in the robust scale.
const LARGEST_WINDOW: usize = 128;

fn bisquare(residual: f64, scale: f64) -> f64 {
    let u = residual / (BISQUARE_REACH * scale);
    if u >= 1.0 { 0.0 } else { (1.0 - u * u).powi(2) }
}

fn interpolated(before: &TimedPose, behind: &TimedPose, instant: Timestamp, origin: Origin, bridged: bool) -> StampedPose {
    let step_s = (behind.stamp - before.stamp).seconds();
    let t = (instant - before.stamp).seconds() / step_s;
    // Across a gap nothing is known but the samples themselves.
    let t = if bridged { t } else { t.clamp(0.0, 1.0).round() };
    let (a, b) = (&before.base_from_hand, &behind.base_from_hand);
    let known = if bridged { 1.0 / step_s } else { 0.0 };
    StampedPose {
        base_from_hand: a.interpolated(b, t),
        origin,
        velocity_mm_s: (b.translation() - a.translation()) * known,
        angular_velocity_rad_s: (b.rotation() * a.rotation().inverse()).scaled_axis() * known,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_distr::Distribution as _;

    fn interpolating() -> Settings {
        Settings {
            smoothing_ms: 0.0,
            ..Settings::default()
        }
    }

    /// A slow sweep as a surgeon's: constant velocity when `bend` is 0.
    fn motion(t: f64, bend: f64) -> Transform<RobotBase, Hand> {
        let p = Vector3::new(
            300.0 + 20.0 * t,
            -40.0 + 8.0 * t + bend * 15.0 * (1.1 * t).sin(),
            90.0 - 5.0 * t,
        );
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.2, -0.15) * (t + bend * 0.4 * (0.9 * t).sin()));
        Transform::new(turn * UnitQuaternion::from_euler_angles(2.0, 0.3, -1.0), p)
    }

    fn sampled(bend: f64, mm: f64, degrees: f64, seed: u64) -> Trajectory {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let normal = rand_distr::Normal::new(0.0, 1.0).unwrap();
        let mut draw = |sigma: f64| Vector3::from_fn(|_, _| sigma * normal.sample(&mut rng));
        let poses = (0..300).map(|i| {
            let t = i as f64 * 0.02;
            let pose = motion(t, bend);
            let turn = UnitQuaternion::from_scaled_axis(draw(degrees.to_radians()));
            TimedPose {
                stamp: Timestamp::from_seconds(t),
                base_from_hand: Transform::new(turn * pose.rotation(), pose.translation() + draw(mm)),
            }
        });
        Trajectory::new(poses.collect()).unwrap()
    }

    /// Root mean square per component: mm, rad.
    fn errors(trajectory: &Trajectory, settings: &Settings, bend: f64) -> (f64, f64) {
        let buffer = PoseBuffer::from_trajectory(trajectory, settings).unwrap();
        let (mut moved, mut turned, mut count) = (0.0, 0.0, 0.0);
        for i in 10..130 {
            let t = 0.04 * i as f64 + 0.0131;
            let pose = buffer.pose_at(Timestamp::from_seconds(t)).unwrap();
            let truth = motion(t, bend);
            moved += (pose.base_from_hand.translation() - truth.translation()).norm_squared();
            turned += (pose.base_from_hand.rotation() * truth.rotation().inverse()).angle().powi(2);
            count += 3.0;
        }
        ((moved / count).sqrt(), (turned / count).sqrt())
    }

    #[test]
    fn no_bias_on_constant_velocity() {
        for settings in [interpolating(), Settings::default()] {
            let (mm, rad) = errors(&sampled(0.0, 0.0, 0.0, 1), &settings, 0.0);
            assert!(mm < 1e-6 && rad < 1e-7, "{mm} {rad}");
        }
    }

    #[test]
    fn white_noise_is_averaged_away() {
        let trajectory = sampled(1.0, 0.25, 0.08, 2);
        let (raw_mm, raw_rad) = errors(&trajectory, &interpolating(), 1.0);
        let (mm, rad) = errors(&trajectory, &Settings::default(), 1.0);
        // Eight samples in the window, tricube weights, a parabola: the variance of the value at the centre is
        // 0.36 of a sample's (0.60 in σ, computed for this window). Interpolating between two leaves 0.5 to 1 of it.
        let sigma = 0.25;
        assert!(mm < 0.70 * sigma && mm < 0.85 * raw_mm, "{mm} against {raw_mm}");
        assert!(
            rad < 0.70 * 0.08_f64.to_radians() && rad < 0.85 * raw_rad,
            "{rad} against {raw_rad}"
        );
    }

    #[test]
    fn an_outlier_is_disarmed() {
        let clean = sampled(0.0, 0.02, 0.01, 3);
        let mut poses = clean.poses().to_vec();
        poses[100].base_from_hand = Transform::new(
            poses[100].base_from_hand.rotation(),
            poses[100].base_from_hand.translation().add_scalar(5.0),
        );
        let buffer = PoseBuffer::from_trajectory(&Trajectory::new(poses).unwrap(), &Settings::default()).unwrap();
        for t in [1.985, 2.001, 2.015] {
            let pose = buffer.pose_at(Timestamp::from_seconds(t)).unwrap();
            let error = (pose.base_from_hand.translation() - motion(t, 0.0).translation()).amax();
            assert!(error < 0.1, "{error} mm at {t} s");
        }
    }

    #[test]
    fn speed_is_told() {
        let buffer = PoseBuffer::from_trajectory(&sampled(0.0, 0.0, 0.0, 1), &Settings::default()).unwrap();
        let pose = buffer.pose_at(Timestamp::from_seconds(2.001)).unwrap();
        assert!((pose.velocity_mm_s - Vector3::new(20.0, 8.0, -5.0)).amax() < 1e-5);
        assert!((pose.angular_velocity_rad_s - Vector3::new(0.1, 0.2, -0.15)).amax() < 1e-5);
    }

    #[test]
    fn misses_are_told_apart() {
        let at = |ms: f64| TimedPose {
            stamp: Timestamp(0) + Span::from_milliseconds(ms),
            base_from_hand: Transform::identity(),
        };
        let look = |buffer: &PoseBuffer, ms: f64| buffer.pose_at(Timestamp(0) + Span::from_milliseconds(ms));
        let mut buffer = PoseBuffer::new(&Settings::default()).unwrap();
        assert_eq!(look(&buffer, 0.0).unwrap_err(), PoseLookupError::Empty);
        for ms in [0.0, 20.0, 40.0, 60.0, 80.0, 500.0, 520.0] {
            assert!(buffer.push(at(ms)));
        }
        assert!(!buffer.push(at(520.0)));
        assert!(matches!(look(&buffer, -51.0), Err(PoseLookupError::NoLonger(_))));
        assert!(matches!(look(&buffer, 571.0), Err(PoseLookupError::NotYet(_))));
        assert!(matches!(look(&buffer, 300.0), Err(PoseLookupError::Gap(_))));
        assert_eq!(look(&buffer, -30.0).unwrap().origin, Origin::Predicted);
        assert_eq!(look(&buffer, 560.0).unwrap().origin, Origin::Predicted);
        for ms in [0.0, 33.0, 80.0, 500.0, 520.0] {
            assert_eq!(look(&buffer, ms).unwrap().origin, Origin::Measured, "{ms}");
        }
    }

    #[test]
    fn one_sample_serves_its_neighbourhood() {
        let mut buffer = PoseBuffer::new(&Settings::default()).unwrap();
        buffer.push(TimedPose {
            stamp: Timestamp(0),
            base_from_hand: Transform::identity(),
        });
        assert_eq!(buffer.pose_at(Timestamp(0)).unwrap().origin, Origin::Measured);
        assert_eq!(buffer.pose_at(Timestamp(10_000_000)).unwrap().origin, Origin::Predicted);
    }

    /// Halfway in time is halfway along the line and half the turn (Shoemake 1985: SLERP at ½ is the normalized sum).
    #[test]
    fn between_two_samples_lies_the_straight_line_and_the_great_arc() {
        let (a, b) = (motion(0.0, 1.0), motion(1.0, 1.0));
        let mut buffer = PoseBuffer::new(&interpolating()).unwrap();
        for (ms, base_from_hand) in [(0.0, a), (100.0, b)] {
            let stamp = Timestamp(0) + Span::from_milliseconds(ms);
            assert!(buffer.push(TimedPose { stamp, base_from_hand }));
        }
        let pose = buffer.pose_at(Timestamp(50_000_000)).unwrap().base_from_hand;
        assert!((pose.translation() - (a.translation() + b.translation()) / 2.0).amax() < 1e-9);
        let sum = a.rotation().coords + b.rotation().coords;
        assert!((pose.rotation().coords - sum.normalize()).amax() < 1e-12);
        // Carried on: as far again beyond the end as the setting allows, marked, and no farther.
        let beyond = buffer.pose_at(Timestamp(150_000_000)).unwrap();
        assert_eq!(beyond.origin, Origin::Predicted);
        assert!((beyond.base_from_hand.translation() - (b.translation() * 1.5 - a.translation() * 0.5)).amax() < 1e-9);
        assert!(matches!(
            buffer.pose_at(Timestamp(150_000_001)),
            Err(PoseLookupError::NotYet(Span(50_000_001)))
        ));
    }

    #[test]
    fn an_endless_feed_takes_bounded_memory() {
        let settings = Settings {
            kept_ms: 1e7,
            ..Settings::default()
        };
        let mut buffer = PoseBuffer::new(&settings).unwrap();
        for i in 0..3 * MOST_SAMPLES as i64 {
            let stamp = Timestamp(i);
            assert!(buffer.push(TimedPose {
                stamp,
                base_from_hand: Transform::identity()
            }));
        }
        assert_eq!(buffer.samples().count(), MOST_SAMPLES);
        assert!(buffer.samples.capacity() <= 2 * MOST_SAMPLES);
        let kept = PoseBuffer::new(&Settings::default()).map(|mut buffer| {
            for i in 0..100_000 {
                buffer.push(TimedPose {
                    stamp: Timestamp(i * 10_000_000),
                    base_from_hand: Transform::identity(),
                });
            }
            buffer.samples().count()
        });
        // Twenty seconds at 100 Hz, both ends.
        assert_eq!(kept.unwrap(), 2001);
        buffer.clear();
        assert_eq!(buffer.pose_at(Timestamp(0)).unwrap_err(), PoseLookupError::Empty);
    }

    #[test]
    fn settings_are_checked() {
        let error = PoseBuffer::new(&Settings {
            max_gap_ms: f64::NAN,
            ..Settings::default()
        })
        .unwrap_err();
        assert!(error.to_string().contains("max_gap_ms"));
    }
}
