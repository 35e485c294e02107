//! The views that speak in a block of the picture, and what is known of them there.

use crate::light_field::mapping::Mapping;
use crate::stages::specularity_substitution::camera_blending::{CameraBlending, Corner};
use crate::stages::specularity_substitution::grid::{Grid, Sums};
use crate::stages::specularity_substitution::live::DARK_LEVELS;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::Vantage;
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::view_fit::{ViewFit, part};

/// At most so many views speak in a block, the loudest.
const MAX_VOICES: usize = 16;

/// What drawing needs besides the scene.
#[derive(Clone, Copy, Debug)]
pub struct Chosen<'a> {
    /// Who speaks at every corner.
    pub corners: &'a [Corner],
    /// One fit for every view.
    pub fits: &'a [ViewFit],
    /// Every view, small.
    pub small_views: &'a [SmallView],
    /// Per view, where it stands.
    pub vantages: &'a [Option<Vantage>],
}

/// A view that speaks in a block.
#[derive(Clone, Copy, Debug)]
pub struct Speaker {
    /// Index of the view.
    pub view: usize,
    /// Loudness at the four corners of the block.
    weights: [f32; 4],
    /// Of the picture to the view.
    pub mapping: Mapping,
    /// Of the picture to the small view.
    pub small_mapping: Mapping,
    /// Its field in the block and the eight around.
    field: [[Sums; 3]; 3],
}

impl Speaker {
    fn loudness(&self) -> f32 {
        self.weights.iter().sum()
    }

    /// Loudness at a place in the block, 0…1 along each axis.
    #[inline(always)]
    pub fn loudness_at(&self, fx: f32, fy: f32) -> f32 {
        let [a, b, c, d] = self.weights;
        (a + (b - a) * fx) * (1.0 - fy) + (c + (d - c) * fx) * fy
    }

    /// The fields of the three columns of blocks at a height in the block, 0…1.
    #[inline(always)]
    pub fn columns_at(&self, fy: f32) -> [Sums; 3] {
        let (row, t) = halves(fy);
        let (upper, lower) = (&self.field[row], &self.field[row + 1]);
        [
            mixed(&upper[0], &lower[0], t),
            mixed(&upper[1], &lower[1], t),
            mixed(&upper[2], &lower[2], t),
        ]
    }
}

/// The first of the two blocks between whose centres a place in the middle one lies, and how near it is to the second.
#[inline(always)]
pub fn halves(place: f32) -> (usize, f32) {
    if place < 0.5 { (0, place + 0.5) } else { (1, place - 0.5) }
}

#[inline(always)]
/// `a` and `b` mixed, `t` of the way to `b`.
pub fn mixed(a: &Sums, b: &Sums, t: f32) -> Sums {
    let mut sums = [0.0; 8];
    for i in 0..8 {
        sums[i] = a[i] + t * (b[i] - a[i]);
    }
    sums
}

/// The views that speak over block (i, j), the loudest first.
pub fn find_speakers(scene: &Scene<'_>, chosen: &Chosen<'_>, (i, j): (usize, usize), speakers: &mut Vec<Speaker>) {
    speakers.clear();
    let across = CameraBlending::corners_across(scene.grid);
    for (index, (i, j)) in [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)].into_iter().enumerate() {
        for voice in chosen.corners[j * across + i].voices() {
            let view = usize::from(voice.view);
            if let Some(speaker) = speakers.iter_mut().find(|s| s.view == view) {
                speaker.weights[index] = voice.weight;
            } else if let Some(Vantage { mapping, small, .. }) = chosen.vantages[view] {
                let mut weights = [0.0; 4];
                weights[index] = voice.weight;
                speakers.push(Speaker {
                    view,
                    weights,
                    mapping,
                    small_mapping: small,
                    field: [[[0.0; 8]; 3]; 3],
                });
            }
        }
    }
    speakers.sort_unstable_by(|a, b| b.loudness().total_cmp(&a.loudness()).then(a.view.cmp(&b.view)));
    speakers.truncate(MAX_VOICES);
    let around = scene.grid.blocks_around(i, j);
    for speaker in speakers {
        let field = &chosen.fits[speaker.view].field;
        speaker.field = around.map(|row| row.map(|block| field[block]));
    }
}

/// A view's colour under the live picture's light.
#[inline(always)]
pub fn brightened(color: [f32; 3], field: &Sums) -> [f32; 3] {
    let brightened = |c: usize| (color[c] + DARK_LEVELS) * field[part::GAIN + c] - DARK_LEVELS;
    [brightened(0), brightened(1), brightened(2)]
}

/// Where a block lies in the picture, px.
#[derive(Clone, Copy, Debug)]
pub struct Block {
    /// Its first column.
    pub left: usize,
    /// Of half a pixel before the first.
    begin: [f32; 2],
    /// One over the side.
    share: f32,
}

impl Block {
    /// Block (i, j).
    pub fn of(grid: Grid, i: usize, j: usize) -> Self {
        let side = grid.block();
        Self {
            left: i * side,
            begin: [i, j].map(|at| (at * side) as f32 - 0.5),
            share: 1.0 / side as f32,
        }
    }

    /// Where a pixel lies within it, 0…1 along each axis.
    #[inline(always)]
    pub fn share_of(self, x: f32, y: f32) -> (f32, f32) {
        let inside = |at: f32, begin: f32| ((at - begin) * self.share).clamp(0.0, 1.0);
        (inside(x, self.begin[0]), inside(y, self.begin[1]))
    }
}
