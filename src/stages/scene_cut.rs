//! Notices when the picture is suddenly another one: a scene cut, the scope wiped, the lamp switched.
//!
//! The picture is reduced to a coarse grid of gray means. A cut changes most of the grid much more than the frames before
//! did, and it changes the histogram too, which neither a fast pan over the same tissue nor a passing instrument does.

use crate::image::buffer::{Image, Rgb8};

const COLUMNS: usize = 24;
const ROWS: usize = 16;
const CELLS: usize = COLUMNS * ROWS;
const BINS: usize = 16;
/// Every how many pixels one is looked at, both ways.
const STEP: usize = 3;
/// Mean change of the grid: levels, and times what it lately was. Tuned on a laparoscopic clip, whose pans reach 5 levels.
const MIN_CHANGE_LEVELS: f32 = 14.0;
const MIN_CHANGE_RATIO: f32 = 4.0;
/// Share of the picture that changed its histogram bin for good.
const MIN_HISTOGRAM_CHANGE: f32 = 0.18;
/// A change this large needs no second witness.
const CERTAIN_CHANGE_LEVELS: f32 = 40.0;
/// Weight of the newest change in the running mean of changes.
const LEARNING: f32 = 0.15;

/// What the picture looked like, coarsely.
#[derive(Clone, Debug)]
struct Signature {
    cells: [f32; CELLS],
    histogram: [f32; BINS],
}

impl Signature {
    fn of(image: &Image<Rgb8>) -> Self {
        let (width, height) = image.size();
        let (mut sums, mut counts) = ([0_u32; CELLS], [0_u32; CELLS]);
        let mut histogram = [0_u32; BINS];
        for y in (0..height).step_by(STEP) {
            let row_of_cells = y * ROWS / height * COLUMNS;
            let row = image.row(y);
            for (column, cell) in (row_of_cells..row_of_cells + COLUMNS).enumerate() {
                // The samples whose x · COLUMNS / width is `column`.
                let first = |column: usize| (column * width).div_ceil(COLUMNS).next_multiple_of(STEP);
                let (mut x, end) = (first(column), first(column + 1).min(width));
                while x < end {
                    let [r, g, b] = row[x].map(u32::from);
                    let gray = (r + 2 * g + b) / 4;
                    sums[cell] += gray;
                    counts[cell] += 1;
                    histogram[gray as usize * BINS / 256] += 1;
                    x += STEP;
                }
            }
        }
        let total = counts.iter().sum::<u32>().max(1) as f32;
        Self {
            cells: std::array::from_fn(|i| sums[i] as f32 / counts[i].max(1) as f32),
            histogram: histogram.map(|count| count as f32 / total),
        }
    }
}

/// Watches for cuts.
#[derive(Clone, Debug, Default)]
pub struct SceneCut {
    previous: Option<Signature>,
    usual_change: f32,
}

impl SceneCut {
    /// Forget the previous frame.
    pub fn clear(&mut self) {
        self.previous = None;
        self.usual_change = 0.0;
    }

    /// True if `image` does not continue the frame before it.
    pub fn is_cut(&mut self, image: &Image<Rgb8>) -> bool {
        let now = Signature::of(image);
        let Some(previous) = &self.previous else {
            self.previous = Some(now);
            return false;
        };
        let change = now.cells.iter().zip(&previous.cells).map(|(a, b)| (a - b).abs()).sum::<f32>() / CELLS as f32;
        let moved = now
            .histogram
            .iter()
            .zip(&previous.histogram)
            .map(|(a, b)| (a - b).abs())
            .sum::<f32>()
            / 2.0;
        let unusual = change > MIN_CHANGE_LEVELS && change > MIN_CHANGE_RATIO * self.usual_change;
        let cut = unusual && (moved > MIN_HISTOGRAM_CHANGE || change > CERTAIN_CHANGE_LEVELS);
        self.usual_change = if cut {
            0.0
        } else {
            self.usual_change + LEARNING * (change - self.usual_change)
        };
        self.previous = Some(now);
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(seed: f32, shift: f32) -> Image<Rgb8> {
        let mut image = Image::filled(320, 180, [0; 3]);
        for y in 0..180 {
            for x in 0..320 {
                let (u, v) = ((x as f32 + shift) * 0.03 + seed, y as f32 * 0.04 * seed);
                let value = 120.0 + 60.0 * u.sin() * v.cos() + 20.0 * (3.0 * u).cos();
                image.set(x, y, [value as u8, (value * 0.7) as u8, (value * 0.6) as u8]);
            }
        }
        image
    }

    #[test]
    fn another_scene_is_a_cut_and_a_pan_is_none() {
        let mut watch = SceneCut::default();
        for i in 0..20 {
            assert!(!watch.is_cut(&scene(1.0, i as f32 * 6.0)), "pan, frame {i}");
        }
        let mut dark = scene(2.7, 0.0);
        dark.pixels_mut().iter_mut().for_each(|p| *p = p.map(|v| v / 3));
        assert!(watch.is_cut(&dark));
        assert!(!watch.is_cut(&dark));
    }
}
