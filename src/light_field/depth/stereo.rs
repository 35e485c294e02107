//! Depth maps of chosen views: who looks with whom, how far to search, coarse to fine, and which depths others confirm.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::camera::intrinsics::Intrinsics;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::Image;
use crate::light_field::depth::pairing::{Station, neighbours, references};
use crate::light_field::depth::plane_sweep::{Plane, Scratch, Sweep, costs};
use crate::light_field::depth::semi_global::{Paths, Smoothness, Winners, aggregate, winners};
use crate::light_field::error::LightFieldError;
use crate::light_field::view::{SparsePoint, View};
use crate::progress::Progress;

/// Two depths of the first pass agree within this share; the second pass asks for more.
const FIRST_AGREEMENT: f32 = 0.015;
/// Depth around a guess needs a matching cost below this (correlation above one half).
const GUESS_COST: f32 = 0.5;

/// How depth is searched.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StereoSettings {
    /// Views that get a depth map of their own, and some more where these leave gaps; the surface serves the rest.
    pub reference_views: usize,
    /// Views each of them is matched with, and some more for places that these do not see.
    pub neighbours: usize,
    /// Angle at the scene at which two views match best, rad: wider resolves depth better, narrower looks more alike.
    pub best_angle_rad: f64,
    /// The finer of the two scales is at most this wide, px.
    pub max_width_px: usize,
    /// Search range when no scene point tells it, mm.
    pub nearest_mm: f64,
    /// Search range when no scene point tells it, mm.
    pub farthest_mm: f64,
    /// Two depths agree within this share.
    pub agreement: f32,
}

impl Default for StereoSettings {
    fn default() -> Self {
        Self {
            reference_views: 28,
            neighbours: 5,
            best_angle_rad: 0.13,
            max_width_px: 640,
            nearest_mm: 20.0,
            farthest_mm: 250.0,
            agreement: 0.008,
        }
    }
}

/// One view's depth.
#[derive(Clone, Debug)]
pub struct DepthMap {
    /// Along the optical axis, mm; 0 unknown.
    pub depth: Image<f32>,
    /// How far to trust it, 0–1.
    pub weight: Image<f32>,
    /// Of the map, which is smaller than the view.
    pub intrinsics: Intrinsics,
    /// Where the camera was.
    pub world_from_camera: Transform<World, Camera>,
}

/// Views prepared for matching: each at the fine and the coarse scale.
#[derive(Debug)]
pub struct Stereo<'a> {
    settings: &'a StereoSettings,
    fine: Vec<Plane>,
    coarse: Vec<Plane>,
    ranges: Vec<(f64, f64)>,
    stations: Vec<Station>,
}

impl<'a> Stereo<'a> {
    /// Prepares the views; `points` tell how far the scene is.
    pub fn new(views: &[View], points: &[SparsePoint], settings: &'a StereoSettings) -> Self {
        let fine: Vec<Plane> = (views.par_iter())
            .map(|view| {
                let mut plane = Plane::new(&view.image, &view.confidence, view.camera.intrinsics, view.world_from_camera);
                while plane.gray.width() > settings.max_width_px {
                    plane = plane.halved();
                }
                plane
            })
            .collect();
        let coarse = fine.par_iter().map(Plane::halved).collect();
        let fallback = fallback_range(views, settings);
        let ranges = views
            .iter()
            .map(|view| depth_range(view, points).unwrap_or(fallback))
            .collect();
        let stations = (views.iter().zip(&ranges))
            .map(|(view, &(near, far))| Station::new(&view.camera, view.world_from_camera, 2.0 / (1.0 / near + 1.0 / far)))
            .collect();
        Self {
            settings,
            fine,
            coarse,
            ranges,
            stations,
        }
    }

    /// Views that get a depth map.
    pub fn reference_views(&self) -> Vec<usize> {
        references(&self.stations, self.settings.reference_views)
    }

    fn neighbours(&self, view: usize) -> Vec<usize> {
        neighbours(&self.stations, view, self.settings.neighbours, self.settings.best_angle_rad)
    }

    fn longest_baseline(&self, view: usize, neighbours: &[usize]) -> f64 {
        let from = self.fine[view].world_from_camera.translation();
        neighbours
            .iter()
            .map(|&n| (self.fine[n].world_from_camera.translation() - from).norm())
            .fold(0.0, f64::max)
            .max(1e-6)
    }

    /// Depth of one view from nothing but the range.
    pub fn from_scratch(&self, view: usize) -> Option<DepthMap> {
        let neighbours = self.neighbours(view);
        if neighbours.is_empty() {
            return None;
        }
        let baseline = self.longest_baseline(view, &neighbours);
        let (near, far) = self.ranges[view];
        let (least, most) = (1.0 / far, 1.0 / near);
        let plane = &self.coarse[view];
        let (width, height) = plane.gray.size();
        // One pixel along the longest epipolar line a step, unless that makes too many.
        let count = (((most - least) * plane.intrinsics.fx * baseline).ceil() as usize).clamp(16, 128);
        let sweep = Sweep {
            step: ((most - least) / (count - 1) as f64) as f32,
            count,
            radius: 3,
        };
        let base = Image::filled(width, height, (0.5 * (least + most)) as f32);
        let (coarse, _) = self.search(
            plane,
            &self.coarse,
            &neighbours,
            &base,
            sweep,
            Smoothness { step: 0.06, jump: 0.5 },
        );
        let mut inverse = base;
        for (w, &index) in inverse.pixels_mut().iter_mut().zip(coarse.index.pixels()) {
            *w += sweep.offset(index);
        }
        let inverse = smoothed(&median(&inverse), 1);
        let (width, height) = self.fine[view].gray.size();
        let base = smoothed(&doubled(&inverse, width, height), 2);
        Some(self.refined(view, &neighbours, &base, None, 0.5, 11))
    }

    /// Depth of one view near a known surface (`depth` at the fine scale's size, 0 unknown), and beyond its rim near what the view's
    /// own `first` map holds.
    pub fn near_surface(&self, view: usize, depth: &Image<f32>, first: &Image<f32>) -> Option<DepthMap> {
        let neighbours = self.neighbours(view);
        if neighbours.is_empty() {
            return None;
        }
        let mut base = depth.clone();
        for (base, &first) in base.pixels_mut().iter_mut().zip(first.pixels()) {
            let depth = if *base > 0.0 { *base } else { first };
            *base = if depth > 0.0 { 1.0 / depth } else { 0.0 };
        }
        let filled = completed(&base);
        Some(self.refined(view, &neighbours, &filled, Some(&base), 0.3, 9))
    }

    /// The size and intrinsics of a view's depth map.
    pub fn fine_plane(&self, view: usize) -> &Plane {
        &self.fine[view]
    }

    /// Around `base`; where `known` is 0 the base is a guess, and depth needs good evidence: views that start from one guess
    /// would otherwise confirm each other's.
    fn refined(
        &self,
        view: usize,
        neighbours: &[usize],
        base: &Image<f32>,
        known: Option<&Image<f32>>,
        step_px: f64,
        count: usize,
    ) -> DepthMap {
        let plane = &self.fine[view];
        let baseline = self.longest_baseline(view, neighbours);
        let sweep = Sweep {
            step: (step_px / (plane.intrinsics.fx * baseline)) as f32,
            count,
            radius: 4,
        };
        let (found, cost) = self.search(
            plane,
            &self.fine,
            neighbours,
            base,
            sweep,
            Smoothness { step: 0.03, jump: 0.3 },
        );
        let (width, height) = plane.gray.size();
        let mut depth = Image::filled(width, height, 0.0_f32);
        let mut weight = Image::filled(width, height, 0.0_f32);
        for i in 0..width * height {
            let w = base.pixels()[i] + sweep.offset(found.index.pixels()[i]);
            let sharpness = found.sharpness.pixels()[i];
            let guessed = known.is_some_and(|k| k.pixels()[i] <= 0.0);
            if base.pixels()[i] > 0.0 && w > 0.0 && sharpness > 0.0 && !(guessed && cost.pixels()[i] > GUESS_COST) {
                depth.pixels_mut()[i] = 1.0 / w;
                let heard = if plane.weight.pixels()[i] > 0.0 { 1.0 } else { 0.3 };
                // The flatter the valley, the vaguer the depth: variance goes with 1 / curvature.
                weight.pixels_mut()[i] = heard * (sharpness / 0.2).clamp(0.02, 1.0);
            }
        }
        DepthMap {
            depth,
            weight,
            intrinsics: plane.intrinsics,
            world_from_camera: plane.world_from_camera,
        }
    }

    fn search(
        &self,
        plane: &Plane,
        all: &[Plane],
        neighbours: &[usize],
        base: &Image<f32>,
        sweep: Sweep,
        smoothness: Smoothness,
    ) -> (Winners, Image<f32>) {
        let (width, height) = plane.gray.size();
        let planes: Vec<&Plane> = neighbours.iter().map(|&n| &all[n]).collect();
        let (mut volume, mut sums) = (Vec::new(), Vec::new());
        costs(plane, &planes, base, sweep, &mut Scratch::default(), &mut volume);
        aggregate(
            &volume,
            width,
            height,
            sweep.count,
            smoothness,
            &mut Paths::default(),
            &mut sums,
        );
        let found = winners(&sums, width, height, sweep.count);
        let mut cost = found.index.clone();
        for (cost, volume) in cost.pixels_mut().iter_mut().zip(volume.chunks_exact(sweep.count)) {
            *cost = volume[(*cost + 0.5) as usize];
        }
        (found, cost)
    }
}

/// Depth maps of all reference views that have neighbours, those depths kept that others confirm; beside each the view.
pub fn depth_maps(
    stereo: &Stereo<'_>,
    references: &[usize],
    progress: &dyn Progress,
) -> Result<(Vec<usize>, Vec<DepthMap>), LightFieldError> {
    progress.begin("depth", references.len() as u64);
    let maps: Vec<Option<(usize, DepthMap)>> = (references.par_iter())
        .map(|&view| {
            let map = if progress.stopping() {
                None
            } else {
                stereo.from_scratch(view)
            };
            progress.advance(1);
            Some((view, map?))
        })
        .collect();
    progress.end();
    if progress.stopping() {
        return Err(LightFieldError::Stopped);
    }
    let (views, maps): (Vec<usize>, Vec<DepthMap>) = maps.into_iter().flatten().unzip();
    Ok((views, confirmed(&maps, FIRST_AGREEMENT)))
}

/// The maps with only those depths that another map sees in the same place; the surface asks for two views once more.
pub fn confirmed(maps: &[DepthMap], agreement: f32) -> Vec<DepthMap> {
    (maps.par_iter().enumerate())
        .map(|(index, map)| {
            let mut near: Vec<(f64, usize)> = (0..maps.len())
                .filter(|&other| other != index)
                .map(|other| {
                    (
                        (maps[other].world_from_camera.translation() - map.world_from_camera.translation()).norm(),
                        other,
                    )
                })
                .collect();
            near.sort_by(|a, b| a.0.total_cmp(&b.0));
            near.truncate(8);
            let motions: Vec<(usize, nalgebra::Matrix3<f32>, Vector3<f32>)> = (near.iter())
                .map(|&(_, other)| {
                    let motion = maps[other].world_from_camera.inverse() * map.world_from_camera;
                    (
                        other,
                        motion.rotation().to_rotation_matrix().matrix().cast(),
                        motion.translation().cast(),
                    )
                })
                .collect();
            let mut out = map.clone();
            let k = &map.intrinsics;
            for y in 0..map.depth.height() {
                for x in 0..map.depth.width() {
                    let z = map.depth.at(x, y);
                    if z <= 0.0 {
                        continue;
                    }
                    let ray = Vector3::new(
                        (x as f32 - k.cx as f32) / k.fx as f32,
                        (y as f32 - k.cy as f32) / k.fy as f32,
                        1.0,
                    );
                    let agreed = motions
                        .iter()
                        .filter(|(other, r, t)| agrees(&maps[*other], &(r * ray * z + t), agreement))
                        .count();
                    if agreed == 0 {
                        out.depth.set(x, y, 0.0);
                        out.weight.set(x, y, 0.0);
                    } else {
                        out.weight.set(x, y, out.weight.at(x, y) * (agreed.min(4) as f32 * 0.25));
                    }
                }
            }
            out
        })
        .collect()
}

fn agrees(map: &DepthMap, point: &Vector3<f32>, agreement: f32) -> bool {
    if point.z <= 0.0 {
        return false;
    }
    let k = &map.intrinsics;
    let x = k.fx as f32 * point.x / point.z + k.cx as f32 + 0.5;
    let y = k.fy as f32 * point.y / point.z + k.cy as f32 + 0.5;
    if !(x >= 0.0 && y >= 0.0 && x < map.depth.width() as f32 && y < map.depth.height() as f32) {
        return false;
    }
    let seen = map.depth.at(x as usize, y as usize);
    seen > 0.0 && (seen - point.z).abs() < agreement * point.z
}

/// Near and far of what a view sees, from the scene points in its picture, with a margin; `None` when they are too few.
fn depth_range(view: &View, points: &[SparsePoint]) -> Option<(f64, f64)> {
    let camera_from_world = view.world_from_camera.inverse();
    let mut depths: Vec<f64> = (points.iter())
        .filter_map(|point| {
            let local = camera_from_world * point.position;
            let pixel = view.camera.project(local)?;
            view.camera.contains(pixel, 0.0).then_some(local.coords.z)
        })
        .collect();
    if depths.len() < 20 {
        return None;
    }
    depths.sort_by(f64::total_cmp);
    let (near, far) = (depths[depths.len() / 50], depths[depths.len() - 1 - depths.len() / 50]);
    Some((near * 0.85, far * 1.2))
}

/// The settings' range, or one that fits the spread of the cameras when that is of another order (a model of unknown unit).
fn fallback_range(views: &[View], settings: &StereoSettings) -> (f64, f64) {
    let centers: Vec<Vector3<f64>> = views.iter().map(|v| v.world_from_camera.translation()).collect();
    let mean = centers.iter().sum::<Vector3<f64>>() / centers.len().max(1) as f64;
    let spread = (centers.iter().map(|c| (c - mean).norm_squared()).sum::<f64>() / centers.len().max(1) as f64).sqrt();
    // A survey moves by a tenth to the whole of its distance.
    if spread > 0.0 && (spread * 15.0 < settings.nearest_mm || spread > settings.farthest_mm * 2.0) {
        (spread, spread * 15.0)
    } else {
        (settings.nearest_mm, settings.farthest_mm)
    }
}

/// Zeros filled from what is known around them: averages over ever larger blocks, where a block knows anything.
fn completed(image: &Image<f32>) -> Image<f32> {
    let (width, height) = image.size();
    if width < 2 || height < 2 || image.pixels().iter().all(|&v| v > 0.0) {
        return image.clone();
    }
    let (half_width, half_height) = (width.div_ceil(2), height.div_ceil(2));
    let mut half = Image::filled(half_width, half_height, 0.0_f32);
    for y in 0..half_height {
        for x in 0..half_width {
            let (mut sum, mut count) = (0.0, 0.0);
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let value = image.at((2 * x + dx).min(width - 1), (2 * y + dy).min(height - 1));
                if value > 0.0 {
                    sum += value;
                    count += 1.0;
                }
            }
            half.set(x, y, if count > 0.0 { sum / count } else { 0.0 });
        }
    }
    let coarse = doubled(&completed(&half), width, height);
    let mut out = image.clone();
    for (out, &guess) in out.pixels_mut().iter_mut().zip(coarse.pixels()) {
        if *out <= 0.0 {
            *out = guess;
        }
    }
    out
}

fn median(image: &Image<f32>) -> Image<f32> {
    let (width, height) = image.size();
    let mut out = image.clone();
    for y in 1..height.saturating_sub(1) {
        for x in 1..width - 1 {
            let mut values = [0.0; 9];
            for (slot, value) in values.iter_mut().enumerate() {
                *value = image.at(x + slot % 3 - 1, y + slot / 3 - 1);
            }
            values.sort_unstable_by(f32::total_cmp);
            out.set(x, y, values[4]);
        }
    }
    out
}

/// `rounds` of the 3×3 binomial.
fn smoothed(image: &Image<f32>, rounds: usize) -> Image<f32> {
    let (width, height) = image.size();
    let mut out = image.clone();
    for _ in 0..rounds {
        let source = out.clone();
        for y in 0..height {
            let rows = [y.saturating_sub(1), y, (y + 1).min(height - 1)].map(|v| source.row(v));
            for x in 0..width {
                let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
                let [a, b, c] = rows.map(|r| r[left] + 2.0 * r[x] + r[right]);
                out.set(x, y, (a + 2.0 * b + c) / 16.0);
            }
        }
    }
    out
}

/// Twice the size, bilinear, pixel centres as [`Intrinsics::scaled`] has them.
fn doubled(image: &Image<f32>, width: usize, height: usize) -> Image<f32> {
    let mut out = Image::filled(width, height, 0.0_f32);
    let (last_x, last_y) = (image.width() as f32 - 1.0, image.height() as f32 - 1.0);
    for y in 0..height {
        let v = ((y as f32 + 0.5) * 0.5 - 0.5).clamp(0.0, last_y);
        let (top, fy) = (v as usize, v - v.floor());
        let below = (top + 1).min(image.height() - 1);
        for x in 0..width {
            let u = ((x as f32 + 0.5) * 0.5 - 0.5).clamp(0.0, last_x);
            let (left, fx) = (u as usize, u - u.floor());
            let beside = (left + 1).min(image.width() - 1);
            let upper = image.at(left, top) * (1.0 - fx) + image.at(beside, top) * fx;
            let lower = image.at(left, below) * (1.0 - fx) + image.at(beside, below) * fx;
            out.set(x, y, upper * (1.0 - fy) + lower * fy);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_are_filled_between_their_sides() {
        let mut image = Image::filled(40, 30, 2.0_f32);
        for y in 0..30 {
            for x in 12..40 {
                image.set(x, y, if x < 25 { 0.0 } else { 4.0 });
            }
        }
        let filled = completed(&image);
        assert!(filled.pixels().iter().all(|&v| (2.0..=4.0).contains(&v)));
        assert_eq!((filled.at(3, 3), filled.at(30, 9)), (2.0, 4.0));
        assert!(filled.at(18, 15) > 2.2 && filled.at(18, 15) < 3.8, "{}", filled.at(18, 15));
    }
}
