//! A picture of a hand-eye calibration: left each station's corners with a line to where the arm alone puts them, right how well each
//! station is predicted by a calibration on the others.

use crate::calibration::plot_style::{BACKGROUND, CAPTION, FIELD, GRID, LEFT_OUT, MARGIN, PANEL_WIDTH, WHITE};
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

/// Decades of the bars' scale, and where it begins, px.
const DECADES: f64 = 4.0;
const FIRST_PX: f64 = 0.01;

/// One station.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// Corners seen, and where the arm alone puts them.
    pub corners: Vec<(Pixel, Option<Pixel>)>,
    /// RMS of what the arm alone puts elsewhere, px.
    pub predicted_px: f64,
    /// RMS when calibrated on the others, px.
    pub left_out_px: Option<f64>,
    /// Not used.
    pub outlier: bool,
}

/// Draw it, for pictures of this size.
pub fn drawn((width, height): (usize, usize), stations: &[Drawn]) -> Image<Rgb8> {
    let zoom = PANEL_WIDTH as f64 / width.max(1) as f64;
    let tall = ((height as f64 * zoom).round() as usize).max(1);
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, tall + CAPTION + 2 * MARGIN, BACKGROUND);
    let (left, right, top) = (MARGIN as f64, (2 * MARGIN + PANEL_WIDTH) as f64, (MARGIN + CAPTION) as f64);
    for x in [left, right] {
        canvas.fill(x, top, PANEL_WIDTH, tall, FIELD);
    }
    let at = |pixel: &Pixel| [left + (pixel.x + 0.5) * zoom, top + (pixel.y + 0.5) * zoom];
    let inside = |[x, y]: [f64; 2]| [x.clamp(left, left + PANEL_WIDTH as f64), y.clamp(top, top + tall as f64)];
    let used = stations.iter().filter(|station| !station.outlier);
    let worst = used.map(|station| station.predicted_px).fold(1e-6, f64::max);
    for station in stations {
        let color = color_of(station.predicted_px, worst, station.outlier);
        for (seen, predicted) in &station.corners {
            if let Some(predicted) = predicted {
                canvas.line(inside(at(seen)), inside(at(predicted)), color);
            }
            let [x, y] = at(seen);
            canvas.fill(x - 1.0, y - 1.0, 2, 2, color);
        }
    }
    canvas.text(
        MARGIN,
        MARGIN,
        &format!("corners to where the arm puts them, worst {worst:.2} px"),
        WHITE,
    );

    let share = |px: f64| ((px / FIRST_PX).max(1.0).log10() / DECADES).min(1.0);
    let bottom = top + tall as f64;
    for decade in 1..DECADES as u32 {
        let y = bottom - f64::from(decade) / DECADES * tall as f64;
        canvas.line([right, y], [right + PANEL_WIDTH as f64, y], GRID);
    }
    let step = PANEL_WIDTH as f64 / stations.len().max(1) as f64;
    for (place, station) in stations.iter().enumerate() {
        let bars = [station.left_out_px, Some(station.predicted_px)];
        for (half, px) in bars.into_iter().enumerate() {
            let Some(px) = px.filter(|px| px.is_finite()) else { continue };
            let high = (share(px) * tall as f64).round();
            let x = right + (place as f64 + 0.1 + 0.4 * half as f64) * step;
            let color = color_of(px, worst, station.outlier);
            let color = if half == 0 { color } else { color.map(|channel| channel / 2) };
            canvas.fill(x, bottom - high, ((0.4 * step) as usize).max(1), high as usize, color);
        }
    }
    for decade in 1..DECADES as u32 {
        let y = bottom - f64::from(decade) / DECADES * tall as f64;
        let px = FIRST_PX * 10.0_f64.powi(decade as i32);
        canvas.text(right as usize + 4, y as usize + 4, &format!("{px} px"), WHITE);
    }
    canvas.text(right as usize, MARGIN, "stations: left out (bright), used (dark)", WHITE);
    canvas.image
}

fn color_of(px: f64, worst: f64, outlier: bool) -> Rgb8 {
    if outlier { LEFT_OUT } else { heat(px / worst) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strange_numbers_are_drawn_somewhere_or_not_at_all() {
        let station = |px: f64| Drawn {
            corners: vec![
                (Pixel { x: 3.0, y: 4.0 }, Some(Pixel { x: px, y: 1e12 })),
                (Pixel { x: 3.0, y: 4.0 }, None),
            ],
            predicted_px: px,
            left_out_px: Some(px),
            outlier: px > 5.0,
        };
        let picture = drawn(
            (320, 180),
            &[
                station(1.0),
                station(f64::NAN),
                station(f64::INFINITY),
                station(0.0),
                station(8.0),
            ],
        );
        assert_eq!(picture.width(), 2 * PANEL_WIDTH + 3 * MARGIN);
        assert!(picture.pixels().contains(&LEFT_OUT));
        // Nobody at all.
        assert!(drawn((0, 0), &[]).height() > 0);
    }
}
