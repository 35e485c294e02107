//! Instruments: connected grey areas that are not all bright, with a margin.

use crate::image::blur::{BlurScratch, box_blur};
use crate::image::buffer::{Image, Mask};
use crate::image::components::Components;
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};
use crate::image::specularity::cells::Cells;
use crate::image::specularity::settings::{CELLS_ACROSS, Settings};

/// Darker cells have no color to speak of, levels.
const MIN_LEVEL: f32 = 30.0;
/// Highlights on tissue are grey too, but small: a cell counts where this share of its neighbourhood is grey.
const MIN_GREY_SHARE: f32 = 0.75;
/// Steel has shades: this share of a region is darker than the bright level (for a well exposed picture).
const MIN_SHADED_SHARE: f32 = 0.45;
const BRIGHT_LEVEL: f32 = 165.0;

/// Finds steel; owns its working memory.
#[derive(Debug)]
pub(super) struct Steel {
    grey: Image<f32>,
    distance: Image<u16>,
    components: Components,
    shaded: Vec<u32>,
    /// 255 on steel, one value a cell.
    pub mask: Mask,
}

impl Steel {
    pub fn new() -> Self {
        Self {
            grey: Image::filled(0, 0, 0.0),
            distance: Image::filled(0, 0, 0),
            components: Components::default(),
            shaded: Vec::new(),
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
        let colors = cells.rgb.pixels().iter().zip(cells.valid.pixels());
        for (grey, ([r, g, b], valid)) in self.grey.pixels_mut().iter_mut().zip(colors) {
            let (most, least) = (r.max(*g).max(*b), r.min(*g).min(*b));
            let is_grey = *valid != 0 && most > MIN_LEVEL && most - least < settings.steel_saturation * most;
            *grey = if is_grey { 1.0 } else { 0.0 };
        }
        let radius = (2.0 * width as f32 / CELLS_ACROSS as f32).round().max(1.0) as usize;
        box_blur(&mut self.grey, radius, scratch);
        for (steel, &share) in self.mask.pixels_mut().iter_mut().zip(self.grey.pixels()) {
            *steel = if share > MIN_GREY_SHARE { 255 } else { 0 };
        }
        self.components.label(&self.mask);
        self.shaded.clear();
        self.shaded.resize(self.components.regions().len(), 0);
        let bright = BRIGHT_LEVEL * brightness;
        for run in self.components.runs() {
            let row = &cells.least.row(run.y as usize)[run.begin as usize..run.end as usize];
            self.shaded[run.label as usize] += row.iter().filter(|least| **least < bright).count() as u32;
        }
        let min_area = settings.steel_min_share * (width * height) as f32;
        let shaded = &self.shaded;
        self.mask.fill(0);
        self.components.paint(&mut self.mask, 255, |label, region| {
            region.area as f32 > min_area && shaded[label] as f32 > MIN_SHADED_SHARE * region.area as f32
        });
        let limit = (radius + 2) as u16 * UNITS_PER_PX;
        chamfer_distance(&self.mask, limit + 1, &mut self.distance);
        for (steel, &distance) in self.mask.pixels_mut().iter_mut().zip(self.distance.pixels()) {
            *steel = if distance <= limit { 255 } else { 0 };
        }
    }
}
