//! A picture of a calibration: left the residual vectors where they are in the image field, right how far two halves of the views
//! disagree; the white line is the area in which corners were seen.

use crate::calibration::camera::coverage::hull;
use crate::calibration::camera::cross_validation::Difference;
use crate::calibration::camera::refine::{Calibration, Residual};
use crate::calibration::plot::field::Field;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, MARGIN, PANEL_WIDTH, WHITE, round_above};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

/// Draw it.
pub fn drawn(calibration: &Calibration, difference: Option<&Difference>) -> Image<Rgb8> {
    let camera = &calibration.camera;
    let left = MARGIN as f64;
    let right = (2 * MARGIN + PANEL_WIDTH) as f64;
    let top = (MARGIN + CAPTION) as f64;
    let fields = [left, right].map(|x| Field::new([x, top], (camera.width, camera.height)));
    let height = fields[0].height;
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, height + CAPTION + 2 * MARGIN, BACKGROUND);
    for field in &fields {
        field.ground(&mut canvas);
    }
    fields[0].grid(&mut canvas);
    let magnification = fields[0].arrows(&mut canvas, residuals(calibration));
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
        for field in &fields {
            canvas.line(field.at(*a), field.at(*b), WHITE);
        }
    }
    canvas.image
}

fn residuals(calibration: &Calibration) -> impl Iterator<Item = &Residual> + Clone {
    calibration.views.iter().flat_map(|view| &view.residuals)
}
