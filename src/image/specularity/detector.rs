//! The detector: all steps in order, and halos joined to their cores.

use std::ops::Range;

use crate::image::blur::BlurScratch;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::{Components, set_runs};
use crate::image::distance::{UNITS_PER_PX, chamfer_distance_within};
use crate::image::specularity::background::{Background, extreme_over_square};
use crate::image::specularity::cells::{CHUNK, Cells};
use crate::image::specularity::classify::{Classifier, Demand};
use crate::image::specularity::settings::{CELLS_ACROSS, REFERENCE_WIDTH_PX, Settings};
use crate::image::specularity::steel::Steel;

/// In the darkest channel, all but clipped.
const NEARLY_CLIPPED_LEVEL: u8 = 240;
/// A region beyond `max_region_share` is specular only if more than this share of it is nearly clipped.
const MIN_CLIPPED_SHARE: f32 = 0.1;
/// Of other large regions only what lies within this square around nearly clipped pixels is, px at 960 px width.
const AROUND_CLIPPED_PX: f32 = 4.0;
/// A single core pixel may be noise.
const MIN_CORE_PX: u32 = 2;

/// Finds specularities and steel; owns its working memory.
#[derive(Debug)]
pub struct SpecularityDetector {
    settings: Settings,
    cells: Cells,
    steel: Steel,
    background: Background,
    classifier: Classifier,
    /// Cells in which there may be cores, near to cores, and of these the ones in which there may be halos.
    core_cells: Mask,
    near_cells: Mask,
    halo_cells: Mask,
    cell_rows: Mask,
    /// 255 on cores; 0 outside `core_cells`.
    cores: Mask,
    /// 255 on halos; 0 outside `halo_cells`.
    halos: Mask,
    /// From the nearest core; beyond every limit outside `near_cells`.
    distance: Image<u16>,
    components: Components,
    /// Per region: core pixels, as far as they decide, and in large ones nearly clipped pixels.
    counts: Vec<[u32; 2]>,
    scratch: BlurScratch,
}

impl SpecularityDetector {
    /// A detector with the given settings.
    pub fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            cells: Cells::new(),
            steel: Steel::new(),
            background: Background::new(),
            classifier: Classifier::new(),
            core_cells: Image::filled(0, 0, 0),
            near_cells: Image::filled(0, 0, 0),
            halo_cells: Image::filled(0, 0, 0),
            cell_rows: Image::filled(0, 0, 0),
            cores: Image::filled(0, 0, 0),
            halos: Image::filled(0, 0, 0),
            distance: Image::filled(0, 0, 0),
            components: Components::default(),
            counts: Vec::new(),
            scratch: BlurScratch::default(),
        }
    }

    /// Find specularities (255 in `specular`) and steel (255 in `instruments`) of `image` inside `field` (all of it if `None`).
    /// Both masks get the size of the picture.
    pub fn detect(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, specular: &mut Mask, instruments: &mut Mask) {
        for mask in [&mut *specular, &mut *instruments] {
            if mask.size() != image.size() {
                mask.resize(image.width(), image.height(), 0);
            }
        }
        specular.fill(0);
        let step = (image.width() / CELLS_ACROSS).max(1);
        self.forget(image.size(), step);
        if image.width() < 2 * step || image.height() < 2 * step || step > CHUNK {
            instruments.fill(0);
            return;
        }
        self.cells.average(image, field, step);
        let brightness = brightness_of(&self.cells);
        self.steel.find(&self.settings, &self.cells, brightness, &mut self.scratch);
        self.background
            .find(&self.settings, &self.cells, &self.steel.mask, brightness, &mut self.scratch);
        let (bounds, steel) = (&self.background.bounds, &self.steel.mask);
        let core = Demand {
            level: &bounds.core,
            white: &bounds.core_white,
            whiteness: self.settings.core_whiteness,
        };
        let halo = Demand {
            level: &bounds.halo,
            white: &bounds.white,
            whiteness: self.settings.whiteness,
        };
        let picture = (image, field);
        self.classifier.candidates(&core, &self.cells, steel, &mut self.core_cells);
        self.classifier
            .classify(picture, &core, (&self.core_cells, step), &mut self.cores);
        let reach = (self.settings.halo_reach_px * image.width() as f32 / REFERENCE_WIDTH_PX).max(3.0);
        let limit = (reach * f32::from(UNITS_PER_PX)) as u16;
        find_near_cells((&self.cores, &self.core_cells, step), &mut self.near_cells);
        let reach_cells = usize::from(limit / UNITS_PER_PX) / step + 1;
        extreme_over_square(&mut self.near_cells, reach_cells, u8::max, 0, &mut self.cell_rows);
        self.classifier.candidates(&halo, &self.cells, steel, &mut self.halo_cells);
        for (cell, near) in self.halo_cells.pixels_mut().iter_mut().zip(self.near_cells.pixels()) {
            *cell &= near;
        }
        self.classifier
            .classify(picture, &halo, (&self.halo_cells, step), &mut self.halos);
        self.join_halos_to_cores(image, step, limit, specular);
        enlarge(&self.steel.mask, step, instruments);
    }

    /// Cores, halos and distances of the last picture away, so that what holds outside their cells holds everywhere.
    fn forget(&mut self, size: (usize, usize), step: usize) {
        if self.cores.size() == size {
            each_stretch(&self.core_cells, step, &mut self.cores, |_, cores| cores.fill(0));
            each_stretch(&self.halo_cells, step, &mut self.halos, |_, halos| halos.fill(0));
            each_stretch(&self.near_cells, step, &mut self.distance, |_, distance| {
                distance.fill(u16::MAX)
            });
        } else {
            self.cores = Image::filled(size.0, size.1, 0);
            self.halos = Image::filled(size.0, size.1, 0);
            self.distance = Image::filled(size.0, size.1, u16::MAX);
        }
        for cells in [&mut self.core_cells, &mut self.halo_cells, &mut self.near_cells] {
            cells.fill(0);
        }
    }

    /// Paint what touches a core into `specular`.
    fn join_halos_to_cores(&mut self, image: &Image<Rgb8>, step: usize, limit: u16, specular: &mut Mask) {
        let (width, height) = specular.size();
        chamfer_distance_within((&self.near_cells, step), &self.cores, limit + 1, &mut self.distance);
        let distance = &self.distance;
        each_stretch(&self.halo_cells, step, &mut self.halos, |pixels, halos| {
            for (halo, &distance) in halos.iter_mut().zip(&distance.pixels()[pixels]) {
                *halo = if distance <= limit { *halo } else { 0 };
            }
        });
        self.components.label(&self.halos);
        self.counts.clear();
        self.counts.resize(self.components.regions().len(), [0, 0]);
        let max_area = self.settings.max_region_share * (width * height) as f32;
        let is_large = |label: usize| self.components.regions()[label].area as f32 > max_area;
        for run in self.components.runs() {
            let first = run.y as usize * width;
            let pixels = first + run.begin as usize..first + run.end as usize;
            let [cores, clipped] = &mut self.counts[run.label as usize];
            if *cores < MIN_CORE_PX {
                *cores += self.cores.pixels()[pixels.clone()].iter().filter(|core| **core != 0).count() as u32;
            }
            if is_large(run.label as usize) {
                *clipped += image.pixels()[pixels].iter().filter(|color| is_nearly_clipped(color)).count() as u32;
            }
        }
        let has_core = |label: usize| self.counts[label][0] >= MIN_CORE_PX;
        let is_plausible = |label: usize| {
            !is_large(label) || self.counts[label][1] as f32 > MIN_CLIPPED_SHARE * self.components.regions()[label].area as f32
        };
        self.components
            .paint(specular, 255, |label, _| has_core(label) && is_plausible(label));
        // Of what is too large to be one specularity, a droplet on pale tissue or a cluster whose halos flow together, only what lies
        // around clipped pixels is the lamp's for sure.
        let around = (AROUND_CLIPPED_PX * width as f32 / REFERENCE_WIDTH_PX).round() as usize;
        let runs = self.components.runs().iter();
        for run in runs.filter(|run| has_core(run.label as usize) && !is_plausible(run.label as usize)) {
            let y = run.y as usize;
            let columns = run.begin as usize..run.end as usize;
            for x in columns.filter(|&x| is_nearly_clipped(&image.at(x, y))) {
                let near = x.saturating_sub(around)..(x + around + 1).min(width);
                for v in y.saturating_sub(around)..(y + around + 1).min(height) {
                    let halos = &self.halos.row(v)[near.clone()];
                    for (specular, &halo) in specular.row_mut(v)[near.clone()].iter_mut().zip(halos) {
                        *specular |= halo;
                    }
                }
            }
        }
    }
}

fn is_nearly_clipped(color: &Rgb8) -> bool {
    color.iter().all(|&level| level >= NEARLY_CLIPPED_LEVEL)
}

/// 255 in `near` for each of the `core_cells`, of `step` px, that has a core.
fn find_near_cells((cores, core_cells, step): (&Mask, &Mask, usize), near: &mut Mask) {
    near.copy_from(core_cells);
    near.fill(0);
    let (width, last_row) = (cores.width(), near.height() - 1);
    for y in 0..cores.height() {
        let row = (y / step).min(last_row);
        let near = near.row_mut(row);
        for cell in set_runs(core_cells.row(row)).flatten() {
            let end = if cell + 1 == near.len() { width } else { (cell + 1) * step };
            near[cell] |= cores.row(y)[cell * step..end].iter().fold(0, |any, core| any | core);
        }
    }
}

/// Do something with each stretch of pixels, named by its place in the image, that the set cells of `step` px cover.
fn each_stretch<P: Copy>(cells: &Mask, step: usize, image: &mut Image<P>, mut work: impl FnMut(Range<usize>, &mut [P])) {
    let (width, height) = image.size();
    for y in 0..height {
        let row = (y / step).min(cells.height().saturating_sub(1));
        for run in set_runs(cells.row(row)) {
            let end = if run.end == cells.width() { width } else { run.end * step };
            let pixels = y * width + run.start * step..y * width + end;
            work(pixels.clone(), &mut image.pixels_mut()[pixels]);
        }
    }
}

/// How bright the picture's bright parts are, 1 when well exposed.
fn brightness_of(cells: &Cells) -> f32 {
    let mut histogram = [0_u32; 256];
    for (most, _) in cells
        .most
        .pixels()
        .iter()
        .zip(cells.valid.pixels())
        .filter(|(_, valid)| **valid != 0)
    {
        histogram[(*most as usize).min(255)] += 1;
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

/// Enlarge a mask of 0 and 255 by an integer factor; a remainder at the right and bottom repeats the last cell.
fn enlarge(small: &Mask, step: usize, out: &mut Mask) {
    let (small_width, small_height) = small.size();
    let (width, height) = out.size();
    for row in 0..small_height {
        let (first, end) = (row * step, if row + 1 == small_height { height } else { (row + 1) * step });
        out.pixels_mut()[first * width..end * width].fill(0);
        for run in set_runs(small.row(row)) {
            let columns = run.start * step..if run.end == small_width { width } else { run.end * step };
            for y in first..end {
                out.row_mut(y)[columns.clone()].fill(255);
            }
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
        let (mut specular, mut steel) = (Image::filled(0, 0, 0), Image::filled(0, 0, 0));
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
    fn a_pale_organ_is_no_steel() {
        let mut image = tissue(1.0);
        for y in 60..200 {
            for x in 100..260 {
                let (u, v) = ((x as f32 - 180.0) / 80.0, (y as f32 - 130.0) / 70.0);
                let shade = 1.0 - 0.45 * (u * u + v * v);
                if u * u + v * v < 1.0 {
                    image.set(x, y, [190.0, 172.0, 168.0].map(|c: f32| (c * shade) as u8));
                }
            }
        }
        let (specular, steel) = detect(&image);
        assert_eq!(count(&steel), 0);
        let inside = |x: usize, y: usize| ((x as f32 - 180.0) / 70.0).hypot((y as f32 - 130.0) / 60.0) < 1.0;
        let marked = (0..HEIGHT)
            .flat_map(|y| (0..WIDTH).map(move |x| (x, y)))
            .filter(|&(x, y)| inside(x, y) && specular.at(x, y) != 0)
            .count();
        assert!(marked * 50 < 70 * 60 * 3, "{marked} px of a pale organ");
    }

    #[test]
    fn of_a_cluster_too_large_the_clipped_droplets_are_found_and_the_gleam_between_is_left() {
        let mut image = tissue(1.0);
        // A long faint gleam joins the droplets.
        for y in 120..132 {
            for x in 160..320 {
                image.set(x, y, image.at(x, y).map(|level| level.saturating_add(60)));
            }
        }
        let droplets = [180, 215, 250, 285].map(|x| (x, 126));
        for (x, y) in droplets {
            shine(&mut image, x as f32, y as f32, 3.0, 255.0);
        }
        let strict = Settings {
            max_region_share: 0.012,
            ..Settings::default()
        };
        let (mut specular, mut steel) = (Image::filled(0, 0, 0), Image::filled(0, 0, 0));
        SpecularityDetector::new(&strict).detect(&image, None, &mut specular, &mut steel);
        for (x, y) in droplets {
            assert_eq!(specular.at(x, y), 255, "droplet at ({x}, {y})");
        }
        let found = specular.pixels().iter().filter(|mark| **mark != 0).count();
        // At half the reference width: a clipped disc of 3 px and 2 px to each side.
        assert!(found <= droplets.len() * 11 * 11, "{found} px");
        let lenient = Settings {
            max_region_share: 1.0,
            ..Settings::default()
        };
        let mut all = Image::filled(0, 0, 0);
        SpecularityDetector::new(&lenient).detect(&image, None, &mut all, &mut steel);
        let joined = all.pixels().iter().filter(|mark| **mark != 0).count();
        assert!(
            joined as f32 > strict.max_region_share * (WIDTH * HEIGHT) as f32,
            "{joined} px are no large region"
        );
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
