//! The image field as a panel of a plot, and residuals as arrows on it.

use crate::calibration::camera::refine::Residual;
use crate::calibration::plot::style::{FIELD, GRID, LEFT_OUT, PANEL_WIDTH};
use crate::camera::intrinsics::Pixel;
use crate::image::canvas::{Canvas, heat};

/// Lengths of a drawn arrow per px of residual, the largest that keeps the longest arrow short.
const MAGNIFICATIONS: [f64; 9] = [1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0];
/// Longest arrow but a few, px in the plot.
const LONGEST_ARROW: f64 = 36.0;

/// Where pixels of a picture lie on the plot.
#[derive(Clone, Copy, Debug)]
pub struct Field {
    corner: [f64; 2],
    zoom: f64,
    /// Of the panel, px.
    pub height: usize,
}

impl Field {
    /// With its upper left at `corner`, for pictures of this size.
    pub fn new(corner: [f64; 2], (width, height): (usize, usize)) -> Self {
        let zoom = PANEL_WIDTH as f64 / width.max(1) as f64;
        Self {
            corner,
            zoom,
            height: ((height as f64 * zoom).round() as usize).max(1),
        }
    }

    /// Where a pixel is drawn.
    pub fn at(&self, pixel: Pixel) -> [f64; 2] {
        let [left, top] = self.corner;
        [left + (pixel.x + 0.5) * self.zoom, top + (pixel.y + 0.5) * self.zoom]
    }

    /// Its ground.
    pub fn ground(&self, canvas: &mut Canvas) {
        let [left, top] = self.corner;
        canvas.fill(left, top, PANEL_WIDTH, self.height, FIELD);
    }

    /// Lines at the eighths.
    pub fn grid(&self, canvas: &mut Canvas) {
        let [left, top] = self.corner;
        for step in 1..8 {
            let share = f64::from(step) / 8.0;
            let (x, y) = (left + share * PANEL_WIDTH as f64, top + share * self.height as f64);
            canvas.line([x, top], [x, top + self.height as f64], GRID);
            canvas.line([left, y], [left + PANEL_WIDTH as f64, y], GRID);
        }
    }

    /// An arrow from each corner, a cross where it was left out; gives back how much longer arrows are than residuals.
    pub fn arrows<'a>(&self, canvas: &mut Canvas, residuals: impl Iterator<Item = &'a Residual> + Clone) -> f64 {
        let length = |residual: &Residual| residual.error_px[0].hypot(residual.error_px[1]);
        let mut lengths: Vec<f64> = residuals.clone().filter(|residual| residual.used).map(length).collect();
        lengths.sort_by(f64::total_cmp);
        let long = lengths.get(lengths.len() * 98 / 100).copied().unwrap_or(1.0).max(1e-6);
        let magnification = MAGNIFICATIONS.into_iter().find(|m| m * long <= LONGEST_ARROW).unwrap_or(1.0);
        for residual in residuals {
            let from = self.at(residual.corner.pixel);
            if !residual.used {
                canvas.cross(from, LEFT_OUT);
                continue;
            }
            let to = [
                from[0] + magnification * residual.error_px[0],
                from[1] + magnification * residual.error_px[1],
            ];
            let color = heat(length(residual) / (1.5 * long));
            canvas.line(from, to, color);
            canvas.fill(from[0] - 1.0, from[1] - 1.0, 2, 2, color);
        }
        magnification
    }
}
