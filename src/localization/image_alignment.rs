//! The pose of a picture near a guess: the picture is laid over nearby views of the light field until their detail agrees.
//!
//! Direct alignment (Lucas and Kanade 1981; for a camera in six degrees of freedom as in Newcombe et al. 2011): chosen points of the
//! views, whose place in space is known from the views' depth, are projected into the picture at the present guess; the differences of
//! detail there, with the gradient of the picture's detail, give a Gauss–Newton step of the pose. Coarse scales first. The arm's pose
//! stays in as a prior, so that what the picture does not tell is left to the arm.

use nalgebra::{Cholesky, Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::blur::BlurScratch;
use crate::light_field::view::{LightField, View};
use crate::localization::detail::{DetailPyramid, SCALES, Usable};

/// How a picture is aligned.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// So many nearby views are laid against the picture.
    pub views: usize,
    /// The arm's position is believed to this, mm.
    pub prior_sigma_mm: f64,
    /// The arm's rotation is believed to this, rad.
    pub prior_sigma_rad: f64,
    /// Detail of picture and views must correlate at least so much, or the frame is not aligned.
    pub min_correlation: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            views: 4,
            prior_sigma_mm: 2.0,
            prior_sigma_rad: 0.02,
            min_correlation: 0.35,
        }
    }
}

/// A point of a view: where it is, and the detail the view shows there.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    position: Vector3<f64>,
    detail: f32,
}

/// What the alignment found.
#[derive(Clone, Copy, Debug)]
pub struct Aligned {
    /// The pose.
    pub world_from_camera: Transform<World, Camera>,
    /// Correlation of detail between the picture and the views, −1…1.
    pub correlation: f32,
    /// Share of the views' points that were seen in the picture.
    pub overlap: f32,
    /// How far the points moved in the picture from the guess, px, root mean square.
    pub moved_px: f32,
}

/// Lays pictures against a light field.
#[derive(Debug)]
pub struct ImageAligner {
    settings: Settings,
    /// Per view, per scale.
    anchors: Vec<[Vec<Anchor>; SCALES]>,
    /// Per view: optical centre and viewing direction in the world, and the median depth, mm.
    stations: Vec<Station>,
    nearest: Vec<(f64, usize)>,
}

#[derive(Clone, Copy, Debug)]
struct Station {
    centre: Vector3<f64>,
    axis: Vector3<f64>,
    depth_mm: f64,
}

/// Pixels of a view that are less sure than this tell nothing about its detail.
const MIN_CONFIDENCE: u8 = 200;
/// Points per view at the scales, finest first.
const ANCHORS: [usize; SCALES] = [1400, 700, 300];
/// Gauss–Newton steps at the scales, finest first.
const STEPS: [usize; SCALES] = [4, 6, 10];

impl ImageAligner {
    /// Choose the points of every view.
    pub fn new(light_field: &LightField, settings: &Settings) -> Self {
        let anchors = light_field.views.iter().map(anchors_of).collect();
        let stations = light_field.views.iter().map(station_of).collect();
        Self {
            settings: settings.clone(),
            anchors,
            stations,
            nearest: Vec::with_capacity(light_field.views.len()),
        }
    }

    /// The pose of the picture whose detail is `pyramid`, near `guess`; `None` when too little of the views is seen or the detail
    /// does not agree. `prior` is what the arm says, if it says anything.
    pub fn align(
        &mut self,
        pyramid: &DetailPyramid,
        camera: &CameraModel,
        guess: &Transform<World, Camera>,
        prior: Option<&Transform<World, Camera>>,
    ) -> Option<Aligned> {
        self.find_nearest(guess);
        let mut pose = *guess;
        for scale in (0..SCALES).rev() {
            for _ in 0..STEPS[scale] {
                let step = self.step(pyramid, camera, scale, &pose, prior)?;
                pose = Transform::from_isometry(pose.isometry() * step_motion(&step).inverse());
                let (turn_px, move_px) = self.step_px(&step, camera, pyramid.scales[scale].step);
                if turn_px.max(move_px) < 0.02 {
                    break;
                }
            }
        }
        let (correlation, overlap) = self.agreement(pyramid, camera, 0, &pose);
        let aligned = Aligned {
            world_from_camera: pose,
            correlation,
            overlap,
            moved_px: self.moved_px(camera, guess, &pose),
        };
        (correlation >= self.settings.min_correlation && overlap > 0.2 && pose.is_finite()).then_some(aligned)
    }

    /// How well the picture agrees with the views near `pose` at the coarsest scale: correlation × overlap.
    pub fn coarse_score(&mut self, pyramid: &DetailPyramid, camera: &CameraModel, pose: &Transform<World, Camera>) -> f32 {
        self.find_nearest(pose);
        let (correlation, overlap) = self.agreement(pyramid, camera, SCALES - 1, pose);
        correlation * overlap.sqrt()
    }

    fn find_nearest(&mut self, pose: &Transform<World, Camera>) {
        let centre = pose.translation();
        let axis = pose.rotation() * Vector3::z();
        self.nearest.clear();
        for (index, station) in self.stations.iter().enumerate() {
            if self.anchors[index][0].is_empty() {
                continue;
            }
            // Baseline against depth and turn of the axis: both rad.
            let away = (station.centre - centre).norm() / station.depth_mm + station.axis.angle(&axis);
            self.nearest.push((away, index));
        }
        self.nearest.sort_by(|a, b| a.0.total_cmp(&b.0));
        self.nearest.truncate(self.settings.views.max(1));
    }

    /// One Gauss–Newton step: a twist of the camera's own space (translation mm, rotation rad).
    fn step(
        &self,
        pyramid: &DetailPyramid,
        camera: &CameraModel,
        scale: usize,
        pose: &Transform<World, Camera>,
        prior: Option<&Transform<World, Camera>>,
    ) -> Option<Vector6<f64>> {
        let level = &pyramid.scales[scale];
        let intrinsics = camera.intrinsics.scaled(1.0 / level.step as f64);
        let camera_from_world = Motion::of(&pose.inverse());
        let mut sums = NormalEquations::default();
        let (mut count, mut energy) = (0_usize, 0.0_f64);
        let residual_scale = 0.05;
        for &(_, view) in &self.nearest {
            for anchor in &self.anchors[view][scale] {
                let p = camera_from_world.apply(&anchor.position);
                if p.z < 1e-6 {
                    continue;
                }
                let inverse_z = 1.0 / p.z;
                let (x, y) = (p.x * inverse_z, p.y * inverse_z);
                let Some((value, gx, gy)) = sample(
                    &level.detail,
                    &level.weight,
                    intrinsics.fx * x + intrinsics.cx,
                    intrinsics.fy * y + intrinsics.cy,
                ) else {
                    continue;
                };
                let residual = f64::from(value - anchor.detail);
                // Cauchy: what moved, was wiped or shines in one picture only has little say.
                let weight = 1.0 / (1.0 + (residual / residual_scale).powi(2));
                let (a, b) = (
                    f64::from(gx) * intrinsics.fx * inverse_z,
                    f64::from(gy) * intrinsics.fy * inverse_z,
                );
                let c = -(a * x + b * y);
                // d detail / d twist for p' = p + t + w × p.
                let row = [a, b, c, c * p.y - b * p.z, a * p.z - c * p.x, b * p.x - a * p.y];
                sums.add(&row, residual, weight);
                energy += weight * residual * residual;
                count += 1;
            }
        }
        if count < 40 {
            return None;
        }
        let (mut normal, mut right) = sums.matrix_and_side();
        // Neighbouring pixels are not independent: the prior weighs as much as a tenth of the points would.
        let variance = (energy / count as f64).max(1e-6) * 10.0;
        if let Some(prior) = prior {
            // Where the prior would have the camera, seen from the present camera.
            let away = pose.inverse() * *prior;
            let rotation: UnitQuaternion<f64> = away.rotation();
            let (t, w) = (away.translation(), rotation.scaled_axis());
            let (it, iw) = (
                variance / self.settings.prior_sigma_mm.powi(2),
                variance / self.settings.prior_sigma_rad.powi(2),
            );
            for axis in 0..3 {
                normal[(axis, axis)] += it;
                normal[(axis + 3, axis + 3)] += iw;
                // The camera moves against the twist of the points.
                right[axis] -= it * t[axis];
                right[axis + 3] -= iw * w[axis];
            }
        }
        for axis in 0..6 {
            normal[(axis, axis)] *= 1.0 + 1e-3;
            normal[(axis, axis)] += 1e-9;
        }
        Cholesky::new(normal).map(|factor| factor.solve(&right))
    }

    fn agreement(
        &self,
        pyramid: &DetailPyramid,
        camera: &CameraModel,
        scale: usize,
        pose: &Transform<World, Camera>,
    ) -> (f32, f32) {
        let level = &pyramid.scales[scale];
        let intrinsics = camera.intrinsics.scaled(1.0 / level.step as f64);
        let camera_from_world = Motion::of(&pose.inverse());
        let (mut seen, mut all) = (0.0_f64, 0.0_f64);
        let (mut xy, mut xx, mut yy) = (0.0_f64, 1e-9_f64, 1e-9_f64);
        for &(_, view) in &self.nearest {
            for anchor in &self.anchors[view][scale] {
                all += 1.0;
                let p = camera_from_world.apply(&anchor.position);
                if p.z < 1e-6 {
                    continue;
                }
                let inverse_z = 1.0 / p.z;
                let (u, v) = (
                    intrinsics.fx * p.x * inverse_z + intrinsics.cx,
                    intrinsics.fy * p.y * inverse_z + intrinsics.cy,
                );
                if let Some((value, _, _)) = sample(&level.detail, &level.weight, u, v) {
                    let (a, b) = (f64::from(value), f64::from(anchor.detail));
                    seen += 1.0;
                    xy += a * b;
                    xx += a * a;
                    yy += b * b;
                }
            }
        }
        ((xy / (xx * yy).sqrt()) as f32, (seen / f64::max(all, 1.0)) as f32)
    }

    fn step_px(&self, step: &Vector6<f64>, camera: &CameraModel, pixel: usize) -> (f64, f64) {
        let focal = camera.intrinsics.fx / pixel as f64;
        let depth = self.nearest.first().map_or(1.0, |&(_, view)| self.stations[view].depth_mm);
        (
            focal * step.fixed_rows::<3>(3).norm(),
            focal * step.fixed_rows::<3>(0).norm() / depth,
        )
    }

    fn moved_px(&self, camera: &CameraModel, from: &Transform<World, Camera>, to: &Transform<World, Camera>) -> f32 {
        let (from, to) = (from.inverse(), to.inverse());
        let (mut sum, mut count) = (0.0, 0.0);
        for &(_, view) in &self.nearest {
            for anchor in &self.anchors[view][SCALES - 1] {
                let position = nalgebra::Point3::from(anchor.position);
                let (a, b) = (from.isometry() * position, to.isometry() * position);
                if a.z > 1e-6 && b.z > 1e-6 {
                    let k = &camera.intrinsics;
                    let dx = k.fx * (a.x / a.z - b.x / b.z);
                    let dy = k.fy * (a.y / a.z - b.y / b.z);
                    sum += dx * dx + dy * dy;
                    count += 1.0;
                }
            }
        }
        if count > 0.0 { (sum / count).sqrt() as f32 } else { 0.0 }
    }
}

/// A rigid motion with its rotation as a matrix: a third of the work of a quaternion per point.
#[derive(Clone, Copy, Debug)]
struct Motion {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

impl Motion {
    fn of<To, From>(transform: &Transform<To, From>) -> Self {
        Self {
            rotation: transform.rotation().to_rotation_matrix().into_inner(),
            translation: transform.translation(),
        }
    }

    #[inline]
    fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }
}

/// Sums of a least-squares problem in six unknowns; of the symmetric matrix one half.
#[derive(Clone, Copy, Debug, Default)]
struct NormalEquations {
    half: [[f64; 6]; 6],
    side: [f64; 6],
}

impl NormalEquations {
    #[inline]
    fn add(&mut self, row: &[f64; 6], residual: f64, weight: f64) {
        for i in 0..6 {
            let weighted = weight * row[i];
            for j in i..6 {
                self.half[i][j] += weighted * row[j];
            }
            self.side[i] -= weighted * residual;
        }
    }

    fn matrix_and_side(&self) -> (Matrix6<f64>, Vector6<f64>) {
        let matrix = Matrix6::from_fn(|i, j| self.half[i.min(j)][i.max(j)]);
        (matrix, Vector6::from(self.side))
    }
}

fn step_motion(twist: &Vector6<f64>) -> nalgebra::Isometry3<f64> {
    nalgebra::Isometry3::from_parts(
        nalgebra::Translation3::new(twist[0], twist[1], twist[2]),
        UnitQuaternion::from_scaled_axis(Vector3::new(twist[3], twist[4], twist[5])),
    )
}

/// Value and gradient at (x, y), bilinear; `None` where any of the four pixels is unknown.
#[inline]
fn sample(
    detail: &crate::image::buffer::Image<f32>,
    weight: &crate::image::buffer::Image<f32>,
    x: f64,
    y: f64,
) -> Option<(f32, f32, f32)> {
    let (width, height) = detail.size();
    if !(x >= 0.0 && y >= 0.0 && x < width as f64 - 1.0 && y < height as f64 - 1.0) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (fx, fy) = ((x - left as f64) as f32, (y - top as f64) as f32);
    let index = top * width + left;
    let w = weight.pixels();
    if w[index] * w[index + 1] * w[index + width] * w[index + width + 1] == 0.0 {
        return None;
    }
    let d = detail.pixels();
    let (a, b, c, e) = (d[index], d[index + 1], d[index + width], d[index + width + 1]);
    let (upper, lower) = (a + (b - a) * fx, c + (e - c) * fx);
    Some((
        upper + (lower - upper) * fy,
        (b - a) * (1.0 - fy) + (e - c) * fy,
        lower - upper,
    ))
}

fn station_of(view: &View) -> Station {
    let mut depths: Vec<f32> = view.depth.pixels().iter().step_by(97).copied().filter(|&d| d > 0.0).collect();
    depths.sort_by(f32::total_cmp);
    let depth_mm = depths.get(depths.len() / 2).copied().map_or(80.0, f64::from);
    Station {
        centre: view.world_from_camera.translation(),
        axis: view.world_from_camera.rotation() * Vector3::z(),
        depth_mm,
    }
}

/// The points with the strongest gradients, spread over the view by a grid of cells.
fn anchors_of(view: &View) -> [Vec<Anchor>; SCALES] {
    let mut pyramid = DetailPyramid::default();
    let usable = Usable {
        within: Some((&view.confidence, MIN_CONFIDENCE)),
        ..Usable::default()
    };
    pyramid.build(&view.image, &usable, &mut BlurScratch::default());
    std::array::from_fn(|index| {
        let level = &pyramid.scales[index];
        let (width, height) = level.detail.size();
        // About three points a cell.
        let cell = (((3 * width * height) as f64 / ANCHORS[index] as f64).sqrt().ceil() as usize).max(3);
        let mut anchors = Vec::with_capacity(ANCHORS[index] + ANCHORS[index] / 4);
        let mut best: Vec<(f32, usize, usize)> = Vec::new();
        for top in (1..height.saturating_sub(1)).step_by(cell) {
            for left in (1..width.saturating_sub(1)).step_by(cell) {
                best.clear();
                for y in top..(top + cell).min(height - 1) {
                    for x in left..(left + cell).min(width - 1) {
                        let known = [(x, y), (x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)]
                            .iter()
                            .all(|&(u, v)| level.weight.at(u, v) > 0.0);
                        if known {
                            let gx = level.detail.at(x + 1, y) - level.detail.at(x - 1, y);
                            let gy = level.detail.at(x, y + 1) - level.detail.at(x, y - 1);
                            best.push((gx * gx + gy * gy, x, y));
                        }
                    }
                }
                best.sort_by(|a, b| b.0.total_cmp(&a.0));
                for &(_, x, y) in best.iter().take(3) {
                    if let Some(position) = place_of(view, x, y, level.step) {
                        anchors.push(Anchor {
                            position,
                            detail: level.detail.at(x, y),
                        });
                    }
                }
            }
        }
        anchors
    })
}

/// Where the centre of a pixel of a scale lies in the world; `None` without depth.
fn place_of(view: &View, x: usize, y: usize, step: usize) -> Option<Vector3<f64>> {
    let centre = |i: usize| (i as f64 + 0.5) * step as f64 - 0.5;
    let (u, v) = (centre(x), centre(y));
    let (left, top) = (u as usize, v as usize);
    let (right, bottom) = ((left + 1).min(view.depth.width() - 1), (top + 1).min(view.depth.height() - 1));
    let corners = [
        view.depth.at(left, top),
        view.depth.at(right, top),
        view.depth.at(left, bottom),
        view.depth.at(right, bottom),
    ];
    let (near, far) = corners.iter().fold((f32::MAX, 0.0_f32), |(a, b), &d| (a.min(d), b.max(d)));
    // Across an edge in depth the place is in doubt.
    if near <= 0.0 || far > 1.05 * near {
        return None;
    }
    let depth = f64::from(corners.iter().sum::<f32>()) / 4.0;
    let k = &view.camera.intrinsics;
    let point = nalgebra::Point3::new((u - k.cx) / k.fx * depth, (v - k.cy) / k.fy * depth, depth);
    Some((view.world_from_camera.isometry() * point).coords)
}
