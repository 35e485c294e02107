//! The detector: all steps in order, and halos joined to their cores.

use crate::image::blur::BlurScratch;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::Components;
use crate::image::distance::{UNITS_PER_PX, chamfer_distance};
use crate::image::specularity::background::Background;
use crate::image::specularity::cells::{CHUNK, Cells, Extremes};
use crate::image::specularity::classify::{Classifier, Rules};
use crate::image::specularity::settings::{CELLS_ACROSS, REFERENCE_WIDTH_PX, Settings};
use crate::image::specularity::steel::Steel;

/// In the darkest channel, all but clipped.
const NEARLY_CLIPPED_LEVEL: u8 = 240;
/// A region beyond `max_region_share` is specular only if more than this share of it is nearly clipped.
const MIN_CLIPPED_SHARE: f32 = 0.1;
/// A single core pixel may be noise.
const MIN_CORE_PX: u32 = 2;

/// Finds specularities and steel; owns its working memory.
#[derive(Debug)]
pub struct SpecularityDetector {
    settings: Settings,
    cells: Cells,
    extremes: Extremes,
    steel: Steel,
    background: Background,
    classifier: Classifier,
    cores: Mask,
    halos: Mask,
    distance: Image<u16>,
    components: Components,
    /// Per region: core pixels, nearly clipped pixels.
    counts: Vec<[u32; 2]>,
    scratch: BlurScratch,
}

impl SpecularityDetector {
    /// A detector with the given settings.
    pub fn new(settings: &Settings) -> Self {
        Self {
            settings: settings.clone(),
            cells: Cells::new(),
            extremes: Extremes::default(),
            steel: Steel::new(),
            background: Background::new(),
            classifier: Classifier::default(),
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
        for mask in [&mut *specular, &mut *instruments, &mut self.cores, &mut self.halos] {
            if mask.size() != image.size() {
                mask.resize(image.width(), image.height(), 0);
            }
        }
        specular.fill(0);
        let step = (image.width() / CELLS_ACROSS).max(1);
        if image.width() < 2 * step || image.height() < 2 * step || step > CHUNK {
            instruments.fill(0);
            return;
        }
        self.cells.average(image, field, step, &mut self.extremes);
        let brightness = brightness_of(&self.cells);
        self.steel.find(&self.settings, &self.cells, brightness, &mut self.scratch);
        self.background
            .find(&self.settings, &self.cells, &self.steel.mask, brightness, &mut self.scratch);
        let rules = Rules {
            bounds: &self.background.bounds,
            steel: &self.steel.mask,
            field,
            step,
            whiteness: self.settings.whiteness,
            core_whiteness: self.settings.core_whiteness,
        };
        self.classifier
            .classify(&self.extremes, &rules, &mut self.cores, &mut self.halos);
        self.join_halos_to_cores(specular);
        enlarge(&self.steel.mask, step, instruments);
    }

    /// Paint what touches a core into `specular`.
    fn join_halos_to_cores(&mut self, specular: &mut Mask) {
        let (width, height) = specular.size();
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
            let first = run.y as usize * width;
            let pixels = first + run.begin as usize..first + run.end as usize;
            let cores = self.cores.pixels()[pixels.clone()].iter().filter(|core| **core != 0);
            let clipped = self.extremes.least[pixels]
                .iter()
                .filter(|least| **least >= NEARLY_CLIPPED_LEVEL);
            let count = &mut self.counts[run.label as usize];
            *count = [count[0] + cores.count() as u32, count[1] + clipped.count() as u32];
        }
        let max_area = self.settings.max_region_share * (width * height) as f32;
        let counts = &self.counts;
        self.components.paint(specular, 255, |label, region| {
            let [cores, clipped] = counts[label];
            let plausible = region.area as f32 <= max_area || clipped as f32 > MIN_CLIPPED_SHARE * region.area as f32;
            cores >= MIN_CORE_PX && plausible
        });
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

/// Enlarge a mask by an integer factor; a remainder at the right and bottom repeats the last cell.
fn enlarge(small: &Mask, step: usize, out: &mut Mask) {
    let (small_width, small_height) = small.size();
    let (width, height) = out.size();
    for row in 0..small_height {
        let (first, end) = (row * step, if row + 1 == small_height { height } else { (row + 1) * step });
        let line = out.row_mut(first);
        for (cell, &value) in small.row(row).iter().enumerate() {
            let end = if cell + 1 == small_width { width } else { (cell + 1) * step };
            line[cell * step..end].fill(value);
        }
        for y in first + 1..end {
            out.pixels_mut().copy_within(first * width..(first + 1) * width, y * width);
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
