//! Instruments: connected grey areas that are dark or of much contrast, what is nearly grey and hangs together with them, and a margin.
//!
//! A pale organ is grey as well, but evenly lit and never quite without colour; polished steel mirrors bright and dark side by side. The
//! lamp's image on tissue is as grey and as uneven, but instruments come in from the rim. Jaws and edges mix with the colours around:
//! they are followed from the shaft.

use crate::image::blur::{BlurScratch, box_blur};
use crate::image::buffer::{Image, Mask};
use crate::image::components::{Components, Region};
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};
use crate::image::specularity::cells::Cells;
use crate::image::specularity::settings::{CELLS_ACROSS, Settings};

/// Darker cells have no color to speak of, levels.
const MIN_LEVEL: f32 = 30.0;
/// Highlights on tissue are grey too, but small: a cell counts where this share of its neighbourhood is grey.
const MIN_GREY_SHARE: f32 = 0.75;
/// Steel shines and mirrors the dark: the standard deviation of a region over its mean is at least this. On a real operation shafts have
/// 0.26 to 0.41, pale gall bladders up to 0.16.
const MIN_CONTRAST: f32 = 0.2;
/// Steel has no colour, however evenly lit: half a shaft's cells have a saturation of 0 to 0.06, of pale gall bladders 0.12 to 0.15.
const NEUTRAL_SATURATION: f32 = 0.08;
/// Share of a region's cells that must be so. It may be small, for a tip that just comes in, but not half the picture: some scenes are grey.
const MIN_NEUTRAL_SHARE: f32 = 0.75;
/// A region whose mean is darker is steel all the same (for a well exposed picture): pale organs are bright, means from 150 levels up.
const DARK_LEVEL: f32 = 130.0;
/// An instrument reaches the rim up to so many cells.
const RIM_CELLS: usize = 6;
/// Cells of up to this saturation are followed …
const FOLLOWED_SATURATION: f32 = 0.33;
/// … so far from a grey region, cells.
const FOLLOWED_CELLS: usize = 24;

/// Finds steel; owns its working memory.
#[derive(Debug)]
pub(super) struct Steel {
    grey: Image<f32>,
    distance: Image<u16>,
    components: Components,
    /// Per region: sum of the levels, of their squares, and how many cells are neutral.
    sums: Vec<[f32; 3]>,
    frontier: Vec<usize>,
    next: Vec<usize>,
    /// 255 on steel, one value a cell.
    pub mask: Mask,
}

impl Steel {
    pub fn new() -> Self {
        Self {
            grey: Image::filled(0, 0, 0.0),
            distance: Image::filled(0, 0, 0),
            components: Components::default(),
            sums: Vec::new(),
            frontier: Vec::new(),
            next: Vec::new(),
            mask: Image::filled(0, 0, 0),
        }
    }

    /// Fill `mask`; `brightness` is 1 in a well exposed picture.
    pub fn find(&mut self, settings: &Settings, cells: &Cells, brightness: f32, scratch: &mut BlurScratch) {
        let (width, height) = cells.size();
        if self.mask.size() != (width, height) {
            self.mask.resize(width, height, 0);
            self.grey.resize(width, height, 0.0);
        }
        for (cell, grey) in self.grey.pixels_mut().iter_mut().enumerate() {
            *grey = if is_grey(cells, cell, settings.steel_saturation) {
                1.0
            } else {
                0.0
            };
        }
        let radius = (2.0 * width as f32 / CELLS_ACROSS as f32).round().max(1.0) as usize;
        box_blur(&mut self.grey, radius, scratch);
        for (steel, &share) in self.mask.pixels_mut().iter_mut().zip(self.grey.pixels()) {
            *steel = if share > MIN_GREY_SHARE { 255 } else { 0 };
        }
        self.components.label(&self.mask);
        self.sums.clear();
        self.sums.resize(self.components.regions().len(), [0.0; 3]);
        for run in self.components.runs() {
            let [sum, squares, neutral] = &mut self.sums[run.label as usize];
            let first = run.y as usize * width;
            for cell in first + run.begin as usize..first + run.end as usize {
                let level = cells.least.pixels()[cell];
                *sum += level;
                *squares += level * level;
                *neutral += if is_grey(cells, cell, NEUTRAL_SATURATION) { 1.0 } else { 0.0 };
            }
        }
        let cell_count = (width * height) as f32;
        let min_area = settings.steel_min_share * cell_count;
        let sums = &self.sums;
        self.mask.fill(0);
        self.components.paint(&mut self.mask, 255, |label, region| {
            let area = region.area as f32;
            let mean = sums[label][0] / area;
            let variance = sums[label][1] / area - mean * mean;
            // Instruments come in from the rim; the lamp's image on tissue is as grey and uneven as steel.
            let is_neutral = sums[label][2] > MIN_NEUTRAL_SHARE * area && area < 0.5 * cell_count;
            let looks_so = is_neutral || (area > min_area && variance > (MIN_CONTRAST * mean).powi(2));
            let comes_in = looks_so && is_at_rim(region, cells);
            (comes_in && area > 0.5 * min_area) || (area > min_area && mean < DARK_LEVEL * brightness)
        });
        self.follow(cells);
        let limit = (radius + 2) as u16 * UNITS_PER_PX;
        chamfer_distance(&self.mask, limit + 1, &mut self.distance);
        for (steel, &distance) in self.mask.pixels_mut().iter_mut().zip(self.distance.pixels()) {
            *steel = if distance <= limit { 255 } else { 0 };
        }
    }

    /// Extend the mask to the nearly grey cells that hang together with it.
    fn follow(&mut self, cells: &Cells) {
        let (width, height) = self.mask.size();
        let found = self.mask.pixels().iter().enumerate().filter(|(_, steel)| **steel != 0);
        self.frontier.clear();
        self.frontier.extend(found.map(|(index, _)| index));
        for _ in 0..FOLLOWED_CELLS {
            self.next.clear();
            for &index in &self.frontier {
                let (x, y) = (index % width, index / width);
                let left = (x > 0).then(|| index - 1);
                let right = (x + 1 < width).then_some(index + 1);
                let above = (y > 0).then(|| index - width);
                let below = (y + 1 < height).then_some(index + width);
                for near in [left, right, above, below].into_iter().flatten() {
                    if self.mask.pixels()[near] == 0 && is_grey(cells, near, FOLLOWED_SATURATION) {
                        self.mask.pixels_mut()[near] = 255;
                        self.next.push(near);
                    }
                }
            }
            std::mem::swap(&mut self.frontier, &mut self.next);
        }
    }
}

/// True for a region that reaches the picture's border, or the image field's, up to a few cells.
fn is_at_rim(region: &Region, cells: &Cells) -> bool {
    let (width, height) = cells.size();
    let Region {
        left,
        top,
        right,
        bottom,
        ..
    } = *region;
    let columns = (left as usize).saturating_sub(RIM_CELLS)..(right as usize + RIM_CELLS).min(width);
    let rows = (top as usize).saturating_sub(RIM_CELLS)..(bottom as usize + RIM_CELLS).min(height);
    let at_border = columns.start == 0 || rows.start == 0 || columns.end == width || rows.end == height;
    at_border || rows.into_iter().any(|y| cells.valid.row(y)[columns.clone()].contains(&0))
}

/// True for a cell with color to speak of, whose saturation is below this.
fn is_grey(cells: &Cells, cell: usize, saturation: f32) -> bool {
    let [r, g, b] = cells.rgb.pixels()[cell];
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    cells.valid.pixels()[cell] != 0 && most > MIN_LEVEL && most - least < saturation * most
}
