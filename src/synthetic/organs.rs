//! The organs: a gall bladder on its liver bed among fat, or a stretch of liver; shapes, tissues, vessels, wet film.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::synthetic::material::{MaterialGrid, MaterialMap, Texel};
use crate::synthetic::noise::Noise;
use crate::synthetic::relief::Relief;
use crate::synthetic::vessels::{Root, vessel_coverage};

/// Which organs lie before the scope.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anatomy {
    /// Gall bladder on its liver bed, fat beside it.
    GallBladder,
    /// Two liver lobes.
    Liver,
}

/// Half extents of the modelled field, mm: what a scope 100 mm away, 12° off, still sees.
const HALF_WIDTH_MM: f64 = 88.0;
const HALF_HEIGHT_MM: f64 = 66.0;
const RELIEF_PITCH_MM: f64 = 0.3;

/// Shape and material of the organs.
#[derive(Clone, Debug)]
pub struct Organs {
    /// Shape.
    pub relief: Relief,
    /// What it is made of.
    pub material: MaterialMap,
}

/// Shape and tissue at one place, with the coarser noises, which are sampled at the relief's pitch only.
#[derive(Clone, Copy, Debug)]
struct Place {
    z: f64,
    /// Share of gall bladder, 0–1.
    gall: f64,
    /// Share of fat, 0–1.
    fat: f64,
    /// Tissue noise of 11 mm and finer.
    coarse: f64,
    /// Tissue noise of 2.6 mm and finer.
    middle: f64,
    /// Wetness of the film.
    wet: f64,
}

const FLAT: Place = Place { z: 0.0, gall: 0.0, fat: 0.0, coarse: 0.0, middle: 0.0, wet: 1.0 };

/// Places on the relief's grid, read bilinearly.
struct Ground {
    grid: MaterialGrid,
    places: Vec<Place>,
}

impl Ground {
    fn new(shape: &Shape, tissue: Noise, film: Noise) -> Self {
        let grid = MaterialGrid::new(HALF_WIDTH_MM, HALF_HEIGHT_MM, RELIEF_PITCH_MM);
        let places = (0..grid.columns * grid.rows)
            .into_par_iter()
            .map(|i| {
                let (x, y) = grid.place(i % grid.columns, i / grid.columns);
                let mut place = shape.at(x, y);
                // Noise in space, not in the plane: steep walls are not smeared.
                let p = Vector3::new(x, y, place.z);
                place.coarse = tissue.octaves(p / 11.0, 3);
                place.middle = tissue.octaves(p / 2.6 + Vector3::repeat(31.0), 2);
                place.wet = (0.9 + 0.5 * film.at(p / 14.0 + Vector3::repeat(3.0))).clamp(0.35, 1.3);
                place
            })
            .collect();
        Self { grid, places }
    }

    fn at(&self, x: f64, y: f64) -> Place {
        let u = ((x - self.grid.origin[0]) / self.grid.pitch_mm).clamp(0.0, (self.grid.columns - 2) as f64);
        let v = ((y - self.grid.origin[1]) / self.grid.pitch_mm).clamp(0.0, (self.grid.rows - 2) as f64);
        let (i, j) = (u as usize, v as usize);
        let (fu, fv) = (u - i as f64, v - j as f64);
        let at = j * self.grid.columns + i;
        let corners = [at, at + 1, at + self.grid.columns, at + self.grid.columns + 1].map(|k| &self.places[k]);
        let weights = [(1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv];
        let mut mean = Place { wet: 0.0, ..FLAT };
        for (place, weight) in corners.into_iter().zip(weights) {
            mean.z += place.z * weight;
            mean.gall += place.gall * weight;
            mean.fat += place.fat * weight;
            mean.coarse += place.coarse * weight;
            mean.middle += place.middle * weight;
            mean.wet += place.wet * weight;
        }
        mean
    }
}

impl Organs {
    /// Grow the organs of `seed`; `texel_mm` is the finest detail of the texture.
    pub fn new(anatomy: Anatomy, seed: u64, texel_mm: f64) -> Self {
        let shape = Shape { anatomy, noise: Noise::new(seed ^ 0x5157) };
        let (tissue, film) = (Noise::new(seed ^ 0x7155), Noise::new(seed ^ 0xF11F));
        let relief =
            Relief::from_function(HALF_WIDTH_MM, HALF_HEIGHT_MM, RELIEF_PITCH_MM, |x, y| shape.at(x, y).z);
        let ground = Ground::new(&shape, tissue, film);
        let grid = MaterialGrid::new(HALF_WIDTH_MM, HALF_HEIGHT_MM, texel_mm);
        let vessels = vessel_coverage(&grid, roots(anatomy), seed ^ 0x7E55);
        let paint = Paint { ground, tissue, film };
        let ripples = paint.film_heights(&grid, &vessels);
        let material = MaterialMap::from_texels(HALF_WIDTH_MM, HALF_HEIGHT_MM, texel_mm, |grid, column, row| {
            let (x, y) = grid.place(column, row);
            let at = row * grid.columns + column;
            let mut texel = paint.texel(x, y, f64::from(vessels[at]));
            let height = |c: usize, r: usize| ripples[r.min(grid.rows - 1) * grid.columns + c.min(grid.columns - 1)];
            let run = (2.0 * grid.pitch_mm) as f32;
            texel.film = [
                (height(column + 1, row) - height(column.saturating_sub(1), row)) / run,
                (height(column, row + 1) - height(column, row.saturating_sub(1))) / run,
            ];
            texel
        });
        Self { relief, material }
    }
}

fn roots(anatomy: Anatomy) -> &'static [Root] {
    const GALL: &[Root] = &[
        Root { at: [33.0, 18.0], heading: 3.5, radius_mm: 0.42, length_mm: 11.0 },
        Root { at: [26.0, 8.0], heading: 3.3, radius_mm: 0.38, length_mm: 10.0 },
        Root { at: [10.0, 17.0], heading: 3.9, radius_mm: 0.33, length_mm: 8.0 },
        Root { at: [2.0, -6.0], heading: 2.4, radius_mm: 0.30, length_mm: 7.0 },
        Root { at: [-12.0, -17.0], heading: 2.2, radius_mm: 0.33, length_mm: 8.0 },
        Root { at: [-36.0, 2.0], heading: 5.6, radius_mm: 0.30, length_mm: 7.0 },
        Root { at: [-16.0, 10.0], heading: 4.4, radius_mm: 0.27, length_mm: 6.0 },
        Root { at: [14.0, 2.0], heading: 1.4, radius_mm: 0.25, length_mm: 6.0 },
        Root { at: [45.0, -40.0], heading: 2.4, radius_mm: 0.6, length_mm: 14.0 },
        Root { at: [15.0, -48.0], heading: 1.2, radius_mm: 0.5, length_mm: 12.0 },
        Root { at: [-60.0, 45.0], heading: 5.6, radius_mm: 0.5, length_mm: 15.0 },
        Root { at: [10.0, 60.0], heading: 4.4, radius_mm: 0.5, length_mm: 15.0 },
        Root { at: [-55.0, -45.0], heading: 0.7, radius_mm: 0.45, length_mm: 13.0 },
    ];
    const LIVER: &[Root] = &[
        Root { at: [-60.0, 20.0], heading: 0.1, radius_mm: 0.6, length_mm: 16.0 },
        Root { at: [50.0, -40.0], heading: 2.3, radius_mm: 0.55, length_mm: 15.0 },
        Root { at: [10.0, 50.0], heading: 4.5, radius_mm: 0.5, length_mm: 14.0 },
        Root { at: [-20.0, -50.0], heading: 1.4, radius_mm: 0.5, length_mm: 14.0 },
        Root { at: [60.0, 25.0], heading: 3.3, radius_mm: 0.45, length_mm: 12.0 },
    ];
    match anatomy {
        Anatomy::GallBladder => GALL,
        Anatomy::Liver => LIVER,
    }
}

struct Shape {
    anatomy: Anatomy,
    noise: Noise,
}

impl Shape {
    fn at(&self, x: f64, y: f64) -> Place {
        let flat = Vector3::new(x, y, 0.0);
        let swell = self.noise.octaves(flat / 42.0, 3) * 5.0 + self.noise.octaves(flat / 9.0 + Vector3::repeat(7.3), 3) * 0.5;
        match self.anatomy {
            Anatomy::GallBladder => {
                // The bed falls away towards the lower right, where the fat of the omentum lies.
                let edge = smooth_step((-y - 0.55 * x - 16.0 + 6.0 * self.noise.at(flat / 16.0)) / 9.0);
                let liver = swell - 0.0016 * (x * x + y * y) - 13.0 * edge;
                let lobules = 1.7 * (1.0 - (self.noise.at(flat / 6.5).powi(2) + 0.02).sqrt() * 2.2) + self.noise.octaves(flat / 3.1, 2) * 0.35;
                let fat = -7.5 + 0.6 * swell + lobules;
                let bed = smooth_max(liver, fat, 1.6);
                let gall_z = self.gall_bladder(x, y);
                let z = smooth_max(bed, gall_z, 1.2);
                Place { z, gall: smooth_step((gall_z - bed + 0.25) / 1.1), fat: smooth_step((fat - liver) / 1.4 + 0.5), ..FLAT }
            }
            Anatomy::Liver => {
                // Two lobes with a fissure between them.
                let along = x * 0.42 + y * 0.91 + 4.0 * self.noise.at(flat / 25.0) - 6.0;
                let left = 4.0 - 0.010 * (along - 26.0) * (along - 26.0);
                let right = 6.0 - 0.007 * (along + 30.0) * (along + 30.0);
                Place { z: smooth_max(left, right, 1.5).max(-25.0) + swell, ..FLAT }
            }
        }
    }

    /// Height of the gall bladder's wall, mm.
    fn gall_bladder(&self, x: f64, y: f64) -> f64 {
        let bulge = self.noise.octaves(Vector3::new(x / 11.0, y / 11.0, 3.7), 2);
        // A pear along a bent axis: fundus lower left, neck upper right.
        let (from, to) = ([-27.0, -11.0], [31.0, 15.0]);
        let (ax, ay) = (to[0] - from[0], to[1] - from[1]);
        let length = f64::hypot(ax, ay);
        let s = (((x - from[0]) * ax + (y - from[1]) * ay) / (length * length)).clamp(0.0, 1.0);
        let bow = 4.5 * (std::f64::consts::PI * s).sin();
        let (cx, cy) = (from[0] + ax * s - ay / length * bow, from[1] + ay * s + ax / length * bow);
        let radius = 15.5 - 9.5 * s.powf(1.4) + 1.3 * (7.5 * s).sin() * (s - 0.25) + 0.6 * bulge;
        let q = f64::hypot(x - cx, y - cy) / radius;
        let centre = -0.36 * radius - 0.0013 * (cx * cx + cy * cy);
        // An ellipsoid's wall down to where it would hang over, then on at that slope.
        const STEEPEST_Q: f64 = 0.93;
        let rim = (1.0 - STEEPEST_Q * STEEPEST_Q).sqrt();
        let wall = if q < STEEPEST_Q { (1.0 - q * q).sqrt() } else { rim - (q - STEEPEST_Q) * STEEPEST_Q / rim };
        centre + 0.95 * radius * wall + 0.25 * bulge
    }
}

struct Paint {
    ground: Ground,
    tissue: Noise,
    film: Noise,
}

impl Paint {
    fn texel(&self, x: f64, y: f64, vessel: f64) -> Texel {
        let place = self.ground.at(x, y);
        let p = Vector3::new(x, y, place.z);
        let (coarse, middle) = (place.coarse, place.middle);
        let fine = self.tissue.octaves(p / 0.85 + Vector3::repeat(57.0), 3);
        let speck = (self.tissue.at(p / 0.55 + Vector3::repeat(83.0)).abs() - 0.42).max(0.0) * 2.2;

        // Liver: brown-red, with the fine net of its lobules.
        let lobules = 1.0 - (self.tissue.at(p / 1.15 + Vector3::repeat(11.0)).abs() * 2.6).min(1.0);
        let tone = 1.0 + 0.30 * coarse + 0.16 * middle + 0.17 * fine;
        let mut colour = scaled(LIVER, tone);
        colour = mixed(colour, LIVER_NET, 0.16 * lobules + 0.14 * speck);

        // Fat: yellow lobules, redder between them.
        let fat = mixed(scaled(FAT, 1.0 + 0.18 * middle + 0.14 * fine), FAT_RED, (0.35 - 0.7 * coarse + 0.3 * middle).clamp(0.0, 0.8));
        colour = mixed(colour, fat, place.fat);

        // Gall bladder: bile shimmers green and yellow through a pale, veined wall.
        let bile = smooth_step(0.5 + 0.9 * coarse + 0.012 * x);
        let wall = mixed(mixed(GALL_PALE, GALL_GREEN, bile), GALL_PINK, (0.30 + 0.55 * middle + 0.2 * coarse).clamp(0.0, 0.85));
        colour = mixed(colour, scaled(wall, 1.0 + 0.08 * middle + 0.13 * fine - 0.12 * speck), place.gall);

        // Capillaries everywhere, faint; vessels over them.
        let net = (1.0 - self.tissue.octaves(p / 2.1 + Vector3::repeat(23.0), 2).abs() * 9.0).max(0.0);
        colour = mixed(colour, CAPILLARY, 0.20 * net * (0.35 + 0.65 * place.gall.max(place.fat)));
        let depth = if place.gall > 0.5 || place.fat > 0.5 { 0.72 } else { 0.5 };
        colour = mixed(colour, VESSEL, depth * vessel);

        Texel { albedo: colour.map(|c| c.clamp(0.003, 0.9) as f32), gloss: place.wet as f32, film: [0.0; 2] }
    }

    /// Height of the film above the tissue, mm.
    fn film_heights(&self, grid: &MaterialGrid, vessels: &[f32]) -> Vec<f32> {
        (0..grid.columns * grid.rows)
            .into_par_iter()
            .map(|i| {
                let (x, y) = grid.place(i % grid.columns, i / grid.columns);
                let p = Vector3::new(x, y, 0.0);
                let place = self.ground.at(x, y);
                // Drops and puddles where the liver is rough; the gall bladder's wall is smoother.
                let rough = 1.0 - 0.45 * place.gall;
                let height = rough
                    * (0.60 * self.film.at(p / 5.6)
                        + 0.150 * self.film.at(p / 1.9 + Vector3::repeat(13.0))
                        + 0.026 * self.film.at(p / 0.8 + Vector3::repeat(29.0)))
                    + 0.02 * f64::from(vessels[i]);
                height as f32
            })
            .collect()
    }
}

/// Linear albedos.
const LIVER: [f64; 3] = [0.118, 0.026, 0.021];
const LIVER_NET: [f64; 3] = [0.25, 0.085, 0.068];
const FAT: [f64; 3] = [0.66, 0.40, 0.135];
const FAT_RED: [f64; 3] = [0.50, 0.17, 0.085];
const GALL_PALE: [f64; 3] = [0.55, 0.385, 0.22];
const GALL_GREEN: [f64; 3] = [0.37, 0.315, 0.145];
const GALL_PINK: [f64; 3] = [0.53, 0.275, 0.20];
const CAPILLARY: [f64; 3] = [0.33, 0.06, 0.055];
const VESSEL: [f64; 3] = [0.145, 0.019, 0.026];

fn scaled(colour: [f64; 3], factor: f64) -> [f64; 3] {
    colour.map(|c| c * factor.max(0.05))
}

fn mixed(a: [f64; 3], b: [f64; 3], share: f64) -> [f64; 3] {
    std::array::from_fn(|k| a[k] + (b[k] - a[k]) * share.clamp(0.0, 1.0))
}

fn smooth_step(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The larger of two, with the crease rounded over `width`.
fn smooth_max(a: f64, b: f64, width: f64) -> f64 {
    let share = (0.5 + 0.5 * (a - b) / width).clamp(0.0, 1.0);
    b + (a - b) * share + width * share * (1.0 - share)
}
