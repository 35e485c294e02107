//! One block of the picture: its pixels that may show the lamp, the views that speak there drawn over them, and blended.

use crate::image::buffer::Rgb8;
use crate::image::color::luma;
use crate::image::wide;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;
use crate::stages::specularity_substitution::camera_blending::{CameraBlending, Corner};
use crate::stages::specularity_substitution::drawn::{Blended, Drawn};
use crate::stages::specularity_substitution::grid::{Grid, SMALL_PER_BLOCK, SMALL_PER_CELL, Sums};
use crate::stages::specularity_substitution::live::DARK_LEVELS;
use crate::stages::specularity_substitution::lookup::{Strip, cubic_across, cubic_down, split};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::Vantage;
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::view_fit::{ViewFit, part};

/// At most so many views speak in a block, the loudest.
const MAX_VOICES: usize = 16;
/// So many clean sights of a pixel are enough.
const ENOUGH_VIEWS: u16 = 3;
/// A sight is clean from this confidence on.
const CLEAN: u8 = 230;
/// A small pixel at most this much brighter than what was measured is taken for tissue, levels.
const PLAIN_LEVELS: f32 = 2.0;
/// The loudest views that are asked whether a small pixel shows the lamp at all.
const ASKED: usize = 4;
/// So many of them must have seen it clean …
const WITNESSES: u16 = 2;
/// … at a place where they fit at least so well.
const WITNESS_FIT: f32 = 0.5;

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
fn halves(place: f32) -> (usize, f32) {
    if place < 0.5 { (0, place + 0.5) } else { (1, place - 0.5) }
}

#[inline(always)]
fn mixed(a: &Sums, b: &Sums, t: f32) -> Sums {
    let mut sums = [0.0; 8];
    for i in 0..8 {
        sums[i] = a[i] + t * (b[i] - a[i]);
    }
    sums
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
    sights: Vec<Sight>,
    strips: Vec<Strip>,
    blended: Vec<Option<Blended>>,
}

impl Bench {
    /// Spots that somebody saw, and what the views say of them.
    pub fn blended(&self) -> impl Iterator<Item = (Spot, Blended)> {
        let pairs = self.spots.iter().zip(&self.blended);
        pairs.filter_map(|(spot, blended)| Some((*spot, (*blended)?)))
    }

    /// Index of the view that was loudest.
    pub fn view_of(&self, blended: &Blended) -> usize {
        self.speakers[blended.speaker].view
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
                    small: &chosen.small_views[self.speakers[index].view],
                    block: Block::of(scene.grid, i, j),
                    index,
                    bench: self,
                });
            }
            self.drawn.blend(self.spots.len(), &mut self.blended);
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
                } else if let Some(Vantage { mapping, small, .. }) = chosen.vantages[view] {
                    let mut weights = [0.0; 4];
                    weights[index] = voice.weight;
                    self.speakers.push(Speaker {
                        view,
                        weights,
                        mapping,
                        small_mapping: small,
                        field: [[[0.0; 8]; 3]; 3],
                    });
                }
            }
        }
        self.speakers
            .sort_unstable_by(|a, b| b.loudness().total_cmp(&a.loudness()).then(a.view.cmp(&b.view)));
        self.speakers.truncate(MAX_VOICES);
        let around = scene.grid.blocks_around(i, j);
        for speaker in &mut self.speakers {
            let field = &chosen.fits[speaker.view].field;
            speaker.field = around.map(|row| row.map(|block| field[block]));
        }
    }

    fn find_spots(&mut self, scene: &Scene<'_>, holes: &[u8], chosen: &Chosen<'_>, i: usize, j: usize) {
        self.spots.clear();
        self.plain.clear();
        let grid = scene.grid;
        let block = Block::of(grid, i, j);
        let mut doubtful = [[false; SMALL_PER_BLOCK]; SMALL_PER_BLOCK];
        for (row, doubtful) in doubtful.iter_mut().enumerate() {
            for (column, doubtful) in doubtful.iter_mut().enumerate() {
                let (x, y) = (i * SMALL_PER_BLOCK + column, j * SMALL_PER_BLOCK + row);
                let (cell_column, cell_row) = (x / SMALL_PER_CELL, y / SMALL_PER_CELL);
                if cell_column < grid.across && cell_row < grid.down && holes[cell_row * grid.across + cell_column] != 0 {
                    match self.look_at_small(scene, chosen, block, (x * grid.step, y * grid.step)) {
                        Look::Nothing => {}
                        Look::Plain(plain) => self.plain.push(plain),
                        Look::Doubtful => *doubtful = true,
                    }
                }
            }
        }
        for y in block.top..(block.top + block.side).min(grid.height) {
            let doubtful = &doubtful[(y - block.top) / grid.step];
            let lefts = (block.left..).step_by(grid.step);
            for (left, _) in lefts.zip(doubtful).filter(|(_, is_doubtful)| **is_doubtful) {
                for x in left..(left + grid.step).min(grid.width) {
                    let depth = scene.depth_at(x, y);
                    if depth > 0.0 && scene.is_open(x, y) {
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
    }

    /// What is known of a small pixel without drawing its pixels.
    fn look_at_small(&self, scene: &Scene<'_>, chosen: &Chosen<'_>, block: Block, (left, top): (usize, usize)) -> Look {
        let (grid, step) = (scene.grid, scene.grid.step);
        let (right, bottom) = ((left + step).min(grid.width), (top + step).min(grid.height));
        if left >= right || top >= bottom {
            return Look::Nothing;
        }
        let (mut nearest, mut forbidden, mut sum) = (u16::MAX, 0, [0_u32; 3]);
        for y in top..bottom {
            nearest = (scene.distance.row(y)[left..right].iter()).fold(nearest, |least, &d| least.min(d));
            forbidden |= scene.forbidden.row(y)[left..right].iter().fold(0, |any, &f| any | f);
            for pixel in &scene.image.row(y)[left..right] {
                for (sum, &channel) in sum.iter_mut().zip(pixel) {
                    *sum += u32::from(channel);
                }
            }
        }
        if nearest > scene.reach {
            return Look::Nothing;
        }
        // What is marked is looked at closely, and so are the edges of what may be touched.
        if nearest == 0 || forbidden != 0 || left + step > grid.width || top + step > grid.height {
            return Look::Doubtful;
        }
        let live = luma(sum.map(|s| s as f32)) / (step * step) as f32;
        match self.expected_at(scene, chosen, block, (left + step / 2, top + step / 2)) {
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
    fn expected_at(&self, scene: &Scene<'_>, chosen: &Chosen<'_>, block: Block, (x, y): (usize, usize)) -> Option<f32> {
        let depth = scene.depth_at(x, y);
        if depth <= 0.0 {
            return None;
        }
        // The middle of the small pixel; (x, y) is the pixel right below it.
        let middle = if scene.grid.step.is_multiple_of(2) { 0.5 } else { 0.0 };
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
}

/// A view's colour under the live picture's light.
#[inline(always)]
fn brightened(color: [f32; 3], field: &Sums) -> [f32; 3] {
    let brightened = |c: usize| (color[c] + DARK_LEVELS) * field[part::GAIN + c] - DARK_LEVELS;
    [brightened(0), brightened(1), brightened(2)]
}

/// Where a block lies in the picture, px.
#[derive(Clone, Copy, Debug)]
struct Block {
    left: usize,
    top: usize,
    side: usize,
    /// Of half a pixel before the first.
    begin: [f32; 2],
    /// One over the side.
    share: f32,
}

impl Block {
    fn of(grid: Grid, i: usize, j: usize) -> Self {
        let side = grid.block();
        Self {
            left: i * side,
            top: j * side,
            side,
            begin: [i, j].map(|at| (at * side) as f32 - 0.5),
            share: 1.0 / side as f32,
        }
    }

    /// Where a pixel lies within it, 0…1 along each axis.
    #[inline(always)]
    fn share_of(self, x: f32, y: f32) -> (f32, f32) {
        let inside = |at: f32, begin: f32| ((at - begin) * self.share).clamp(0.0, 1.0);
        (inside(x, self.begin[0]), inside(y, self.begin[1]))
    }
}

/// One speaker drawn over the spots that are not settled.
struct Draw<'a> {
    view: &'a View,
    small: &'a SmallView,
    block: Block,
    index: usize,
    bench: &'a mut Bench,
}

impl wide::Kernel for Draw<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            view,
            small,
            block,
            index,
            bench,
        } = self;
        let Bench {
            speakers,
            spots,
            drawn,
            sights,
            strips,
            ..
        } = bench;
        sights.clear();
        find_sights(&speakers[index], spots, view, small, block, sights);
        if strips.len() < sights.len() {
            strips.resize(sights.len(), [0.0; 16]);
        }
        // First all strips, then all colours: each a short loop over memory that fills vector registers.
        for (strip, sight) in strips.iter_mut().zip(&*sights) {
            cubic_down(&view.image, sight.x, sight.y, sight.fy, strip);
        }
        for (strip, sight) in strips.iter_mut().zip(&*sights) {
            let color = cubic_across(strip, sight.fx);
            strip[..4].copy_from_slice(&color);
        }
        let begin = index * drawn.pitch;
        for (strip, sight) in strips.iter().zip(&*sights) {
            let color = brightened([strip[0], strip[1], strip[2]], &sight.field);
            let brightness = luma(color);
            let spot = &mut spots[sight.spot];
            if sight.confidence >= CLEAN {
                spot.clean += 1;
                spot.luma += brightness;
            }
            let confidence = f32::from(sight.confidence) / 255.0;
            let place = begin + sight.spot;
            for (plane, channel) in drawn.color.iter_mut().zip(color) {
                plane[place] = channel;
            }
            drawn.luma[place] = brightness;
            // Clean sights outshout hazy ones by far more than the confidences alone.
            drawn.weight[place] = sight.loud * confidence * confidence;
            drawn.confidence[place] = confidence;
            drawn.residual[place] = sight.field[part::RESIDUAL];
        }
    }
}

/// Where a view shows a spot.
#[derive(Clone, Copy, Debug)]
struct Sight {
    /// Index of the spot.
    spot: usize,
    /// The pixel of the view, and the way to the next.
    x: usize,
    y: usize,
    fx: f32,
    fy: f32,
    /// There, mm.
    depth: f32,
    field: Sums,
    loud: f32,
    /// The least of the pixels around.
    confidence: u8,
}

/// Where a speaker's view shows the spots that are not settled, if it does.
#[inline(always)]
fn find_sights(speaker: &Speaker, spots: &[Spot], view: &View, small: &SmallView, block: Block, sights: &mut Vec<Sight>) {
    let (width, height) = view.image.size();
    let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 3.0);
    let confidences = view.confidence.pixels();
    let (mut row, mut columns) = (u16::MAX, [[0.0; 8]; 3]);
    for (k, spot) in spots.iter().enumerate() {
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
        let ((x, fx), (y, fy)) = (split(u), split(v));
        fetch(view, small, x, y);
        sights.push(Sight {
            spot: k,
            x,
            y,
            fx,
            fy,
            depth,
            field,
            loud,
            confidence: 0,
        });
    }
    sights.retain_mut(|sight| {
        let corner = sight.y * width + sight.x;
        // Where any of the four is dazzled the mixture is.
        let (upper, lower) = (
            &confidences[corner..corner + 2],
            &confidences[corner + width..corner + width + 2],
        );
        sight.confidence = upper[0].min(upper[1]).min(lower[0]).min(lower[1]);
        sight.confidence > 0 && is_unoccluded(small.depth_at(sight.x, sight.y), sight.depth)
    });
}

/// Ask for all that a spot at pixel (x, y) of a view needs.
#[inline(always)]
fn fetch(view: &View, small: &SmallView, x: usize, y: usize) {
    let (width, bytes) = (view.image.width(), view.image.as_bytes());
    let corner = y * width + x;
    wide::fetch(view.confidence.pixels(), corner);
    wide::fetch(view.confidence.pixels(), corner + width);
    for row in 0..4 {
        wide::fetch(bytes, 3 * (corner + row * width) - 3 * (width + 1));
    }
    small.fetch_depth(x, y);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::ensemble::MOST_MEMBERS;
    use crate::stages::specularity_substitution::example::{Example, HOLE, in_hole};
    use crate::stages::specularity_substitution::live::Live;
    use crate::stages::specularity_substitution::settings::Settings;
    use crate::stages::specularity_substitution::view_fit::{Comparison, Workbench};

    /// Spots and what was blended of them in the block of the hole's middle.
    fn blended(example: &Example) -> Bench {
        let (scene, vantages, settings) = (example.scene(), example.vantages(), Settings::default());
        let views = example.views(&vantages);
        let (mut blending, mut live) = (CameraBlending::default(), Live::default());
        live.look(&scene);
        blending.choose(&scene, &live.holes, &views, MOST_MEMBERS);
        let block = scene.grid.block();
        let (i, j) = (HOLE.0 / block, HOLE.1 / block);
        let mut fits = Vec::new();
        for (small, vantage) in example.small_views.iter().zip(&vantages) {
            let mut fit = ViewFit::default();
            fit.begin(scene.grid);
            fit.need_around(&scene, &live, i, j);
            let comparison = Comparison {
                grid: scene.grid,
                scale: scene.scale,
                live: &live,
                view: small,
                mapping: &vantage.unwrap().small,
                settings: &settings,
            };
            fit.measure(&comparison, &mut Workbench::default());
            fits.push(fit);
        }
        let chosen = Chosen {
            corners: blending.corners(),
            fits: &fits,
            small_views: &example.small_views,
            vantages: &vantages,
        };
        let mut bench = Bench::default();
        bench.blend(&scene, &live.holes, &chosen, i, j);
        bench
    }

    #[test]
    fn under_the_lamp_the_tissue_is_found_and_tissue_is_not_drawn() {
        let example = Example::new(&[(4.0, 0.0), (-4.0, 1.0), (1.0, 5.0), (0.0, -5.0)], [1.0; 3], (0.0, 0.0));
        let bench = blended(&example);
        assert!(
            bench
                .blended()
                .filter(|(spot, _)| in_hole(spot.x.into(), spot.y.into()))
                .count()
                > 30
        );
        for (spot, blended) in bench.blended() {
            let truth = example.truth(spot.x.into(), spot.y.into());
            for (found, truth) in blended.color.into_iter().zip(truth) {
                assert!((found - truth).abs() < 3.0, "{spot:?}: {:?} for {truth}", blended.color);
            }
            assert!(blended.confidence > 0.95);
        }
    }

    #[test]
    fn a_view_that_is_dazzled_unnoticed_is_not_heard() {
        let mut example = Example::new(&[(4.0, 0.0), (-4.0, 1.0), (1.0, 5.0), (0.0, -5.0)], [1.0; 3], (0.0, 0.0));
        // View 0 shows the lamp at the hole and believes itself.
        let (u, v, _) = example.vantages()[0].unwrap().mapping.apply(
            HOLE.0 as f32,
            HOLE.1 as f32,
            crate::stages::specularity_substitution::example::DEPTH,
        );
        let image = &mut example.light_field.views[0].image;
        for y in v as usize - 8..v as usize + 9 {
            for pixel in &mut image.row_mut(y)[u as usize - 8..u as usize + 9] {
                *pixel = pixel.map(|c| c.saturating_add(60));
            }
        }
        example.look_again();
        let bench = blended(&example);
        let mut seen = 0;
        for (spot, blended) in bench.blended().filter(|(spot, _)| in_hole(spot.x.into(), spot.y.into())) {
            let truth = luma(example.truth(spot.x.into(), spot.y.into()));
            assert!(
                (luma(blended.color) - truth).abs() < 3.0,
                "{spot:?}: {:?} for {truth}",
                blended.color
            );
            seen += 1;
        }
        assert!(seen > 30);
    }
}
