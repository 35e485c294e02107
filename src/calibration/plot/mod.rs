//! What all plots of calibrations share: sizes and colors, the image field with residuals, bars on a scale of decades.

pub mod bars;
pub mod field;
pub mod style;
