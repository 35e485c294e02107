//! The chosen views drawn in full over the holes, and blended.

use crossbeam::queue::ArrayQueue;
use rayon::prelude::*;

use crate::image::buffer::{Image, Rgb8};
use crate::image::color::luma;
use crate::light_field::lamp_share::difference;
use crate::stages::specularity_substitution::drawing::Bench;
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Grid, Sums};
use crate::stages::specularity_substitution::live::{DARK_LEVELS, Live};
use crate::stages::specularity_substitution::residual_lamp::{doubt_of, without_lamp};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::speaker::Chosen;
use crate::stages::specularity_substitution::spots::Spot;

/// A pixel this much darker than what was measured may be noise, levels.
const NOISE_LEVELS: f32 = 5.0;

/// White light is known to this, levels.
const WHITE_NOISE_LEVELS: f32 = 4.0;
/// Where the surface breaks off the views show one thing or the other: so much more evidence is wanted, levels.
const EDGE_DOUBT_LEVELS: f32 = 25.0;
/// The same for what the detector marked.
const EDGE_DOUBT_DETECTED_LEVELS: f32 = 10.0;
/// The surface breaks off where depth changes by this share …
const EDGE_STEP: f32 = 0.03;
/// … from this many pixels on one side to as many on the other, in a 960 px wide picture.
const EDGE_REACH_PX: f32 = 4.0;

/// Views that leave more difference than this around a hole, levels …
const USUAL_RESIDUAL_LEVELS: f32 = 3.0;
/// … must show so much more evidence for every level of it.
const RESIDUAL_WEIGHT: f32 = 3.0;

/// Tissue looks the same to most views; steel, a mirror, to none. Where less than this share of the votes agrees …
const USUAL_AGREEMENT: f32 = 0.7;
/// … so much more evidence is wanted, all of it where none does, levels; less where none is known to have seen it clean, for the lamp's
/// light differs from view to view.
const DISAGREEMENT_LEVELS: f32 = 90.0;

/// Tissue is not darker than this share of what lies around it; the gap behind an organ's edge is.
const DARKEST_SHARE: f32 = 0.5;

/// Where no view is known to have seen a pixel clean, one with all channels above this shows the lamp, and some may have been clipped: what
/// is below cannot be told.
const DAZZLED_LEVELS: f32 = 200.0;

/// The mean luma of the good pixels around a spot, levels.
fn usual(scene: &Scene<'_>, brightness: &[Sums], spot: Spot) -> f32 {
    let sums = brightness[scene.grid.block_at(spot.x.into(), spot.y.into())];
    (sums[1] / sums[0].max(1e-6) - DARK_LEVELS).max(0.0)
}

fn is_depth_edge(scene: &Scene<'_>, spot: Spot) -> bool {
    let (x, y) = (usize::from(spot.x), usize::from(spot.y));
    let reach = (EDGE_REACH_PX * scene.scale).ceil() as usize;
    let (width, height) = (scene.grid.width, scene.grid.height);
    let differ = |a: f32, b: f32| (a - b).abs() > EDGE_STEP * spot.depth;
    differ(
        scene.depth_at(x.saturating_sub(reach), y),
        scene.depth_at((x + reach).min(width - 1), y),
    ) || differ(
        scene.depth_at(x, y.saturating_sub(reach)),
        scene.depth_at(x, (y + reach).min(height - 1)),
    )
}

/// How much more of the lamp's light a spot shows than was measured, levels. What the detector saw need only be brighter; beyond, the
/// light must be white, and more of it where the surface breaks off.
fn excess_of(scene: &Scene<'_>, spot: Spot, blended: [f32; 3]) -> f32 {
    let brighter = spot.live - luma(blended);
    let (excess, doubt) = if scene.distance.at(spot.x.into(), spot.y.into()) == 0 {
        (brighter, EDGE_DOUBT_DETECTED_LEVELS)
    } else {
        let white = white_light(spot.color.map(f32::from), blended) + WHITE_NOISE_LEVELS;
        (brighter.min(white), EDGE_DOUBT_LEVELS)
    };
    if is_depth_edge(scene, spot) { excess - doubt } else { excess }
}

/// White light that `live` has and `tissue` has not, levels.
fn white_light(live: [f32; 3], tissue: [f32; 3]) -> f32 {
    let dark = |c: f32| c + DARK_LEVELS;
    let tissue = tissue.map(dark);
    difference(live.map(dark), tissue).lamp * luma(tissue)
}

/// Belief of a pixel that was not drawn, as it is no brighter than what was measured.
pub const PLAIN: u8 = 1;

/// What the light field shows over the holes of a frame; keeps its memory.
#[derive(Debug)]
pub struct Canvas {
    /// Colours; only where `belief` is above [`PLAIN`].
    pub color: Image<Rgb8>,
    /// How sure, 0–255; 0 where nothing is known.
    pub belief: Image<u8>,
    /// The loudest view.
    pub source: Image<u16>,
    /// How much brighter the live picture is in white light, levels; only where `belief` is above zero.
    pub excess: Image<f32>,
    /// Per cell: by how much the live picture is darker than what was measured, levels, mean over 3 × 3 cells. The lamp never darkens;
    /// what does is an edge out of place, a shadow, or a thing that was not there.
    pub against: Vec<f32>,
    /// Per cell: the same summed over its pixels, and how many these are.
    darker: Vec<[f32; 2]>,
    benches: ArrayQueue<Bench>,
}

impl Default for Canvas {
    fn default() -> Self {
        Self {
            color: Image::filled(0, 0, [0; 3]),
            belief: Image::filled(0, 0, 0),
            source: Image::filled(0, 0, 0),
            excess: Image::filled(0, 0, 0.0),
            against: Vec::new(),
            darker: Vec::new(),
            benches: ArrayQueue::new(64),
        }
    }
}

impl Canvas {
    /// Draw and blend over all holes of the frame.
    pub fn draw(&mut self, scene: &Scene<'_>, live: &Live, chosen: &Chosen<'_>) {
        let usually = &live.detail;
        let (width, height) = scene.image.size();
        if self.belief.size() != (width, height) {
            self.color.resize(width, height, [0; 3]);
            self.belief.resize(width, height, 0);
            self.source.resize(width, height, 0);
            self.excess.resize(width, height, 0.0);
        }
        let rows = scene.grid.block() * width;
        let benches = &self.benches;
        self.darker.clear();
        self.darker.resize(scene.grid.count(), [0.0; 2]);
        (self.color.pixels_mut().par_chunks_mut(rows))
            .zip(self.belief.pixels_mut().par_chunks_mut(rows))
            .zip(self.source.pixels_mut().par_chunks_mut(rows))
            .zip(self.excess.pixels_mut().par_chunks_mut(rows))
            .zip(self.darker.par_chunks_mut(scene.grid.across * CELLS_PER_BLOCK))
            .enumerate()
            .for_each(|(j, ((((color, belief), source), excess), against))| {
                belief.fill(0);
                let mut bench = benches.pop().unwrap_or_default();
                let across = scene.grid.blocks().0;
                for i in (0..across).filter(|i| live.hole_blocks[j * across + i] != 0) {
                    bench.blend(scene, live, chosen, (i, j));
                    for plain in &bench.spots.plain {
                        let (top, step) = (plain.top - j * scene.grid.block(), scene.grid.step);
                        for (y, live) in (top..top + step).zip(plain.top..) {
                            let columns = plain.left..plain.left + step;
                            let index = y * width + plain.left;
                            belief[index..index + step].fill(PLAIN);
                            for (excess, pixel) in excess[index..].iter_mut().zip(&scene.image.row(live)[columns]) {
                                *excess = luma(pixel.map(f32::from)) - plain.expected;
                            }
                        }
                        let cell = &mut against[scene.grid.cell_at(plain.left, top)];
                        let count = (step * step) as f32;
                        cell[0] += count * (plain.darker - NOISE_LEVELS).max(0.0);
                        cell[1] += count;
                    }
                    for (spot, blended) in bench.blended() {
                        let (brightness, doubt) = (luma(blended.color), doubt_of(blended.confidence));
                        let dazzled = doubt > 0.0 && blended.color.iter().all(|&level| level > DAZZLED_LEVELS);
                        if dazzled || brightness <= DARKEST_SHARE * usual(scene, usually, spot) {
                            continue;
                        }
                        let (x, y) = (usize::from(spot.x), usize::from(spot.y) - j * scene.grid.block());
                        let index = y * width + x;
                        color[index] = blended.color.map(|v| (v + 0.5) as u8);
                        belief[index] = (255.0 * blended.confidence).clamp(f32::from(PLAIN) + 1.0, 255.0) as u8;
                        source[index] = bench.view_of(&blended) as u16;
                        let unsure = RESIDUAL_WEIGHT * (blended.residual - USUAL_RESIDUAL_LEVELS).max(0.0)
                            + (1.0 - doubt) * DISAGREEMENT_LEVELS * (USUAL_AGREEMENT - blended.agreement).max(0.0);
                        excess[index] = excess_of(scene, spot, blended.color) - unsure;
                        let cell = &mut against[scene.grid.cell_at(x, y)];
                        cell[0] += (brightness - spot.live - NOISE_LEVELS).max(0.0);
                        cell[1] += 1.0;
                    }
                }
                // More benches than the queue holds are simply freed.
                let _surplus = benches.push(bench);
            });
        self.average_darker(scene.grid, &live.holes);
    }

    /// Take the lamp's light off what is to be laid over the picture where no view is known to have seen it clean; `shares` are above
    /// `tissue` there. What is replaced was decided by what was measured.
    pub fn take_lamp_off(&mut self, scene: &Scene<'_>, live: &Live, (shares, tissue): (&Image<u8>, u8)) {
        let width = scene.grid.width.max(1);
        let rows = self.color.pixels_mut().par_chunks_mut(width).enumerate();
        let belief = &self.belief;
        rows.with_min_len(16).for_each(|(y, colors)| {
            for (x, ((color, &belief), &share)) in colors.iter_mut().zip(belief.row(y)).zip(shares.row(y)).enumerate() {
                let doubt = if share > tissue {
                    doubt_of(f32::from(belief) / 255.0)
                } else {
                    0.0
                };
                if doubt > 0.0 {
                    let sums = scene.grid.between(&live.detail, x as f32, y as f32);
                    let nearby = [3, 4, 5].map(|part| (sums[part] / sums[0].max(1e-6) - DARK_LEVELS).max(1.0));
                    *color = without_lamp(color.map(f32::from), nearby, doubt).map(|v| (v + 0.5) as u8);
                }
            }
        });
    }

    /// Fill `against`.
    fn average_darker(&mut self, grid: Grid, holes: &[u8]) {
        self.against.clear();
        self.against.resize(grid.count(), 0.0);
        for (cell, against) in self.against.iter_mut().enumerate().filter(|(cell, _)| holes[*cell] != 0) {
            let (column, row) = (cell % grid.across, cell / grid.across);
            let (mut sum, mut count) = (0.0_f32, 0.0_f32);
            for v in row.saturating_sub(1)..(row + 2).min(grid.down) {
                let begin = v * grid.across;
                for darker in &self.darker[begin + column.saturating_sub(1)..begin + (column + 2).min(grid.across)] {
                    sum += darker[0];
                    count += darker[1];
                }
            }
            *against = sum / count.max(1.0);
        }
    }
}
