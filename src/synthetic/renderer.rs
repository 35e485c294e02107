//! From the scene to pictures, each with its truth.
//!
//! A frame is rendered twice: through the lens as the camera sees it (`video`), and through the pinhole with the same camera
//! matrix as the undistorted picture shall be (the truth). Rays have z = 1 in the camera's space, so that the parameter along a
//! ray *is* the depth. Depths are found robustly on every fourth pixel and by Newton's method from the interpolated guess in
//! between, wherever the surface is smooth there.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::color::luma;
use crate::synthetic::airborne::{AIRLIGHT, Smoke, Streak, streaks};
use crate::synthetic::instrument::{InstrumentHit, Rod, grasper, instrument_hit, unshaded};
use crate::synthetic::light::{Facing, Lamp, Radiance, steel_radiance, tissue_radiance};
use crate::synthetic::noise::hash_u64;
use crate::synthetic::relief::ReliefHit;
use crate::synthetic::scene::World3d;
use crate::synthetic::sensor::Sensor;

/// Excess over the diffuse picture that counts as specularity, gray levels.
pub const SPECULAR_LEVELS: u8 = 12;

/// Distance of the pixels whose depth is found without a guess.
const NODE_PX: usize = 4;

/// What one frame is a picture of.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// Number of the frame.
    pub frame: u64,
    /// When, on the recording's clock.
    pub seconds: f64,
    /// From where.
    pub world_from_camera: Transform<World, Camera>,
    /// Factor on the light.
    pub exposure: f64,
    /// Seed of the recording's sensor noise and particles.
    pub noise_key: u64,
    /// What is in the way.
    pub obstacles: Obstacles,
}

/// What comes between scope and tissue.
#[derive(Clone, Copy, Debug, Default)]
pub struct Obstacles {
    /// A grasper crosses the field.
    pub instrument: bool,
    /// Particles in a frame, on average.
    pub particles_per_frame: f64,
    /// A plume of smoke.
    pub smoke: Option<Smoke>,
}

/// One frame and its truth.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// As the camera delivers it.
    pub video: Image<Rgb8>,
    /// The same without particles, and 255 where a particle covers more than a tenth; where there are particles.
    pub without_particles: Option<(Image<Rgb8>, Mask)>,
    /// The truth, if it was asked for.
    pub truth: Option<Truth>,
}

/// What is exactly so, in the undistorted geometry.
#[derive(Clone, Debug)]
pub struct Truth {
    /// The picture without mirror reflections and noise.
    pub diffuse: Image<Rgb8>,
    /// Levels (luma) by which the full picture is brighter than the diffuse one.
    pub strength: Mask,
    /// 255 where that is more than [`SPECULAR_LEVELS`].
    pub specular: Mask,
    /// 255 where an instrument is seen.
    pub instrument: Mask,
    /// 255 where a particle is seen.
    pub particles: Mask,
    /// Depth along the optical axis, hundredths of a mm; 0 outside the field.
    pub depth: Image<u16>,
}

/// Rays through the pixels of a camera: (x, y) at z = 1; NaN outside the image field.
#[derive(Clone, Debug)]
struct Rays {
    slopes: Vec<[f64; 2]>,
    /// How much of the pixel's light gets through the field stop, 0–1.
    field: Vec<f32>,
    /// Where the ray lands behind the lens, px.
    landings: Vec<[f32; 2]>,
}

/// Renders shots of one world through one camera.
#[derive(Debug)]
pub struct Renderer {
    world: World3d,
    camera: CameraModel,
    sensor: Sensor,
    lens_rays: Rays,
    pinhole_rays: Rays,
}

/// The scene from one place at one time.
struct View<'a> {
    world: &'a World3d,
    /// Scene from camera.
    rotation: Matrix3<f64>,
    eye: Vector3<f64>,
    /// Organs at rest from camera.
    rest_rotation: Matrix3<f64>,
    rest_eye: Vector3<f64>,
    rest_linear: Matrix3<f64>,
    lamps: Vec<Lamp>,
    rods: Vec<Rod>,
}

/// Body and coat of what one ray meets, and whether that is the instrument.
struct Seen {
    light: Radiance,
    depth: f64,
    is_instrument: bool,
}

impl Renderer {
    /// `field_radius` is that of the image field in widths of the picture; `None` = the whole picture.
    pub fn new(world: World3d, camera: CameraModel, field_radius: Option<f64>, noise: f64) -> Self {
        let radius_px = field_radius.map(|share| share * camera.width as f64);
        let lens_rays = Rays::new(
            &camera,
            |pixel| camera.unproject(pixel).map(|d| (d.coords.x, d.coords.y, pixel)),
            radius_px,
        );
        let pinhole = camera.pinhole();
        let seen_through_lens = |pixel: Pixel| {
            let ray = pinhole.unproject(pixel)?;
            let landing = camera.project(Point::from_coords(ray.coords))?;
            camera
                .contains(landing, -0.5)
                .then_some((ray.coords.x, ray.coords.y, landing))
        };
        let pinhole_rays = Rays::new(&camera, seen_through_lens, radius_px);
        Self {
            world,
            camera,
            sensor: Sensor::new(noise),
            lens_rays,
            pinhole_rays,
        }
    }

    /// The world that is rendered.
    pub fn world(&self) -> &World3d {
        &self.world
    }

    /// The camera with its lens.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// The electronics.
    pub fn sensor(&self) -> &Sensor {
        &self.sensor
    }

    /// 255 where the undistorted picture shows something.
    pub fn field_mask(&self) -> Mask {
        let mut mask = Mask::filled(self.camera.width, self.camera.height, 0);
        for (pixel, &share) in mask.pixels_mut().iter_mut().zip(&self.pinhole_rays.field) {
            *pixel = if share > 0.5 { 255 } else { 0 };
        }
        mask
    }

    /// Where the ray through a pixel of the video (counted row by row) goes, and how much of it the field stop lets through.
    pub fn lens_ray(&self, pixel: usize) -> Option<([f64; 2], f32)> {
        let slope = *self.lens_rays.slopes.get(pixel)?;
        (!slope[0].is_nan()).then(|| (slope, self.lens_rays.field[pixel]))
    }

    /// True if `pixel` of the video lies well inside the image field.
    pub fn in_field(&self, pixel: Pixel) -> bool {
        const MARGIN_PX: f64 = 4.0;
        if !self.camera.contains(pixel, MARGIN_PX) {
            return false;
        }
        let reach = [-MARGIN_PX, MARGIN_PX];
        reach.iter().all(|dx| {
            reach.iter().all(|dy| {
                let at = (pixel.y + dy).round() as usize * self.camera.width + (pixel.x + dx).round() as usize;
                self.lens_rays.field.get(at).is_some_and(|&share| share > 0.99)
            })
        })
    }

    /// Samples of the light (linear luma) of a shot at exposure 1, for the exposure loop.
    pub fn metered(&self, seconds: f64, world_from_camera: Transform<World, Camera>) -> Vec<f32> {
        let view = View::new(&self.world, seconds, world_from_camera, false);
        let step = (self.camera.width / 24).max(1);
        let mut samples = Vec::new();
        for y in (step / 2..self.camera.height).step_by(step) {
            for x in (step / 2..self.camera.width).step_by(step) {
                let at = y * self.camera.width + x;
                if self.lens_rays.field[at] < 0.5 {
                    continue;
                }
                let slope = self.lens_rays.slopes[at];
                if let Some(hit) = view.first_hit(slope) {
                    let light = view.radiance(slope, &hit);
                    samples.push(luma(std::array::from_fn(|k| light.diffuse[k] + light.specular[k])));
                }
            }
        }
        samples
    }

    /// Render a shot, with its truth or without.
    pub fn render(&self, shot: &Shot, with_truth: bool) -> Rendered {
        let size = (self.camera.width, self.camera.height);
        let view = View::new(&self.world, shot.seconds, shot.world_from_camera, shot.obstacles.instrument);
        let mut light = self.light(&view, shot);
        let particles = streaks(shot.noise_key, shot.frame, shot.obstacles.particles_per_frame, size);
        let mut without_particles = None;
        if shot.obstacles.particles_per_frame > 0.0 {
            let clean = self.developed(&light, shot);
            without_particles = Some((clean, self.drawn(&mut light, &particles)));
        }
        let video = self.developed(&light, shot);
        let truth = with_truth.then(|| {
            let mut truth = self.truth(&view, shot);
            if let Some((_, mask)) = &without_particles {
                truth.particles = self.undistorted_mask(mask);
            }
            truth
        });
        Rendered {
            video,
            without_particles,
            truth,
        }
    }

    /// Light on the sensor, after exposure, through lens and smoke.
    fn light(&self, view: &View, shot: &Shot) -> Vec<[f32; 3]> {
        let width = self.camera.width;
        let hits = self.hits(view, &self.lens_rays);
        let exposure = shot.exposure as f32;
        let mut light = vec![[0.0_f32; 3]; hits.len()];
        for (i, pixel) in light.iter_mut().enumerate() {
            if let Some(seen) = view.seen(self.lens_rays.slopes[i], &hits[i]) {
                let through = exposure * self.lens_rays.field[i];
                *pixel = std::array::from_fn(|k| (seen.light.diffuse[k] + seen.light.specular[k]) * through);
            }
        }
        soften(&mut light, width);
        if let Some(smoke) = &shot.obstacles.smoke {
            self.veil(&mut light, smoke, shot.seconds);
        }
        light
    }

    /// Smoke over the picture; its density is smooth, so it is computed on a coarse grid and interpolated.
    fn veil(&self, light: &mut [[f32; 3]], smoke: &Smoke, seconds: f64) {
        const GRID_PX: usize = 8;
        let (width, height) = (self.camera.width, self.camera.height);
        let (columns, rows) = (width / GRID_PX + 2, height / GRID_PX + 2);
        let across = width as f64;
        let grid: Vec<f32> = (0..columns * rows)
            .map(|i| {
                let x = ((i % columns * GRID_PX) as f64 - 0.5 * across) / across;
                let y = ((i / columns * GRID_PX) as f64 - 0.5 * height as f64) / across;
                smoke.transmission(seconds, x, y) as f32
            })
            .collect();
        for (at, pixel) in light.iter_mut().enumerate() {
            let (x, y) = (at % width, at / width);
            let corner = y / GRID_PX * columns + x / GRID_PX;
            let (u, v) = ((x % GRID_PX) as f32 / GRID_PX as f32, (y % GRID_PX) as f32 / GRID_PX as f32);
            let above = grid[corner] * (1.0 - u) + grid[corner + 1] * u;
            let below = grid[corner + columns] * (1.0 - u) + grid[corner + columns + 1] * u;
            let transmission = above * (1.0 - v) + below * v;
            let through = self.lens_rays.field[at];
            *pixel = std::array::from_fn(|k| pixel[k] * transmission + AIRLIGHT[k] * through * (1.0 - transmission));
        }
    }

    /// Draw particles; 255 where they cover more than a tenth.
    fn drawn(&self, light: &mut [[f32; 3]], particles: &[Streak]) -> Mask {
        let (width, height) = (self.camera.width, self.camera.height);
        let mut mask = Mask::filled(width, height, 0);
        for streak in particles {
            let [columns, rows] = streak.extent((width, height));
            for y in rows {
                for x in columns.clone() {
                    let at = y * width + x;
                    let cover = streak.cover_at(x as f64, y as f64);
                    if cover > 0.0 && self.lens_rays.field[at] > 0.5 {
                        light[at] = light[at].map(|v| v + (streak.light - v) * cover);
                        if cover > 0.1 {
                            mask.set(x, y, 255);
                        }
                    }
                }
            }
        }
        mask
    }

    /// From light to pixels, with the noise of the frame.
    fn developed(&self, light: &[[f32; 3]], shot: &Shot) -> Image<Rgb8> {
        let mut video = Image::filled(self.camera.width, self.camera.height, [0_u8; 3]);
        let key = hash_u64(shot.noise_key ^ hash_u64(shot.frame));
        for (i, (pixel, light)) in video.pixels_mut().iter_mut().zip(light).enumerate() {
            *pixel = self.sensor.noisy(*light, key.wrapping_add(i as u64));
        }
        video
    }

    /// A mask of the video in the truth's geometry.
    fn undistorted_mask(&self, mask: &Mask) -> Mask {
        let mut undistorted = Mask::filled(mask.width(), mask.height(), 0);
        for (pixel, landing) in undistorted.pixels_mut().iter_mut().zip(&self.pinhole_rays.landings) {
            if landing[0].is_finite() {
                let (x, y) = (landing[0].round().max(0.0) as usize, landing[1].round().max(0.0) as usize);
                *pixel = mask.at(x.min(mask.width() - 1), y.min(mask.height() - 1));
            }
        }
        undistorted
    }

    fn truth(&self, view: &View, shot: &Shot) -> Truth {
        let (width, height) = (self.camera.width, self.camera.height);
        let hits = self.hits(view, &self.pinhole_rays);
        let exposure = shot.exposure as f32;
        let mut body = vec![[0.0_f32; 3]; width * height];
        let mut full = body.clone();
        let mut depth = Image::filled(width, height, 0_u16);
        let mut instrument = Mask::filled(width, height, 0);
        for i in 0..width * height {
            let Some(seen) = view.seen(self.pinhole_rays.slopes[i], &hits[i]) else {
                continue;
            };
            depth.pixels_mut()[i] = (seen.depth * 100.0).round().clamp(0.0, 65535.0) as u16;
            let through = exposure * self.pinhole_rays.field[i];
            full[i] = std::array::from_fn(|k| (seen.light.diffuse[k] + seen.light.specular[k]) * through);
            // Steel is all reflection: its picture without reflections would be no picture of it.
            if seen.is_instrument {
                instrument.pixels_mut()[i] = 255;
                body[i] = full[i];
            } else {
                body[i] = seen.light.diffuse.map(|v| v * through);
            }
        }
        soften(&mut body, width);
        soften(&mut full, width);
        let mut diffuse = Image::filled(width, height, [0_u8; 3]);
        let mut strength = Mask::filled(width, height, 0);
        let mut specular = Mask::filled(width, height, 0);
        for i in 0..width * height {
            diffuse.pixels_mut()[i] = self.sensor.clean(body[i]);
            if instrument.pixels()[i] == 0 {
                let levels = |light: [f32; 3]| luma(light.map(|v| self.sensor.level(v)));
                let excess = (levels(full[i]) - levels(body[i])).round().clamp(0.0, 255.0) as u8;
                strength.pixels_mut()[i] = excess;
                specular.pixels_mut()[i] = if excess > SPECULAR_LEVELS { 255 } else { 0 };
            }
        }
        Truth {
            diffuse,
            strength,
            specular,
            instrument,
            particles: Mask::filled(width, height, 0),
            depth,
        }
    }

    /// Where every ray meets the tissue; t is NaN where it does not.
    fn hits(&self, view: &View, rays: &Rays) -> Vec<ReliefHit> {
        let (width, height) = (self.camera.width, self.camera.height);
        let node_columns = (width - 1).div_ceil(NODE_PX) + 1;
        let node_rows = (height - 1).div_ceil(NODE_PX) + 1;
        let pixel_of = |column: usize, row: usize| (row * NODE_PX).min(height - 1) * width + (column * NODE_PX).min(width - 1);
        let mut hits = vec![MISS; width * height];
        let mut nodes = Vec::with_capacity(node_columns * node_rows);
        for row in 0..node_rows {
            for column in 0..node_columns {
                let at = pixel_of(column, row);
                hits[at] = view.first_hit(rays.slopes[at]).unwrap_or(MISS);
                nodes.push(hits[at].t);
            }
        }
        for row in 0..node_rows - 1 {
            for column in 0..node_columns - 1 {
                let corner = row * node_columns + column;
                let corners = [
                    nodes[corner],
                    nodes[corner + 1],
                    nodes[corner + node_columns],
                    nodes[corner + node_columns + 1],
                ];
                let highest = corners.iter().fold(f64::MIN, |a, &b| a.max(b));
                let lowest = corners.iter().fold(f64::MAX, |a, &b| a.min(b));
                let smooth = corners.iter().all(|c| c.is_finite()) && highest - lowest < MAX_SPREAD_MM;
                let (x0, y0) = (column * NODE_PX, row * NODE_PX);
                let (x1, y1) = ((x0 + NODE_PX).min(width - 1), (y0 + NODE_PX).min(height - 1));
                for y in y0..=y1 {
                    let v = (y - y0) as f64 / (y1 - y0).max(1) as f64;
                    let left = corners[0] * (1.0 - v) + corners[2] * v;
                    let right = corners[1] * (1.0 - v) + corners[3] * v;
                    for x in x0..=x1 {
                        let at = y * width + x;
                        let slope = rays.slopes[at];
                        if slope[0].is_nan() || hits[at].t.is_finite() {
                            continue;
                        }
                        let guess = left + (right - left) * ((x - x0) as f64 / (x1 - x0).max(1) as f64);
                        let near = if smooth { view.polished_hit(slope, guess) } else { None };
                        hits[at] = near
                            .filter(|hit| (hit.t - guess).abs() < MAX_POLISH_MM)
                            .or_else(|| view.first_hit(slope))
                            .unwrap_or(MISS);
                    }
                }
            }
        }
        hits
    }
}

const MISS: ReliefHit = ReliefHit {
    t: f64::NAN,
    dx: 0.0,
    dy: 0.0,
};

/// More than this between the corners of a block is an edge, or nearly one, mm.
const MAX_SPREAD_MM: f64 = 2.0;
/// Newton's method may move a guess this far, mm.
const MAX_POLISH_MM: f64 = 0.5;

impl Rays {
    /// `ray_of` gives x, y at z = 1 and where the ray lands behind the lens.
    fn new(camera: &CameraModel, ray_of: impl Fn(Pixel) -> Option<(f64, f64, Pixel)> + Sync, radius_px: Option<f64>) -> Self {
        let centre = Pixel {
            x: 0.5 * camera.width as f64 - 0.5,
            y: 0.5 * camera.height as f64 - 0.5,
        };
        let rays: Vec<([f64; 2], f32, [f32; 2])> = (0..camera.width * camera.height)
            .into_par_iter()
            .map(|i| {
                let pixel = Pixel {
                    x: (i % camera.width) as f64,
                    y: (i / camera.width) as f64,
                };
                let Some((x, y, landing)) = ray_of(pixel) else {
                    return ([f64::NAN; 2], 0.0, [f32::NAN; 2]);
                };
                // The field stop is a little out of focus.
                let share = radius_px.map_or(1.0, |radius| {
                    let beyond = (landing.x - centre.x).hypot(landing.y - centre.y) - radius;
                    (0.5 - beyond / 3.0).clamp(0.0, 1.0)
                });
                let landing = [landing.x as f32, landing.y as f32];
                if share > 0.0 {
                    ([x, y], share as f32, landing)
                } else {
                    ([f64::NAN; 2], 0.0, [f32::NAN; 2])
                }
            })
            .collect();
        Self {
            slopes: rays.iter().map(|r| r.0).collect(),
            field: rays.iter().map(|r| r.1).collect(),
            landings: rays.iter().map(|r| r.2).collect(),
        }
    }
}

impl<'a> View<'a> {
    fn new(world: &'a World3d, seconds: f64, world_from_camera: Transform<World, Camera>, with_instrument: bool) -> Self {
        let scene_from_camera = world.world_from_organs.inverse() * world_from_camera;
        let rotation = scene_from_camera.rotation().to_rotation_matrix().into_inner();
        let eye = scene_from_camera.translation();
        let rest = world.motion.rest_from_moved(seconds);
        let lamps = world
            .lamps
            .iter()
            .map(|lamp| Lamp {
                at: eye + rotation * lamp.at,
                axis: rotation * lamp.axis,
                ..*lamp
            })
            .collect();
        Self {
            world,
            rotation,
            eye,
            rest_rotation: rest.linear * rotation,
            rest_eye: rest.linear * eye + rest.offset,
            rest_linear: rest.linear,
            lamps,
            rods: if with_instrument {
                grasper(seconds).to_vec()
            } else {
                Vec::new()
            },
        }
    }

    /// What the ray meets first; `tissue` is where it meets the tissue, t NaN where it does not.
    fn seen(&self, slope: [f64; 2], tissue: &ReliefHit) -> Option<Seen> {
        if slope[0].is_nan() {
            return None;
        }
        let direction = self.rotation * Vector3::new(slope[0], slope[1], 1.0);
        if !self.rods.is_empty()
            && let Some(hit) = instrument_hit(&self.rods, self.eye, direction)
            && (tissue.t.is_nan() || hit.t < tissue.t)
        {
            return Some(Seen {
                light: self.steel(direction, &hit),
                depth: hit.t,
                is_instrument: true,
            });
        }
        tissue.t.is_finite().then(|| Seen {
            light: self.radiance(slope, tissue),
            depth: tissue.t,
            is_instrument: false,
        })
    }

    fn steel(&self, direction: Vector3<f64>, hit: &InstrumentHit) -> Radiance {
        let facing = Facing {
            at: self.eye + direction * hit.t,
            normal: hit.normal,
            film_normal: hit.normal,
            to_camera: -direction.normalize(),
        };
        let light = steel_radiance(&facing, &self.lamps);
        let finish = hit.finish as f32;
        Radiance {
            diffuse: light.diffuse.map(|v| v * finish),
            specular: light.specular.map(|v| v * finish),
        }
    }

    fn first_hit(&self, slope: [f64; 2]) -> Option<ReliefHit> {
        if slope[0].is_nan() {
            return None;
        }
        self.world
            .organs
            .relief
            .first_hit(self.rest_eye, self.rest_rotation * Vector3::new(slope[0], slope[1], 1.0))
    }

    fn polished_hit(&self, slope: [f64; 2], guess: f64) -> Option<ReliefHit> {
        let direction = self.rest_rotation * Vector3::new(slope[0], slope[1], 1.0);
        self.world.organs.relief.polished_hit(self.rest_eye, direction, guess)
    }

    fn radiance(&self, slope: [f64; 2], hit: &ReliefHit) -> Radiance {
        let ray = Vector3::new(slope[0], slope[1], 1.0);
        let direction = self.rotation * ray;
        let rest = self.rest_eye + self.rest_rotation * ray * hit.t;
        let texel = self.world.organs.material.at(rest.x, rest.y);
        let film = texel.film.map(f64::from);
        // Normals go with the transposed of the map to rest.
        let normal = self.rest_linear.tr_mul(&Vector3::new(-hit.dx, -hit.dy, 1.0)).normalize();
        let film_normal = self
            .rest_linear
            .tr_mul(&Vector3::new(-hit.dx - film[0], -hit.dy - film[1], 1.0))
            .normalize();
        let facing = Facing {
            at: self.eye + direction * hit.t,
            normal,
            film_normal,
            to_camera: -direction.normalize(),
        };
        tissue_radiance(&facing, &texel, &self.lamps, &self.world.film, |lamp| {
            if self.rods.is_empty() {
                1.0
            } else {
                unshaded(&self.rods, facing.at, lamp.at)
            }
        })
    }
}

/// The lens's blur: a 3×3 binomial-like kernel, in place.
pub(super) fn soften(light: &mut [[f32; 3]], width: usize) {
    /// Share of a pixel's light that falls on each of its neighbours along an axis.
    const SPILL: f32 = 0.11;
    let mix = |a: [f32; 3], b: [f32; 3], c: [f32; 3]| -> [f32; 3] {
        std::array::from_fn(|k| SPILL * (a[k] + c[k]) + (1.0 - 2.0 * SPILL) * b[k])
    };
    for row in light.chunks_exact_mut(width) {
        let mut left = row[0];
        for x in 0..width {
            let here = row[x];
            let right = row[(x + 1).min(width - 1)];
            row[x] = mix(left, here, right);
            left = here;
        }
    }
    let rows = light.len() / width;
    let mut above = light[..width].to_vec();
    for y in 0..rows {
        for x in 0..width {
            let at = y * width + x;
            let here = light[at];
            let below = if y + 1 < rows { light[at + width] } else { here };
            light[at] = mix(above[x], here, below);
            above[x] = here;
        }
    }
}
