//! Bars on a scale of decades, in a panel of a plot.

use crate::calibration::plot::style::{FIELD, GRID, PANEL_WIDTH, WHITE};
use crate::image::buffer::Rgb8;
use crate::image::canvas::Canvas;

/// A panel of them.
#[derive(Clone, Copy, Debug)]
pub struct Bars {
    /// Its upper left.
    pub corner: [f64; 2],
    /// Its height, px.
    pub height: usize,
    /// Where the scale begins.
    pub first: f64,
    /// How many times ten times as much.
    pub decades: u32,
    /// What the numbers are.
    pub unit: &'static str,
    /// Bars have places on it, this many.
    pub places: usize,
}

impl Bars {
    /// Ground and lines, before the bars.
    pub fn ground(&self, canvas: &mut Canvas) {
        let [left, top] = self.corner;
        canvas.fill(left, top, PANEL_WIDTH, self.height, FIELD);
        for decade in 1..self.decades {
            let y = self.line(decade);
            canvas.line([left, y], [left + PANEL_WIDTH as f64, y], GRID);
        }
    }

    /// A bar over the part from `from` to `to` (0 to 1) of its place; what is no number has none.
    pub fn bar(&self, canvas: &mut Canvas, place: usize, [from, to]: [f64; 2], value: f64, color: Rgb8) {
        if !value.is_finite() {
            return;
        }
        let share = ((value / self.first).max(1.0).log10() / f64::from(self.decades)).min(1.0);
        let high = (share * self.height as f64).round();
        let step = self.step();
        let wide = (((to - from) * step) as usize).max(1);
        let bottom = self.corner[1] + self.height as f64;
        canvas.fill(self.left_of(place) + from * step, bottom - high, wide, high as usize, color);
    }

    /// The scale's numbers, over the bars.
    pub fn numbers(&self, canvas: &mut Canvas) {
        for decade in 1..self.decades {
            // Without the last digits of a product: 0.1, not 0.10000000000000002.
            let number = (self.first * 10.0_f64.powi(decade as i32) * 1e6).round() / 1e6;
            let (x, y) = (self.corner[0] as usize + 4, self.line(decade) as usize + 4);
            canvas.text(x, y, &format!("{number} {}", self.unit), WHITE);
        }
    }

    /// Where a place begins.
    pub fn left_of(&self, place: usize) -> f64 {
        self.corner[0] + place as f64 * self.step()
    }

    fn step(&self) -> f64 {
        PANEL_WIDTH as f64 / self.places.max(1) as f64
    }

    fn line(&self, decade: u32) -> f64 {
        self.corner[1] + (1.0 - f64::from(decade) / f64::from(self.decades)) * self.height as f64
    }
}
