//! A picture of a calibration: left the residual vectors where they are in the image field, right how far two halves of the views
//! disagree; the white line is the area in which corners were seen.

use crate::calibration::camera::coverage::hull;
use crate::calibration::camera::cross_validation::Difference;
use crate::calibration::camera::refine::Calibration;
use crate::calibration::plot_style::{BACKGROUND, CAPTION, FIELD, GRID, LEFT_OUT, MARGIN, PANEL_WIDTH, WHITE};
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

/// Lengths of a drawn arrow per px of residual, the largest that keeps the longest arrow short.
const MAGNIFICATIONS: [f64; 9] = [1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0];
/// Longest arrow but a few, px in the plot.
const LONGEST_ARROW: f64 = 36.0;

/// Draw it.
pub fn drawn(calibration: &Calibration, difference: Option<&Difference>) -> Image<Rgb8> {
    let camera = &calibration.camera;
    let zoom = PANEL_WIDTH as f64 / camera.width.max(1) as f64;
    let height = ((camera.height as f64 * zoom).round() as usize).max(1);
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, height + CAPTION + 2 * MARGIN, BACKGROUND);
    let left = MARGIN as f64;
    let right = (2 * MARGIN + PANEL_WIDTH) as f64;
    let top = (MARGIN + CAPTION) as f64;
    for x in [left, right] {
        canvas.fill(x, top, PANEL_WIDTH, height, FIELD);
    }
    let at = |panel: f64, pixel: Pixel| [panel + (pixel.x + 0.5) * zoom, top + (pixel.y + 0.5) * zoom];
    for step in 1..8 {
        let share = f64::from(step) / 8.0;
        let (x, y) = (left + share * PANEL_WIDTH as f64, top + share * height as f64);
        canvas.line([x, top], [x, top + height as f64], GRID);
        canvas.line([left, y], [left + PANEL_WIDTH as f64, y], GRID);
    }
    let mut lengths: Vec<f64> = residuals(calibration)
        .filter(|residual| residual.used)
        .map(|residual| residual.error_px[0].hypot(residual.error_px[1]))
        .collect();
    lengths.sort_by(f64::total_cmp);
    let long = lengths.get(lengths.len() * 98 / 100).copied().unwrap_or(1.0).max(1e-6);
    let magnification = MAGNIFICATIONS.into_iter().find(|m| m * long <= LONGEST_ARROW).unwrap_or(1.0);
    for residual in residuals(calibration) {
        let from = at(left, residual.corner.pixel);
        if !residual.used {
            canvas.cross(from, LEFT_OUT);
            continue;
        }
        let length = residual.error_px[0].hypot(residual.error_px[1]);
        let to = [
            from[0] + magnification * residual.error_px[0],
            from[1] + magnification * residual.error_px[1],
        ];
        let color = heat(length / (1.5 * long));
        canvas.line(from, to, color);
        canvas.fill(from[0] - 1.0, from[1] - 1.0, 2, 2, color);
    }
    canvas.text(
        left as usize,
        MARGIN,
        &format!("RESIDUALS X{magnification:.0}  RMS {:.3} PX", calibration.rms_px),
        WHITE,
    );
    if let Some(difference) = difference {
        let columns = difference.columns;
        let rows = difference.map_px.len() / columns.max(1);
        // A scale that ends at a round number above the worst that is covered.
        let most = round_above(difference.worst_px);
        for (place, value) in difference.map_px.iter().enumerate() {
            let (u, v) = ((place % columns) as f64, (place / columns) as f64);
            let (w, h) = (PANEL_WIDTH as f64 / columns as f64, height as f64 / rows as f64);
            let color = value.map_or([0, 0, 0], |value| heat(value / most));
            canvas.fill(right + u * w, top + v * h, w.ceil() as usize, h.ceil() as usize, color);
        }
        for step in 0..120 {
            let color = heat(f64::from(step) / 119.0);
            canvas.fill(right + 520.0 + f64::from(step), MARGIN as f64 + 2.0, 1, 16, color);
        }
        canvas.text(right as usize + 490, MARGIN, "0", WHITE);
        canvas.text(right as usize + 650, MARGIN, &format!("{most} PX"), WHITE);
        let caption = format!("HALVES DIFFER  MEDIAN {:.3} PX", difference.median_px);
        canvas.text(right as usize, MARGIN, &caption, WHITE);
    } else {
        canvas.text(right as usize, MARGIN, "TOO FEW VIEWS TO COMPARE HALVES", WHITE);
    }
    let around = hull(
        residuals(calibration)
            .filter(|residual| residual.used)
            .map(|residual| residual.corner.pixel)
            .collect(),
    );
    for (a, b) in around.iter().zip(around.iter().cycle().skip(1)) {
        for panel in [left, right] {
            canvas.line(at(panel, *a), at(panel, *b), WHITE);
        }
    }
    canvas.image
}

fn residuals(calibration: &Calibration) -> impl Iterator<Item = &crate::calibration::camera::refine::Residual> {
    calibration.views.iter().flat_map(|view| &view.residuals)
}

/// The next of 1, 2, 5, 10, 20 … hundredths.
fn round_above(value: f64) -> f64 {
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
