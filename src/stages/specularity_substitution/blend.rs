//! The chosen views drawn in full over the holes, and blended.

use crossbeam::queue::ArrayQueue;
use rayon::prelude::*;

use crate::image::buffer::{Image, Rgb8};
use crate::image::color::luma;
use crate::light_field::lamp_share::difference;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::stages::specularity_substitution::camera_blending::{CameraBlending, Corner};
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Sums};
use crate::stages::specularity_substitution::live::{DARK_LEVELS, Live};
use crate::stages::specularity_substitution::lookup::bicubic;
use crate::stages::specularity_substitution::scene::Scene;
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

/// Views agree with the blend within this, levels, and this share of its luma.
const AGREEMENT_LEVELS: f32 = 5.0;
const AGREEMENT_SHARE: f32 = 0.05;
/// Tissue looks the same to most views; steel, a mirror, to none. Where less than this share of the votes agrees …
const USUAL_AGREEMENT: f32 = 0.7;
/// … so much more evidence is wanted, all of it where none does, levels.
const DISAGREEMENT_LEVELS: f32 = 90.0;

/// Tissue is not darker than this share of what lies around it; the gap behind an organ's edge is.
const DARKEST_SHARE: f32 = 0.5;

/// The mean luma of the good pixels around a spot, levels.
fn usual(scene: &Scene<'_>, brightness: &[Sums], spot: Spot) -> f32 {
    let cell = usize::from(spot.y) / scene.grid.cell * scene.grid.across + usize::from(spot.x) / scene.grid.cell;
    let sums = brightness[cell];
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

/// What the light field shows over the holes of a frame; keeps its memory.
#[derive(Debug)]
pub struct Canvas {
    /// Colours; only where `belief` is above zero.
    pub color: Image<Rgb8>,
    /// How sure, 0–255; 0 where nothing is known.
    pub belief: Image<u8>,
    /// The loudest view.
    pub source: Image<u16>,
    /// How much brighter the live picture is in white light, levels.
    pub excess: Image<f32>,
    /// Per cell: by how much the live picture is darker than what was measured, summed over its pixels, levels, and how many these are.
    /// The lamp never darkens; what does is an edge out of place, a shadow, or a thing that was not there.
    pub against: Vec<[f32; 2]>,
    benches: ArrayQueue<Box<Bench>>,
}

impl Default for Canvas {
    fn default() -> Self {
        Self {
            color: Image::filled(0, 0, [0; 3]),
            belief: Image::filled(0, 0, 0),
            source: Image::filled(0, 0, 0),
            excess: Image::filled(0, 0, 0.0),
            against: Vec::new(),
            benches: ArrayQueue::new(64),
        }
    }
}

/// A pixel of a hole.
#[derive(Clone, Copy, Debug)]
struct Spot {
    x: u16,
    y: u16,
    depth: f32,
    /// The live pixel and its luma, levels.
    color: Rgb8,
    live: f32,
    /// How many views were heard that saw it clean, and the sum of their luma.
    clean: u16,
    luma: f32,
}

impl Spot {
    /// True once more views would change nothing: enough have spoken, or two say that there is nothing to replace.
    fn is_settled(&self) -> bool {
        self.clean >= ENOUGH_VIEWS || self.clean >= 2 && self.live <= self.luma / f32::from(self.clean)
    }
}

/// A view's colour for a spot, and how loud.
#[derive(Clone, Copy, Debug, Default)]
struct Drawn {
    color: [f32; 3],
    weight: f32,
    confidence: f32,
    residual: f32,
}

/// A view's loudness at the four corners of a block.
#[derive(Clone, Copy, Debug)]
struct Speaker {
    slot: usize,
    weights: [f32; 4],
}

/// Working memory of one block at a time.
#[derive(Debug, Default)]
struct Bench {
    spots: Vec<Spot>,
    speakers: Vec<Speaker>,
    drawn: Vec<Drawn>,
}

/// What drawing needs besides the scene.
#[derive(Clone, Copy, Debug)]
pub struct Chosen<'a> {
    /// Who speaks at every corner.
    pub corners: &'a [Corner],
    /// One fit for every view that speaks.
    pub fits: &'a [ViewFit],
    /// Per view, its place among `fits`.
    pub slots: &'a [u16],
    /// Per view, where it looks.
    pub mappings: &'a [Option<Mapping>],
}

impl Canvas {
    /// Draw and blend over all holes of the frame.
    pub fn draw(&mut self, scene: &Scene<'_>, live: &Live, chosen: &Chosen<'_>) {
        let (holes, brightness) = (&live.holes, &live.detail);
        let (width, height) = scene.image.size();
        self.color.resize(width, height, [0; 3]);
        self.belief.resize(width, height, 0);
        self.source.resize(width, height, 0);
        self.excess.resize(width, height, 0.0);
        let rows = scene.grid.block() * width;
        let benches = &self.benches;
        self.against.clear();
        self.against.resize(scene.grid.count(), [0.0; 2]);
        (self.color.pixels_mut().par_chunks_mut(rows))
            .zip(self.belief.pixels_mut().par_chunks_mut(rows))
            .zip(self.source.pixels_mut().par_chunks_mut(rows))
            .zip(self.excess.pixels_mut().par_chunks_mut(rows))
            .zip(self.against.par_chunks_mut(scene.grid.across * CELLS_PER_BLOCK))
            .enumerate()
            .for_each(|(j, ((((color, belief), source), excess), against))| {
                belief.fill(0);
                excess.fill(0.0);
                let mut bench = benches.pop().unwrap_or_default();
                for i in 0..scene.grid.blocks().0 {
                    bench.find_spots(scene, holes, i, j);
                    if bench.spots.is_empty() {
                        continue;
                    }
                    bench.find_speakers(scene, chosen, i, j);
                    bench.draw(scene, chosen, i, j);
                    for k in 0..bench.spots.len() {
                        let spot = bench.spots[k];
                        let seen = bench
                            .blended(k)
                            .filter(|(blended, ..)| luma(*blended) > DARKEST_SHARE * usual(scene, brightness, spot));
                        if let Some((blended, confidence, unsure, loudest)) = seen {
                            let (x, y) = (usize::from(spot.x), usize::from(spot.y) - j * scene.grid.block());
                            let index = y * width + x;
                            color[index] = blended.map(|v| (v + 0.5) as u8);
                            belief[index] = (255.0 * confidence).clamp(1.0, 255.0) as u8;
                            source[index] = chosen.fits[bench.speakers[loudest].slot].view as u16;
                            excess[index] = excess_of(scene, spot, blended) - unsure;
                            let cell = &mut against[y / scene.grid.cell * scene.grid.across + x / scene.grid.cell];
                            cell[0] += (luma(blended) - spot.live - NOISE_LEVELS).max(0.0);
                            cell[1] += 1.0;
                        }
                    }
                }
                // More benches than the queue holds are simply freed.
                let _surplus = benches.push(bench);
            });
    }
}

impl Bench {
    fn find_spots(&mut self, scene: &Scene<'_>, holes: &[u8], i: usize, j: usize) {
        self.spots.clear();
        let grid = scene.grid;
        for row in j * CELLS_PER_BLOCK..((j + 1) * CELLS_PER_BLOCK).min(grid.down) {
            for column in i * CELLS_PER_BLOCK..((i + 1) * CELLS_PER_BLOCK).min(grid.across) {
                if holes[row * grid.across + column] == 0 {
                    continue;
                }
                for y in row * grid.cell..((row + 1) * grid.cell).min(grid.height) {
                    for x in column * grid.cell..((column + 1) * grid.cell).min(grid.width) {
                        if scene.is_open(x, y) {
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
            }
        }
    }

    fn find_speakers(&mut self, scene: &Scene<'_>, chosen: &Chosen<'_>, i: usize, j: usize) {
        self.speakers.clear();
        let across = CameraBlending::corners_across(scene.grid);
        for (index, corner) in [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)].into_iter().enumerate() {
            for voice in chosen.corners[corner.1 * across + corner.0].voices() {
                let slot = usize::from(chosen.slots[usize::from(voice.view)]);
                let speaker = match self.speakers.iter().position(|s| s.slot == slot) {
                    Some(place) => &mut self.speakers[place],
                    None => {
                        self.speakers.push(Speaker { slot, weights: [0.0; 4] });
                        let last = self.speakers.len() - 1;
                        &mut self.speakers[last]
                    }
                };
                speaker.weights[index] = voice.weight;
            }
        }
        let loudness = |s: &Speaker| s.weights.iter().sum::<f32>();
        self.speakers
            .sort_unstable_by(|a, b| loudness(b).total_cmp(&loudness(a)).then(a.slot.cmp(&b.slot)));
        self.speakers.truncate(MAX_VOICES);
    }

    fn draw(&mut self, scene: &Scene<'_>, chosen: &Chosen<'_>, i: usize, j: usize) {
        self.drawn.clear();
        let block = scene.grid.block();
        let (left, top, pitch) = ((i * block) as f32, (j * block) as f32, 1.0 / block as f32);
        for speaker in &self.speakers {
            let fit = &chosen.fits[speaker.slot];
            let view = &scene.light_field.views[fit.view];
            let Some(mapping) = &chosen.mappings[fit.view] else {
                self.drawn.resize(self.drawn.len() + self.spots.len(), Drawn::default());
                continue;
            };
            let (width, height) = view.image.size();
            let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 2.0);
            let confidences = view.confidence.pixels();
            let depths = view.depth.pixels();
            let [a, b, c, d] = speaker.weights;
            self.drawn.extend(self.spots.iter_mut().map(|spot| {
                if spot.is_settled() {
                    return Drawn::default();
                }
                let (x, y) = (f32::from(spot.x), f32::from(spot.y));
                let (fx, fy) = ((x - left) * pitch, (y - top) * pitch);
                let loud = (a + (b - a) * fx) * (1.0 - fy) + (c + (d - c) * fx) * fy;
                if loud <= 0.0 {
                    return Drawn::default();
                }
                let field = scene.grid.between(&fit.field, x, y);
                let (u, v, depth) = mapping.apply(x + field[part::SHIFT], y + field[part::SHIFT + 1], spot.depth);
                let loud = loud * field[part::FIT];
                if !(loud > 0.0 && depth > 0.0 && u >= 1.0 && v >= 1.0 && u < last_x && v < last_y) {
                    return Drawn::default();
                }
                let (x0, y0) = (u as usize, v as usize);
                let corner = y0 * width + x0;
                // Where any of the four is dazzled the mixture is.
                let near = [corner, corner + 1, corner + width, corner + width + 1];
                let least = near.iter().fold(255, |least, &i| confidences[i].min(least));
                if least == 0 || !is_unoccluded(depths[corner], depth) {
                    return Drawn::default();
                }
                let color = bicubic(&view.image, x0, y0, u - x0 as f32, v - y0 as f32);
                let color = std::array::from_fn(|c| (color[c] + DARK_LEVELS) * field[part::GAIN + c] - DARK_LEVELS);
                if least >= CLEAN {
                    spot.clean += 1;
                    spot.luma += luma(color);
                }
                let confidence = f32::from(least) / 255.0;
                Drawn {
                    color,
                    // Clean sights outshout hazy ones by far more than the confidences alone.
                    weight: loud * confidence * confidence,
                    confidence,
                    residual: field[part::RESIDUAL],
                }
            }));
        }
    }

    /// Colour, confidence, how much more evidence is wanted for what its views leave open (levels) and the loudest speaker for spot `k`;
    /// `None` when nobody saw it.
    fn blended(&self, k: usize) -> Option<([f32; 3], f32, f32, usize)> {
        let count = self.spots.len();
        let drawn = || (0..self.speakers.len()).map(|s| &self.drawn[s * count + k]);
        let mut reference = f32::INFINITY;
        let mut result = None;
        for _ in 0..=ROUNDS {
            let (mut sum, mut total, mut confidence, mut residual) = ([0.0_f32; 3], 0.0_f32, 0.0_f32, 0.0_f32);
            let (mut agreed, mut heard) = (0.0_f32, 0.0_f32);
            let tolerance = AGREEMENT_LEVELS
                + if reference.is_finite() {
                    AGREEMENT_SHARE * reference
                } else {
                    0.0
                };
            let mut loudest = (0.0_f32, 0);
            for (index, view) in drawn().enumerate() {
                let brighter = (luma(view.color) - reference).max(0.0) / BRIGHTER_HALF_LEVELS;
                let weight = view.weight / (1.0 + brighter * brighter);
                for (sum, channel) in sum.iter_mut().zip(view.color) {
                    *sum += weight * channel;
                }
                total += weight;
                heard += view.weight;
                if (luma(view.color) - reference).abs() < tolerance {
                    agreed += view.weight;
                }
                confidence += weight * view.confidence;
                residual += weight * view.residual;
                if weight > loudest.0 {
                    loudest = (weight, index);
                }
            }
            if total < 1e-12 {
                return None;
            }
            let color = sum.map(|s| (s / total).clamp(0.0, 255.0));
            reference = luma(color);
            let unsure = RESIDUAL_WEIGHT * (residual / total - USUAL_RESIDUAL_LEVELS).max(0.0)
                + DISAGREEMENT_LEVELS * (USUAL_AGREEMENT - agreed / heard).max(0.0);
            result = Some((color, confidence / total, unsure, loudest.1));
        }
        result
    }
}
