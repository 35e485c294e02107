//! Which pixels of one picture show the lamp's mirror image, and which show steel.
//!
//! The lamp's mirror image adds light of the lamp's colour to the tissue's own (Shafer 1985): it lifts the *least* of the
//! three channels, which red tissue keeps low. So the picture's darkest channel m = min(R, G, B) is compared with its own
//! background: a wide mean of m that leaves out what stands above it (the way Arnold et al. 2010 compare with a picture in which
//! candidates are filled by their surroundings, and El Meslouhi et al. 2011 weigh intensity by min/max), and with m's morphological
//! opening, which holds every bright thing that is wide. What stands out must do so by *white* light: m must rise about as much as
//! max(R, G, B) does. White gauze or fat as a whole is its own background and does not stand out; a core must stand far above, its halo
//! may stand less far but must touch a core.
//!
//! Steel is grey where tissue is red, over a connected area that is not all bright; its highlights lie inside.
//!
//! All lengths below are given for a picture 960 px wide and scale with the width.

use rayon::prelude::*;

use crate::image::blur::{BlurScratch, box_blur, gaussian_blur};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::Components;
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};

/// Width of the picture for which lengths are given, px.
pub const REFERENCE_WIDTH_PX: f32 = 960.0;

/// Background and steel are found on cells, about so many across the picture.
const CELLS_ACROSS: usize = 240;

/// In the darkest channel, clipped.
const CLIPPED_LEVEL: u8 = 250;

/// What counts as a specularity.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A core stands at least so far above its background, levels of the darkest channel in a well exposed picture.
    pub core_levels: f32,
    /// A halo stands at least so far above.
    pub halo_levels: f32,
    /// A halo reaches at most so far from a core, px at 960 px width.
    pub halo_reach_px: f32,
    /// The background is a mean over about this radius, px at 960 px width.
    pub background_sigma_px: f32,
    /// Bright things wider than this are background, unless clipped, px at 960 px width.
    pub max_width_px: f32,
    /// The darkest channel rises at least this much of what the brightest does.
    pub whiteness: f32,
    /// Regions beyond this share of the picture are specular only if a good part of them is clipped.
    pub max_region_share: f32,
    /// Steel: (max − min)/max of the channels is below this.
    pub steel_saturation: f32,
    /// Steel: a region covers at least this share of the picture.
    pub steel_min_share: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            core_levels: 26.0,
            halo_levels: 10.0,
            halo_reach_px: 9.0,
            background_sigma_px: 28.0,
            max_width_px: 44.0,
            whiteness: 0.72,
            max_region_share: 0.012,
            steel_saturation: 0.2,
            steel_min_share: 0.004,
        }
    }
}

/// Averages over one cell of the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Cell {
    /// Mean of min(R, G, B).
    least: f32,
    /// Mean of max(R, G, B).
    most: f32,
    /// Mean of each channel.
    rgb: [f32; 3],
    /// Lies inside the image field and is not all but black.
    valid: bool,
}

/// What a pixel must exceed, interpolated between cells.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Bounds {
    core: f32,
    halo: f32,
    white: f32,
}

/// Finds specularities and steel; owns its working memory.
#[derive(Debug)]
pub struct SpecularityDetector {
    settings: Settings,
    cells: Image<Cell>,
    weight: Image<f32>,
    blurred_weight: Image<f32>,
    least_background: Image<f32>,
    most_background: Image<f32>,
    spread: Image<f32>,
    opened: Image<f32>,
    bounds: Image<Bounds>,
    steel: Mask,
    cores: Mask,
    halos: Mask,
    distance: Image<u16>,
    components: Components,
    counts: Vec<[u32; 2]>,
    scratch: BlurScratch,
    brightness: f32,
}

fn empty<P: Copy + Default>() -> Image<P> {
    Image::filled(0, 0, P::default())
}

impl SpecularityDetector {
    /// A detector with the given settings.
    pub fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            cells: empty(),
            weight: empty(),
            blurred_weight: empty(),
            least_background: empty(),
            most_background: empty(),
            spread: empty(),
            opened: empty(),
            bounds: empty(),
            steel: empty(),
            cores: empty(),
            halos: empty(),
            distance: empty(),
            components: Components::default(),
            counts: Vec::new(),
            scratch: BlurScratch::default(),
            brightness: 1.0,
        }
    }

    /// Find specularities (255 in `specular`) and steel (255 in `instruments`) of `image` inside `field` (all of it if `None`).
    /// Both masks get the size of the picture.
    pub fn detect(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, specular: &mut Mask, instruments: &mut Mask) {
        for mask in [&mut *specular, &mut *instruments, &mut self.cores, &mut self.halos] {
            if mask.size() != image.size() {
                mask.resize(image.width(), image.height(), 0);
            }
        }
        let step = (image.width() / CELLS_ACROSS).max(1);
        if image.width() < 2 * step || image.height() < 2 * step {
            specular.fill(0);
            instruments.fill(0);
            return;
        }
        self.average(image, field, step);
        self.find_steel();
        self.find_background();
        self.set_bounds();
        self.classify(image, field, step);
        self.join_halos_to_cores(image, specular);
        enlarge(&self.steel, step, instruments);
    }

    fn average(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, step: usize) {
        let (width, height) = (image.width() / step, image.height() / step);
        if self.cells.size() != (width, height) {
            self.cells.resize(width, height, Cell::default());
        }
        let scale = 1.0 / (step * step) as f32;
        self.cells
            .pixels_mut()
            .par_chunks_mut(width)
            .enumerate()
            .for_each(|(y, cells)| {
                cells.fill(Cell {
                    valid: true,
                    ..Cell::default()
                });
                for v in y * step..(y + 1) * step {
                    for (cell, pixels) in cells.iter_mut().zip(image.row(v).chunks_exact(step)) {
                        let (mut least, mut most, mut rgb) = (0_u32, 0_u32, [0_u32; 3]);
                        for &[r, g, b] in pixels {
                            least += u32::from(r.min(g).min(b));
                            most += u32::from(r.max(g).max(b));
                            rgb = [rgb[0] + u32::from(r), rgb[1] + u32::from(g), rgb[2] + u32::from(b)];
                        }
                        cell.least += least as f32 * scale;
                        cell.most += most as f32 * scale;
                        for (mean, sum) in cell.rgb.iter_mut().zip(rgb) {
                            *mean += sum as f32 * scale;
                        }
                    }
                    if let Some(field) = field {
                        for (cell, inside) in cells.iter_mut().zip(field.row(v).chunks_exact(step)) {
                            cell.valid &= inside.iter().all(|&p| p != 0);
                        }
                    }
                }
                for cell in cells {
                    // What is all but black tells nothing about tissue (surround, shadow).
                    cell.valid &= cell.most > 12.0;
                }
            });
        self.brightness = brightness_of(self.cells.pixels());
    }

    /// The mean of what does not stand out, how much that varies, and what is left when narrow bright things are taken off.
    fn find_background(&mut self) {
        let cells_per_px = self.cells.width() as f32 / REFERENCE_WIDTH_PX;
        let sigma = self.settings.background_sigma_px * cells_per_px;
        let steel = self.steel.pixels();
        fill_from(&mut self.weight, &self.cells, |_, cell| if cell.valid { 1.0 } else { 0.0 });
        for (weight, &steel) in self.weight.pixels_mut().iter_mut().zip(steel) {
            *weight = if steel != 0 { 0.0 } else { *weight };
        }
        for limit in [12.0, 8.0, 8.0] {
            self.blur_backgrounds(sigma);
            let means = self.least_background.pixels().iter().zip(steel_free(&self.steel));
            for ((weight, cell), (mean, free)) in self.weight.pixels_mut().iter_mut().zip(self.cells.pixels()).zip(means) {
                let known = cell.valid && free;
                // What stands out keeps a little say, so that a wide bright area is still its own background.
                *weight = if !known {
                    0.0
                } else if cell.least - mean < limit {
                    1.0
                } else {
                    0.02
                };
            }
        }
        self.blur_backgrounds(sigma);
        // Mean absolute deviation of the unexceptional cells.
        let means = &self.least_background;
        fill_from(&mut self.spread, &self.cells, |index, cell| {
            (cell.least - means.pixels()[index]).abs()
        });
        weighted_mean(
            &mut self.spread,
            &self.weight,
            sigma,
            &mut self.blurred_weight,
            &mut self.scratch,
        );
        // Opening: erosion, then dilation, by squares; invalid cells take no part in the erosion.
        let radius = (0.5 * self.settings.max_width_px * cells_per_px).round().max(1.0) as usize;
        fill_from(
            &mut self.opened,
            &self.cells,
            |_, cell| if cell.valid { cell.least } else { 255.0 },
        );
        extreme_over_square(&mut self.opened, radius, f32::min, 255.0, &mut self.blurred_weight);
        extreme_over_square(&mut self.opened, radius, f32::max, 0.0, &mut self.blurred_weight);
    }

    fn blur_backgrounds(&mut self, sigma: f32) {
        fill_from(&mut self.least_background, &self.cells, |_, cell| cell.least);
        weighted_mean(
            &mut self.least_background,
            &self.weight,
            sigma,
            &mut self.blurred_weight,
            &mut self.scratch,
        );
        fill_from(&mut self.most_background, &self.cells, |_, cell| cell.most);
        weighted_mean(
            &mut self.most_background,
            &self.weight,
            sigma,
            &mut self.blurred_weight,
            &mut self.scratch,
        );
    }

    fn set_bounds(&mut self) {
        if self.bounds.size() != self.cells.size() {
            self.bounds.resize(self.cells.width(), self.cells.height(), Bounds::default());
        }
        let core_levels = self.settings.core_levels * self.brightness;
        let halo_levels = self.settings.halo_levels * self.brightness;
        for (index, bounds) in self.bounds.pixels_mut().iter_mut().enumerate() {
            let least = self.least_background.pixels()[index];
            let most = self.most_background.pixels()[index];
            let spread = self.spread.pixels()[index];
            let base = least.max(self.opened.pixels()[index]);
            *bounds = Bounds {
                core: base + core_levels.max(2.5 * spread),
                halo: base + halo_levels.max(1.2 * spread),
                white: least - self.settings.whiteness * most,
            };
        }
    }

    fn classify(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, step: usize) {
        let width = image.width();
        let (cells_across, cells_down) = self.bounds.size();
        let (bounds, steel, whiteness) = (&self.bounds, &self.steel, self.settings.whiteness);
        let cores = self.cores.pixels_mut().par_chunks_mut(width);
        let halos = self.halos.pixels_mut().par_chunks_mut(width);
        cores.zip(halos).enumerate().for_each(|(y, (cores, halos))| {
            let down = ((y as f32 + 0.5) / step as f32 - 0.5).clamp(0.0, cells_down as f32 - 1.0);
            let (top, part) = (bounds.row(down as usize), down.fract());
            let bottom = bounds.row((down as usize + 1).min(cells_down - 1));
            let steel = steel.row((y / step).min(cells_down - 1));
            let inside = field.map(|f| f.row(y));
            let at = |x: usize| {
                let mix = |a: f32, b: f32| a + (b - a) * part;
                let (a, b) = (&top[x], &bottom[x]);
                Bounds {
                    core: mix(a.core, b.core),
                    halo: mix(a.halo, b.halo),
                    white: mix(a.white, b.white),
                }
            };
            // Between the centres of two cells all bounds are linear.
            let mut x = 0;
            for left in 0..=cells_across {
                let (a, b) = (at(left.max(1) - 1), at(left.min(cells_across - 1)));
                let begin = x;
                let end = if left == cells_across {
                    width
                } else {
                    (left * step + step / 2).min(width)
                };
                let origin = left as f32 * step as f32 - 0.5 * step as f32;
                for column in begin..end {
                    let t = ((column as f32 + 0.5 - origin) / step as f32).clamp(0.0, 1.0);
                    let [r, g, b8] = image.row(y)[column];
                    let least = r.min(g).min(b8);
                    let value = f32::from(least);
                    let white = value - whiteness * f32::from(r.max(g).max(b8)) >= a.white + (b.white - a.white) * t;
                    let clipped = least >= CLIPPED_LEVEL;
                    let free = steel[(column / step).min(cells_across - 1)] == 0 && inside.is_none_or(|row| row[column] != 0);
                    cores[column] = u8::from(free && (clipped || white && value > a.core + (b.core - a.core) * t)) * 255;
                    halos[column] = u8::from(free && (clipped || white && value > a.halo + (b.halo - a.halo) * t)) * 255;
                }
                x = end.max(begin);
            }
        });
    }

    fn join_halos_to_cores(&mut self, image: &Image<Rgb8>, specular: &mut Mask) {
        let (width, height) = image.size();
        let reach = (self.settings.halo_reach_px * width as f32 / REFERENCE_WIDTH_PX).max(3.0);
        let limit = (reach * f32::from(UNITS_PER_PX)) as u16;
        chamfer_distance(&self.cores, limit + 1, &mut self.distance);
        for (halo, &distance) in self.halos.pixels_mut().iter_mut().zip(self.distance.pixels()) {
            *halo = if distance <= limit { *halo } else { 0 };
        }
        self.components.label(&self.halos);
        self.counts.clear();
        self.counts.resize(self.components.regions().len(), [0, 0]);
        for run in self.components.runs() {
            let columns = run.begin as usize..run.end as usize;
            let cores = self.cores.row(run.y as usize)[columns.clone()]
                .iter()
                .filter(|&&c| c != 0)
                .count();
            let clipped = image.row(run.y as usize)[columns]
                .iter()
                .filter(|p| p.iter().all(|&c| c >= 240))
                .count();
            let count = &mut self.counts[run.label as usize];
            *count = [count[0] + cores as u32, count[1] + clipped as u32];
        }
        let max_area = self.settings.max_region_share * (width * height) as f32;
        let counts = &self.counts;
        specular.fill(0);
        self.components.paint(specular, 255, |label, region| {
            let [cores, clipped] = counts[label];
            let plausible = region.area as f32 <= max_area || clipped as f32 > 0.1 * region.area as f32;
            cores >= 2 && plausible
        });
    }

    /// Connected grey areas that are not all bright, with a margin.
    fn find_steel(&mut self) {
        let (width, height) = self.cells.size();
        if self.steel.size() != (width, height) {
            self.steel.resize(width, height, 0);
        }
        let saturation = self.settings.steel_saturation;
        fill_from(&mut self.weight, &self.cells, |_, cell| {
            let [r, g, b] = cell.rgb;
            let (most, least) = (r.max(g).max(b), r.min(g).min(b));
            if cell.valid && most > 30.0 && most - least < saturation * most {
                1.0
            } else {
                0.0
            }
        });
        // Highlights on tissue are grey too, but small: keep where most of the neighbourhood is grey.
        let radius = (2.0 * width as f32 / CELLS_ACROSS as f32).round().max(1.0) as usize;
        box_blur(&mut self.weight, radius, &mut self.scratch);
        for (steel, &share) in self.steel.pixels_mut().iter_mut().zip(self.weight.pixels()) {
            *steel = if share > 0.75 { 255 } else { 0 };
        }
        self.components.label(&self.steel);
        self.counts.clear();
        self.counts.resize(self.components.regions().len(), [0, 0]);
        let bright = 165.0 * self.brightness;
        for run in self.components.runs() {
            let row = &self.cells.row(run.y as usize)[run.begin as usize..run.end as usize];
            self.counts[run.label as usize][0] += row.iter().filter(|c| c.least < bright).count() as u32;
        }
        let min_area = self.settings.steel_min_share * (width * height) as f32;
        let counts = &self.counts;
        self.steel.fill(0);
        self.components.paint(&mut self.steel, 255, |label, region| {
            region.area as f32 > min_area && counts[label][0] as f32 > 0.45 * region.area as f32
        });
        let limit = (radius + 2) as u16 * UNITS_PER_PX;
        chamfer_distance(&self.steel, limit + 1, &mut self.distance);
        for (steel, &distance) in self.steel.pixels_mut().iter_mut().zip(self.distance.pixels()) {
            *steel = if distance <= limit { 255 } else { 0 };
        }
    }
}

fn steel_free(steel: &Mask) -> impl Iterator<Item = bool> {
    steel.pixels().iter().map(|&s| s == 0)
}

/// How bright the picture's bright parts are, 1 when well exposed.
fn brightness_of(cells: &[Cell]) -> f32 {
    let mut histogram = [0_u32; 256];
    for cell in cells.iter().filter(|c| c.valid) {
        histogram[(cell.most as usize).min(255)] += 1;
    }
    let total: u32 = histogram.iter().sum();
    let mut above = 0;
    for level in (0..256).rev() {
        above += histogram[level];
        if above > 0 && above as f32 >= 0.1 * total as f32 {
            return (level as f32 / 170.0).clamp(0.4, 1.0);
        }
    }
    1.0
}

fn fill_from<P: Copy>(out: &mut Image<f32>, cells: &Image<P>, value: impl Fn(usize, &P) -> f32) {
    if out.size() != cells.size() {
        out.resize(cells.width(), cells.height(), 0.0);
    }
    for (index, (out, cell)) in out.pixels_mut().iter_mut().zip(cells.pixels()).enumerate() {
        *out = value(index, cell);
    }
}

/// values ← blur(weight · value)/blur(weight); where no weight is near, 0.
fn weighted_mean(
    values: &mut Image<f32>,
    weight: &Image<f32>,
    sigma_px: f32,
    blurred: &mut Image<f32>,
    scratch: &mut BlurScratch,
) {
    for (value, w) in values.pixels_mut().iter_mut().zip(weight.pixels()) {
        *value *= w;
    }
    blurred.copy_from(weight);
    gaussian_blur(values, sigma_px, scratch);
    gaussian_blur(blurred, sigma_px, scratch);
    for (value, w) in values.pixels_mut().iter_mut().zip(blurred.pixels()) {
        *value = if *w > 1e-4 { *value / w } else { 0.0 };
    }
}

/// The extreme over a (2·radius + 1)² square, in place; `neutral` stands for what lies outside.
fn extreme_over_square(image: &mut Image<f32>, radius: usize, pick: fn(f32, f32) -> f32, neutral: f32, rows: &mut Image<f32>) {
    let (width, height) = image.size();
    if rows.size() != image.size() {
        rows.resize(width, height, neutral);
    }
    for y in 0..height {
        let source = image.row(y);
        for (x, out) in rows.row_mut(y).iter_mut().enumerate() {
            *out = source[x.saturating_sub(radius)..(x + radius + 1).min(width)]
                .iter()
                .copied()
                .fold(neutral, pick);
        }
    }
    for y in 0..height {
        let out = image.row_mut(y);
        out.fill(neutral);
        for v in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            for (out, &value) in out.iter_mut().zip(rows.row(v)) {
                *out = pick(*out, value);
            }
        }
    }
}

/// Enlarge a mask by an integer factor; a remainder at the right and bottom repeats the last cell.
fn enlarge(small: &Mask, step: usize, out: &mut Mask) {
    let (small_width, small_height) = small.size();
    for y in 0..out.height() {
        let source = small.row((y / step).min(small_height - 1));
        for (x, value) in out.row_mut(y).iter_mut().enumerate() {
            *value = source[(x / step).min(small_width - 1)];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 480;
    const HEIGHT: usize = 270;

    /// Mottled reddish tissue of the given brightness.
    fn tissue(brightness: f32) -> Image<Rgb8> {
        let mut image = Image::filled(WIDTH, HEIGHT, [0; 3]);
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                let mottle = 1.0 + 0.08 * (x as f32 * 0.21).sin() * (y as f32 * 0.17).cos() + 0.1 * (x as f32 * 0.011).sin();
                let noise = ((x * 7919 + y * 104_729) % 13) as f32 * 0.3 - 1.8;
                let level = |base: f32| (base * brightness * mottle + noise).clamp(0.0, 255.0) as u8;
                image.set(x, y, [level(170.0), level(80.0), level(70.0)]);
            }
        }
        image
    }

    /// Add a highlight with a clipped core of `radius` px and a halo half as wide again.
    fn shine(image: &mut Image<Rgb8>, cx: f32, cy: f32, radius: f32, strength: f32) {
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                let d = (x as f32 - cx).hypot(y as f32 - cy) / radius;
                let light = strength * (1.5 - d).clamp(0.0, 1.0);
                let mut pixel = image.at(x, y);
                for channel in &mut pixel {
                    *channel = (f32::from(*channel) + light).min(255.0) as u8;
                }
                image.set(x, y, pixel);
            }
        }
    }

    fn detect(image: &Image<Rgb8>) -> (Mask, Mask) {
        let mut detector = SpecularityDetector::new(&Settings::default());
        let (mut specular, mut steel) = (empty(), empty());
        detector.detect(image, None, &mut specular, &mut steel);
        (specular, steel)
    }

    fn count(mask: &Mask) -> usize {
        mask.pixels().iter().filter(|&&v| v != 0).count()
    }

    #[test]
    fn plain_tissue_is_left_alone_bright_or_dim() {
        for brightness in [0.35, 0.7, 1.0, 1.3] {
            let (specular, steel) = detect(&tissue(brightness));
            assert_eq!(count(&specular), 0, "at brightness {brightness}");
            assert_eq!(count(&steel), 0);
        }
    }

    #[test]
    fn cores_and_halos_are_found_bright_or_dim() {
        for brightness in [0.4, 1.0] {
            let plain = tissue(brightness);
            let mut image = plain.clone();
            for (x, y, radius, strength) in [
                (60.0, 60.0, 3.0, 220.0),
                (200.0, 150.0, 7.0, 230.0),
                (330.0, 90.0, 5.0, 120.0),
            ] {
                shine(&mut image, x, y, radius, strength);
            }
            let (specular, _) = detect(&image);
            let (mut strong, mut found, mut false_touches) = (0, 0, 0);
            for (i, (lit, dark)) in image.pixels().iter().zip(plain.pixels()).enumerate() {
                let excess = i32::from(lit[1]) - i32::from(dark[1]);
                if excess > 40 {
                    strong += 1;
                    found += usize::from(specular.pixels()[i] != 0);
                }
                if excess < 2 && specular.pixels()[i] != 0 {
                    false_touches += 1;
                }
            }
            assert!(found * 100 >= strong * 97, "{found} of {strong} at brightness {brightness}");
            assert!(false_touches < 20, "{false_touches} at brightness {brightness}");
        }
    }

    #[test]
    fn white_gauze_is_no_specularity_and_steel_is_steel() {
        let mut image = tissue(1.0);
        for y in 40..160 {
            for x in 60..220 {
                let weave = 8 * ((x / 2 + y / 2) % 2) as u8;
                image.set(x, y, [205 + weave, 200 + weave, 195 + weave]);
            }
        }
        for y in 0..HEIGHT {
            for x in 300..345 {
                let shade = (40.0 + 120.0 * (std::f32::consts::PI * (x - 300) as f32 / 45.0).sin()) as u8;
                image.set(x, y, [shade, shade, shade.saturating_add(4)]);
            }
            for x in 318..324 {
                image.set(x, y, [255; 3]);
            }
        }
        let (specular, steel) = detect(&image);
        let in_gauze = (44..156)
            .flat_map(|y| (64..216).map(move |x| (x, y)))
            .filter(|&(x, y)| specular.at(x, y) != 0)
            .count();
        assert!(in_gauze * 50 < 152 * 112, "{in_gauze} px of gauze");
        let on_steel = (0..HEIGHT)
            .flat_map(|y| (300..345).map(move |x| (x, y)))
            .filter(|&(x, y)| specular.at(x, y) != 0)
            .count();
        assert_eq!(on_steel, 0);
        let covered = (0..HEIGHT)
            .flat_map(|y| (302..343).map(move |x| (x, y)))
            .filter(|&(x, y)| steel.at(x, y) != 0)
            .count();
        assert!(covered * 100 > 95 * 41 * HEIGHT, "{covered} px of steel");
    }
}
