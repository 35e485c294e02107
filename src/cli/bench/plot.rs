//! Latency drawn: its cumulative distribution, and how it went over time.

use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::Canvas;
use crate::sinks::meter::Shown;

const WIDTH: usize = 1280;
const HEIGHT: usize = 920;
/// Around a panel, px.
const LEFT: f64 = 150.0;
const RIGHT: f64 = 40.0;
const PANEL_HEIGHT: f64 = 320.0;
const TOPS: [f64; 2] = [70.0, 530.0];

const PAPER: Rgb8 = [255, 255, 255];
const INK: Rgb8 = [40, 40, 40];
const GRID: Rgb8 = [222, 222, 222];
const CURVE: Rgb8 = [30, 90, 180];
const LATE: Rgb8 = [210, 50, 40];
const LIMIT: Rgb8 = [220, 150, 40];

/// Where a panel lies, and what its axes say.
struct Panel {
    top: f64,
    x: [f64; 2],
    y: [f64; 2],
}

impl Panel {
    fn at(&self, x: f64, y: f64) -> [f64; 2] {
        let across = (x - self.x[0]) / (self.x[1] - self.x[0]).max(1e-12);
        let up = (y - self.y[0]) / (self.y[1] - self.y[0]).max(1e-12);
        [
            LEFT + across.clamp(0.0, 1.0) * (WIDTH as f64 - LEFT - RIGHT),
            self.top + (1.0 - up.clamp(0.0, 1.0)) * PANEL_HEIGHT,
        ]
    }

    fn frame(&self, canvas: &mut Canvas, x_steps: &[f64], y_steps: &[f64], y_word: impl Fn(f64) -> String) {
        for &x in x_steps {
            canvas.line(self.at(x, self.y[0]), self.at(x, self.y[1]), GRID);
            let [left, bottom] = self.at(x, self.y[0]);
            let word = plain(x);
            let start = (left - 8.0 * word.len() as f64).max(0.0);
            canvas.text(start as usize, (bottom + 10.0) as usize, &word, INK);
        }
        for &y in y_steps {
            canvas.line(self.at(self.x[0], y), self.at(self.x[1], y), GRID);
            let [_, height] = self.at(self.x[0], y);
            let word = y_word(y);
            let start = (LEFT - 10.0 - 16.0 * word.len() as f64).max(0.0);
            canvas.text(start as usize, (height - 10.0).max(0.0) as usize, &word, INK);
        }
        for (from, to) in [([0, 0], [0, 1]), ([0, 0], [1, 0])] {
            let corner = |which: [usize; 2]| self.at(self.x[which[0]], self.y[which[1]]);
            canvas.line(corner(from), corner(to), INK);
        }
    }
}

fn plain(value: f64) -> String {
    let text = format!("{value:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// Round steps that cover `range`, about `count` of them.
fn steps(range: [f64; 2], count: f64) -> Vec<f64> {
    let rough = (range[1] - range[0]).max(1e-9) / count;
    let decade = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .map(|factor| factor * decade)
        .into_iter()
        .find(|step| *step >= rough);
    let step = step.unwrap_or(10.0 * decade);
    let first = (range[0] / step).ceil() as i64;
    let last = (range[1] / step + 1e-9).floor() as i64;
    (first..=last).map(|number| number as f64 * step).collect()
}

/// The picture. `deadline_ms` is drawn where there is one.
pub fn drawn(shown: &[Shown], title: &str, deadline_ms: Option<f64>) -> Image<Rgb8> {
    let mut canvas = Canvas::new(WIDTH, HEIGHT, PAPER);
    canvas.text(24, 16, title, INK);
    let mut sorted: Vec<f64> = shown.iter().map(|frame| frame.latency_ms).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let most = sorted.last().copied().unwrap_or(1.0).max(deadline_ms.unwrap_or(0.0)).max(1.0) * 1.05;

    // Far out in the tail one frame in a thousand counts: the height is the logarithm of what is left above.
    let rank_of = |share: f64| -(1.0 - share).max(1e-12).log10();
    let ranks = [rank_of(0.0), rank_of(0.9999)];
    let panel = Panel {
        top: TOPS[0],
        x: [0.0, most],
        y: ranks,
    };
    let marks = [0.0, 0.5, 0.9, 0.99, 0.999, 0.9999].map(rank_of);
    panel.frame(&mut canvas, &steps(panel.x, 8.0), &marks, |rank| {
        format!("{}%", plain(100.0 * (1.0 - 10_f64.powf(-rank))))
    });
    if let Some(deadline) = deadline_ms {
        canvas.line(panel.at(deadline, ranks[0]), panel.at(deadline, ranks[1]), LIMIT);
    }
    let count = sorted.len() as f64;
    let mut before = panel.at(0.0, ranks[0]);
    for (number, latency) in sorted.iter().enumerate() {
        let step = panel.at(*latency, rank_of((number as f64 + 0.5) / count));
        canvas.line(before, [step[0], before[1]], CURVE);
        canvas.line([step[0], before[1]], step, CURVE);
        before = step;
    }
    canvas.text(
        24,
        (TOPS[0] + PANEL_HEIGHT + 40.0) as usize,
        "frames that took at most so many ms",
        INK,
    );

    let began = shown.first().map_or(0.0, |frame| frame.arrived_s);
    let length = shown.last().map_or(1.0, |frame| frame.arrived_s - began).max(1e-3);
    let panel = Panel {
        top: TOPS[1],
        x: [0.0, length],
        y: [0.0, most],
    };
    panel.frame(&mut canvas, &steps(panel.x, 10.0), &steps(panel.y, 6.0), plain);
    if let Some(deadline) = deadline_ms {
        canvas.line(panel.at(0.0, deadline), panel.at(length, deadline), LIMIT);
    }
    for frame in shown {
        let [x, y] = panel.at(frame.arrived_s - began, frame.latency_ms);
        let color = if frame.untouched { LATE } else { CURVE };
        canvas.fill((x - 1.0).floor(), (y - 1.0).floor(), 3, 3, color);
    }
    let words = "ms over s, red: shown as it came";
    canvas.text(24, (TOPS[1] + PANEL_HEIGHT + 40.0) as usize, words, INK);
    canvas.image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_cover() {
        assert_eq!(steps([0.0, 40.0], 8.0), [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0]);
        assert!(steps([0.0, 0.7], 7.0).len() >= 7);
    }

    #[test]
    fn what_was_late_is_red_and_the_curve_is_drawn() {
        let shown: Vec<Shown> = (0..100)
            .map(|number| Shown {
                frame: number,
                arrived_s: 0.03 * number as f64,
                latency_ms: if number == 50 { 40.0 } else { 10.0 + 0.1 * number as f64 },
                untouched: number == 50,
                passed_by: 0,
            })
            .collect();
        let image = drawn(&shown, "bench", Some(40.0));
        let count = |color: Rgb8| image.pixels().iter().filter(|pixel| **pixel == color).count();
        assert!((1..=9).contains(&count(LATE)), "{}", count(LATE));
        assert!(count(CURVE) > 300 && count(LIMIT) > 300);
        let empty = drawn(&[], "bench", None);
        assert!(empty.pixels().iter().all(|pixel| *pixel != CURVE));
    }
}
