//! One block of the picture: its pixels that may show the lamp, the views that speak there drawn over them, and blended.

use crate::image::buffer::Rgb8;
use crate::image::color::luma;
use crate::image::wide;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;
use crate::stages::specularity_substitution::camera_blending::{CameraBlending, Corner};
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Grid, SMALL_PER_BLOCK, SMALL_PER_CELL, Sums};
use crate::stages::specularity_substitution::live::DARK_LEVELS;
use crate::stages::specularity_substitution::lookup::bicubic;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::Vantage;
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::view_fit::{ViewFit, part};

/// At most so many views speak in a block, the loudest.
const MAX_VOICES: usize = 16;
/// So many clean sights of a pixel are enough.
const ENOUGH_VIEWS: u16 = 5;
/// A sight is clean from this confidence on.
const CLEAN: u8 = 230;
/// A view that is this much brighter than the blend counts for half, levels: the lamp only adds light.
const BRIGHTER_HALF_LEVELS: f32 = 0.8;
/// Rounds of that.
const ROUNDS: usize = 5;
/// The loudest views that are asked whether a small pixel shows the lamp at all.
const ASKED: usize = 4;
/// So many of them must have seen it clean …
const WITNESSES: u16 = 2;
/// … at a place where they fit at least so well.
const WITNESS_FIT: f32 = 0.5;
/// Spots blended at a time.
const LANES: usize = 8;

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
    /// How many views were heard that saw it clean, and the sum of their luma.
    clean: u16,
    luma: f32,
}

impl Spot {
    /// True once more views would change nothing: enough have spoken, or two say that there is nothing to replace.
    #[inline]
    fn is_settled(&self) -> bool {
        self.clean >= ENOUGH_VIEWS || self.clean >= 2 && self.live <= self.luma / f32::from(self.clean)
    }
}

/// What the views say of a spot together.
#[derive(Clone, Copy, Debug)]
pub struct Blended {
    /// Levels.
    pub color: [f32; 3],
    /// 0…1.
    pub confidence: f32,
    /// What difference the views leave around the hole, levels.
    pub residual: f32,
    /// Index of the loudest view.
    pub view: usize,
}

/// Pixels of which it is known without drawing them that they do not show the lamp.
#[derive(Clone, Copy, Debug)]
pub struct Plain {
    /// The cell, row by row over the picture.
    pub cell: usize,
    /// By how much the live picture is darker than what was measured, levels.
    pub darker: f32,
    /// How many.
    pub count: f32,
}

/// A view that speaks in a block.
#[derive(Clone, Copy, Debug)]
struct Speaker {
    view: usize,
    /// Loudness at the four corners of the block.
    weights: [f32; 4],
    mapping: Mapping,
    small_mapping: Mapping,
    /// Its field in the block and the eight around.
    field: [[Sums; 3]; 3],
}

impl Speaker {
    fn loudness(&self) -> f32 {
        self.weights.iter().sum()
    }

    /// Loudness at a place in the block, 0…1 along each axis.
    #[inline(always)]
    fn loudness_at(&self, fx: f32, fy: f32) -> f32 {
        let [a, b, c, d] = self.weights;
        (a + (b - a) * fx) * (1.0 - fy) + (c + (d - c) * fx) * fy
    }

    /// The fields of the three columns of blocks at a height in the block, 0…1.
    #[inline(always)]
    fn columns_at(&self, fy: f32) -> [Sums; 3] {
        let (row, t) = halves(fy);
        std::array::from_fn(|i| mixed(&self.field[row][i], &self.field[row + 1][i], t))
    }
}

/// The first of the two blocks between whose centres a place in the middle one lies, and how near it is to the second.
#[inline(always)]
fn halves(place: f32) -> (usize, f32) {
    if place < 0.5 { (0, place + 0.5) } else { (1, place - 0.5) }
}

#[inline(always)]
fn mixed(a: &Sums, b: &Sums, t: f32) -> Sums {
    std::array::from_fn(|i| a[i] + t * (b[i] - a[i]))
}

/// What every speaker shows at every spot, plane by plane, speaker by speaker.
#[derive(Debug, Default)]
struct Drawn {
    /// Spots, rounded up to whole lanes.
    pitch: usize,
    color: [Vec<f32>; 3],
    luma: Vec<f32>,
    /// 0 where nothing was drawn.
    weight: Vec<f32>,
    confidence: Vec<f32>,
    residual: Vec<f32>,
}

impl Drawn {
    fn clear(&mut self, spots: usize, speakers: usize) {
        self.pitch = spots.next_multiple_of(LANES);
        let [r, g, b] = &mut self.color;
        for plane in [
            r,
            g,
            b,
            &mut self.luma,
            &mut self.weight,
            &mut self.confidence,
            &mut self.residual,
        ] {
            plane.clear();
            plane.resize(self.pitch * speakers, 0.0);
        }
    }
}

/// Working memory of one block at a time.
#[derive(Debug, Default)]
pub struct Bench {
    /// The pixels that may show the lamp, row by row.
    spots: Vec<Spot>,
    /// Small pixels that do not.
    pub plain: Vec<Plain>,
    speakers: Vec<Speaker>,
    drawn: Drawn,
    blended: Vec<Option<Blended>>,
}

impl Bench {
    /// Spots that somebody saw, and what the views say of them.
    pub fn blended(&self) -> impl Iterator<Item = (Spot, Blended)> {
        let pairs = self.spots.iter().zip(&self.blended);
        pairs.filter_map(|(spot, blended)| Some((*spot, (*blended)?)))
    }

    /// Blend the views over block (i, j).
    pub fn blend(&mut self, scene: &Scene<'_>, holes: &[u8], chosen: &Chosen<'_>, i: usize, j: usize) {
        self.find_speakers(scene, chosen, i, j);
        self.find_spots(scene, holes, chosen, i, j);
        self.blended.clear();
        if !self.spots.is_empty() {
            self.drawn.clear(self.spots.len(), self.speakers.len());
            for index in 0..self.speakers.len() {
                wide::run(Draw {
                    view: &scene.light_field.views[self.speakers[index].view],
                    block: Block::of(scene.grid, i, j),
                    index,
                    bench: self,
                });
            }
            wide::run(Blend(self));
        }
    }

    fn find_speakers(&mut self, scene: &Scene<'_>, chosen: &Chosen<'_>, i: usize, j: usize) {
        self.speakers.clear();
        let across = CameraBlending::corners_across(scene.grid);
        for (index, (i, j)) in [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)].into_iter().enumerate() {
            for voice in chosen.corners[j * across + i].voices() {
                let view = usize::from(voice.view);
                if let Some(speaker) = self.speakers.iter_mut().find(|s| s.view == view) {
                    speaker.weights[index] = voice.weight;
                } else if let Some(Vantage { mapping, .. }) = chosen.vantages[view] {
                    let mut weights = [0.0; 4];
                    weights[index] = voice.weight;
                    self.speakers.push(Speaker {
                        view,
                        weights,
                        mapping,
                        small_mapping: mapping.onto_coarser(chosen.small_views[view].step as f32),
                        field: [[[0.0; 8]; 3]; 3],
                    });
                }
            }
        }
        self.speakers
            .sort_unstable_by(|a, b| b.loudness().total_cmp(&a.loudness()).then(a.view.cmp(&b.view)));
        self.speakers.truncate(MAX_VOICES);
        let (across, down) = scene.grid.blocks();
        let near = |place: usize, step: usize, count: usize| (place + step).saturating_sub(1).min(count - 1);
        for speaker in &mut self.speakers {
            let field = &chosen.fits[speaker.view].field;
            speaker.field =
                std::array::from_fn(|v| std::array::from_fn(|u| field[near(j, v, down) * across + near(i, u, across)]));
        }
    }

    fn find_spots(&mut self, scene: &Scene<'_>, holes: &[u8], chosen: &Chosen<'_>, i: usize, j: usize) {
        self.spots.clear();
        self.plain.clear();
        let grid = scene.grid;
        let mut doubtful = [[false; SMALL_PER_BLOCK]; SMALL_PER_BLOCK];
        for (row, doubtful) in doubtful.iter_mut().enumerate() {
            for (column, doubtful) in doubtful.iter_mut().enumerate() {
                let (x, y) = (i * SMALL_PER_BLOCK + column, j * SMALL_PER_BLOCK + row);
                let (cell_column, cell_row) = (x / SMALL_PER_CELL, y / SMALL_PER_CELL);
                if cell_column < grid.across && cell_row < grid.down && holes[cell_row * grid.across + cell_column] != 0 {
                    let plain = self.plain_at(scene, chosen, (i, j), x, y);
                    *doubtful = plain.is_none();
                    self.plain.extend(plain.filter(|plain| plain.count > 0.0));
                }
            }
        }
        let block = Block::of(grid, i, j);
        for y in block.top..(block.top + block.side).min(grid.height) {
            let doubtful = &doubtful[(y - block.top) / grid.step];
            for x in block.left..(block.left + block.side).min(grid.width) {
                if !doubtful[(x - block.left) / grid.step] || !scene.is_open(x, y) {
                    continue;
                }
                let depth = scene.depth_at(x, y);
                if depth > 0.0 {
                    let color = scene.image.at(x, y);
                    self.spots.push(Spot {
                        x: x as u16,
                        y: y as u16,
                        depth,
                        color,
                        live: luma(color.map(f32::from)),
                        clean: 0,
                        luma: 0.0,
                    });
                }
            }
        }
    }

    /// What is known of a small pixel (column, row) without drawing its pixels; `None` where it may show the lamp.
    fn plain_at(
        &self,
        scene: &Scene<'_>,
        chosen: &Chosen<'_>,
        (i, j): (usize, usize),
        column: usize,
        row: usize,
    ) -> Option<Plain> {
        let (grid, step) = (scene.grid, scene.grid.step);
        let (left, top) = (column * step, row * step);
        let (mut sum, mut open, mut marked) = ([0_u32; 3], 0_u32, false);
        for y in top..(top + step).min(grid.height) {
            for x in left..(left + step).min(grid.width) {
                open += u32::from(scene.is_open(x, y));
                marked |= scene.distance.at(x, y) == 0;
                for (sum, channel) in sum.iter_mut().zip(scene.image.at(x, y)) {
                    *sum += u32::from(channel);
                }
            }
        }
        let cell = row / SMALL_PER_CELL * grid.across + column / SMALL_PER_CELL;
        let plain = |darker: f32| Plain {
            cell,
            darker,
            count: open as f32,
        };
        if open == 0 {
            return Some(plain(0.0));
        }
        if marked || left + step > grid.width || top + step > grid.height {
            return None;
        }
        let live = luma(sum.map(|s| s as f32)) / (step * step) as f32;
        let expected = self.expected_at(scene, chosen, Block::of(grid, i, j), (left + step / 2, top + step / 2))?;
        (live <= expected).then(|| plain(expected - live))
    }

    /// The luma that the loudest views expect at a small pixel; `None` where too few see it clean.
    fn expected_at(&self, scene: &Scene<'_>, chosen: &Chosen<'_>, block: Block, (x, y): (usize, usize)) -> Option<f32> {
        let depth = scene.depth_at(x, y);
        if depth <= 0.0 {
            return None;
        }
        // The middle of the small pixel; (x, y) is the pixel right below it.
        let middle = if scene.grid.step % 2 == 0 { 0.5 } else { 0.0 };
        let (x, y) = (x as f32 - middle, y as f32 - middle);
        let (fx, fy) = block.share_of(x, y);
        let (mut sum, mut clean) = (0.0, 0);
        for speaker in self.speakers.iter().take(ASKED) {
            let (first, t) = halves(fx);
            let columns = speaker.columns_at(fy);
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
                sum += luma(brightened(sample.color, &field));
                clean += 1;
                if clean == WITNESSES {
                    return Some(sum / f32::from(clean));
                }
            }
        }
        None
    }
}

/// A view's colour under the live picture's light.
#[inline(always)]
fn brightened(color: [f32; 3], field: &Sums) -> [f32; 3] {
    std::array::from_fn(|c| (color[c] + DARK_LEVELS) * field[part::GAIN + c] - DARK_LEVELS)
}

/// Where a block lies in the picture, px.
#[derive(Clone, Copy, Debug)]
struct Block {
    left: usize,
    top: usize,
    side: usize,
}

impl Block {
    fn of(grid: Grid, i: usize, j: usize) -> Self {
        let side = grid.step * SMALL_PER_CELL * CELLS_PER_BLOCK;
        Self {
            left: i * side,
            top: j * side,
            side,
        }
    }

    /// Where a pixel lies within it, 0…1 along each axis.
    #[inline(always)]
    fn share_of(self, x: f32, y: f32) -> (f32, f32) {
        let share = 1.0 / self.side as f32;
        let inside = |at: f32, begin: usize| ((at + 0.5 - begin as f32) * share).clamp(0.0, 1.0);
        (inside(x, self.left), inside(y, self.top))
    }
}

/// One speaker drawn over the spots that are not settled.
struct Draw<'a> {
    view: &'a View,
    block: Block,
    index: usize,
    bench: &'a mut Bench,
}

impl wide::Kernel for Draw<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            view,
            block,
            index,
            bench,
        } = self;
        let speaker = &bench.speakers[index];
        let (width, height) = view.image.size();
        let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 2.0);
        let (confidences, depths) = (view.confidence.pixels(), view.depth.pixels());
        let begin = index * bench.drawn.pitch;
        let (mut row, mut columns) = (u16::MAX, [[0.0; 8]; 3]);
        for (k, spot) in bench.spots.iter_mut().enumerate() {
            if spot.is_settled() {
                continue;
            }
            let (x, y) = (f32::from(spot.x), f32::from(spot.y));
            let (fx, fy) = block.share_of(x, y);
            if spot.y != row {
                (row, columns) = (spot.y, speaker.columns_at(fy));
            }
            let (first, t) = halves(fx);
            let field = mixed(&columns[first], &columns[first + 1], t);
            let loud = speaker.loudness_at(fx, fy) * field[part::FIT];
            let (u, v, depth) = (speaker.mapping).apply(x + field[part::SHIFT], y + field[part::SHIFT + 1], spot.depth);
            if !(loud > 0.0 && depth > 0.0 && u >= 1.0 && v >= 1.0 && u < last_x && v < last_y) {
                continue;
            }
            let (x0, y0) = (u as usize, v as usize);
            let corner = y0 * width + x0;
            // Where any of the four is dazzled the mixture is.
            let (upper, lower) = (
                &confidences[corner..corner + 2],
                &confidences[corner + width..corner + width + 2],
            );
            let least = upper[0].min(upper[1]).min(lower[0]).min(lower[1]);
            if least == 0 || !is_unoccluded(depths[corner], depth) {
                continue;
            }
            let color = brightened(bicubic(&view.image, x0, y0, u - x0 as f32, v - y0 as f32), &field);
            let brightness = luma(color);
            if least >= CLEAN {
                spot.clean += 1;
                spot.luma += brightness;
            }
            let confidence = f32::from(least) / 255.0;
            let drawn = &mut bench.drawn;
            for (plane, channel) in drawn.color.iter_mut().zip(color) {
                plane[begin + k] = channel;
            }
            drawn.luma[begin + k] = brightness;
            // Clean sights outshout hazy ones by far more than the confidences alone.
            drawn.weight[begin + k] = loud * confidence * confidence;
            drawn.confidence[begin + k] = confidence;
            drawn.residual[begin + k] = field[part::RESIDUAL];
        }
    }
}

/// Every spot's colour from its speakers, the darker heard rather than the brighter.
struct Blend<'a>(&'a mut Bench);

impl wide::Kernel for Blend<'_> {
    #[inline(always)]
    fn run(self) {
        let Self(bench) = self;
        let (drawn, count) = (&bench.drawn, bench.spots.len());
        for begin in (0..count).step_by(LANES) {
            let lanes = |plane: &[f32], speaker: usize| -> [f32; LANES] {
                let at = speaker * drawn.pitch + begin;
                std::array::from_fn(|lane| plane[at..at + LANES][lane])
            };
            let weights = |speaker: usize, reference: &[f32; LANES]| -> [f32; LANES] {
                let (weight, luma) = (lanes(&drawn.weight, speaker), lanes(&drawn.luma, speaker));
                std::array::from_fn(|lane| {
                    let brighter = (luma[lane] - reference[lane]).max(0.0) * (1.0 / BRIGHTER_HALF_LEVELS);
                    weight[lane] / (1.0 + brighter * brighter)
                })
            };
            let mut reference = [f32::INFINITY; LANES];
            for _ in 0..ROUNDS {
                let (mut total, mut sum) = ([1e-20_f32; LANES], [0.0_f32; LANES]);
                for speaker in 0..bench.speakers.len() {
                    let (weight, luma) = (weights(speaker, &reference), lanes(&drawn.luma, speaker));
                    for lane in 0..LANES {
                        total[lane] += weight[lane];
                        sum[lane] += weight[lane] * luma[lane];
                    }
                }
                for lane in 0..LANES {
                    reference[lane] = sum[lane] / total[lane];
                }
            }
            // Red, green, blue, confidence, residual.
            let mut sums = [[0.0_f32; LANES]; 5];
            let (mut total, mut most, mut loudest) = ([0.0_f32; LANES], [0.0_f32; LANES], [0_u32; LANES]);
            for speaker in 0..bench.speakers.len() {
                let weight = weights(speaker, &reference);
                let [r, g, b] = &drawn.color;
                for (sum, plane) in sums.iter_mut().zip([r, g, b, &drawn.confidence, &drawn.residual]) {
                    let values = lanes(plane, speaker);
                    for lane in 0..LANES {
                        sum[lane] += weight[lane] * values[lane];
                    }
                }
                for lane in 0..LANES {
                    total[lane] += weight[lane];
                    loudest[lane] = if weight[lane] > most[lane] {
                        speaker as u32
                    } else {
                        loudest[lane]
                    };
                    most[lane] = most[lane].max(weight[lane]);
                }
            }
            for lane in 0..LANES.min(count - begin) {
                let mean = |part: usize| sums[part][lane] / total[lane];
                bench.blended.push((total[lane] > 1e-12).then(|| Blended {
                    color: [mean(0), mean(1), mean(2)].map(|c| c.clamp(0.0, 255.0)),
                    confidence: mean(3),
                    residual: mean(4),
                    view: bench.speakers[loudest[lane] as usize].view,
                }));
            }
        }
    }
}
