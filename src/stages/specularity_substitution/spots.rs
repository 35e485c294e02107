//! The pixels of a block that may show the lamp, found by looking at small pixels first.

use crate::image::buffer::Rgb8;
use crate::image::color::luma;
use crate::image::reduction::sum_of;
use crate::image::wide;
use crate::light_field::mapping::is_unoccluded;
use crate::stages::specularity_substitution::grid::{SMALL_PER_BLOCK, SMALL_PER_CELL, Sums};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::speaker::{Block, Chosen, Speaker, brightened, halves, mixed};
use crate::stages::specularity_substitution::view_fit::part;

/// A sight is clean from this confidence on.
pub const CLEAN: u8 = 230;
/// So many clean sights of a pixel are enough.
const ENOUGH_VIEWS: u16 = 3;
/// A small pixel at most this much brighter than what was measured is taken for tissue, levels.
const PLAIN_LEVELS: f32 = 2.0;
/// The loudest views that are asked whether a small pixel shows the lamp at all.
const ASKED: usize = 4;
/// So many of them must have seen it clean …
const WITNESSES: u16 = 2;
/// … at a place where they fit at least so well.
const WITNESS_FIT: f32 = 0.5;

/// A pixel of a hole.
#[derive(Clone, Copy, Debug)]
pub struct Spot {
    /// Column.
    pub x: u16,
    /// Row.
    pub y: u16,
    /// Depth, mm.
    pub depth: f32,
    /// The live pixel.
    pub color: Rgb8,
    /// Its luma, levels.
    pub live: f32,
    /// How many views were heard that saw it clean.
    pub clean: u16,
    /// The sum of their luma, levels.
    pub luma: f32,
}

impl Spot {
    /// True once more views would change nothing: enough have spoken, or two say that there is nothing to replace.
    #[inline]
    pub fn is_settled(&self) -> bool {
        self.clean >= ENOUGH_VIEWS || self.clean >= 2 && self.live * f32::from(self.clean) <= self.luma
    }
}

/// A small pixel of which it is known without drawing its pixels that it does not show the lamp.
#[derive(Clone, Copy, Debug)]
pub struct Plain {
    /// Its first column in the picture.
    pub left: usize,
    /// Its first row.
    pub top: usize,
    /// The luma that was measured, levels.
    pub expected: f32,
    /// By how much the live picture is darker than that, levels.
    pub darker: f32,
}

/// What is known of a small pixel before its pixels are drawn.
#[derive(Clone, Copy, Debug)]
enum Look {
    /// None of it may be replaced.
    Nothing,
    /// It shows tissue.
    Plain(Plain),
    /// It may show the lamp.
    Doubtful,
}

/// The pixels and small pixels of a block; keeps its memory.
#[derive(Debug, Default)]
pub struct Spots {
    /// The pixels that may show the lamp, row by row.
    pub doubtful: Vec<Spot>,
    /// Small pixels that do not.
    pub plain: Vec<Plain>,
}

/// What a speaker knows in a row of small pixels: the fields of the three columns of blocks.
type RowFields = [[Sums; 3]; ASKED];

/// Sorts the small pixels of a block, and lists the pixels of the doubtful ones.
#[derive(Debug)]
pub struct FindSpots<'a> {
    /// The frame.
    pub scene: &'a Scene<'a>,
    /// 1 for every cell with a pixel that may be replaced.
    pub holes: &'a [u8],
    /// What is known of the views.
    pub chosen: &'a Chosen<'a>,
    /// Of the views, those that speak here.
    pub speakers: &'a [Speaker],
    /// The block.
    pub place: (usize, usize),
    /// What was found.
    pub found: &'a mut Spots,
}

impl wide::Kernel for FindSpots<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            scene,
            holes,
            chosen,
            speakers,
            place: (i, j),
            found,
        } = self;
        found.doubtful.clear();
        found.plain.clear();
        let grid = scene.grid;
        let block = Block::of(grid, i, j);
        for row in 0..SMALL_PER_BLOCK {
            let y = j * SMALL_PER_BLOCK + row;
            let cell_row = y / SMALL_PER_CELL;
            if cell_row >= grid.down {
                break;
            }
            // What the speakers know changes along a row only between three columns of blocks.
            let middle = (y * grid.step) as f32 + 0.5 * (grid.step as f32 - 1.0);
            let (_, fy) = block.share_of(0.0, middle);
            let mut fields: RowFields = [[[0.0; 8]; 3]; ASKED];
            for (fields, speaker) in fields.iter_mut().zip(speakers) {
                *fields = speaker.columns_at(fy);
            }
            let mut doubtful = [false; SMALL_PER_BLOCK];
            for (column, doubtful) in doubtful.iter_mut().enumerate() {
                let x = i * SMALL_PER_BLOCK + column;
                let cell_column = x / SMALL_PER_CELL;
                if cell_column >= grid.across || holes[cell_row * grid.across + cell_column] == 0 {
                    continue;
                }
                match look_at_small(scene, chosen, (speakers, &fields), block, (x * grid.step, y * grid.step)) {
                    Look::Nothing => {}
                    Look::Plain(plain) => found.plain.push(plain),
                    Look::Doubtful => *doubtful = true,
                }
            }
            for y in y * grid.step..((y + 1) * grid.step).min(grid.height) {
                for (left, _) in (block.left..)
                    .step_by(grid.step)
                    .zip(doubtful)
                    .filter(|(_, doubtful)| *doubtful)
                {
                    for x in left..(left + grid.step).min(grid.width) {
                        let depth = scene.depth_at(x, y);
                        if depth > 0.0 && scene.is_open(x, y) {
                            let color = scene.image.at(x, y);
                            found.doubtful.push(Spot {
                                x: x as u16,
                                y: y as u16,
                                depth,
                                color,
                                live: luma([f32::from(color[0]), f32::from(color[1]), f32::from(color[2])]),
                                clean: 0,
                                luma: 0.0,
                            });
                        }
                    }
                }
            }
        }
    }
}

/// What is known of a small pixel without drawing its pixels.
#[inline(always)]
fn look_at_small(
    scene: &Scene<'_>,
    chosen: &Chosen<'_>,
    asked: (&[Speaker], &RowFields),
    block: Block,
    (left, top): (usize, usize),
) -> Look {
    let (grid, step) = (scene.grid, scene.grid.step);
    let (right, bottom) = ((left + step).min(grid.width), (top + step).min(grid.height));
    if left >= right || top >= bottom {
        return Look::Nothing;
    }
    let (mut nearest, mut forbidden) = (u16::MAX, 0);
    for y in top..bottom {
        for &distance in &scene.distance.row(y)[left..right] {
            nearest = nearest.min(distance);
        }
        for &mark in &scene.forbidden.row(y)[left..right] {
            forbidden |= mark;
        }
    }
    if nearest > scene.reach {
        return Look::Nothing;
    }
    // What is marked is looked at closely, and so are the edges of what may be touched.
    if nearest == 0 || forbidden != 0 || left + step > grid.width || top + step > grid.height {
        return Look::Doubtful;
    }
    let sum = sum_of(scene.image, left..right, top..bottom);
    let live = luma([sum[0] as f32, sum[1] as f32, sum[2] as f32]) / (step * step) as f32;
    match expected_at(scene, chosen, asked, block, (left + step / 2, top + step / 2)) {
        Some(expected) if live <= expected + PLAIN_LEVELS => Look::Plain(Plain {
            left,
            top,
            expected,
            darker: expected - live,
        }),
        _ => Look::Doubtful,
    }
}

/// The luma that the loudest views expect at a small pixel; `None` where too few see it clean.
#[inline(always)]
fn expected_at(
    scene: &Scene<'_>,
    chosen: &Chosen<'_>,
    (speakers, fields): (&[Speaker], &RowFields),
    block: Block,
    (x, y): (usize, usize),
) -> Option<f32> {
    let depth = scene.depth_at(x, y);
    if depth <= 0.0 {
        return None;
    }
    // The middle of the small pixel; (x, y) is the pixel right below it.
    let middle = if scene.grid.step.is_multiple_of(2) { 0.5 } else { 0.0 };
    let (x, y) = (x as f32 - middle, y as f32 - middle);
    let (fx, fy) = block.share_of(x, y);
    let (first, t) = halves(fx);
    let (mut sum, mut clean) = (0.0, 0);
    for (speaker, columns) in speakers.iter().zip(fields) {
        let field = mixed(&columns[first], &columns[first + 1], t);
        if speaker.loudness_at(fx, fy) <= 0.0 || field[part::FIT] < WITNESS_FIT {
            continue;
        }
        let view = &chosen.small_views[speaker.view];
        let (u, v, depth) = (speaker.small_mapping).apply(x + field[part::SHIFT], y + field[part::SHIFT + 1], depth);
        let (last_x, last_y) = view.last();
        if !(depth > 0.0 && u >= 0.0 && v >= 0.0 && u < last_x && v < last_y) {
            continue;
        }
        let sample = view.between(u, v);
        if sample.confidence >= CLEAN && is_unoccluded(sample.depth, depth) {
            let [r, g, b, _] = sample.color;
            sum += luma(brightened([r, g, b], &field));
            clean += 1;
            if clean == WITNESSES {
                return Some(sum / f32::from(clean));
            }
        }
    }
    None
}
