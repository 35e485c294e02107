//! A view small enough that looking at a few pixels of every block does not alias.

use crate::light_field::view::View;
use crate::stages::specularity_substitution::grid::{Division, step_for};
use crate::stages::specularity_substitution::lookup::split;

/// A pixel: all that a comparison asks for, in one place.
#[derive(Clone, Copy, Debug, Default)]
struct SmallPixel {
    /// Mean colour, and the least confidence of the pixels averaged.
    color: [u8; 4],
    /// Depth in the middle, mm, 0 where unknown.
    depth: f32,
}

/// A view at about the resolution of the small live picture.
#[derive(Clone, Debug)]
pub struct SmallView {
    /// Pixels of the view along a pixel of this.
    pub step: usize,
    by_step: Division,
    width: usize,
    height: usize,
    pixels: Vec<SmallPixel>,
}

/// What a small view shows between its pixels.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Levels, and a number that means nothing.
    pub color: [f32; 4],
    /// The least of the four pixels around.
    pub confidence: u8,
    /// Of the nearest pixel, mm.
    pub depth: f32,
}

impl SmallView {
    /// A small copy of a view.
    pub fn of(view: &View) -> Self {
        let step = step_for(view.image.width());
        let (width, height) = ((view.image.width() / step).max(1), (view.image.height() / step).max(1));
        let mut pixels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let (mut sum, mut confidence, mut count) = ([0_u32; 3], 255, 0);
                for v in y * step..((y + 1) * step).min(view.image.height()) {
                    for u in x * step..((x + 1) * step).min(view.image.width()) {
                        for (sum, channel) in sum.iter_mut().zip(view.image.at(u, v)) {
                            *sum += u32::from(channel);
                        }
                        confidence = view.confidence.at(u, v).min(confidence);
                        count += 1;
                    }
                }
                let [r, g, b] = sum.map(|s| ((s + count / 2) / count.max(1)) as u8);
                let middle = |at: usize, end: usize| (at * step + step / 2).min(end - 1);
                pixels.push(SmallPixel {
                    color: [r, g, b, confidence],
                    depth: view.depth.at(middle(x, view.depth.width()), middle(y, view.depth.height())),
                });
            }
        }
        Self {
            step,
            by_step: Division::by(step),
            width,
            height,
            pixels,
        }
    }

    /// The last column and row; places before them lie between pixels.
    pub fn last(&self) -> (f32, f32) {
        (self.width as f32 - 1.0, self.height as f32 - 1.0)
    }

    /// Depth at a pixel of the view itself, mm, 0 where unknown.
    #[inline(always)]
    pub fn depth_at(&self, x: usize, y: usize) -> f32 {
        let (x, y) = (self.by_step.of(x).min(self.width - 1), self.by_step.of(y).min(self.height - 1));
        self.pixels[y * self.width + x].depth
    }

    /// What is shown at column `u` and row `v`, linear between pixels; both at least 0 and before the last.
    #[inline(always)]
    pub fn between(&self, u: f32, v: f32) -> Sample {
        let ((x, fx), (y, fy)) = (split(u), split(v));
        let upper = &self.pixels[y * self.width + x..][..2];
        let lower = &self.pixels[(y + 1) * self.width + x..][..2];
        let (a, b, c, d) = (upper[0].color, upper[1].color, lower[0].color, lower[1].color);
        let mix = |from: [f32; 4], to: [f32; 4], share: f32| std::array::from_fn(|i| from[i] + (to[i] - from[i]) * share);
        let (top, bottom) = (
            mix(a.map(f32::from), b.map(f32::from), fx),
            mix(c.map(f32::from), d.map(f32::from), fx),
        );
        let color = mix(top, bottom, fy);
        let row = if fy < 0.5 { upper } else { lower };
        Sample {
            color,
            confidence: a[3].min(b[3]).min(c[3]).min(d[3]),
            depth: row[usize::from(fx >= 0.5)].depth,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::Example;

    #[test]
    fn between_pixels_it_is_linear_and_as_sure_as_the_least_sure() {
        let mut example = Example::new(&[(0.0, 0.0)], [1.0; 3], (0.0, 0.0));
        let view = &mut example.light_field.views[0];
        for y in 0..view.image.height() {
            for x in 0..view.image.width() {
                view.image.set(x, y, [(x / 4) as u8, (y / 2) as u8, 77]);
                view.confidence.set(x, y, (x % 200) as u8);
            }
        }
        let small = SmallView::of(view);
        assert_eq!(small.step, 1);
        let sample = small.between(84.0, 50.0);
        assert_eq!((sample.color[..3].to_vec(), sample.confidence), (vec![21.0, 25.0, 77.0], 84));
        // From column 83, which is one level darker.
        let sample = small.between(83.25, 51.5);
        assert!((sample.color[0] - 20.25).abs() < 1e-4 && (sample.color[1] - 25.5).abs() < 1e-4);
        assert_eq!(sample.confidence, 83);
    }
}
