//! How much a residual may cost, so that a wrong measurement cannot outvote the right ones.
//!
//! With s the squared residual in units of its standard deviation, ρ(s) replaces s in the cost, and ρ'(s) is the weight of the
//! measurement in the next linear solve (iteratively reweighted least squares; Triggs et al., "Bundle adjustment — a modern
//! synthesis", 2000, section 4.3, without its second-order correction, which can make the normal matrix indefinite).

/// A cost of s, growing slower than s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RobustLoss {
    /// ρ = s.
    Squared,
    /// Squared up to `width` standard deviations, then linear.
    Huber {
        /// In standard deviations.
        width: f64,
    },
    /// Logarithmic: far outliers lose all influence.
    Cauchy {
        /// In standard deviations.
        width: f64,
    },
}

impl RobustLoss {
    /// ρ(s).
    pub fn cost(&self, s: f64) -> f64 {
        match *self {
            Self::Squared => s,
            Self::Huber { width } if s <= width * width => s,
            Self::Huber { width } => 2.0 * width * s.sqrt() - width * width,
            Self::Cauchy { width } => width * width * (s / (width * width)).ln_1p(),
        }
    }

    /// ρ'(s).
    pub fn weight(&self, s: f64) -> f64 {
        match *self {
            Self::Squared => 1.0,
            Self::Huber { width } if s <= width * width => 1.0,
            Self::Huber { width } => width / s.sqrt(),
            Self::Cauchy { width } => 1.0 / (1.0 + s / (width * width)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_slopes_of_the_costs() {
        for loss in [
            RobustLoss::Squared,
            RobustLoss::Huber { width: 1.5 },
            RobustLoss::Cauchy { width: 2.0 },
        ] {
            for s in [0.01, 0.7, 2.2, 5.0, 40.0] {
                let slope = (loss.cost(s + 1e-6) - loss.cost(s - 1e-6)) / 2e-6;
                assert!((slope - loss.weight(s)).abs() < 1e-5, "{loss:?} at {s}");
            }
        }
    }
}
