//! Nonlinear least squares: Levenberg–Marquardt over any state with a tangent space, with a robust loss and the result's covariance.
//!
//! Sought is the state x that makes Σ ρ(‖rᵢ(x)‖²) + Σ pⱼ(x)² least, r being measured residuals in blocks (a pixel's two coordinates)
//! and p priors, all in units of their standard deviations. A step d solves (JᵀWJ + λ·diag) d = −JᵀWr, W holding ρ' of each block
//! (iteratively reweighted least squares), and is taken if it lowers the cost (Marquardt 1963; λ as Nielsen, "Damping parameter in
//! Marquardt's method", 1999). Where residuals are in standard deviations, (JᵀWJ)⁻¹ is the covariance of d.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::solver::robust_loss::RobustLoss;

/// What is to be made least.
pub trait Problem: Sync {
    /// What is sought: numbers, poses, anything that a step can be added to.
    type State: Clone + Sync;

    /// Number of directions in which the state can move.
    fn directions(&self) -> usize;

    /// Number of measured residuals, whose blocks of [`Problem::block`] may cost less than their square.
    fn measured(&self) -> usize;

    /// Residuals of one measurement.
    fn block(&self) -> usize {
        2
    }

    /// Number of residuals after the measured ones that always cost their square.
    fn priors(&self) -> usize {
        0
    }

    /// What a block of measured residuals costs.
    fn loss(&self) -> RobustLoss {
        RobustLoss::Squared
    }

    /// The residuals `rows` (measured ones, then priors), in standard deviations. One that is not finite makes a step be refused.
    fn residuals(&self, state: &Self::State, rows: Range<usize>, out: &mut [f64]);

    /// The state moved by a step.
    fn moved(&self, state: &Self::State, step: &[f64]) -> Self::State;

    /// Rows that a direction can change; the fewer, the faster.
    fn support(&self, direction: usize) -> Vec<Range<usize>> {
        let _any = direction;
        vec![0..self.measured() + self.priors()]
    }

    /// A small step in a direction, for central differences: about the cube root of the precision times the parameter's size.
    fn small_step(&self, direction: usize) -> f64 {
        let _any = direction;
        1e-6
    }
}

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Steps tried at most.
    pub max_iterations: usize,
    /// Done when a step lowers the cost by less than this share.
    pub least_gain: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_iterations: 100,
            least_gain: 1e-12,
        }
    }
}

/// Where the search ended.
#[derive(Clone, Debug)]
pub struct Solution<State> {
    /// The state of least cost.
    pub state: State,
    /// Σ ρ + Σ p².
    pub cost: f64,
    /// Residuals there, unweighted.
    pub residuals: DVector<f64>,
    /// ρ' of each block, 1 for a measurement in full standing.
    pub weights: Vec<f64>,
    /// Of a small step away from the state, if every direction is determined.
    pub covariance: Option<DMatrix<f64>>,
    /// Steps tried.
    pub iterations: usize,
    /// False if the steps ran out first.
    pub converged: bool,
}

impl<State> Solution<State> {
    /// The covariance if the residuals' scale was only assumed: times the mean square of what the measurements have left over.
    pub fn scaled_covariance(&self, measured: usize) -> Option<DMatrix<f64>> {
        let covariance = self.covariance.as_ref()?;
        let block = measured / self.weights.len().max(1);
        let sum: f64 = (self.residuals.rows(0, measured).iter().enumerate())
            .map(|(row, r)| self.weights[row / block.max(1)] * r * r)
            .sum();
        let heard: f64 = block as f64 * self.weights.iter().sum::<f64>();
        let free = heard - covariance.nrows() as f64;
        (free > 0.0).then(|| covariance * (sum / free))
    }
}

/// Search from `start`. `None` if the residuals are not finite there.
pub fn minimize<P: Problem>(problem: &P, start: P::State, settings: &Settings) -> Option<Solution<P::State>> {
    let rows = problem.measured() + problem.priors();
    let mut state = start;
    let mut residuals = evaluated(problem, &state, rows);
    let mut cost = cost_of(problem, &residuals)?;
    let (mut damping, mut raise) = (1e-4, 2.0);
    let (mut iterations, mut converged) = (0, false);
    let mut linear = Linear::at(problem, &state, &residuals);
    while iterations < settings.max_iterations && !converged {
        iterations += 1;
        let Some(step) = linear.step(damping) else {
            damping *= raise;
            raise *= 2.0;
            continue;
        };
        let moved = problem.moved(&state, step.as_slice());
        let new_residuals = evaluated(problem, &moved, rows);
        let expected = linear.expected_gain(&step);
        match cost_of(problem, &new_residuals) {
            Some(new_cost) if new_cost <= cost => {
                let gain = cost - new_cost;
                converged = gain <= settings.least_gain * cost;
                let quality: f64 = if expected > 0.0 { gain / expected } else { 1.0 };
                damping = (damping * (1.0 - (2.0 * quality - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0)).max(1e-15);
                raise = 2.0;
                (state, residuals, cost) = (moved, new_residuals, new_cost);
                linear = Linear::at(problem, &state, &residuals);
            }
            _ => {
                converged = expected <= settings.least_gain * cost;
                damping *= raise;
                raise *= 2.0;
            }
        }
        if damping > 1e20 {
            // No direction leads down: as far as numbers tell, this is the bottom.
            converged = true;
        }
    }
    Some(Solution {
        covariance: linear.covariance(),
        weights: weights_of(problem, &residuals),
        state,
        cost,
        residuals,
        iterations,
        converged,
    })
}

fn evaluated<P: Problem>(problem: &P, state: &P::State, rows: usize) -> DVector<f64> {
    let mut out = DVector::zeros(rows);
    problem.residuals(state, 0..rows, out.as_mut_slice());
    out
}

fn squares<P: Problem>(problem: &P, residuals: &DVector<f64>) -> impl Iterator<Item = f64> {
    let measured = &residuals.as_slice()[..problem.measured()];
    measured
        .chunks(problem.block())
        .map(|block| block.iter().map(|r| r * r).sum())
}

fn cost_of<P: Problem>(problem: &P, residuals: &DVector<f64>) -> Option<f64> {
    let loss = problem.loss();
    let measured: f64 = squares(problem, residuals).map(|s| loss.cost(s)).sum();
    let priors: f64 = residuals.as_slice()[problem.measured()..].iter().map(|p| p * p).sum();
    Some(measured + priors).filter(|cost| cost.is_finite())
}

fn weights_of<P: Problem>(problem: &P, residuals: &DVector<f64>) -> Vec<f64> {
    let loss = problem.loss();
    squares(problem, residuals).map(|s| loss.weight(s)).collect()
}

/// The problem made linear at a state: JᵀWJ and JᵀWr.
struct Linear {
    normal: DMatrix<f64>,
    slope: DVector<f64>,
}

impl Linear {
    fn at<P: Problem>(problem: &P, state: &P::State, residuals: &DVector<f64>) -> Self {
        let (rows, directions) = (residuals.len(), problem.directions());
        let weights = weights_of(problem, residuals);
        let weight = |row: usize| {
            weights
                .get(row / problem.block())
                .filter(|_| row < problem.measured())
                .map_or(1.0, |w| w.sqrt())
        };
        let supports: Vec<Vec<Range<usize>>> = (0..directions).map(|direction| problem.support(direction)).collect();
        // Weighted already; zero outside a direction's support.
        let mut jacobian = DMatrix::zeros(rows, directions);
        (jacobian.as_mut_slice().par_chunks_mut(rows.max(1)).enumerate()).for_each(|(direction, column)| {
            let h = problem.small_step(direction);
            let mut step = vec![0.0; directions];
            step[direction] = h;
            let ahead = problem.moved(state, &step);
            step[direction] = -h;
            let behind = problem.moved(state, &step);
            let mut other = Vec::new();
            for support in &supports[direction] {
                let column = &mut column[support.clone()];
                other.resize(column.len(), 0.0);
                problem.residuals(&ahead, support.clone(), column);
                problem.residuals(&behind, support.clone(), &mut other);
                for ((row, slope), behind) in support.clone().zip(column).zip(&other) {
                    *slope = weight(row) * (*slope - behind) / (2.0 * h);
                }
            }
        });
        let column = |direction: usize| &jacobian.as_slice()[direction * rows..(direction + 1) * rows];
        let mut normal = DMatrix::zeros(directions, directions);
        (normal.as_mut_slice().par_chunks_mut(directions.max(1)).enumerate()).for_each(|(a, sums)| {
            for (b, sum) in sums.iter_mut().enumerate().skip(a) {
                let shared = shared(&supports[a], &supports[b]);
                *sum = shared.map(|rows| dot(&column(a)[rows.clone()], &column(b)[rows])).sum();
            }
        });
        normal.fill_upper_triangle_with_lower_triangle();
        let weighted = DVector::from_fn(rows, |row, _| weight(row) * residuals[row]);
        let slope = DVector::from_fn(directions, |direction, _| dot(column(direction), weighted.as_slice()));
        Self { normal, slope }
    }

    fn step(&self, damping: f64) -> Option<DVector<f64>> {
        let mut damped = self.normal.clone();
        for (i, diagonal) in self.normal.diagonal().iter().enumerate() {
            damped[(i, i)] += damping * diagonal.max(1e-12);
        }
        let step = damped.cholesky()?.solve(&-&self.slope);
        step.iter().all(|d| d.is_finite()).then_some(step)
    }

    /// By how much the cost falls if the problem is as linear as it looks.
    fn expected_gain(&self, step: &DVector<f64>) -> f64 {
        -(2.0 * self.slope.dot(step) + step.dot(&(&self.normal * step)))
    }

    fn covariance(&self) -> Option<DMatrix<f64>> {
        // Scaled to a unit diagonal first: px, mm and rad differ by orders of magnitude.
        let scale: Vec<f64> = self.normal.diagonal().iter().map(|d| 1.0 / d.sqrt()).collect();
        if scale.iter().any(|s| !s.is_finite()) {
            return None;
        }
        let scaled = DMatrix::from_fn(scale.len(), scale.len(), |i, j| self.normal[(i, j)] * scale[i] * scale[j]);
        let inverse = scaled.cholesky()?.inverse();
        let covariance = DMatrix::from_fn(scale.len(), scale.len(), |i, j| inverse[(i, j)] * scale[i] * scale[j]);
        covariance.iter().all(|v| v.is_finite()).then_some(covariance)
    }
}

/// Rows that two directions have in common.
fn shared(a: &[Range<usize>], b: &[Range<usize>]) -> impl Iterator<Item = Range<usize>> {
    a.iter().flat_map(move |a| {
        b.iter()
            .map(|b| a.start.max(b.start)..a.end.min(b.end))
            .filter(|rows| !rows.is_empty())
    })
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    /// Decay a·exp(−b·t) seen at known times, each of its samples a block; every tenth sample wrong by `outlier`.
    struct Decay {
        times: Vec<f64>,
        samples: Vec<f64>,
        sigma: f64,
        loss: RobustLoss,
        /// b is known to be so much, and how well.
        prior: Option<(f64, f64)>,
    }

    impl Problem for Decay {
        type State = [f64; 2];

        fn directions(&self) -> usize {
            2
        }
        fn measured(&self) -> usize {
            self.times.len()
        }
        fn block(&self) -> usize {
            1
        }
        fn priors(&self) -> usize {
            usize::from(self.prior.is_some())
        }
        fn loss(&self) -> RobustLoss {
            self.loss
        }
        fn residuals(&self, [a, b]: &[f64; 2], rows: Range<usize>, out: &mut [f64]) {
            for (row, out) in rows.zip(out) {
                *out = match (self.times.get(row), self.prior) {
                    (Some(t), _) => (a * (-b * t).exp() - self.samples[row]) / self.sigma,
                    (None, Some((mean, sigma))) => (b - mean) / sigma,
                    (None, None) => f64::NAN,
                };
            }
        }
        fn moved(&self, [a, b]: &[f64; 2], step: &[f64]) -> [f64; 2] {
            [a + step[0], b + step[1]]
        }
    }

    const TRUTH: [f64; 2] = [3.0, 0.7];

    fn decay(seed: u64, sigma: f64, outlier: f64) -> Decay {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let times: Vec<f64> = (0..60).map(|i| f64::from(i) * 0.05).collect();
        let sample = |(i, t): (usize, &f64)| {
            let noise: f64 = random.sample(StandardNormal);
            TRUTH[0] * (-TRUTH[1] * t).exp() + sigma * noise + if i % 10 == 4 { outlier } else { 0.0 }
        };
        Decay {
            samples: times.iter().enumerate().map(sample).collect(),
            times,
            sigma,
            loss: RobustLoss::Squared,
            prior: None,
        }
    }

    #[test]
    fn the_truth_is_found_within_the_stated_covariance() {
        // The squared Mahalanobis distance of two directions is χ² of two degrees: its mean over 300 runs is 2 ± 4·2/√300.
        let runs = 300;
        let mean = (0..runs)
            .map(|seed| {
                let solution = minimize(&decay(seed, 0.02, 0.0), [1.0, 0.1], &Settings::default()).unwrap();
                assert!(solution.converged && solution.iterations < 30);
                let error = DVector::from_fn(2, |i, _| solution.state[i] - TRUTH[i]);
                let information = solution.covariance.unwrap().try_inverse().unwrap();
                error.dot(&(information * &error))
            })
            .sum::<f64>()
            / runs as f64;
        assert!((mean - 2.0).abs() < 4.0 * 2.0 / f64::from(runs as u32).sqrt(), "{mean}");
    }

    #[test]
    fn a_robust_loss_bears_outliers_and_the_scale_is_found_from_the_rest() {
        let mut problem = decay(7, 0.02, 1.5);
        let naive = minimize(&problem, [1.0, 0.1], &Settings::default()).unwrap();
        problem.loss = RobustLoss::Cauchy { width: 2.0 };
        let robust = minimize(&problem, [1.0, 0.1], &Settings::default()).unwrap();
        let error = |state: [f64; 2]| (state[0] - TRUTH[0]).abs().max((state[1] - TRUTH[1]).abs());
        assert!(error(naive.state) > 0.05);
        let sigma = robust.covariance.as_ref().unwrap().diagonal().map(f64::sqrt);
        assert!((0..2).all(|i| (robust.state[i] - TRUTH[i]).abs() < 4.0 * sigma[i]));
        assert!((0..60).all(|i| (robust.weights[i] < 0.1) == (i % 10 == 4)));
        // Residuals were divided by a sigma five times too small: the scaled covariance makes that good.
        problem.sigma /= 5.0;
        problem.loss = RobustLoss::Cauchy { width: 10.0 };
        let scaled = minimize(&problem, [1.0, 0.1], &Settings::default()).unwrap();
        let wide = scaled.scaled_covariance(60).unwrap().diagonal().map(f64::sqrt);
        assert!((0..2).all(|i| (wide[i] / sigma[i] - 1.0).abs() < 0.35), "{wide} {sigma}");
    }

    #[test]
    fn a_prior_counts_as_its_deviation_says_and_what_is_undetermined_has_no_covariance() {
        let mut problem = decay(3, 0.02, 0.0);
        problem.prior = Some((0.5, 1e-6));
        let held = minimize(&problem, [1.0, 0.1], &Settings::default()).unwrap();
        assert!((held.state[1] - 0.5).abs() < 1e-5);
        // At time 0 the decay's rate does not show.
        problem.prior = None;
        problem.times = vec![0.0; 60];
        let solution = minimize(&problem, [1.0, 0.1], &Settings::default()).unwrap();
        assert!(solution.covariance.is_none());
    }

    #[test]
    fn a_start_without_finite_residuals_is_refused() {
        assert!(minimize(&decay(1, 0.02, 0.0), [f64::NAN, 0.0], &Settings::default()).is_none());
    }
}
