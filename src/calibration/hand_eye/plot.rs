//! A picture of a hand-eye calibration: left each station's corners with a line to where the arm alone puts them, right how well each
//! station is predicted by a calibration on the others.

use crate::calibration::plot::bars::Bars;
use crate::calibration::plot::field::Field;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, LEFT_OUT, MARGIN, PANEL_WIDTH, WHITE};
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

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
pub fn drawn(size: (usize, usize), stations: &[Drawn]) -> Image<Rgb8> {
    let (left, right, top) = (MARGIN as f64, (2 * MARGIN + PANEL_WIDTH) as f64, (MARGIN + CAPTION) as f64);
    let field = Field::new([left, top], size);
    let tall = field.height;
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, tall + CAPTION + 2 * MARGIN, BACKGROUND);
    field.ground(&mut canvas);
    let at = |pixel: &Pixel| field.at(*pixel);
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

    let bars = Bars {
        corner: [right, top],
        height: tall,
        first: 0.01,
        decades: 4,
        unit: "px",
        places: stations.len(),
    };
    bars.ground(&mut canvas);
    for (place, station) in stations.iter().enumerate() {
        let color = |px| color_of(px, worst, station.outlier);
        if let Some(px) = station.left_out_px {
            bars.bar(&mut canvas, place, [0.1, 0.5], px, color(px));
        }
        let px = station.predicted_px;
        bars.bar(&mut canvas, place, [0.5, 0.9], px, color(px).map(|channel| channel / 2));
    }
    bars.numbers(&mut canvas);
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
