//! Correction and light together: what the camera does to colors, and how unevenly the chart was lit.
//!
//! A scope lights a chart very unevenly, so the light belongs to what is sought. Residuals are, for each patch, the difference of the
//! corrected color to the reference in L*a*b*, measured as ΔE2000 measures there (its local metric, M of ΔE² ≈ dᵀMd), and the difference of
//! the light's slope to that seen within the patch. Both under a Huber loss: glare and worn patches do not count fully. Clipped patches
//! do not take part.
//!
//! Which form of correction and which degree of light, is decided by leaving out one patch after the other and predicting it from the
//! rest: the simplest is taken of those that predict as well as the best, within one standard error of the paired differences (Breiman
//! et al. 1984, Classification and Regression Trees, section 3.4.3).

use std::ops::Range;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use rayon::prelude::*;

use crate::calibration::color::chart::{PATCHES, Reference, place};
use crate::calibration::color::model::{Form, SHAPES, Shape, light_numbers, light_slopes, light_terms, linear_by_gamma};
use crate::calibration::color::patches::Patch;
use crate::image::color::{Lab, delta_e_2000, lab_from_linear};
use crate::image::color_correction::Correction;
use crate::solver::least_squares::{Problem, Settings, minimize};
use crate::solver::robust_loss::RobustLoss;

/// Patches that must be in range.
pub const LEAST_PATCHES: usize = 14;
/// Degrees of light that are tried.
const MOST_LIGHT: usize = 4;
/// By this shape the degree of light is chosen.
const TRIAL: Shape = Shape {
    form: Form::Matrix,
    gamma: true,
};
/// Least width of the Huber loss, ΔE.
const LEAST_WIDTH: f64 = 1.0;
/// How far exponents lie from 1, standard deviation: weak, so that few gray patches in range do no harm.
const GAMMA_SIGMA: f64 = 0.5;
/// How large the light's numbers are, standard deviation of ln(light).
const LIGHT_SIGMA: f64 = 1.0;
/// A simpler model may predict worse by this anyway, ΔE: nobody sees it.
const NEGLIGIBLE: f64 = 0.02;

/// Why there is no correction.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FitError {
    /// Too many patches clipped or black.
    #[error(
        "expected at least {LEAST_PATCHES} of 24 patches within the camera's range, found {0}; lower the light or the exposure until white \
         is not clipped, and see that the dark patches are not black"
    )]
    TooFewPatches(usize),
    /// No minimum was found.
    #[error(
        "expected colors that follow the chart's, found some that no correction brings there; is it this chart, and in the right light?"
    )]
    Undetermined,
}

/// One form of correction, tried.
#[derive(Clone, Debug)]
pub struct Trial {
    /// What.
    pub shape: Shape,
    /// Degree of the light.
    pub light_degree: usize,
    /// ΔE2000 of each patch in range, when predicted from the others.
    pub errors: Vec<f64>,
}

impl Trial {
    /// Mean ΔE2000 of patches predicted.
    pub fn mean(&self) -> f64 {
        mean(&self.errors)
    }
}

/// A patch after the fit.
#[derive(Clone, Copy, Debug)]
pub struct PatchResult {
    /// As measured.
    pub patch: Patch,
    /// Light on it relative to the middle of the chart (in the first picture).
    pub light: f64,
    /// Linear light as seen, the light on the chart evened out.
    pub even: [f64; 3],
    /// Linear light as corrected.
    pub corrected: [f64; 3],
    /// ΔE2000 as seen.
    pub seen_error: f64,
    /// ΔE2000 of the even color before correction.
    pub before: f64,
    /// ΔE2000 as corrected.
    pub after: f64,
}

/// The fit.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// What to apply.
    pub correction: Correction,
    /// Its form.
    pub shape: Shape,
    /// Degree of the light.
    pub light_degree: usize,
    /// All that was tried with that degree, and how well it predicts.
    pub trials: Vec<Trial>,
    /// The shape taken, among `trials`.
    pub chosen: usize,
    /// The patches of all pictures.
    pub patches: Vec<PatchResult>,
}

impl Calibration {
    /// ΔE2000 of the chosen form on patches left out of its fit, mean.
    pub fn cross_validated(&self) -> f64 {
        self.trials.get(self.chosen).map_or(f64::NAN, Trial::mean)
    }
}

struct Chart<'a> {
    shape: Shape,
    degree: usize,
    pictures: usize,
    patches: &'a [Patch],
    references: &'a [Reference; PATCHES],
    /// Square roots of ΔE2000's metric at the references.
    metrics: &'a [Matrix3<f64>],
    loss: RobustLoss,
}

impl Chart<'_> {
    /// Numbers of one picture's light: in other pictures than the first there is one more, the exposure.
    fn light<'s>(&self, state: &'s [f64], picture: usize) -> (f64, &'s [f64]) {
        let each = light_numbers(self.degree);
        let begin = self.shape.numbers() + picture * (each + 1);
        match picture {
            0 => (0.0, state.get(begin..begin + each).unwrap_or_default()),
            _ => (
                state.get(begin - 1).copied().unwrap_or(0.0),
                state.get(begin..begin + each).unwrap_or_default(),
            ),
        }
    }

    fn gamma(&self, state: &[f64]) -> f64 {
        if self.shape.gamma {
            state.get(self.shape.form_numbers()).copied().unwrap_or(1.0)
        } else {
            1.0
        }
    }

    fn light_on(&self, state: &[f64], patch: &Patch) -> f64 {
        let (exposure, numbers) = self.light(state, patch.picture);
        let log: f64 = (light_terms(self.degree, place(patch.patch)).zip(numbers))
            .map(|(term, number)| term * number)
            .sum();
        (exposure + log).exp()
    }

    /// The patch's color with the light evened out.
    fn even(&self, state: &[f64], patch: &Patch) -> [f64; 3] {
        let light = self.light_on(state, patch);
        linear_by_gamma(patch.linear, self.gamma(state)).map(|v| v / light)
    }

    fn corrected(&self, state: &[f64], patch: &Patch) -> [f64; 3] {
        self.shape.correction(state).formula.apply(self.even(state, patch))
    }

    fn color_residual(&self, state: &[f64], patch: &Patch) -> [f64; 3] {
        let found = lab_from_linear(self.corrected(state, patch));
        let wanted = self.references[patch.patch].lab;
        let d = Vector3::new(found.l - wanted.l, found.a - wanted.a, found.b - wanted.b);
        (self.metrics[patch.patch] * d).into()
    }

    fn slope_residual(&self, state: &[f64], patch: &Patch) -> [f64; 3] {
        let (_, numbers) = self.light(state, patch.picture);
        let mut slope = [0.0; 2];
        for (terms, number) in light_slopes(self.degree, place(patch.patch)).zip(numbers) {
            slope[0] += terms[0] * number;
            slope[1] += terms[1] * number;
        }
        // The exponent steepens what was seen.
        let gamma = self.gamma(state);
        let luminance = |light: f64| {
            let [r, g, b] = linear_by_gamma(patch.linear.map(|v| v * light), gamma);
            (0.2126 * r + 0.7152 * g + 0.0722 * b).max(1e-6).ln()
        };
        let steeper = (luminance(1.01) - luminance(0.99)) / 0.02;
        let off = |axis: usize| (slope[axis] - steeper * patch.slope[axis]) / patch.slope_sigma;
        [off(0), off(1), 0.0]
    }
}

impl Problem for Chart<'_> {
    type State = Vec<f64>;

    fn directions(&self) -> usize {
        self.shape.numbers() + self.pictures * (light_numbers(self.degree) + 1) - 1
    }
    fn measured(&self) -> usize {
        6 * self.patches.len()
    }
    fn block(&self) -> usize {
        3
    }
    fn priors(&self) -> usize {
        usize::from(self.shape.gamma) + self.pictures * light_numbers(self.degree)
    }
    fn loss(&self) -> RobustLoss {
        self.loss
    }
    fn residuals(&self, state: &Vec<f64>, rows: Range<usize>, out: &mut [f64]) {
        let colors = self.patches.iter().map(|patch| self.color_residual(state, patch));
        let slopes = self.patches.iter().map(|patch| self.slope_residual(state, patch));
        let gamma = self.shape.gamma.then(|| (self.gamma(state) - 1.0) / GAMMA_SIGMA);
        let lights = (0..self.pictures).flat_map(|picture| self.light(state, picture).1.iter().map(|v| v / LIGHT_SIGMA));
        let all = colors.chain(slopes).flatten().chain(gamma).chain(lights);
        for (out, residual) in out.iter_mut().zip(all.skip(rows.start)) {
            *out = residual;
        }
    }
    fn moved(&self, state: &Vec<f64>, step: &[f64]) -> Vec<f64> {
        state.iter().zip(step).map(|(v, d)| v + d).collect()
    }
    fn small_step(&self, _direction: usize) -> f64 {
        1e-5
    }
}

/// The square root T of ΔE2000's metric at each reference: ΔE ≈ ‖T d‖.
fn metrics(references: &[Reference; PATCHES]) -> Vec<Matrix3<f64>> {
    (references.iter())
        .map(|reference| {
            let square = |d: Vector3<f64>| {
                let moved = Lab {
                    l: reference.lab.l + d.x,
                    a: reference.lab.a + d.y,
                    b: reference.lab.b + d.z,
                };
                delta_e_2000(reference.lab, moved).powi(2)
            };
            let even = |d: Vector3<f64>| (square(d) + square(-d)) / 2.0;
            let unit = |i: usize| Vector3::from_fn(|r, _| if r == i { 0.5 } else { 0.0 });
            // Polarization: 2 dᵀMe = Q(d + e) − Q(d) − Q(e), with steps of half a unit.
            let metric = Matrix3::from_fn(|i, j| {
                if i == j {
                    4.0 * even(unit(i))
                } else {
                    2.0 * (even(unit(i) + unit(j)) - even(unit(i)) - even(unit(j)))
                }
            });
            let root = metric.cholesky().map(|cholesky| cholesky.l().transpose());
            root.unwrap_or_else(|| Matrix3::from_diagonal(&metric.diagonal().map(|v| v.max(1e-4).sqrt())))
        })
        .collect()
}

/// A start: the light from the slopes alone, the form from the colors in linear light, each by linear least squares.
fn start(chart: &Chart<'_>) -> Option<Vec<f64>> {
    let each = light_numbers(chart.degree);
    let mut state = vec![0.0; chart.directions()];
    if chart.shape.gamma {
        state[chart.shape.form_numbers()] = 1.0;
    }
    for picture in 0..chart.pictures {
        let mut normal = DMatrix::from_diagonal_element(each, each, 1e-3 / (LIGHT_SIGMA * LIGHT_SIGMA));
        let mut right = DVector::zeros(each);
        for patch in chart.patches.iter().filter(|patch| patch.picture == picture) {
            let terms: Vec<[f64; 2]> = light_slopes(chart.degree, place(patch.patch)).collect();
            // A slope bent by glare must not bend the start.
            let weight = 1.0 / (0.03_f64.powi(2) + patch.slope_sigma.powi(2));
            for (axis, slope) in patch.slope.iter().enumerate() {
                let row = DVector::from_iterator(each, terms.iter().map(|term| term[axis]));
                right += weight * slope.clamp(-0.5, 0.5) * &row;
                normal += weight * &row * row.transpose();
            }
        }
        if each > 0 {
            let numbers = normal.cholesky()?.solve(&right);
            let begin = chart.shape.numbers() + picture * (each + 1);
            state.get_mut(begin..begin + each)?.copy_from_slice(numbers.as_slice());
        }
    }
    // Exposures relative to the first picture's, by the patches that both show.
    for picture in 1..chart.pictures {
        let log = |patch: &Patch| {
            let [r, g, b] = chart.even(&state, patch);
            (r + g + b).max(1e-6).ln()
        };
        let ratios: Vec<f64> = (chart.patches.iter())
            .filter(|patch| patch.picture == picture)
            .filter_map(|patch| {
                let same = |other: &&Patch| other.picture == 0 && other.patch == patch.patch;
                Some(log(patch) - log(chart.patches.iter().find(same)?))
            })
            .collect();
        let begin = chart.shape.numbers() + picture * (each + 1);
        *state.get_mut(begin - 1)? = mean(&ratios);
    }
    let numbers = chart.shape.form_numbers() / 3;
    for channel in 0..3 {
        let mut normal = DMatrix::from_diagonal_element(numbers, numbers, 1e-4);
        let mut right = DVector::zeros(numbers);
        for patch in chart.patches {
            let row = DVector::from_vec(chart.shape.terms(chart.even(&state, patch), channel));
            let reference = &chart.references[patch.patch];
            let weight = 1.0 / (0.03 + reference.linear[1].max(0.0)).powi(2);
            right += weight * reference.linear[channel] * &row;
            normal += weight * &row * row.transpose();
        }
        let solved = normal.cholesky()?.solve(&right);
        state
            .get_mut(channel * numbers..(channel + 1) * numbers)?
            .copy_from_slice(solved.as_slice());
    }
    Some(state)
}

/// The numbers of a shape; from `known` on where it is given.
fn fitted(mut chart: Chart<'_>, known: Option<&[f64]>) -> Option<Vec<f64>> {
    let settings = Settings {
        max_iterations: 40,
        least_gain: 1e-6,
    };
    let mut state = match known {
        Some(known) => known.to_vec(),
        None => start(&chart)?,
    };
    for _ in 0..if known.is_some() { 1 } else { 3 } {
        let mut sizes: Vec<f64> = (chart.patches.iter())
            .map(|patch| Vector3::from(chart.color_residual(&state, patch)).norm())
            .collect();
        sizes.sort_by(f64::total_cmp);
        let middle = sizes.get(sizes.len() / 2).copied()?;
        chart.loss = RobustLoss::Huber {
            width: (2.0 * middle).max(LEAST_WIDTH),
        };
        state = minimize(&chart, state, &settings)?.state;
    }
    Some(state)
}

struct Measured<'a> {
    pictures: usize,
    patches: &'a [Patch],
    references: &'a [Reference; PATCHES],
    metrics: Vec<Matrix3<f64>>,
}

impl<'a> Measured<'a> {
    fn chart<'b>(&'b self, shape: Shape, degree: usize, patches: &'b [Patch]) -> Chart<'b> {
        Chart {
            shape,
            degree,
            pictures: self.pictures,
            patches,
            references: self.references,
            metrics: &self.metrics,
            loss: RobustLoss::Huber { width: 5.0 },
        }
    }

    /// Each patch predicted from the others.
    fn tried(&self, shape: Shape, degree: usize) -> Option<Trial> {
        let all = fitted(self.chart(shape, degree, self.patches), None)?;
        let mut numbers: Vec<usize> = self.patches.iter().map(|patch| patch.patch).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let errors: Option<Vec<f64>> = numbers
            .par_iter()
            .map(|number| {
                let (out, rest): (Vec<Patch>, Vec<Patch>) = self.patches.iter().partition(|patch| patch.patch == *number);
                let state = fitted(self.chart(shape, degree, &rest), Some(&all))?;
                let chart = self.chart(shape, degree, &rest);
                let errors: Vec<f64> = (out.iter())
                    .map(|patch| {
                        delta_e_2000(
                            lab_from_linear(chart.corrected(&state, patch)),
                            self.references[patch.patch].lab,
                        )
                    })
                    .collect();
                Some(mean(&errors))
            })
            .collect();
        Some(Trial {
            shape,
            light_degree: degree,
            errors: errors?,
        })
    }
}

/// The correction and the light of `patches`, measured in `pictures` pictures.
pub fn calibrate(patches: &[Patch], pictures: usize, references: &[Reference; PATCHES]) -> Result<Calibration, FitError> {
    let used: Vec<Patch> = patches.iter().filter(|patch| !patch.out_of_range).copied().collect();
    let mut distinct: Vec<usize> = used.iter().map(|patch| patch.patch).collect();
    distinct.sort_unstable();
    distinct.dedup();
    if distinct.len() < LEAST_PATCHES {
        return Err(FitError::TooFewPatches(distinct.len()));
    }
    let measured = Measured {
        pictures,
        patches: &used,
        references,
        metrics: metrics(references),
    };
    let lights: Vec<Trial> = (0..=MOST_LIGHT).filter_map(|degree| measured.tried(TRIAL, degree)).collect();
    let degree = simplest(&lights).ok_or(FitError::Undetermined)?;
    let degree = lights.get(degree).map_or(0, |trial| trial.light_degree);
    let trials: Vec<Trial> = SHAPES.iter().filter_map(|shape| measured.tried(*shape, degree)).collect();
    let chosen = simplest(&trials).ok_or(FitError::Undetermined)?;
    let shape = trials.get(chosen).ok_or(FitError::Undetermined)?.shape;
    let state = fitted(measured.chart(shape, degree, &used), None).ok_or(FitError::Undetermined)?;
    let chart = measured.chart(shape, degree, &used);
    let results = (patches.iter())
        .map(|patch| {
            let wanted = references[patch.patch].lab;
            let even = chart.even(&state, patch);
            let light = chart.light_on(&state, patch);
            let corrected = chart.corrected(&state, patch);
            let shown = corrected.map(|v| v.clamp(0.0, 1.0));
            let difference = |linear: [f64; 3]| delta_e_2000(lab_from_linear(linear), wanted);
            PatchResult {
                patch: *patch,
                light,
                even,
                corrected,
                seen_error: difference(patch.linear),
                before: difference(patch.linear.map(|v| (v / light).min(1.0))),
                after: difference(shown),
            }
        })
        .collect();
    Ok(Calibration {
        correction: shape.correction(&state),
        shape,
        light_degree: degree,
        trials,
        chosen,
        patches: results,
    })
}

/// The first of the trials that predicts as well as the best, as far as the patches tell.
fn simplest(trials: &[Trial]) -> Option<usize> {
    let best = trials.iter().min_by(|a, b| a.mean().total_cmp(&b.mean()))?;
    trials.iter().position(|trial| {
        let worse: Vec<f64> = trial.errors.iter().zip(&best.errors).map(|(a, b)| a - b).collect();
        let by = mean(&worse);
        let n = worse.len() as f64;
        let variance = worse.iter().map(|d| (d - by).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
        by <= (variance / n).sqrt().max(NEGLIGIBLE)
    })
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::color::chart::{Edition, references};
    use crate::calibration::color::detection::find;
    use crate::calibration::color::example::{Setting, Tint, taken};
    use crate::calibration::color::patches::measured;

    #[test]
    fn the_metric_is_delta_e() {
        let references = references(Edition::Since2014);
        for (reference, root) in references.iter().zip(metrics(&references)) {
            for d in [[0.4, 0.2, -0.3], [-0.1, 0.5, 0.1], [0.3, -0.4, 0.4]] {
                let d = Vector3::from(d);
                let moved = Lab {
                    l: reference.lab.l + d.x,
                    a: reference.lab.a + d.y,
                    b: reference.lab.b + d.z,
                };
                let exact = delta_e_2000(reference.lab, moved);
                assert!(((root * d).norm() / exact - 1.0).abs() < 0.12, "{d} {exact}");
            }
        }
    }

    #[test]
    fn a_wrong_camera_under_a_scopes_light_is_corrected() {
        let references = references(Edition::Since2014);
        let (mut sum, runs) = (0.0, 4);
        for seed in 0..runs {
            let example = taken(
                960,
                540,
                &Setting {
                    seed,
                    ..Setting::default()
                },
            );
            let found = find(&example.image, &references).unwrap();
            let patches = measured(&example.image, &found.pixel_from_chart, 0).unwrap();
            let fit = calibrate(&patches, 1, &references).unwrap();
            let used = || fit.patches.iter().filter(|p| !p.patch.out_of_range);
            let after = used().map(|p| p.after).sum::<f64>() / used().count() as f64;
            let before = used().map(|p| p.before).sum::<f64>() / used().count() as f64;
            assert!(before > 5.0 && after < 1.5, "{seed}: {before} {after}");
            // The truth is an inverse mixing, an exponent and gains: against the truth, on colors that no patch has.
            let tint = Tint::WRONG;
            let mut worst: f64 = 0.0;
            for color in [[0.4, 0.1, 0.08], [0.5, 0.35, 0.3], [0.2, 0.25, 0.1], [0.6, 0.5, 0.2]] {
                let seen = tint.seen(color).map(|v| (255.0 * v) as f32);
                let corrected = fit
                    .correction
                    .apply(seen)
                    .map(|v| crate::image::color::linear_from_srgb(f64::from(v) / 255.0));
                // The chart's exposure is not known to the camera.
                let gain = 1.0 / 0.8;
                worst = worst.max(delta_e_2000(
                    lab_from_linear(corrected),
                    lab_from_linear(color.map(|v| v * gain).map(|v| v.min(1.0))),
                ));
            }
            sum += worst;
        }
        // Noise of 2 levels and 8 bits leave about half a unit; colors between the patches must be no worse than the patches.
        assert!(sum / f64::from(runs as u32) < 1.5, "{sum}");
    }
}
