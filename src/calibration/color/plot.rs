//! A picture of a calibration of colors: left the chart where it was found, right its patches: the reference above, below it the measured
//! color at the left and the corrected one at the right.

use nalgebra::Matrix3;

use crate::calibration::color::chart::{COLUMNS, PATCHES, ROWS, place};
use crate::calibration::color::report::Report;
use crate::calibration::homography;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, MARGIN, PANEL_WIDTH, WHITE};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::Canvas;

const OUTLINE: Rgb8 = [60, 255, 120];
const SHADOW: Rgb8 = [0, 0, 0];
/// Half of a patch as drawn, in distances of patches.
const HALF: f64 = 0.4;
/// Side of a patch's square in the table of patches.
const SQUARE: usize = 124;

/// Draw it.
pub fn drawn(report: &Report, image: &Image<Rgb8>, pixel_from_chart: &Matrix3<f64>) -> Image<Rgb8> {
    let zoom = PANEL_WIDTH as f64 / image.width().max(1) as f64;
    let picture_height = (image.height() as f64 * zoom) as usize;
    let table = ROWS * (SQUARE + CAPTION);
    let height = picture_height.max(table) + CAPTION + 2 * MARGIN;
    let right = 2 * MARGIN + PANEL_WIDTH;
    let mut canvas = Canvas::new(right + COLUMNS * (SQUARE + MARGIN) + MARGIN, height, BACKGROUND);
    canvas.text(MARGIN, MARGIN / 2, "chart", WHITE);
    let words = format!(
        "dE {:.2} before {:.2} after, left out {:.2}",
        report.before.mean, report.after.mean, report.cross_validated
    );
    canvas.text(right, MARGIN / 2, &words, WHITE);
    let top = (MARGIN + CAPTION) as f64;
    for y in 0..picture_height {
        for x in 0..PANEL_WIDTH {
            let at = |v: usize, most: usize| ((v as f64 / zoom) as usize).min(most.saturating_sub(1));
            let pixel = image.at(at(x, image.width()), at(y, image.height()));
            canvas.dot((MARGIN + x) as f64, top + y as f64, pixel);
        }
    }
    let on_picture = |u: f64, v: f64| {
        let [x, y] = homography::mapped(pixel_from_chart, [u, v])?;
        Some([MARGIN as f64 + (x + 0.5) * zoom, top + (y + 0.5) * zoom])
    };
    for patch in 0..PATCHES {
        let [u, v] = place(patch);
        let corners = [[-HALF, -HALF], [HALF, -HALF], [HALF, HALF], [-HALF, HALF]];
        for side in 0..4 {
            let (a, b) = (corners[side], corners[(side + 1) % 4]);
            if let (Some(a), Some(b)) = (on_picture(u + a[0], v + a[1]), on_picture(u + b[0], v + b[1])) {
                canvas.line([a[0] + 1.0, a[1] + 1.0], [b[0] + 1.0, b[1] + 1.0], SHADOW);
                canvas.line(a, b, OUTLINE);
            }
        }
    }
    for (patch, shown) in report.patches.iter().enumerate() {
        let (column, row) = (patch % COLUMNS, patch / COLUMNS);
        let x = (right + column * (SQUARE + MARGIN)) as f64;
        let y = top + (row * (SQUARE + CAPTION)) as f64;
        let byte = |color: [f64; 3]| color.map(|v| v.round().clamp(0.0, 255.0) as u8);
        let half = SQUARE / 2;
        canvas.fill(x, y, SQUARE, half, byte(shown.reference));
        canvas.fill(x, y + half as f64, half, half, byte(shown.measured));
        canvas.fill(x + half as f64, y + half as f64, half, half, byte(shown.corrected));
        let words = if shown.out_of_range {
            "clip".to_owned()
        } else {
            format!("{:.1}", shown.after)
        };
        canvas.text(x as usize, y as usize + SQUARE + 4, &words, WHITE);
    }
    canvas.image
}
