//! What a virtual camera would see: unstructured lumigraph rendering (Buehler, Bosse, McMillan, Gortler, Cohen, "Unstructured
//! Lumigraph Rendering", SIGGRAPH 2001, doi:10.1145/383259.383309) on the proxy surface.
//!
//! For a scene point p seen from D, view i with centre Cᵢ is penalised by the angle between p−Cᵢ and p−D and by standing
//! farther away than D (resolution). The k views of least penalty speak, with weights that fall to zero at the (k+1)-th
//! penalty, so that views come and go without a step. A view counts only where it saw p: p must lie in its picture, its own
//! depth there must agree (visibility), and its confidence there (no specularity, no instrument) scales its weight; towards
//! its border it fades out (field of view).
//!
//! All views are ranked once per block of pixels; each pixel then asks only the block's best, with its own exact penalties.

use nalgebra::{Matrix3, Vector3};

use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::light_field::rasterize::DepthRasterizer;
use crate::light_field::view::{LampShading, LightField, View};

/// Pixels of a block that share a list of candidate views.
const BLOCK: usize = 16;
/// Candidate views of a block.
const CANDIDATES: usize = 12;
/// Penalties of one view differ by less than this within a block, rad.
const RANK_SLACK_RAD: f32 = 0.012;
/// Views that are blended; k of the paper, as in its experiments.
const BLENDED: usize = 4;
/// Weight of relative resolution beside angle in rad (β/α of the paper).
const RESOLUTION_WEIGHT: f32 = 0.1;
/// Added to each penalty, so that a view that stands where the virtual camera stands has a large but finite weight; rad.
const PENALTY_FLOOR_RAD: f32 = 2e-3;
/// A view fades out over this many pixels towards its border.
const FEATHER_PX: f32 = 12.0;
/// A point is seen by a view if it is at most this share of its depth behind what the view sees there.
const VISIBILITY_TOLERANCE: f32 = 0.015;

/// One point's colour, and who said so.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// sRGB, 0–255, at the light field's common brightness.
    pub color: [f32; 3],
    /// How much evidence stands behind it: the best confidence among the views that spoke, 0–1.
    pub weight: f32,
    /// The view that spoke loudest.
    pub view: usize,
    /// How many views spoke.
    pub views: usize,
}

/// A view's numbers in the form the inner loop wants them.
#[derive(Clone, Debug)]
struct Source {
    rotation: Matrix3<f32>,
    shift: Vector3<f32>,
    center: Vector3<f32>,
    focal: [f32; 2],
    principal: [f32; 2],
    last: [f32; 2],
    gain: [f32; 3],
}

impl Source {
    fn new(view: &View) -> Self {
        let camera_from_world = view.world_from_camera.inverse();
        let k = &view.camera.intrinsics;
        Self {
            rotation: camera_from_world.rotation().to_rotation_matrix().matrix().cast(),
            shift: camera_from_world.translation().cast(),
            center: view.world_from_camera.translation().cast(),
            focal: [k.fx as f32, k.fy as f32],
            principal: [k.cx as f32, k.cy as f32],
            last: [view.image.width() as f32 - 1.0, view.image.height() as f32 - 1.0],
            gain: view.gain,
        }
    }

    /// (penalty, distance) of this view for a point `from_eye` away from a virtual camera at `eye_distance`.
    #[inline]
    fn penalty(&self, point: &Vector3<f32>, from_eye: &Vector3<f32>, eye_distance: f32) -> (f32, f32) {
        let from_center = point - self.center;
        let distance = from_center.norm();
        let cosine = from_center.dot(from_eye) / (distance * eye_distance).max(1e-12);
        // The chord stands for the angle; within 1 % of it up to 28°.
        let angle = (2.0 - 2.0 * cosine).max(0.0).sqrt();
        let resolution = (distance / eye_distance - 1.0).max(0.0);
        (angle + RESOLUTION_WEIGHT * resolution + PENALTY_FLOOR_RAD, distance)
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Heard {
    penalty: f32,
    weight: f32,
    view: usize,
    x: f32,
    y: f32,
    distance: f32,
    rho2: f32,
}

/// Renders a light field; keeps its buffers.
#[derive(Clone, Debug)]
pub struct Renderer {
    sources: Vec<Source>,
    shading: LampShading,
    rasterizer: DepthRasterizer,
    depth: Image<f32>,
    ranked: Vec<(f32, usize)>,
    excluded: Option<usize>,
}

impl Renderer {
    /// For this light field as it is now; make a new one when views come or go.
    pub fn new(light_field: &LightField) -> Self {
        Self {
            sources: light_field.views.iter().map(Source::new).collect(),
            shading: light_field.shading,
            rasterizer: DepthRasterizer::new(),
            depth: Image::filled(0, 0, 0.0),
            ranked: Vec::with_capacity(light_field.views.len()),
            excluded: None,
        }
    }

    /// Leave this view out of everything that follows (leave-one-out evaluation); `None` brings all back.
    pub fn exclude(&mut self, view: Option<usize>) {
        self.excluded = view;
    }

    /// The depth map of the last [`Renderer::render`].
    pub fn depth(&self) -> &Image<f32> {
        &self.depth
    }

    /// What a pinhole `camera` at `world_from_camera` would see; `valid` is 255 where the light field had something to say,
    /// and `out` is 0 elsewhere. Both take the camera's size.
    pub fn render(
        &mut self,
        light_field: &LightField,
        camera: &CameraModel,
        world_from_camera: &Transform<World, Camera>,
        out: &mut Image<Rgb8>,
        valid: &mut Mask,
    ) {
        let mut depth = std::mem::replace(&mut self.depth, Image::filled(0, 0, 0.0));
        self.rasterizer
            .render(&light_field.surface, camera, world_from_camera, &mut depth);
        self.render_on_depth(light_field, camera, world_from_camera, &depth, out, valid);
        self.depth = depth;
    }

    /// As [`Renderer::render`], on a depth map that is known already.
    pub fn render_on_depth(
        &mut self,
        light_field: &LightField,
        camera: &CameraModel,
        world_from_camera: &Transform<World, Camera>,
        depth: &Image<f32>,
        out: &mut Image<Rgb8>,
        valid: &mut Mask,
    ) {
        let (width, height) = depth.size();
        out.resize(width, height, [0; 3]);
        valid.resize(width, height, 0);
        let rotation: Matrix3<f32> = world_from_camera.rotation().to_rotation_matrix().matrix().cast();
        let eye: Vector3<f32> = world_from_camera.translation().cast();
        let k = &camera.intrinsics;
        let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32);
        let ray = |x: usize, y: usize| Vector3::new((x as f32 - cx) / fx, (y as f32 - cy) / fy, 1.0);
        let mut ranked = std::mem::take(&mut self.ranked);
        for top in (0..height).step_by(BLOCK) {
            for left in (0..width).step_by(BLOCK) {
                let (right, bottom) = ((left + BLOCK).min(width), (top + BLOCK).min(height));
                let Some((x, y)) = known_pixel(depth, left, top, right, bottom) else {
                    continue;
                };
                self.rank(&(eye + rotation * ray(x, y) * depth.at(x, y)), &eye, &mut ranked);
                for y in top..bottom {
                    for x in left..right {
                        let z = depth.at(x, y);
                        if z <= 0.0 {
                            continue;
                        }
                        let ray = ray(x, y);
                        let rho2 = ray.x * ray.x + ray.y * ray.y;
                        let point = eye + rotation * ray * z;
                        if let Some(sample) = self.blend(light_field, &ranked, &point, &eye, rho2) {
                            out.set(x, y, sample.color.map(|v| (v + 0.5).clamp(0.0, 255.0) as u8));
                            valid.set(x, y, 255);
                        }
                    }
                }
            }
        }
        self.ranked = ranked;
    }

    /// The colour of `point` as seen from the place `from`, on the optical axis of a camera there; `None` where no view saw
    /// it with any confidence.
    pub fn sample(&mut self, light_field: &LightField, point: &Point<World>, from: &Point<World>) -> Option<Sample> {
        let (point, eye) = (point.coords.cast(), from.coords.cast());
        let mut ranked = std::mem::take(&mut self.ranked);
        self.rank(&point, &eye, &mut ranked);
        let sample = self.blend(light_field, &ranked, &point, &eye, 0.0);
        self.ranked = ranked;
        sample
    }

    /// The best candidates for points around `point`, best first.
    fn rank(&self, point: &Vector3<f32>, eye: &Vector3<f32>, ranked: &mut Vec<(f32, usize)>) {
        let from_eye = point - eye;
        let eye_distance = from_eye.norm();
        let margin = 2.0 * BLOCK as f32;
        ranked.clear();
        for (index, source) in self.sources.iter().enumerate() {
            if self.excluded == Some(index) {
                continue;
            }
            let p = source.rotation * point + source.shift;
            if p.z <= 0.0 {
                continue;
            }
            let x = source.focal[0] * p.x / p.z + source.principal[0];
            let y = source.focal[1] * p.y / p.z + source.principal[1];
            if x > -margin && y > -margin && x < source.last[0] + margin && y < source.last[1] + margin {
                ranked.push((source.penalty(point, &from_eye, eye_distance).0, index));
            }
        }
        ranked.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        ranked.truncate(CANDIDATES);
    }

    /// The blend of at most [`BLENDED`] views; `rho2` tells the lamp model where in the virtual picture the point lies.
    #[inline]
    fn blend(
        &self,
        light_field: &LightField,
        candidates: &[(f32, usize)],
        point: &Vector3<f32>,
        eye: &Vector3<f32>,
        rho2: f32,
    ) -> Option<Sample> {
        let from_eye = point - eye;
        let eye_distance = from_eye.norm();
        let mut heard = [Heard::default(); BLENDED + 1];
        let mut count = 0;
        for &(rank, index) in candidates {
            if count > BLENDED && rank > heard[BLENDED].penalty + RANK_SLACK_RAD {
                break;
            }
            let (source, view) = (&self.sources[index], &light_field.views[index]);
            let p = source.rotation * point + source.shift;
            if p.z <= 0.0 {
                continue;
            }
            let (u, v) = (p.x / p.z, p.y / p.z);
            let x = source.focal[0] * u + source.principal[0];
            let y = source.focal[1] * v + source.principal[1];
            let border = x.min(y).min(source.last[0] - x).min(source.last[1] - y) - 0.5;
            if border.is_nan() || border <= 0.0 {
                continue;
            }
            let seen = view.depth.at((x + 0.5) as usize, (y + 0.5) as usize);
            if seen <= 0.0 || p.z > seen * (1.0 + VISIBILITY_TOLERANCE) {
                continue;
            }
            let confidence = bilinear(&view.confidence, x, y) * (1.0 / 255.0);
            if confidence < 0.02 {
                continue;
            }
            let (penalty, distance) = source.penalty(point, &from_eye, eye_distance);
            let new = Heard {
                penalty,
                weight: confidence * (border / FEATHER_PX).min(1.0),
                view: index,
                x,
                y,
                distance,
                rho2: u * u + v * v,
            };
            // Insertion into the short list, least penalty first; the last place gives the threshold only.
            let mut place = count.min(BLENDED);
            if count > BLENDED && heard[BLENDED].penalty <= penalty {
                continue;
            }
            while place > 0 && heard[place - 1].penalty > penalty {
                heard[place] = heard[place - 1];
                place -= 1;
            }
            heard[place] = new;
            count = (count + 1).min(BLENDED + 1);
        }
        if count == 0 {
            return None;
        }
        let spoken = count.min(BLENDED);
        // With k views or fewer nobody is pushed out, and the threshold only has to lie beyond the last.
        let threshold = if count > BLENDED {
            heard[BLENDED].penalty
        } else {
            heard[spoken - 1].penalty * 1.5
        };
        let flat = self.shading.is_flat();
        let here = if flat {
            0.0
        } else {
            self.shading.log_brightness(eye_distance, rho2)
        };
        let (mut sum, mut total, mut best, mut loudest) = ([0.0_f32; 3], 0.0, 0.0_f32, (0.0, heard[0].view));
        for voice in &heard[..spoken] {
            // ULR, section 5: w = max(0, 1 − penalty / threshold), with 1 / penalty for epipole consistency.
            let weight = voice.weight * ((1.0 - voice.penalty / threshold).max(0.0) + 1e-4) / voice.penalty;
            let source = &self.sources[voice.view];
            let color = bilinear_rgb(&light_field.views[voice.view].image, voice.x, voice.y);
            let lamp = if flat {
                1.0
            } else {
                (here - self.shading.log_brightness(voice.distance, voice.rho2)).exp()
            };
            for channel in 0..3 {
                sum[channel] += weight * lamp * source.gain[channel] * color[channel];
            }
            total += weight;
            best = best.max(voice.weight);
            if weight > loudest.0 {
                loudest = (weight, voice.view);
            }
        }
        (total > 0.0).then(|| Sample {
            color: sum.map(|v| v / total),
            weight: best,
            view: loudest.1,
            views: spoken,
        })
    }
}

/// A pixel of the block with known depth, the middle one if it can be.
fn known_pixel(depth: &Image<f32>, left: usize, top: usize, right: usize, bottom: usize) -> Option<(usize, usize)> {
    let middle = ((left + right) / 2, (top + bottom) / 2);
    if depth.at(middle.0.min(right - 1), middle.1.min(bottom - 1)) > 0.0 {
        return Some((middle.0.min(right - 1), middle.1.min(bottom - 1)));
    }
    (top..bottom)
        .flat_map(|y| (left..right).map(move |x| (x, y)))
        .find(|&(x, y)| depth.at(x, y) > 0.0)
}

/// Bilinear value at a place at least half a pixel inside the image.
#[inline]
fn bilinear(image: &Mask, x: f32, y: f32) -> f32 {
    let (left, top) = (x as usize, y as usize);
    let (a, b) = (x - left as f32, y - top as f32);
    let width = image.width();
    let at = top * width + left;
    let pixels = &image.pixels()[at..at + width + 2];
    let upper = f32::from(pixels[0]) * (1.0 - a) + f32::from(pixels[1]) * a;
    let lower = f32::from(pixels[width]) * (1.0 - a) + f32::from(pixels[width + 1]) * a;
    upper * (1.0 - b) + lower * b
}

/// Bilinear colour at a place at least half a pixel inside the image.
#[inline]
pub(crate) fn bilinear_rgb(image: &Image<Rgb8>, x: f32, y: f32) -> [f32; 3] {
    let (left, top) = (x as usize, y as usize);
    let (a, b) = (x - left as f32, y - top as f32);
    let width = image.width();
    let at = top * width + left;
    let pixels = &image.pixels()[at..at + width + 2];
    let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
    let corners = [pixels[0], pixels[1], pixels[width], pixels[width + 1]];
    let mut color = [0.0; 3];
    for (weight, corner) in weights.iter().zip(&corners) {
        for (sum, &value) in color.iter_mut().zip(corner) {
            *sum += weight * f32::from(value);
        }
    }
    color
}
