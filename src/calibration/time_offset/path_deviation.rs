//! How sure an offset is: by the fit itself, by how alike neighbouring residuals are, and by whether parts agree.

use nalgebra::Vector6;

use crate::calibration::time_offset::path_matching::{Fit, Heard, Matching, Normal, OffsetIs, UNKNOWNS};
use crate::robot::trajectory::TimedPose;

/// Lengths of the sandwich's windows, s.
const ALIKE_S: [f64; 4] = [0.08, 0.16, 0.32, 0.64];
/// So many windows are needed for their sum to mean anything.
const FEWEST_WINDOWS: f64 = 6.0;
/// Into how many parts the readings are cut to see whether they agree.
const PARTS: usize = 3;

impl Matching<'_> {
    /// Of the offset, ms: if errors were independent, and as they are.
    pub(super) fn deviations(&self, fit: &Fit) -> Option<[f64; 2]> {
        let used: Vec<TimedPose> = self.readings(fit.state.offset_ms).copied().collect();
        let Normal { matrix, readings, .. } = self.normal(&fit.state, &used, fit.noise);
        let covariance = matrix.try_inverse()?;
        let row = covariance.row(0);
        let white = covariance[(0, 0)].sqrt();
        // By how much a reading's residuals, one deviation each, move the offset.
        let levers: Vec<Vector6<f64>> = readings.iter().map(|heard| heard.slopes * row.transpose()).collect();
        let whole_s = (readings.last()?.at - readings.first()?.at).seconds();
        // The fit has taken part of the errors with it.
        let left = (1.0 - UNKNOWNS as f64 / (6.0 * readings.len() as f64)).max(0.1);
        let mut worst = white.max((correlated(&readings, &levers) / left).sqrt());
        for window_s in ALIKE_S.into_iter().filter(|window_s| FEWEST_WINDOWS * window_s <= whole_s) {
            let mut sum = 0.0;
            for (i, (heard, lever)) in readings.iter().zip(&levers).enumerate() {
                let own = lever.dot(&heard.residual);
                sum += own * own;
                for (later, lever) in readings.iter().zip(&levers).skip(i + 1) {
                    // Bartlett's weights keep the sum from turning negative.
                    let weight = 1.0 - (later.at - heard.at).seconds() / window_s;
                    if weight <= 0.0 {
                        break;
                    }
                    sum += 2.0 * weight * own * lever.dot(&later.residual);
                }
            }
            worst = worst.max((sum.max(0.0) / left / (1.0 - window_s / whole_s)).sqrt());
        }
        (white.is_finite() && worst.is_finite()).then_some([white, worst])
    }

    /// By how many times the offsets of the parts, each with a similarity of its own, differ more than they should; 1 where they agree. A
    /// path that is bent over seconds gives itself away by it (Birge 1932, as with stretches).
    pub(super) fn scatter_of_parts(&self, offset_ms: f64) -> f64 {
        let used: Vec<TimedPose> = self.readings(offset_ms).copied().collect();
        let found: Vec<[f64; 2]> = (used.chunks(used.len().div_ceil(PARTS).max(1)))
            .filter_map(|arm| {
                let part = Matching { arm, ..*self };
                let fit = part.fitted(offset_ms, OffsetIs::Sought)?;
                Some([fit.state.offset_ms, part.deviations(&fit)?[1]])
            })
            .collect();
        if found.len() < 2 {
            return 1.0;
        }
        let weights: f64 = found.iter().map(|[_, sigma]| sigma.powi(-2)).sum();
        let mean = found.iter().map(|[ms, sigma]| ms * sigma.powi(-2)).sum::<f64>() / weights;
        let misfit: f64 = found.iter().map(|[ms, sigma]| ((ms - mean) / sigma).powi(2)).sum();
        let scatter = (misfit / (found.len() - 1) as f64).sqrt();
        if scatter.is_finite() { scatter.max(1.0) } else { 1.0 }
    }
}

/// Variance of the offset if neighbouring readings' errors are as alike as their residuals are on the average of all axes; where lags
/// beyond the first tell less than a first-order process would, that process counts.
fn correlated(readings: &[Heard], levers: &[Vector6<f64>]) -> f64 {
    let whole: f64 = readings
        .iter()
        .map(|heard| heard.residual.norm_squared())
        .sum::<f64>()
        .max(1e-12);
    let chance = 2.0 / (6.0 * readings.len() as f64).sqrt();
    let alike_at = |lag: usize| {
        let pairs = readings.iter().zip(readings.iter().skip(lag));
        pairs.map(|(a, b)| a.residual.dot(&b.residual)).sum::<f64>() / whole
    };
    let mut variance: f64 = levers.iter().map(Vector6::norm_squared).sum();
    let first = alike_at(1);
    if first < chance {
        return variance;
    }
    // What the fit took with it was the most alike of all: half of what chance may do is added again.
    let process = (first + 0.5 * chance).min(0.995);
    let mut measured = true;
    for lag in 1..readings.len() / 2 {
        let here = alike_at(lag);
        measured &= here > chance;
        let alike = if measured {
            here.max(process.powi(lag as i32))
        } else {
            process.powi(lag as i32)
        };
        if alike < 0.5 * chance {
            break;
        }
        variance += 2.0 * alike * levers.iter().zip(&levers[lag..]).map(|(a, b)| a.dot(b)).sum::<f64>();
    }
    variance
}
