//! A view small enough that looking at a few pixels of every block does not alias.

use crate::image::reduction::mean_of;
use crate::image::wide;
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

/// Pixels along a tile.
const TILE: usize = 8;
/// Pixels from a row of a tile to the next: tiles overlap by a pixel, so that what lies between pixels of one needs no other.
const PITCH: usize = TILE + 1;

/// A view at about the resolution of the small live picture.
///
/// It is held in tiles: a block of the live picture asks many views for a small square each, and a square of a picture held row by row
/// lies on as many pages of memory as it has rows, more than the processor keeps track of.
#[derive(Clone, Debug)]
pub struct SmallView {
    /// Pixels of the view along a pixel of this.
    pub step: usize,
    by_step: Division,
    width: usize,
    height: usize,
    /// Tiles in a row.
    across: usize,
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
        let across = width.div_ceil(TILE);
        let places = (0..height.div_ceil(TILE)).flat_map(|row| (0..across).map(move |column| (column * TILE, row * TILE)));
        let places = places.flat_map(|(left, top)| (0..PITCH * PITCH).map(move |i| (left + i % PITCH, top + i / PITCH)));
        Self {
            step,
            by_step: Division::by(step),
            width,
            height,
            across,
            pixels: places
                .map(|(x, y)| small_pixel(view, step, x.min(width - 1), y.min(height - 1)))
                .collect(),
        }
    }

    /// The last column and row; places before them lie between pixels.
    pub fn last(&self) -> (f32, f32) {
        (self.width as f32 - 1.0, self.height as f32 - 1.0)
    }

    /// Depth at a pixel of the view itself, mm, 0 where unknown.
    #[inline(always)]
    pub fn depth_at(&self, x: usize, y: usize) -> f32 {
        self.pixels[self.index_of(x, y)].depth
    }

    /// Ask for what [`Self::depth_at`] will read.
    #[inline(always)]
    pub fn fetch_depth(&self, x: usize, y: usize) {
        wide::fetch(&self.pixels, self.index_of(x, y));
    }

    /// Where the pixel stands in which a pixel of the view lies.
    #[inline(always)]
    fn index_of(&self, x: usize, y: usize) -> usize {
        self.index(
            self.by_step.of(x).min(self.width - 1),
            self.by_step.of(y).min(self.height - 1),
        )
    }

    /// Where a pixel stands in the tile that it and those right of it and below it share.
    #[inline(always)]
    fn index(&self, x: usize, y: usize) -> usize {
        (y / TILE * self.across + x / TILE) * (PITCH * PITCH) + y % TILE * PITCH + x % TILE
    }

    /// Ask for what [`Self::between`] will read there.
    #[inline(always)]
    pub fn fetch(&self, u: f32, v: f32) {
        let index = self.index(u as i32 as usize, v as i32 as usize);
        wide::fetch(&self.pixels, index);
        wide::fetch(&self.pixels, index + PITCH + 1);
    }

    /// What is shown at column `u` and row `v`, linear between pixels; both at least 0 and before the last.
    #[inline(always)]
    pub fn between(&self, u: f32, v: f32) -> Sample {
        let ((x, fx), (y, fy)) = (split(u), split(v));
        let index = self.index(x, y);
        let square = &self.pixels[index..index + PITCH + 2];
        let (upper, lower) = (&square[..2], &square[PITCH..]);
        let (a, b, c, d) = (upper[0].color, upper[1].color, lower[0].color, lower[1].color);
        let mut color = [0.0; 4];
        for (i, value) in color.iter_mut().enumerate() {
            let (a, b, c, d) = (f32::from(a[i]), f32::from(b[i]), f32::from(c[i]), f32::from(d[i]));
            let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
            *value = top + (bottom - top) * fy;
        }
        let row = if fy < 0.5 { upper } else { lower };
        Sample {
            color,
            confidence: a[3].min(b[3]).min(c[3]).min(d[3]),
            depth: row[usize::from(fx >= 0.5)].depth,
        }
    }
}

/// The mean of a square of a view's pixels.
fn small_pixel(view: &View, step: usize, x: usize, y: usize) -> SmallPixel {
    let columns = x * step..((x + 1) * step).min(view.image.width());
    let rows = y * step..((y + 1) * step).min(view.image.height());
    let confidences = rows.clone().flat_map(|v| &view.confidence.row(v)[columns.clone()]);
    let confidence = confidences.fold(255, |least, &confidence| confidence.min(least));
    let [r, g, b] = mean_of(&view.image, columns, rows);
    let middle = |at: usize, end: usize| (at * step + step / 2).min(end - 1);
    SmallPixel {
        color: [r, g, b, confidence],
        depth: view.depth.at(middle(x, view.depth.width()), middle(y, view.depth.height())),
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
