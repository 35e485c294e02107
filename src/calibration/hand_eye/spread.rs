//! How the arm's errors of place and turn spread over the views: a prior that is found from the data.

use nalgebra::{Matrix6, Vector6};

/// Deviations never fall below these, mm, rad, px: with exact data the corrections would have no room for rounding.
pub(super) const LEAST_SIGMAS: [f64; 3] = [1e-4, 1e-6, 1e-4];

/// How the corrections spread: a joint's error moves and turns the camera at once, so shift and turn go together.
pub(super) struct Spread {
    pub(super) covariance: Matrix6<f64>,
    pub(super) information: Matrix6<f64>,
    /// Turns a correction into standard deviations: the inverse of the covariance's lower root.
    pub(super) whitening: Matrix6<f64>,
}

/// A spread is held to be isotropic with the weight of so many views: few views do not tell how shift and turn go together.
const ISOTROPIC_VIEWS: f64 = 8.0;

impl Spread {
    pub(super) fn isotropic(place_mm: f64, turn_rad: f64) -> Option<Self> {
        let [place, turn] = [place_mm.max(LEAST_SIGMAS[0]), turn_rad.max(LEAST_SIGMAS[1])].map(|sigma| sigma * sigma);
        Self::of(Matrix6::from_diagonal(&Vector6::new(place, place, place, turn, turn, turn)))
    }

    /// From the sum over views of a correction's square.
    pub(super) fn learnt(sum: Matrix6<f64>, views: usize) -> Option<Self> {
        let count = views as f64;
        let variance = |first: usize| sum.fixed_view::<3, 3>(first, first).trace() / (3.0 * count);
        let isotropic = Self::isotropic(variance(0).sqrt(), variance(3).sqrt())?;
        Self::of((sum + ISOTROPIC_VIEWS * isotropic.covariance) / (count + ISOTROPIC_VIEWS))
    }

    fn of(covariance: Matrix6<f64>) -> Option<Self> {
        let lower = covariance.cholesky()?.l();
        let whitening = lower.try_inverse()?;
        Some(Self {
            covariance,
            information: whitening.transpose() * whitening,
            whitening,
        })
    }
}
