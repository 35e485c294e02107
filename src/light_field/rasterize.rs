//! A mesh's depth as a pinhole camera sees it: a z-buffer.
//!
//! 1/z is linear over the picture of a plane, so the buffer holds 1/z, the largest wins, and one pass at the end turns it
//! into depth. A triangle is filled span by span: each row's span is the intersection of three half-lines, and the inside is
//! a running maximum that the compiler vectorises.

use crate::camera::model::CameraModel;
use crate::geometry::mesh::Mesh;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::Image;

/// Spans are widened by this much, so that rounding leaves no crack between neighbours.
const CRACK_PX: f32 = 1e-3;
/// A vertex nearer than this is behind the picture; its triangles are left out.
const NEAREST: f64 = 1e-6;

/// Renders depth; keeps its buffers, so that once warm it allocates nothing.
#[derive(Clone, Debug, Default)]
pub struct DepthRasterizer {
    /// Per vertex: x, y in px, 1/z (0 behind the camera).
    projected: Vec<[f32; 3]>,
}

impl DepthRasterizer {
    /// A rasteriser with empty buffers.
    pub fn new() -> Self {
        Self::default()
    }

    /// Depth along the optical axis into `out` (resized to the camera's picture), 0 where the mesh is not seen. The camera's
    /// lens is ignored: this is a pinhole's view.
    pub fn render(
        &mut self,
        mesh: &Mesh<World>,
        camera: &CameraModel,
        world_from_camera: &Transform<World, Camera>,
        out: &mut Image<f32>,
    ) {
        if out.size() == (camera.width, camera.height) {
            out.fill(0.0);
        } else {
            out.resize(camera.width, camera.height, 0.0);
        }
        if out.pixels().is_empty() {
            return;
        }
        let camera_from_world = world_from_camera.inverse();
        let rotation = camera_from_world.rotation().to_rotation_matrix();
        let (rotation, shift) = (rotation.matrix(), camera_from_world.translation());
        let k = &camera.intrinsics;
        self.projected.clear();
        self.projected.extend(mesh.vertices.iter().map(|vertex| {
            let p = rotation * vertex.coords + shift;
            if p.z <= NEAREST {
                return [0.0; 3];
            }
            let w = 1.0 / p.z;
            [(k.fx * p.x * w + k.cx) as f32, (k.fy * p.y * w + k.cy) as f32, w as f32]
        }));
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|i| self.projected.get(i as usize).copied().unwrap_or([0.0; 3]));
            if a[2] > 0.0 && b[2] > 0.0 && c[2] > 0.0 {
                fill(a, b, c, out);
            }
        }
        for depth in out.pixels_mut() {
            *depth = if *depth > 0.0 { 1.0 / *depth } else { 0.0 };
        }
    }
}

/// Max of the triangle's 1/z into `buffer`.
#[inline]
fn fill(a: [f32; 3], b: [f32; 3], c: [f32; 3], buffer: &mut Image<f32>) {
    let (width, height) = buffer.size();
    let top = a[1].min(b[1]).min(c[1]).ceil().max(0.0);
    let bottom = a[1].max(b[1]).max(c[1]).floor().min(height as f32 - 1.0);
    let left = a[0].min(b[0]).min(c[0]);
    let right = a[0].max(b[0]).max(c[0]);
    if top > bottom || right < 0.0 || left > width as f32 - 1.0 {
        return;
    }
    let area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
    if area.abs() < 1e-9 || !area.is_finite() {
        return;
    }
    let w_dx = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area;
    let w_dy = ((c[2] - a[2]) * (b[0] - a[0]) - (b[2] - a[2]) * (c[0] - a[0])) / area;
    let edges = [(a, b), (b, c), (c, a)].map(|(from, to)| {
        let rise = to[1] - from[1];
        // Which side of the edge is inside: the sign of rise tells, turned round for the other winding.
        let slope = if rise == 0.0 { 0.0 } else { (to[0] - from[0]) / rise };
        (from[0] - slope * from[1], slope, if area > 0.0 { rise } else { -rise })
    });
    let (left, right) = (left.max(0.0), right.min(width as f32 - 1.0));
    for y in top as usize..=bottom as usize {
        let row = y as f32;
        let (mut lo, mut hi) = (left, right);
        for (offset, slope, rise) in edges {
            let x = offset + slope * row;
            if rise < 0.0 {
                lo = lo.max(x - CRACK_PX);
            } else if rise > 0.0 {
                hi = hi.min(x + CRACK_PX);
            }
        }
        let (first, last) = (lo.ceil(), hi.floor());
        if first > last {
            continue;
        }
        let start = a[2] + w_dx * (first - a[0]) + w_dy * (row - a[1]);
        let (first, last) = (first as usize, last as usize);
        for (step, value) in buffer.row_mut(y)[first..=last].iter_mut().enumerate() {
            *value = value.max(start + w_dx * step as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;
    use crate::geometry::point::Point;

    fn camera() -> CameraModel {
        CameraModel {
            width: 64,
            height: 48,
            intrinsics: Intrinsics {
                fx: 60.0,
                fy: 58.0,
                cx: 31.0,
                cy: 24.5,
            },
            distortion: Distortion::None,
        }
    }

    /// The plainest possible: every pixel's ray against every triangle (Möller and Trumbore 1997).
    fn reference(mesh: &Mesh<World>, camera: &CameraModel) -> Image<f32> {
        let mut out = Image::filled(camera.width, camera.height, 0.0_f32);
        let k = &camera.intrinsics;
        for y in 0..camera.height {
            for x in 0..camera.width {
                let ray = Vector3::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy, 1.0);
                for t in &mesh.triangles {
                    let [a, b, c] = t.map(|i| mesh.vertices[i as usize].coords);
                    let (e1, e2) = (b - a, c - a);
                    let p = ray.cross(&e2);
                    let det = e1.dot(&p);
                    if det.abs() < 1e-12 {
                        continue;
                    }
                    let s = -a / det;
                    let u = s.dot(&p);
                    let q = s.cross(&e1);
                    let (v, z) = (ray.dot(&q), e2.dot(&q));
                    if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && z > 0.0 {
                        let best = out.at(x, y);
                        if best == 0.0 || (z as f32) < best {
                            out.set(x, y, z as f32);
                        }
                    }
                }
            }
        }
        out
    }

    #[test]
    fn agrees_with_ray_casting() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        for _ in 0..20 {
            let mut mesh = Mesh::<World>::default();
            for i in 0..12_u32 {
                for _ in 0..3 {
                    mesh.vertices.push(Point::new(
                        random.random_range(-40.0..40.0),
                        random.random_range(-30.0..30.0),
                        random.random_range(30.0..90.0),
                    ));
                }
                mesh.triangles.push([3 * i, 3 * i + 1, 3 * i + 2]);
            }
            let camera = camera();
            let expected = reference(&mesh, &camera);
            let mut found = Image::filled(0, 0, 0.0);
            DepthRasterizer::new().render(&mesh, &camera, &Transform::identity(), &mut found);
            // Only pixels whose centre lies within a thousandth of an edge may differ.
            let unlike = (expected.pixels().iter().zip(found.pixels()))
                .filter(|(a, b)| (*a - *b).abs() > 1e-3 * a.max(**b))
                .count();
            assert!(unlike <= 6, "{unlike} pixels differ");
        }
    }

    #[test]
    fn what_is_behind_or_beside_is_not_seen() {
        let mesh = Mesh {
            vertices: vec![
                Point::new(-1.0, -1.0, -5.0),
                Point::new(1.0, -1.0, -5.0),
                Point::new(0.0, 1.0, -5.0),
                Point::new(900.0, 0.0, 10.0),
                Point::new(901.0, 0.0, 10.0),
                Point::new(900.0, 1.0, 10.0),
            ],
            triangles: vec![[0, 1, 2], [3, 4, 5], [7, 8, 9]],
        };
        let mut found = Image::filled(0, 0, 0.0);
        DepthRasterizer::new().render(&mesh, &camera(), &Transform::identity(), &mut found);
        assert!(found.pixels().iter().all(|&z| z == 0.0));
    }
}
