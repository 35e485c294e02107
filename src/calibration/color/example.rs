//! Pictures of a chart as a scope takes them, the truth being known: turned, seen in perspective, under a light that falls off, before a
//! dark, light or mottled ground, by a camera that mixes its channels, with noise. Tests measure against them.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::calibration::color::chart::{COLUMNS, Edition, PATCHES, ROWS, references};
use crate::calibration::homography;
use crate::image::buffer::{Image, Rgb8};
use crate::image::color::srgb_from_linear;

/// Half of a patch, in distances of patches.
const HALF_PATCH: f64 = 0.44;
/// How far the frame reaches beyond the outer patches' middles, in distances of patches.
const FRAME: f64 = 0.62;

/// How a camera sees colors.
#[derive(Clone, Copy, Debug)]
pub struct Tint {
    /// Linear light of the camera from that of the scene, row by row.
    pub mixing: Matrix3<f64>,
    /// Gain of each channel.
    pub gains: [f64; 3],
    /// The camera encodes as sRGB does, raised to this power.
    pub power: f64,
}

impl Tint {
    /// Sees colors as they are.
    pub const NONE: Self = Self {
        mixing: Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        gains: [1.0; 3],
        power: 1.0,
    };

    /// A wrong white balance, channels that mix, another tone curve.
    pub const WRONG: Self = Self {
        mixing: Matrix3::new(0.82, 0.13, 0.05, 0.09, 0.84, 0.07, 0.03, 0.14, 0.83),
        gains: [1.15, 1.0, 0.8],
        power: 1.12,
    };

    /// Encoded values 0 to 1 of linear light.
    pub fn seen(&self, linear: [f64; 3]) -> [f64; 3] {
        let mixed = self.mixing * Vector3::from(linear);
        std::array::from_fn(|c| {
            srgb_from_linear((mixed[c] * self.gains[c]).clamp(0.0, 1.0))
                .clamp(0.0, 1.0)
                .powf(self.power)
        })
    }
}

/// What lies around the chart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ground {
    /// Black cloth.
    Dark,
    /// White paper.
    Light,
    /// Blotches of all colors.
    Mottled,
}

/// How the picture is taken.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    /// Of pose, ground and noise.
    pub seed: u64,
    /// The camera.
    pub tint: Tint,
    /// Standard deviation of a pixel's noise, levels.
    pub noise_levels: f64,
    /// Share of the light that is lost at the corners of the picture.
    pub fall_off: f64,
    /// Light at the picture's middle; 1 brings the chart's white to the reference.
    pub exposure: f64,
    /// Glare on one of the patches.
    pub glare: bool,
}

impl Default for Setting {
    fn default() -> Self {
        Self {
            seed: 0,
            tint: Tint::WRONG,
            noise_levels: 2.0,
            fall_off: 0.45,
            exposure: 0.8,
            glare: true,
        }
    }
}

/// A picture of a chart.
#[derive(Clone, Debug)]
pub struct Example {
    /// The picture.
    pub image: Image<Rgb8>,
    /// The same picture by a camera without fault, under even light, without noise.
    pub truth: Image<Rgb8>,
    /// Where the chart is: (column, row, 1) to pixels.
    pub pixel_from_chart: Matrix3<f64>,
    /// What lies around it.
    pub ground: Ground,
}

/// Take a picture of `width` × `height` pixels.
pub fn taken(width: usize, height: usize, setting: &Setting) -> Example {
    let mut random = ChaCha8Rng::seed_from_u64(setting.seed);
    let ground = [Ground::Dark, Ground::Light, Ground::Mottled][random.random_range(0..3)];
    let pixel_from_chart = pose(width, height, &mut random);
    let chart = Painted::new(ground, setting.glare, &mut random);
    let back = pixel_from_chart.try_inverse().unwrap_or_else(Matrix3::identity);
    let lamp = [
        random.random_range(0.4..0.6) * width as f64,
        random.random_range(0.4..0.6) * height as f64,
    ];
    let reach = (width as f64).hypot(height as f64) / 2.0;
    let (mut image, mut truth) = (Image::filled(width, height, [0; 3]), Image::filled(width, height, [0; 3]));
    let level = |v: f64| (255.0 * v).round().clamp(0.0, 255.0) as u8;
    for y in 0..height {
        for x in 0..width {
            let mut sum = [0.0; 3];
            for (dx, dy) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let at = homography::mapped(&back, [x as f64 + dx, y as f64 + dy]).unwrap_or([-9.0; 2]);
                for (sum, v) in sum.iter_mut().zip(chart.linear(at)) {
                    *sum += v / 4.0;
                }
            }
            let far = (x as f64 - lamp[0]).hypot(y as f64 - lamp[1]) / reach;
            // Inverse square and the lens's fall-off, such that the corner loses the share asked for.
            let light = setting.exposure / (1.0 + far * far * setting.fall_off / (1.0 - setting.fall_off));
            truth.set(x, y, sum.map(|v| level(srgb_from_linear(v.clamp(0.0, 1.0)))));
            let seen = setting.tint.seen(sum.map(|v| v * light));
            let noisy = seen.map(|v| v + setting.noise_levels / 255.0 * random.sample::<f64, _>(StandardNormal));
            image.set(x, y, noisy.map(level));
        }
    }
    Example {
        image,
        truth,
        pixel_from_chart,
        ground,
    }
}

/// The chart somewhere before the camera, tilted by up to 40° and turned at will, whole in the picture.
fn pose(width: usize, height: usize, random: &mut ChaCha8Rng) -> Matrix3<f64> {
    let (w, h) = (width as f64, height as f64);
    let focal = 0.9 * w;
    loop {
        let turn = random.random_range(0.0..std::f64::consts::TAU);
        let tilt = random.random_range(0.0..0.7);
        let toward = random.random_range(0.0..std::f64::consts::TAU);
        let distance = random.random_range(6.0..16.0);
        let rotation = Rotation3::from_scaled_axis(tilt * Vector3::new(toward.cos(), toward.sin(), 0.0))
            * Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
        let middle = Vector3::new(random.random_range(-0.2..0.2), random.random_range(-0.2..0.2), 1.0) * distance;
        let r = rotation.matrix();
        let origin = middle - rotation * Vector3::new((COLUMNS - 1) as f64 / 2.0, (ROWS - 1) as f64 / 2.0, 0.0);
        let camera = Matrix3::new(focal, 0.0, w / 2.0, 0.0, focal, h / 2.0, 0.0, 0.0, 1.0);
        let map = camera * Matrix3::from_columns(&[r.column(0).into_owned(), r.column(1).into_owned(), origin]);
        let right = (COLUMNS - 1) as f64 + FRAME;
        let low = (ROWS - 1) as f64 + FRAME;
        let inside = [[-FRAME, -FRAME], [right, -FRAME], [right, low], [-FRAME, low]]
            .iter()
            .all(|at| {
                homography::mapped(&map, *at).is_some_and(|[x, y]| (8.0..w - 8.0).contains(&x) && (8.0..h - 8.0).contains(&y))
            });
        if inside {
            return map;
        }
    }
}

struct Painted {
    colors: [[f64; 3]; PATCHES],
    frame: [f64; 3],
    ground: Ground,
    blotches: Vec<([f64; 2], f64, [f64; 3])>,
    glare: Option<[f64; 2]>,
}

impl Painted {
    fn new(ground: Ground, glare: bool, random: &mut ChaCha8Rng) -> Self {
        let colors = references(Edition::Since2014).map(|reference| reference.linear);
        let blotches = (0..60)
            .map(|_| {
                let at = [random.random_range(-6.0..11.0), random.random_range(-6.0..9.0)];
                let color = std::array::from_fn(|_| random.random_range(0.02..0.6));
                (at, random.random_range(0.3..1.4), color)
            })
            .collect();
        let patch = random.random_range(0..PATCHES);
        let spot = [
            (patch % COLUMNS) as f64 + random.random_range(-0.2..0.2),
            (patch / COLUMNS) as f64 + random.random_range(-0.2..0.2),
        ];
        Self {
            colors,
            frame: [0.025; 3],
            ground,
            blotches,
            glare: glare.then_some(spot),
        }
    }

    fn linear(&self, [u, v]: [f64; 2]) -> [f64; 3] {
        let (column, row) = (u.round(), v.round());
        let on_chart = (0.0..COLUMNS as f64).contains(&column) && (0.0..ROWS as f64).contains(&row);
        let framed = u > -FRAME && v > -FRAME && u < (COLUMNS - 1) as f64 + FRAME && v < (ROWS - 1) as f64 + FRAME;
        let mut color = if on_chart && (u - column).abs() < HALF_PATCH && (v - row).abs() < HALF_PATCH {
            self.colors[row as usize * COLUMNS + column as usize]
        } else if framed {
            self.frame
        } else {
            match self.ground {
                Ground::Dark => [0.01, 0.012, 0.015],
                Ground::Light => [0.7, 0.68, 0.65],
                Ground::Mottled => (self.blotches.iter())
                    .find(|(at, size, _)| (at[0] - u).hypot(at[1] - v) < *size)
                    .map_or([0.2, 0.15, 0.1], |(.., color)| *color),
            }
        };
        if let Some([x, y]) = self.glare {
            let shine = 0.8 * (-((u - x).powi(2) + (v - y).powi(2)) / (2.0 * 0.1 * 0.1)).exp();
            color = color.map(|v| v + shine);
        }
        color
    }
}
