//! What would be replaced only in part, though the picture goes on alike beyond the cut, is not replaced at all.
//!
//! The lamp's image ends where the picture gets darker, so a replacement ends there too and its rim cannot be seen. Where a strongly
//! changed patch ends in the midst of what looks alike, because beyond nothing was measured or no view fits, either half a specularity
//! would stay behind a hard edge, or, worse, the bright thing is pale tissue that has moved and the patch is what lay there before.

use rayon::prelude::*;

use crate::image::buffer::{Image, Rgb8};
use crate::image::color::luma;
use crate::image::components::Components;
use crate::stages::specularity_substitution::blend::Canvas;
use crate::stages::specularity_substitution::scene::Scene;

/// A pixel that gets darker by less is not part of a patch, levels of luma.
const CHANGED_LEVELS: f32 = 8.0;
/// One that gets darker by more would show as an edge, levels of luma.
const EDGE_LEVELS: f32 = 25.0;
/// The picture goes on alike where neighbours differ by less, levels of luma.
const ALIKE_LEVELS: f32 = 15.0;
/// A patch is cut where it ends in the midst of what looks alike for more than this times the square root of its much changed area, …
const CUT_SHARE: f32 = 1.0;
/// … and for more than this, px.
const LEAST_CUT_PX: f32 = 6.0;

/// Most stretches of so many pixels have nothing to replace.
const LOOKED_AT_ONCE: usize = 32;

const CHANGED: u8 = 1;
const MUCH_CHANGED: u8 = 2;

/// Finds such patches; keeps its memory.
#[derive(Debug)]
pub struct CutPatches {
    /// How the pixels change.
    change: Image<u8>,
    patches: Components,
    /// Per patch: much changed pixels, and sides of them at which the picture goes on alike beyond the cut.
    counts: Vec<[u32; 2]>,
}

impl Default for CutPatches {
    fn default() -> Self {
        Self {
            change: Image::filled(0, 0, 0),
            patches: Components::default(),
            counts: Vec::new(),
        }
    }
}

impl CutPatches {
    /// Set to 0 the `shares` (of 255, of the new colour; 0 where nothing was measured, below `least` where nothing changes) of patches
    /// that would be cut.
    pub fn leave(&mut self, scene: &Scene<'_>, canvas: &Canvas, shares: &mut Image<u8>, least: u8) {
        let (width, height) = shares.size();
        self.find_change(scene.image, canvas, shares, least);
        self.patches.label(&self.change);
        self.counts.clear();
        self.counts.resize(self.patches.regions().len(), [0, 0]);
        for run in self.patches.runs() {
            let y = run.y as usize;
            let [much, cut] = &mut self.counts[run.label as usize];
            for x in (run.begin as usize..run.end as usize).filter(|&x| self.change.at(x, y) == MUCH_CHANGED) {
                *much += 1;
                let level = |x: usize, y: usize| brightness(scene.image.at(x, y));
                let is_left = |u: usize, v: usize| shares.at(u, v) == 0 && scene.distance.at(u, v) == 0;
                let goes_on = |u: usize, v: usize| is_left(u, v) && (level(u, v) - level(x, y)).abs() < ALIKE_LEVELS;
                *cut += u32::from(x > 0 && goes_on(x - 1, y))
                    + u32::from(x + 1 < width && goes_on(x + 1, y))
                    + u32::from(y > 0 && goes_on(x, y - 1))
                    + u32::from(y + 1 < height && goes_on(x, y + 1));
            }
        }
        let counts = &self.counts;
        self.patches.paint(shares, 0, |label, _| {
            let [much, cut] = counts[label].map(|count| count as f32);
            cut > LEAST_CUT_PX && cut > CUT_SHARE * much.sqrt()
        });
    }

    fn find_change(&mut self, image: &Image<Rgb8>, canvas: &Canvas, shares: &Image<u8>, least: u8) {
        let (width, height) = shares.size();
        if self.change.size() != (width, height) {
            self.change.resize(width, height, 0);
        }
        let rows = self.change.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
        rows.with_min_len(16).for_each(|(y, change)| {
            change.fill(0);
            let (old, new) = (image.row(y), canvas.color.row(y));
            for (first, shares) in (0..).step_by(LOOKED_AT_ONCE).zip(shares.row(y).chunks(LOOKED_AT_ONCE)) {
                if shares.iter().all(|&share| share < least) {
                    continue;
                }
                for (x, &share) in (first..).zip(shares).filter(|(_, share)| **share >= least) {
                    let darker = f32::from(share) * (1.0 / 255.0) * (brightness(old[x]) - brightness(new[x]));
                    change[x] = if darker > EDGE_LEVELS {
                        MUCH_CHANGED
                    } else {
                        CHANGED * u8::from(darker > CHANGED_LEVELS)
                    };
                }
            }
        });
    }
}

#[inline(always)]
fn brightness(color: Rgb8) -> f32 {
    luma(color.map(f32::from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{Example, HOLE, HOLE_RADIUS, SIZE, in_hole};

    const LEAST: u8 = 2;

    /// Shares of the example's hole after a look at it, where something was measured left of column `end`; `color` is what was measured.
    fn left(end: usize, color: Rgb8) -> Image<u8> {
        let example = Example::new(&[], [1.0; 3], (0.0, 0.0));
        let mut canvas = Canvas::default();
        canvas.color.resize(SIZE.0, SIZE.1, color);
        let mut shares = Image::filled(SIZE.0, SIZE.1, 0);
        for y in 0..SIZE.1 {
            for x in 0..end {
                shares.set(x, y, if in_hole(x, y) { 255 } else { LEAST - 1 });
            }
        }
        let mut patches = CutPatches::default();
        // What the last frame left in its memory does not matter.
        patches.leave(&example.scene(), &canvas, &mut shares.clone(), LEAST);
        patches.leave(&example.scene(), &canvas, &mut shares, LEAST);
        shares
    }

    fn replaced(shares: &Image<u8>) -> usize {
        shares.pixels().iter().filter(|&&share| share >= LEAST).count()
    }

    #[test]
    fn a_whole_specularity_goes_and_half_of_one_stays() {
        let tissue = [140, 90, 80];
        let area = (0..SIZE.0 * SIZE.1).filter(|i| in_hole(i % SIZE.0, i / SIZE.0)).count();
        assert_eq!(replaced(&left(SIZE.0, tissue)), area);
        assert_eq!(replaced(&left(HOLE.0, tissue)), 0);
        // All but a crescent whose chord is shorter than the root of the area.
        let end = HOLE.0 + HOLE_RADIUS as usize - 1;
        assert!(replaced(&left(end, tissue)) > area * 9 / 10);
    }

    #[test]
    fn a_change_that_shows_no_edge_may_end_anywhere() {
        let shares = left(HOLE.0, [235, 235, 235]);
        assert!(replaced(&shares) > 100);
    }
}
