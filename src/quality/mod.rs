//! Figures of quality: how near a picture comes to the truth.

pub mod figures;
pub mod similarity;
