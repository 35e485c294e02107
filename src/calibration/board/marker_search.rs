//! Square markers in a picture: dark quadrangles whose cells spell a marker of the dictionary.

use nalgebra::Matrix3;

use crate::calibration::board::marker::Dictionary;
use crate::calibration::board::saddle::bilinear;
use crate::calibration::camera::coverage::hull;
use crate::calibration::homography::{from_pairs, mapped};
use crate::camera::intrinsics::Pixel;
use crate::image::blur::{BlurScratch, box_blur};
use crate::image::buffer::Image;
use crate::image::components::Components;

/// A marker that was read.
#[derive(Clone, Copy, Debug)]
pub struct FoundMarker {
    /// Its number.
    pub id: usize,
    /// Its corners in the picture, clockwise from the first as the marker is read.
    pub corners: [[f64; 2]; 4],
}

/// Windows of the local mean, as shares of the picture's width.
const WINDOWS: [f64; 3] = [0.012, 0.025, 0.06];
/// Darker than the mean around by this much, gray levels.
const LEAST_DIFFERENCE: f32 = 2.0;
/// Sides of a quadrangle, px.
const LEAST_SIDE_PX: f64 = 6.0;
/// The longest side over the shortest.
const MOST_UNEVEN: f64 = 3.0;
/// Area of the hull that the quadrangle may miss.
const MOST_MISSED: f64 = 0.17;
/// Black to white, gray levels.
const LEAST_CONTRAST: f64 = 10.0;
/// Cells that may be misread; neighbours check the rest.
const MOST_ERRORS: u32 = 0;

/// All markers that can be read.
pub fn markers(gray: &Image<f32>, dictionary: Dictionary) -> Vec<FoundMarker> {
    let (width, height) = gray.size();
    let mut found: Vec<FoundMarker> = Vec::new();
    let mut components = Components::default();
    let mut mask = Image::filled(width, height, 0_u8);
    for window in WINDOWS {
        let mut mean = gray.clone();
        box_blur(
            &mut mean,
            ((width as f64 * window) as usize).max(3),
            &mut BlurScratch::default(),
        );
        for (out, (value, mean)) in mask.pixels_mut().iter_mut().zip(gray.pixels().iter().zip(mean.pixels())) {
            *out = u8::from(mean - value > LEAST_DIFFERENCE);
        }
        components.label(&mask);
        let mut ends: Vec<Vec<Pixel>> = vec![Vec::new(); components.regions().len()];
        let side = LEAST_SIDE_PX as u32;
        for run in components.runs() {
            let region = &components.regions()[run.label as usize];
            let (wide, high) = (region.right - region.left, region.bottom - region.top);
            if wide < side || high < side || wide as usize > width / 3 || high as usize > height / 2 {
                continue;
            }
            let ends = &mut ends[run.label as usize];
            for x in [run.begin, run.end - 1] {
                ends.push(Pixel {
                    x: f64::from(x),
                    y: f64::from(run.y),
                });
            }
        }
        for ends in ends.into_iter().filter(|ends| ends.len() > 8) {
            let Some(quad) = quadrangle(ends) else { continue };
            let Some(marker) = read(gray, &quad, dictionary) else {
                continue;
            };
            let near = |other: &FoundMarker| {
                other.id == marker.id
                    && (other.corners[0][0] - marker.corners[0][0]).hypot(other.corners[0][1] - marker.corners[0][1])
                        < LEAST_SIDE_PX
            };
            if !found.iter().any(near) {
                found.push(marker);
            }
        }
    }
    found
}

/// The quadrangle that a region fills, clockwise on the screen.
fn quadrangle(ends: Vec<Pixel>) -> Option<[[f64; 2]; 4]> {
    let around = hull(ends);
    if around.len() < 4 {
        return None;
    }
    let distance = |a: &Pixel, b: &Pixel| (a.x - b.x).hypot(a.y - b.y);
    let mut far = (0.0, 0, 0);
    for i in 0..around.len() {
        for j in i + 1..around.len() {
            let d = distance(&around[i], &around[j]);
            if d > far.0 {
                far = (d, i, j);
            }
        }
    }
    let (a, c) = (around[far.1], around[far.2]);
    let side = |p: &Pixel| (c.x - a.x) * (p.y - a.y) - (c.y - a.y) * (p.x - a.x);
    let b = *around.iter().min_by(|p, q| side(p).total_cmp(&side(q)))?;
    let d = *around.iter().max_by(|p, q| side(p).total_cmp(&side(q)))?;
    // y points down: negative is on the left when looking from a to c, so a, b, c, d turn clockwise.
    let quad = [a, b, c, d];
    let area = |points: &[Pixel]| -> f64 {
        let cross = |(p, q): (&Pixel, &Pixel)| p.x * q.y - p.y * q.x;
        points.iter().zip(points.iter().cycle().skip(1)).map(cross).sum::<f64>().abs() / 2.0
    };
    let sides: Vec<f64> = (0..4).map(|k| distance(&quad[k], &quad[(k + 1) % 4])).collect();
    let (shortest, longest) = sides
        .iter()
        .fold((f64::INFINITY, 0.0_f64), |(s, l), d| (s.min(*d), l.max(*d)));
    let whole = area(&around);
    if shortest < LEAST_SIDE_PX || longest > MOST_UNEVEN * shortest || area(&quad) < (1.0 - MOST_MISSED) * whole {
        return None;
    }
    // Pixel centres lie half a pixel within the rim.
    let middle = [
        quad.iter().map(|p| p.x).sum::<f64>() / 4.0,
        quad.iter().map(|p| p.y).sum::<f64>() / 4.0,
    ];
    Some(quad.map(|p| {
        let out = [p.x - middle[0], p.y - middle[1]];
        let length = out[0].hypot(out[1]);
        [p.x + 0.6 * out[0] / length, p.y + 0.6 * out[1] / length]
    }))
}

fn read(gray: &Image<f32>, quad: &[[f64; 2]; 4], dictionary: Dictionary) -> Option<FoundMarker> {
    let cells = dictionary.cells() + 2;
    let n = cells as f64;
    let unit = [[0.0, 0.0], [n, 0.0], [n, n], [0.0, n]];
    let pairs = [0, 1, 2, 3].map(|k| (unit[k], quad[k]));
    let map = from_pairs(&pairs)?;
    let mut levels = Vec::with_capacity(cells * cells);
    for row in 0..cells {
        for column in 0..cells {
            levels.push(level(gray, &map, column as f64, row as f64)?);
        }
    }
    let (low, high) = levels.iter().fold((f64::INFINITY, 0.0_f64), |(low, high), level| {
        (low.min(*level), high.max(*level))
    });
    if high - low < LEAST_CONTRAST {
        return None;
    }
    // A lone white cell is less bright than a wide one, and a lone black one less dark.
    let middle = low + 0.45 * (high - low);
    let mut bits = 0_u64;
    let mut white_frame = 0;
    for (place, level) in levels.iter().enumerate() {
        let (column, row) = (place % cells, place / cells);
        let white = *level > middle;
        if column == 0 || row == 0 || column + 1 == cells || row + 1 == cells {
            white_frame += usize::from(white);
        } else {
            bits = bits << 1 | u64::from(white);
        }
    }
    if white_frame > 1 {
        return None;
    }
    let reading = dictionary.read(bits, MOST_ERRORS)?;
    // Turned clockwise by k quarters, the marker's first corner stands at the quadrangle's k-th.
    let corners = [0, 1, 2, 3].map(|k| quad[(k + reading.quarter_turns) % 4]);
    Some(FoundMarker { id: reading.id, corners })
}

/// The mean over the inner part of a cell.
fn level(gray: &Image<f32>, map: &Matrix3<f64>, column: f64, row: f64) -> Option<f64> {
    let mut sum = 0.0;
    for k in 0..9 {
        let at = mapped(
            map,
            [
                column + 0.5 + 0.2 * f64::from(k % 3 - 1),
                row + 0.5 + 0.2 * f64::from(k / 3 - 1),
            ],
        )?;
        sum += bilinear(gray, at[0], at[1])?;
    }
    Some(sum / 9.0)
}
