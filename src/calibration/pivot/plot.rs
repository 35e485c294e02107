//! A picture of a pivot calibration: left where each pose puts the tip about the place of rest, from two sides, right how far off it is.

use nalgebra::Vector3;

use crate::calibration::pivot::fit::Pivot;
use crate::calibration::plot::bars::Bars;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, FIELD, GRID, LEFT_OUT, MARGIN, PANEL_WIDTH, WHITE, round_above};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

/// Side of one of the two views of the tips.
const SIDE: usize = (PANEL_WIDTH - MARGIN) / 2;

/// Draw it.
pub fn drawn(found: &Pivot) -> Image<Rgb8> {
    let (right, top) = ((2 * MARGIN + PANEL_WIDTH) as f64, (MARGIN + CAPTION) as f64);
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, SIDE + CAPTION + 2 * MARGIN, BACKGROUND);
    let used = found.offsets_mm.iter().zip(&found.outliers).filter(|(_, outlier)| !**outlier);
    let farthest = used.clone().map(|(offset, _)| offset.amax()).fold(0.0, f64::max);
    let worst = used.map(|(offset, _)| offset.norm()).fold(1e-6, f64::max);
    let color = |offset: &Vector3<f64>, outlier: bool| {
        if outlier { LEFT_OUT } else { heat(offset.norm() / worst) }
    };
    let most = round_above(farthest);
    for (view, across, words) in [(0, 1, "X/Y"), (1, 2, "X/Z")] {
        let left = (MARGIN + view * (SIDE + MARGIN)) as f64;
        canvas.fill(left, top, SIDE, SIDE, FIELD);
        let middle = [left + SIDE as f64 / 2.0, top + SIDE as f64 / 2.0];
        for step in 1..8 {
            let at = (step * SIDE / 8) as f64;
            canvas.line([left + at, top], [left + at, top + SIDE as f64 - 1.0], GRID);
            canvas.line([left, top + at], [left + SIDE as f64 - 1.0, top + at], GRID);
        }
        for (offset, &outlier) in found.offsets_mm.iter().zip(&found.outliers) {
            // Half of the side is `most`; what lies beyond is drawn at the rim.
            let at = |mm: f64| (mm / most * SIDE as f64 / 2.0).clamp(5.0 - SIDE as f64 / 2.0, SIDE as f64 / 2.0 - 5.0);
            let place = [middle[0] + at(offset.x), middle[1] + at(offset[across])];
            if outlier {
                canvas.cross(place, LEFT_OUT);
            } else {
                canvas.fill(place[0] - 2.0, place[1] - 2.0, 5, 5, color(offset, outlier));
            }
        }
        canvas.text(left as usize, MARGIN, &format!("TIPS {words} +-{most} MM"), WHITE);
    }
    let bars = Bars {
        corner: [right, top],
        height: SIDE,
        first: first_of_scale(&found.offsets_mm),
        decades: 4,
        unit: "mm",
        places: found.offsets_mm.len(),
    };
    bars.ground(&mut canvas);
    for (place, (offset, &outlier)) in found.offsets_mm.iter().zip(&found.outliers).enumerate() {
        bars.bar(&mut canvas, place, [0.1, 0.9], offset.norm(), color(offset, outlier));
    }
    bars.numbers(&mut canvas);
    let words = format!("POSES: HOW FAR OFF, RMS {:.3} MM AN AXIS", found.rms_mm);
    canvas.text(right as usize, MARGIN, &words, WHITE);
    canvas.image
}

/// Three decades below the first round number that the middle one is under: the scale reaches ten times as high, and an exact tool's tips
/// are still told apart.
fn first_of_scale(offsets_mm: &[Vector3<f64>]) -> f64 {
    let mut lengths: Vec<f64> = offsets_mm.iter().map(Vector3::norm).collect();
    lengths.sort_by(f64::total_cmp);
    let middle = lengths
        .get(lengths.len() / 2)
        .copied()
        .filter(|mm| mm.is_finite())
        .unwrap_or(1.0);
    10.0_f64.powf(middle.max(1e-3).log10().ceil() - 3.0)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix6, Vector3};

    use super::*;
    use crate::geometry::point::Point;

    fn found(offsets_mm: Vec<Vector3<f64>>, outliers: Vec<bool>) -> Pivot {
        Pivot {
            tip: Point::new(0.0, 0.0, 100.0),
            rest: Point::new(0.0, 0.0, 0.0),
            covariance: Matrix6::identity(),
            rms_mm: 1.0,
            offsets_mm,
            outliers,
        }
    }

    #[test]
    fn outliers_are_told_by_their_color_wherever_they_are() {
        let near = Vector3::new(0.5, -0.3, 0.2);
        let count = |far: Vector3<f64>, outlier| {
            let picture = drawn(&found(vec![near, -near, far], vec![false, false, outlier]));
            picture.pixels().iter().filter(|pixel| **pixel == LEFT_OUT).count()
        };
        // Crosses of nine pixels a stroke in both views, and a bar.
        assert!(count(Vector3::new(900.0, 0.0, -3.0), true) > 2 * 17 + 1000);
        assert_eq!(count(near, false), 0);
    }

    #[test]
    fn strange_numbers_are_drawn_somewhere_or_not_at_all() {
        let strange = vec![Vector3::repeat(f64::NAN), Vector3::repeat(f64::INFINITY), Vector3::zeros()];
        let size = drawn(&found(vec![], vec![])).size();
        assert_eq!(drawn(&found(strange, vec![false, false, true])).size(), size);
    }
}
