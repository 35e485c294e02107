//! Sizes and colors that all plots of calibrations share, so that they look alike.

use crate::image::buffer::Rgb8;

/// Width of a panel, px.
pub const PANEL_WIDTH: usize = 800;
/// Height of the line above a panel, px.
pub const CAPTION: usize = 34;
/// Between panels and around them, px.
pub const MARGIN: usize = 12;
/// Around the panels.
pub const BACKGROUND: Rgb8 = [24, 24, 28];
/// Behind the curves.
pub const FIELD: Rgb8 = [44, 44, 50];
/// Lines of the scales.
pub const GRID: Rgb8 = [66, 66, 74];
/// Letters.
pub const WHITE: Rgb8 = [235, 235, 235];
/// What was measured and not used.
pub const LEFT_OUT: Rgb8 = [255, 60, 200];

/// The next of 1, 2, 5, 10, 20 … hundredths: where a scale ends.
pub fn round_above(value: f64) -> f64 {
    let mut round = 0.01;
    loop {
        for factor in [1.0, 2.0, 5.0] {
            if round * factor >= value || round > 1e4 {
                return round * factor;
            }
        }
        round *= 10.0;
    }
}
