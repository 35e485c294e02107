//! A picture of a calibration: left the residual vectors where they are in the image field, right how far two halves of the views
//! disagree; the white line is the area in which corners were seen.

use crate::calibration::camera::coverage::hull;
use crate::calibration::camera::cross_validation::Difference;
use crate::calibration::camera::refine::Calibration;
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};

const PANEL_WIDTH: usize = 800;
const MARGIN: usize = 12;
const CAPTION: usize = 34;
const BACKGROUND: Rgb8 = [24, 24, 28];
const FIELD: Rgb8 = [44, 44, 50];
const WHITE: Rgb8 = [235, 235, 235];
const GRID: Rgb8 = [66, 66, 74];
const LEFT_OUT: Rgb8 = [255, 60, 200];
/// Lengths of a drawn arrow per px of residual, the largest that keeps the longest arrow short.
const MAGNIFICATIONS: [f64; 9] = [1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0];
/// Longest arrow but a few, px in the plot.
const LONGEST_ARROW: f64 = 36.0;

/// Draw it.
pub fn drawn(calibration: &Calibration, difference: Option<&Difference>) -> Image<Rgb8> {
    let camera = &calibration.camera;
    let zoom = PANEL_WIDTH as f64 / camera.width.max(1) as f64;
    let height = ((camera.height as f64 * zoom).round() as usize).max(1);
    let mut canvas = Image::filled(2 * PANEL_WIDTH + 3 * MARGIN, height + CAPTION + 2 * MARGIN, BACKGROUND);
    let left = MARGIN as f64;
    let right = (2 * MARGIN + PANEL_WIDTH) as f64;
    let top = (MARGIN + CAPTION) as f64;
    for x in [left, right] {
        fill(&mut canvas, x, top, PANEL_WIDTH, height, FIELD);
    }
    let at = |panel: f64, pixel: Pixel| [panel + (pixel.x + 0.5) * zoom, top + (pixel.y + 0.5) * zoom];
    for step in 1..8 {
        let share = f64::from(step) / 8.0;
        let (x, y) = (left + share * PANEL_WIDTH as f64, top + share * height as f64);
        line(&mut canvas, [x, top], [x, top + height as f64], GRID);
        line(&mut canvas, [left, y], [left + PANEL_WIDTH as f64, y], GRID);
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
            cross(&mut canvas, from, LEFT_OUT);
            continue;
        }
        let length = residual.error_px[0].hypot(residual.error_px[1]);
        let to = [
            from[0] + magnification * residual.error_px[0],
            from[1] + magnification * residual.error_px[1],
        ];
        let color = heat(length / (1.5 * long));
        line(&mut canvas, from, to, color);
        fill(&mut canvas, from[0] - 1.0, from[1] - 1.0, 2, 2, color);
    }
    text(
        &mut canvas,
        left as usize,
        MARGIN,
        &format!("RESIDUALS X{magnification:.0}  RMS {:.3} PX", calibration.rms_px),
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
            fill(
                &mut canvas,
                right + u * w,
                top + v * h,
                w.ceil() as usize,
                h.ceil() as usize,
                color,
            );
        }
        for step in 0..120 {
            let color = heat(f64::from(step) / 119.0);
            fill(
                &mut canvas,
                right + 520.0 + f64::from(step),
                MARGIN as f64 + 2.0,
                1,
                16,
                color,
            );
        }
        text(&mut canvas, right as usize + 490, MARGIN, "0");
        text(&mut canvas, right as usize + 650, MARGIN, &format!("{most} PX"));
        let caption = format!("HALVES DIFFER  MEDIAN {:.3} PX", difference.median_px);
        text(&mut canvas, right as usize, MARGIN, &caption);
    } else {
        text(&mut canvas, right as usize, MARGIN, "TOO FEW VIEWS TO COMPARE HALVES");
    }
    let around = hull(
        residuals(calibration)
            .filter(|residual| residual.used)
            .map(|residual| residual.corner.pixel)
            .collect(),
    );
    for (a, b) in around.iter().zip(around.iter().cycle().skip(1)) {
        for panel in [left, right] {
            line(&mut canvas, at(panel, *a), at(panel, *b), WHITE);
        }
    }
    canvas
}

fn residuals(calibration: &Calibration) -> impl Iterator<Item = &crate::calibration::camera::refine::Residual> {
    calibration.views.iter().flat_map(|view| &view.residuals)
}

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

/// From blue over green and yellow to red.
fn heat(share: f64) -> Rgb8 {
    const STOPS: [[f64; 3]; 5] = [
        [40.0, 60.0, 160.0],
        [30.0, 150.0, 170.0],
        [90.0, 200.0, 90.0],
        [240.0, 210.0, 60.0],
        [230.0, 50.0, 40.0],
    ];
    let at = share.clamp(0.0, 1.0) * 4.0;
    let low = (at as usize).min(3);
    let part = at - low as f64;
    let mut color = [0; 3];
    for (channel, out) in color.iter_mut().enumerate() {
        *out = (STOPS[low][channel] * (1.0 - part) + STOPS[low + 1][channel] * part).round() as u8;
    }
    color
}

fn dot(canvas: &mut Image<Rgb8>, x: f64, y: f64, color: Rgb8) {
    if x >= 0.0 && y >= 0.0 && (x as usize) < canvas.width() && (y as usize) < canvas.height() {
        canvas.set(x as usize, y as usize, color);
    }
}

fn fill(canvas: &mut Image<Rgb8>, x: f64, y: f64, width: usize, height: usize, color: Rgb8) {
    for v in 0..height {
        for u in 0..width {
            dot(canvas, x + u as f64, y + v as f64, color);
        }
    }
}

fn line(canvas: &mut Image<Rgb8>, from: [f64; 2], to: [f64; 2], color: Rgb8) {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let steps = dx.abs().max(dy.abs()).ceil().clamp(1.0, 1e4);
    for step in 0..=steps as usize {
        let share = step as f64 / steps;
        dot(canvas, from[0] + share * dx, from[1] + share * dy, color);
    }
}

fn cross(canvas: &mut Image<Rgb8>, at: [f64; 2], color: Rgb8) {
    line(canvas, [at[0] - 4.0, at[1] - 4.0], [at[0] + 4.0, at[1] + 4.0], color);
    line(canvas, [at[0] - 4.0, at[1] + 4.0], [at[0] + 4.0, at[1] - 4.0], color);
}

/// Letters of three by five cells; what is not here is a blank.
const GLYPHS: [(char, [u8; 5]); 38] = [
    ('0', [7, 5, 5, 5, 7]),
    ('1', [2, 6, 2, 2, 7]),
    ('2', [7, 1, 7, 4, 7]),
    ('3', [7, 1, 7, 1, 7]),
    ('4', [5, 5, 7, 1, 1]),
    ('5', [7, 4, 7, 1, 7]),
    ('6', [7, 4, 7, 5, 7]),
    ('7', [7, 1, 2, 2, 2]),
    ('8', [7, 5, 7, 5, 7]),
    ('9', [7, 5, 7, 1, 7]),
    ('.', [0, 0, 0, 0, 2]),
    ('-', [0, 0, 7, 0, 0]),
    ('A', [2, 5, 7, 5, 5]),
    ('B', [6, 5, 6, 5, 6]),
    ('C', [7, 4, 4, 4, 7]),
    ('D', [6, 5, 5, 5, 6]),
    ('E', [7, 4, 6, 4, 7]),
    ('F', [7, 4, 6, 4, 4]),
    ('G', [7, 4, 5, 5, 7]),
    ('H', [5, 5, 7, 5, 5]),
    ('I', [7, 2, 2, 2, 7]),
    ('J', [1, 1, 1, 5, 7]),
    ('K', [5, 5, 6, 5, 5]),
    ('L', [4, 4, 4, 4, 7]),
    ('M', [5, 7, 7, 5, 5]),
    ('N', [6, 5, 5, 5, 5]),
    ('O', [7, 5, 5, 5, 7]),
    ('P', [7, 5, 7, 4, 4]),
    ('Q', [7, 5, 5, 7, 1]),
    ('R', [6, 5, 6, 5, 5]),
    ('S', [7, 4, 7, 1, 7]),
    ('T', [7, 2, 2, 2, 2]),
    ('U', [5, 5, 5, 5, 7]),
    ('V', [5, 5, 5, 5, 2]),
    ('W', [5, 5, 7, 7, 5]),
    ('X', [5, 5, 2, 5, 5]),
    ('Y', [5, 5, 2, 2, 2]),
    ('Z', [7, 1, 2, 4, 7]),
];
const CELL: usize = 4;

fn text(canvas: &mut Image<Rgb8>, x: usize, y: usize, words: &str) {
    for (place, letter) in words.chars().enumerate() {
        let Some((_, rows)) = GLYPHS.iter().find(|(known, _)| *known == letter) else {
            continue;
        };
        for (v, row) in rows.iter().enumerate() {
            for u in 0..3 {
                if row >> (2 - u) & 1 == 1 {
                    let left = x + (place * 4 + u) * CELL;
                    fill(canvas, left as f64, (y + v * CELL) as f64, CELL, CELL, WHITE);
                }
            }
        }
    }
}
