//! Solvers: unknowns from measurements, knowing nothing of what they mean.

pub mod bundle_adjustment;
pub mod least_squares;
pub mod robust_loss;
