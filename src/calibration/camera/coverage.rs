//! Whether the views tell the whole camera: where in the picture corners lie, how the board was tilted.
//!
//! A lens is known where corners were seen and guessed elsewhere; the focal length shows only where the board is tilted, and a tilt one
//! way only leaves the principal point free to follow it.

use nalgebra::Vector3;

use crate::calibration::camera::lens;
use crate::calibration::camera::refine::Calibration;
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};

/// Columns of the coarse grid that coverage is counted on; rows follow the picture's shape.
const COLUMNS: usize = 12;
/// A cell never brighter than this on average lies outside the scope's round field, gray levels.
const BLACK_LEVEL: f32 = 12.0;
/// Fewer views than this leave little to check one against the other.
const FEW_VIEWS: usize = 8;
/// Covered less than this of the picture, its outer parts are guessed.
const POOR_SHARE: f64 = 0.5;
/// Steepest view at least this much, rad.
const LEAST_TILT_RAD: f64 = 0.26;
/// Tilts must lie round the axis, not to one side: length of the mean tilt direction.
const ONE_SIDED: f64 = 0.75;

/// How well the views cover the camera.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Coverage {
    /// Share of the image field's cells with a corner in or next to them.
    pub share: f64,
    /// The same for the four quarters: left top, right top, left bottom, right bottom.
    pub quarters: [f64; 4],
    /// Angle of the board's normal to the line of sight, smallest and largest, degrees.
    pub tilt_degrees: [f64; 2],
    /// Distance of the board's middle, smallest and largest, mm.
    pub distance_mm: [f64; 2],
    /// Farthest corner from the principal point, px.
    pub reach_px: f64,
    /// Corners used, the convex hull around them, px.
    #[serde(skip)]
    pub hull: Vec<Pixel>,
}

/// Cells that light falls on, put together from all pictures.
#[derive(Clone, Debug, Default)]
pub struct Lit(Vec<bool>);

impl Lit {
    /// Of one picture.
    pub fn of(image: &Image<Rgb8>) -> Self {
        let (width, height) = image.size();
        let rows = rows_of(width, height);
        let (mut sums, mut counts) = (vec![0.0_f32; COLUMNS * rows], vec![0.0_f32; COLUMNS * rows]);
        for y in (0..height).step_by(4) {
            for (x, pixel) in image.row(y).iter().enumerate().step_by(4) {
                let cell = (y * rows / height) * COLUMNS + x * COLUMNS / width;
                sums[cell] += f32::from(pixel[1]);
                counts[cell] += 1.0;
            }
        }
        Self(
            sums.iter()
                .zip(&counts)
                .map(|(sum, count)| *sum > BLACK_LEVEL * count)
                .collect(),
        )
    }

    /// Cells lit in either.
    pub fn or(mut self, other: &Self) -> Self {
        self.0.resize(self.0.len().max(other.0.len()), false);
        for (cell, lit) in self.0.iter_mut().zip(&other.0) {
            *cell |= lit;
        }
        self
    }
}

fn rows_of(width: usize, height: usize) -> usize {
    (COLUMNS * height).div_ceil(width.max(1)).max(2)
}

/// Coverage of the corners used, in the part of the picture that was ever lit.
pub fn coverage(calibration: &Calibration, lit: &Lit) -> Coverage {
    let camera = &calibration.camera;
    let used: Vec<Pixel> = used_pixels(calibration).collect();
    let rows = rows_of(camera.width, camera.height);
    let mut seen = vec![false; COLUMNS * rows];
    for pixel in &used {
        let u = (pixel.x / camera.width as f64 * COLUMNS as f64).floor() as i64;
        let v = (pixel.y / camera.height as f64 * rows as f64).floor() as i64;
        if (0..COLUMNS as i64).contains(&u) && (0..rows as i64).contains(&v) {
            seen[v as usize * COLUMNS + u as usize] = true;
        }
    }
    let mut counts = [[0.0_f64; 2]; 4];
    for v in 0..rows {
        for u in 0..COLUMNS {
            if lit.0.get(v * COLUMNS + u) == Some(&false) && !seen[v * COLUMNS + u] {
                continue;
            }
            let near = (v.saturating_sub(1)..=(v + 1).min(rows - 1))
                .any(|y| (u.saturating_sub(1)..=(u + 1).min(COLUMNS - 1)).any(|x| (x == u || y == v) && seen[y * COLUMNS + x]));
            let quarter = 2 * usize::from(2 * v >= rows) + usize::from(2 * u >= COLUMNS);
            counts[quarter][0] += f64::from(u8::from(near));
            counts[quarter][1] += 1.0;
        }
    }
    let tilts: Vec<f64> = tilts(calibration).map(|tilt| tilt.norm().min(1.0).asin()).collect();
    let distances: Vec<f64> = middles(calibration).map(|middle| middle.norm()).collect();
    let range = |values: &[f64]| {
        [
            values.iter().copied().fold(f64::INFINITY, f64::min),
            values.iter().copied().fold(0.0, f64::max),
        ]
    };
    let k = &camera.intrinsics;
    Coverage {
        share: counts.iter().map(|c| c[0]).sum::<f64>() / counts.iter().map(|c| c[1]).sum::<f64>().max(1.0),
        quarters: counts.map(|c| c[0] / c[1].max(1.0)),
        tilt_degrees: range(&tilts).map(f64::to_degrees),
        distance_mm: range(&distances),
        reach_px: used.iter().map(|p| (p.x - k.cx).hypot(p.y - k.cy)).fold(0.0, f64::max),
        hull: hull(used),
    }
}

/// What should be said about the calibration, in plain sentences.
pub fn warnings(calibration: &Calibration, coverage: &Coverage) -> Vec<String> {
    let mut warnings = Vec::new();
    let views = calibration
        .views
        .iter()
        .filter(|view| view.residuals.iter().any(|r| r.used))
        .count();
    if views < FEW_VIEWS {
        warnings.push(format!("only {views} views were used: take at least {FEW_VIEWS}, better 20"));
    }
    if coverage.share < POOR_SHARE {
        warnings.push(format!(
            "corners cover {:.0} % of the image field: the lens is a guess beyond {:.0} px from its middle; bring the board to the border too",
            coverage.share * 100.0,
            coverage.reach_px
        ));
    }
    let names = ["left top", "right top", "left bottom", "right bottom"];
    let (least, most) = coverage
        .quarters
        .iter()
        .fold((1.0_f64, 0.0_f64), |(a, b), q| (a.min(*q), b.max(*q)));
    if least < 0.4 * most {
        let poor: Vec<&str> = names
            .into_iter()
            .zip(coverage.quarters)
            .filter(|(_, q)| *q < 0.4 * most)
            .map(|(n, _)| n)
            .collect();
        warnings.push(format!(
            "the views are one-sided: hardly any corner in the quarter {}",
            poor.join(" and ")
        ));
    }
    if coverage.tilt_degrees[1] < LEAST_TILT_RAD.to_degrees() {
        warnings.push(format!(
            "the board was tilted by {:.0}° at most: focal length and distance cannot be told apart well; tilt it by 20° to 45°",
            coverage.tilt_degrees[1]
        ));
    } else {
        let directions: Vec<Vector3<f64>> = tilts(calibration)
            .filter(|tilt| tilt.xy().norm() > 0.5 * LEAST_TILT_RAD.sin())
            .map(|tilt| Vector3::new(tilt.x, tilt.y, 0.0).normalize())
            .collect();
        let mean = directions.iter().sum::<Vector3<f64>>() / directions.len().max(1) as f64;
        if directions.len() > 2 && mean.norm() > ONE_SIDED {
            warnings.push("the board was always tilted the same way: tilt it to all sides".into());
        }
    }
    let k = &calibration.camera.intrinsics;
    let (w, h) = (calibration.camera.width as f64 - 1.0, calibration.camera.height as f64 - 1.0);
    let corner = k.cx.max(w - k.cx).hypot(k.cy.max(h - k.cy));
    if let Some(fold) = lens::fold_px(&calibration.camera, corner) {
        let covered = if fold < coverage.reach_px {
            ", even among the corners seen"
        } else {
            ""
        };
        warnings.push(format!(
            "the lens model turns back on itself {fold:.0} px from the picture's middle{covered}: beyond that nothing can be undistorted; \
             see that corners reach the border, or fit fewer terms"
        ));
    }
    if k.cx < 0.0 || k.cy < 0.0 || k.cx > w || k.cy > h {
        warnings.push(format!(
            "the principal point ({:.0}, {:.0}) lies outside the picture",
            k.cx, k.cy
        ));
    }
    if calibration.covariance.is_none() {
        warnings.push("some parameters are not determined by these views at all".into());
    }
    warnings
}

/// Corners that took part.
pub fn used_pixels(calibration: &Calibration) -> impl Iterator<Item = Pixel> + '_ {
    (calibration.views.iter().flat_map(|view| &view.residuals))
        .filter(|residual| residual.used)
        .map(|residual| residual.corner.pixel)
}

/// The board's middle in camera space, per view used.
pub fn middles(calibration: &Calibration) -> impl Iterator<Item = Vector3<f64>> + '_ {
    calibration.views.iter().filter_map(|view| {
        let pose = view.camera_from_board?;
        let used: Vec<_> = view.residuals.iter().filter(|residual| residual.used).collect();
        let sum: Vector3<f64> = used.iter().map(|residual| (pose * residual.corner.board).coords).sum();
        (!used.is_empty()).then(|| sum / used.len() as f64)
    })
}

/// Part of the board's unit normal across the line of sight, per view used; its length is the sine of the tilt.
fn tilts(calibration: &Calibration) -> impl Iterator<Item = Vector3<f64>> + '_ {
    let poses = calibration
        .views
        .iter()
        .filter(|view| view.residuals.iter().any(|residual| residual.used))
        .filter_map(|view| view.camera_from_board);
    poses.zip(middles(calibration)).map(|(pose, middle)| {
        let normal = pose.rotation() * Vector3::z();
        let sight = middle.normalize();
        normal - sight * normal.dot(&sight)
    })
}

/// Convex hull, counter-clockwise in a y-up sense (Andrew 1979).
pub fn hull(mut points: Vec<Pixel>) -> Vec<Pixel> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let half = |points: &mut dyn Iterator<Item = Pixel>| {
        let mut chain: Vec<Pixel> = Vec::new();
        for p in points {
            while let [.., a, b] = chain[..]
                && (b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut around = half(&mut points.iter().copied());
    around.extend(half(&mut points.iter().rev().copied()));
    around
}

/// True inside a hull.
pub fn inside(hull: &[Pixel], at: Pixel) -> bool {
    hull.len() >= 3
        && hull
            .iter()
            .zip(hull.iter().cycle().skip(1))
            .all(|(a, b)| (b.x - a.x) * (at.y - a.y) - (b.y - a.y) * (at.x - a.x) >= -1e-6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hull_holds_its_points() {
        let points: Vec<Pixel> = (0..50)
            .map(|i| Pixel {
                x: 50.0 + 40.0 * f64::from(i * 37 % 50) / 50.0,
                y: 10.0 + f64::from(i * 13 % 50),
            })
            .collect();
        let around = hull(points.clone());
        assert!(around.len() >= 3 && points.iter().all(|p| inside(&around, *p)));
        assert!(!inside(&around, Pixel { x: 0.0, y: 0.0 }));
    }
}
