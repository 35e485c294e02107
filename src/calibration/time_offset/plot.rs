//! A picture of a time offset: left how likely each offset is, right the motion of picture and arm over time, laid over each other.

use crate::calibration::plot::style::{BACKGROUND, CAPTION, FIELD, GRID, WHITE};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::Canvas;

const PANEL: (usize, usize) = (800, 420);
const MARGIN: usize = 16;
const PICTURE: Rgb8 = [90, 200, 90];
const ARM: Rgb8 = [240, 170, 60];
/// Likelihoods lower than the best by more than this say the same: no.
const DEEPEST: f64 = 200.0;

/// What is drawn.
#[derive(Clone, Copy, Debug)]
pub struct Plotted<'a> {
    /// ms.
    pub offset_ms: f64,
    /// ms.
    pub sigma_ms: f64,
    /// Offset (ms) and logarithm of its likelihood.
    pub curve: &'a [[f64; 2]],
    /// Seconds, by the pictures, by the arm.
    pub traces: &'a [[f64; 3]],
    /// What the traces are, such as `HAND MM`.
    pub traced: &'a str,
}

/// Draw it.
pub fn drawn(plotted: &Plotted<'_>) -> Image<Rgb8> {
    let (width, height) = (2 * PANEL.0 + 3 * MARGIN, PANEL.1 + 2 * CAPTION + 2 * MARGIN);
    let mut canvas = Canvas::new(width, height, BACKGROUND);
    let top = (MARGIN + CAPTION) as f64;
    let best = plotted.curve.iter().map(|[_, l]| *l).fold(f64::NEG_INFINITY, f64::max);
    let left = Panel::new(
        [MARGIN as f64, top],
        plotted.curve.iter().map(|[ms, l]| [*ms, (l - best).max(-DEEPEST)]),
    );
    let right = Panel::new(
        [(2 * MARGIN + PANEL.0) as f64, top],
        plotted
            .traces
            .iter()
            .flat_map(|[s, picture, arm]| [[*s, *picture], [*s, *arm]]),
    );
    left.frame(&mut canvas);
    right.frame(&mut canvas);
    let place = left.at([plotted.offset_ms, left.low[1]]);
    canvas.line(place, [place[0], top], WHITE);
    for pair in plotted.curve.windows(2) {
        let ends = [pair[0], pair[1]].map(|[ms, l]| left.at([ms, (l - best).max(-DEEPEST)]));
        canvas.line(ends[0], ends[1], PICTURE);
    }
    for (line, color) in [(1, PICTURE), (2, ARM)] {
        for pair in plotted.traces.windows(2).filter(|pair| pair[1][0] >= pair[0][0]) {
            canvas.line(
                right.at([pair[0][0], pair[0][line]]),
                right.at([pair[1][0], pair[1][line]]),
                color,
            );
        }
    }
    let caption = format!(
        "OFFSET {:.1} +- {:.1} MS  LOG-LIKELIHOOD",
        plotted.offset_ms, plotted.sigma_ms
    );
    canvas.text(MARGIN, MARGIN, &caption, WHITE);
    canvas.text(2 * MARGIN + PANEL.0, MARGIN, &format!("{}: PICTURE", plotted.traced), PICTURE);
    canvas.text(2 * MARGIN + PANEL.0 + 16 * (plotted.traced.len() + 11), MARGIN, "ARM", ARM);
    left.scale(&mut canvas, "MS");
    right.scale(&mut canvas, "S");
    canvas.image
}

/// Where numbers lie on the picture.
struct Panel {
    corner: [f64; 2],
    low: [f64; 2],
    high: [f64; 2],
}

impl Panel {
    fn new(corner: [f64; 2], points: impl Iterator<Item = [f64; 2]>) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for point in points.filter(|point| point.iter().all(|v| v.is_finite())) {
            for axis in 0..2 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        for axis in 0..2 {
            if high[axis].total_cmp(&low[axis]).is_le() || !low[axis].is_finite() {
                (low[axis], high[axis]) = (0.0, 1.0);
            }
        }
        Self { corner, low, high }
    }

    fn at(&self, point: [f64; 2]) -> [f64; 2] {
        let share = |axis: usize| ((point[axis] - self.low[axis]) / (self.high[axis] - self.low[axis])).clamp(0.0, 1.0);
        [
            self.corner[0] + share(0) * (PANEL.0 - 1) as f64,
            self.corner[1] + (1.0 - share(1)) * (PANEL.1 - 1) as f64,
        ]
    }

    fn frame(&self, canvas: &mut Canvas) {
        canvas.fill(self.corner[0], self.corner[1], PANEL.0, PANEL.1, FIELD);
        for step in 1..8 {
            let (x, y) = (
                self.corner[0] + (step * PANEL.0 / 8) as f64,
                self.corner[1] + (step * PANEL.1 / 8) as f64,
            );
            canvas.line([x, self.corner[1]], [x, self.corner[1] + (PANEL.1 - 1) as f64], GRID);
            canvas.line([self.corner[0], y], [self.corner[0] + (PANEL.0 - 1) as f64, y], GRID);
        }
    }

    fn scale(&self, canvas: &mut Canvas, unit: &str) {
        let (x, y) = (self.corner[0] as usize, self.corner[1] as usize + PANEL.1 + 8);
        canvas.text(x, y, &format!("{:.0}", self.low[0]), WHITE);
        let end = format!("{:.0} {unit}", self.high[0]);
        canvas.text((x + PANEL.0).saturating_sub(16 * end.len()), y, &end, WHITE);
        let span = format!("{:.3} TO {:.3}", self.low[1], self.high[1]);
        canvas.text(x + PANEL.0 / 2 - 8 * span.len(), y, &span, WHITE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_curves_are_drawn_and_nothing_to_draw_is_no_fault() {
        let curve: Vec<[f64; 2]> = (-30..=30).map(|k| [10.0 * f64::from(k), -f64::from(k * k)]).collect();
        let traces: Vec<[f64; 3]> = (0..100)
            .map(|i| [0.1 * f64::from(i), (0.2 * f64::from(i)).sin(), (0.2 * f64::from(i)).cos()])
            .collect();
        let drawn_of = |curve, traces| {
            drawn(&Plotted {
                offset_ms: -40.0,
                sigma_ms: 1.2,
                curve,
                traces,
                traced: "HAND MM",
            })
        };
        let image = drawn_of(&curve, &traces);
        let count = |color: Rgb8| image.pixels().iter().filter(|pixel| **pixel == color).count();
        assert!(count(PICTURE) > 1000 && count(ARM) > 700);
        assert_eq!(drawn_of(&[], &[]).size(), image.size());
        assert_eq!(
            drawn_of(&[[0.0, f64::NAN]], &[[f64::INFINITY, 0.0, 0.0]]).size(),
            image.size()
        );
    }
}
