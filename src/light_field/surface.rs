//! Depth maps fused into one triangle mesh.
//!
//! Each depth map votes, for every voxel near what it sees, for the signed distance to the surface along its rays; the weighted
//! mean of the votes is the field (Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images",
//! SIGGRAPH 1996, doi:10.1145/237170.237269). Its zero set is meshed by surface nets (Gibson, "Constrained Elastic Surface
//! Nets", MICCAI 1998): one vertex a cell, the mean of the cell's edge crossings, and a quad per crossed grid edge; vertices
//! are shared by construction. Where fewer than two views looked there is no surface: holes are honest.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::geometry::mesh::Mesh;
use crate::geometry::point::Point;
use crate::geometry::space::World;
use crate::light_field::depth::stereo::DepthMap;

/// How depth maps are fused.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SurfaceSettings {
    /// About how many triangles the surface should have; decides the voxel size.
    pub triangles: usize,
    /// Upper bound on voxels; decides the voxel size of deep scenes.
    pub max_voxels: usize,
    /// Depth votes within this many voxels of the surface.
    pub truncation_voxels: f32,
    /// Pieces smaller than this share of the surface are dropped.
    pub smallest_piece: f64,
}

impl Default for SurfaceSettings {
    fn default() -> Self {
        Self {
            triangles: 60_000,
            max_voxels: 6_000_000,
            truncation_voxels: 4.0,
            smallest_piece: 0.01,
        }
    }
}

/// A box of voxels, its axes those of the middle camera.
#[derive(Clone, Debug)]
struct Grid {
    size: [usize; 3],
    /// World from grid axes.
    rotation: Matrix3<f32>,
    origin: Vector3<f32>,
    voxel: f32,
}

impl Grid {
    fn world(&self, x: f32, y: f32, z: f32) -> Vector3<f32> {
        self.origin + self.rotation * (Vector3::new(x, y, z) * self.voxel)
    }

    fn index(&self, x: usize, y: usize, z: usize) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }

    fn count(&self) -> usize {
        self.size.iter().product()
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Voxel {
    /// In truncation lengths, −1…1; meaningless when `weight` is 0.
    distance: f32,
    weight: f32,
    views: u8,
}

/// The surface, or `None` when the maps hold too little depth.
pub fn fuse(maps: &[DepthMap], settings: &SurfaceSettings) -> Option<Mesh<World>> {
    let grid = enclosing_grid(maps, settings)?;
    let mut voxels = vec![Voxel::default(); grid.count()];
    let layer = grid.size[0] * grid.size[1];
    let truncation = settings.truncation_voxels * grid.voxel;
    let needed = if maps.len() >= 2 { 2 } else { 1 };
    voxels
        .par_chunks_mut(layer)
        .enumerate()
        .for_each(|(z, layer)| integrate(&grid, z, maps, truncation, layer));
    let voxels = smoothed(&grid, &voxels);
    let mesh = surface_net(&grid, &voxels, needed);
    (!mesh.triangles.is_empty()).then(|| without_small_pieces(&mesh, settings.smallest_piece))
}

fn enclosing_grid(maps: &[DepthMap], settings: &SurfaceSettings) -> Option<Grid> {
    let middle = maps.get(maps.len() / 2)?;
    let world_from_grid = middle.world_from_camera.rotation().to_rotation_matrix();
    let grid_from_world = world_from_grid.inverse();
    let mut along: [Vec<f64>; 3] = Default::default();
    let mut footprint = Vec::new();
    for map in maps {
        let k = &map.intrinsics;
        for y in (0..map.depth.height()).step_by(5) {
            for x in (0..map.depth.width()).step_by(5) {
                let z = f64::from(map.depth.at(x, y));
                if z > 0.0 {
                    let local = Vector3::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy, 1.0) * z;
                    let p = grid_from_world * (map.world_from_camera * Point::from_coords(local)).coords;
                    for axis in 0..3 {
                        along[axis].push(p[axis]);
                    }
                    footprint.push(z / k.fx);
                }
            }
        }
    }
    if footprint.len() < 50 {
        return None;
    }
    for values in along.iter_mut().chain([&mut footprint]) {
        values.sort_by(f64::total_cmp);
    }
    let share = |values: &[f64], q: f64| values[((values.len() - 1) as f64 * q) as usize];
    let low = Vector3::from_fn(|axis, _| share(&along[axis], 0.002));
    let high = Vector3::from_fn(|axis, _| share(&along[axis], 0.998));
    let size = high - low;
    // A surface over the box's face, somewhat tilted; two triangles a voxel.
    let area = 1.3 * size.x * size.y;
    let mut voxel = (2.0 * area / settings.triangles as f64).sqrt().max(share(&footprint, 0.5));
    let margin = |voxel: f64| size.add_scalar(2.0 * f64::from(settings.truncation_voxels) * voxel);
    let volume = margin(voxel).product() / voxel.powi(3);
    if volume > settings.max_voxels as f64 {
        voxel *= (volume / settings.max_voxels as f64).cbrt();
    }
    let full = margin(voxel);
    let origin = world_from_grid * low.add_scalar(-f64::from(settings.truncation_voxels) * voxel);
    Some(Grid {
        size: [0, 1, 2].map(|axis| (full[axis] / voxel).ceil() as usize + 1),
        rotation: world_from_grid.matrix().cast(),
        origin: origin.cast(),
        voxel: voxel as f32,
    })
}

fn integrate(grid: &Grid, z: usize, maps: &[DepthMap], truncation: f32, layer: &mut [Voxel]) {
    for map in maps {
        let camera_from_world = map.world_from_camera.inverse();
        let rotation: Matrix3<f32> = camera_from_world.rotation().to_rotation_matrix().matrix().cast();
        let shift: Vector3<f32> = camera_from_world.translation().cast();
        let k = &map.intrinsics;
        let (fx, fy, cx, cy) = (k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32);
        let step = rotation * grid.rotation.column(0) * grid.voxel;
        let (right, bottom) = (map.depth.width() as f32 - 1.001, map.depth.height() as f32 - 1.001);
        for y in 0..grid.size[1] {
            let start = rotation * grid.world(0.0, y as f32, z as f32) + shift;
            for x in 0..grid.size[0] {
                let p = start + step * x as f32;
                if p.z <= 0.0 {
                    continue;
                }
                let inverse = 1.0 / p.z;
                let (u, v) = (fx * p.x * inverse + cx, fy * p.y * inverse + cy);
                if !(u >= 0.0 && v >= 0.0 && u <= right && v <= bottom) {
                    continue;
                }
                let Some((seen, weight)) = depth_at(map, u, v, truncation) else {
                    continue;
                };
                let distance = (seen - p.z) / truncation;
                if distance < -1.0 {
                    continue;
                }
                let voxel = &mut layer[y * grid.size[0] + x];
                let near = distance < 1.0;
                // Free space far in front counts little, so that a stray depth does not carve the surface away.
                let weight = if near { weight } else { 0.1 * weight };
                let total = voxel.weight + weight;
                voxel.distance += (distance.min(1.0) - voxel.distance) * weight / total.max(1e-12);
                voxel.weight = total;
                voxel.views = voxel.views.saturating_add(u8::from(near));
            }
        }
    }
}

/// Bilinear depth and weight where the four pixels show one surface.
#[inline]
fn depth_at(map: &DepthMap, u: f32, v: f32, spread: f32) -> Option<(f32, f32)> {
    let (left, top) = (u as usize, v as usize);
    let width = map.depth.width();
    let at = top * width + left;
    let depth = map.depth.pixels();
    let [a, b, c, d] = [depth[at], depth[at + 1], depth[at + width], depth[at + width + 1]];
    let least = a.min(b).min(c).min(d);
    if least <= 0.0 || a.max(b).max(c).max(d) - least > spread {
        return None;
    }
    let (fx, fy) = (u - left as f32, v - top as f32);
    let upper = a + fx * (b - a);
    let lower = c + fx * (d - c);
    Some((upper + fy * (lower - upper), map.weight.pixels()[at].max(1e-3)))
}

/// One round of a weighted 3×3×3 binomial over known voxels: noise of single maps goes, tissue is smooth at this size.
fn smoothed(grid: &Grid, voxels: &[Voxel]) -> Vec<Voxel> {
    let mut current = voxels.to_vec();
    let strides = [1, grid.size[0], grid.size[0] * grid.size[1]];
    for (axis, &stride) in strides.iter().enumerate() {
        let source = current.clone();
        let layer = strides[2];
        current.par_chunks_mut(layer).enumerate().for_each(|(z, out)| {
            for (offset, voxel) in out.iter_mut().enumerate() {
                let at = z * layer + offset;
                let place = [offset % grid.size[0], offset / grid.size[0], z][axis];
                if voxel.weight <= 0.0 || place == 0 || place + 1 == grid.size[axis] {
                    continue;
                }
                let (before, after) = (&source[at - stride], &source[at + stride]);
                // Beyond the truncation the field is flat; mixing that in would bend the zero set.
                let usable = |v: &Voxel| v.weight > 0.0 && v.distance.abs() < 0.99;
                if usable(before) && usable(after) && usable(&source[at]) {
                    let (wa, wb, wc) = (before.weight, 2.0 * source[at].weight, after.weight);
                    voxel.distance = (wa * before.distance + wb * source[at].distance + wc * after.distance) / (wa + wb + wc);
                }
            }
        });
    }
    current
}

const CORNERS: [[usize; 3]; 8] = [
    [0, 0, 0],
    [1, 0, 0],
    [0, 1, 0],
    [1, 1, 0],
    [0, 0, 1],
    [1, 0, 1],
    [0, 1, 1],
    [1, 1, 1],
];
const EDGES: [[usize; 2]; 12] = [
    [0, 1],
    [2, 3],
    [4, 5],
    [6, 7],
    [0, 2],
    [1, 3],
    [4, 6],
    [5, 7],
    [0, 4],
    [1, 5],
    [2, 6],
    [3, 7],
];

fn surface_net(grid: &Grid, voxels: &[Voxel], needed: u32) -> Mesh<World> {
    let [nx, ny, nz] = grid.size;
    let mut vertex_of = vec![u32::MAX; grid.count()];
    let mut mesh = Mesh::default();
    for z in 0..nz.saturating_sub(1) {
        for y in 0..ny.saturating_sub(1) {
            for x in 0..nx.saturating_sub(1) {
                let corners = CORNERS.map(|[dx, dy, dz]| voxels[grid.index(x + dx, y + dy, z + dz)]);
                let inside = corners.iter().filter(|v| v.distance < 0.0).count();
                if inside == 0 || inside == 8 || corners.iter().any(|v| v.weight <= 0.0) {
                    continue;
                }
                if corners.iter().map(|v| u32::from(v.views)).sum::<u32>() < 8 * needed {
                    continue;
                }
                let (mut sum, mut crossings) = (Vector3::zeros(), 0.0_f32);
                for [a, b] in EDGES {
                    let (da, db) = (corners[a].distance, corners[b].distance);
                    if (da < 0.0) != (db < 0.0) {
                        let t = da / (da - db);
                        let from = Vector3::from(CORNERS[a].map(|v| v as f32));
                        let to = Vector3::from(CORNERS[b].map(|v| v as f32));
                        sum += from + (to - from) * t;
                        crossings += 1.0;
                    }
                }
                let local = sum / crossings + Vector3::new(x as f32, y as f32, z as f32);
                vertex_of[grid.index(x, y, z)] = mesh.vertices.len() as u32;
                mesh.vertices
                    .push(Point::from_coords(grid.world(local.x, local.y, local.z).cast()));
            }
        }
    }
    let strides = [1, nx, nx * ny];
    for z in 1..nz.saturating_sub(1) {
        for y in 1..ny.saturating_sub(1) {
            for x in 1..nx.saturating_sub(1) {
                let at = grid.index(x, y, z);
                for axis in 0..3 {
                    let (here, there) = (&voxels[at], &voxels[at + strides[axis]]);
                    if here.weight <= 0.0 || there.weight <= 0.0 || (here.distance < 0.0) == (there.distance < 0.0) {
                        continue;
                    }
                    // The four cells around the edge, in turning order about the axis.
                    let (s, t) = (strides[(axis + 1) % 3], strides[(axis + 2) % 3]);
                    let quad = [at, at - s, at - s - t, at - t].map(|cell| vertex_of[cell]);
                    if quad.contains(&u32::MAX) {
                        continue;
                    }
                    // Counter-clockwise seen from the free side.
                    let [a, b, c, d] = if here.distance < 0.0 {
                        quad
                    } else {
                        [quad[3], quad[2], quad[1], quad[0]]
                    };
                    let span =
                        |i: u32, j: u32| (mesh.vertices[i as usize].coords - mesh.vertices[j as usize].coords).norm_squared();
                    if span(a, c) <= span(b, d) {
                        mesh.triangles.extend([[a, b, c], [a, c, d]]);
                    } else {
                        mesh.triangles.extend([[a, b, d], [b, c, d]]);
                    }
                }
            }
        }
    }
    mesh
}

/// The mesh without unused vertices and without pieces that hold less than `share` of all triangles.
fn without_small_pieces(mesh: &Mesh<World>, share: f64) -> Mesh<World> {
    let mut parent: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    fn root(parent: &mut [u32], mut at: u32) -> u32 {
        while parent[at as usize] != at {
            parent[at as usize] = parent[parent[at as usize] as usize];
            at = parent[at as usize];
        }
        at
    }
    for &[a, b, c] in &mesh.triangles {
        let a = root(&mut parent, a);
        for other in [b, c] {
            let other = root(&mut parent, other);
            parent[other as usize] = a;
        }
    }
    let mut triangles_of = vec![0_usize; mesh.vertices.len()];
    for t in &mesh.triangles {
        triangles_of[root(&mut parent, t[0]) as usize] += 1;
    }
    let least = (share * mesh.triangles.len() as f64) as usize;
    let mut renamed = vec![u32::MAX; mesh.vertices.len()];
    let mut out = Mesh::default();
    for t in &mesh.triangles {
        if triangles_of[root(&mut parent, t[0]) as usize] < least {
            continue;
        }
        out.triangles.push(t.map(|v| {
            if renamed[v as usize] == u32::MAX {
                renamed[v as usize] = out.vertices.len() as u32;
                out.vertices.push(mesh.vertices[v as usize]);
            }
            renamed[v as usize]
        }));
    }
    out
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::camera::intrinsics::Intrinsics;
    use crate::geometry::transform::Transform;
    use crate::image::buffer::Image;

    /// Exact depth of a sphere of radius 20 mm at (0, 0, 80), from a camera `x` mm to the side that looks at it.
    fn map(x: f64) -> DepthMap {
        let intrinsics = Intrinsics {
            fx: 200.0,
            fy: 200.0,
            cx: 79.5,
            cy: 59.5,
        };
        let pose = Transform::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(0.0, -(x / 80.0).atan(), 0.0)),
            Vector3::new(x, 0.0, 0.0),
        );
        let center = (pose.inverse() * Point::new(0.0, 0.0, 80.0)).coords;
        let mut depth = Image::filled(160, 120, 0.0);
        for v in 0..120 {
            for u in 0..160 {
                let ray = Vector3::new((u as f64 - 79.5) / 200.0, (v as f64 - 59.5) / 200.0, 1.0);
                let (a, b, c) = (ray.norm_squared(), ray.dot(&center), center.norm_squared() - 400.0);
                if b * b > a * c {
                    depth.set(u, v, ((b - (b * b - a * c).sqrt()) / a) as f32);
                }
            }
        }
        DepthMap {
            depth,
            weight: Image::filled(160, 120, 1.0),
            intrinsics,
            world_from_camera: pose,
        }
    }

    #[test]
    fn a_sphere_comes_back_facing_the_cameras() {
        let maps: Vec<DepthMap> = [-15.0, -5.0, 5.0, 15.0].map(map).to_vec();
        let mesh = fuse(
            &maps,
            &SurfaceSettings {
                triangles: 8000,
                ..Default::default()
            },
        )
        .unwrap();
        assert!((2000..40_000).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
        let center = Vector3::new(0.0, 0.0, 80.0);
        let (mut squares, mut count) = (0.0, 0.0);
        for vertex in &mesh.vertices {
            let outward = vertex.coords - center;
            // Near the silhouette depth maps are steep; the rest must be within a small part of a voxel (0.8 mm).
            if outward.z < -10.0 {
                squares += (outward.norm() - 20.0).powi(2);
                count += 1.0;
            }
        }
        assert!((squares / count).sqrt() < 0.06, "{}", (squares / count).sqrt());
        let facing = (mesh.triangles.iter())
            .filter(|t| {
                let [a, b, c] = t.map(|i| mesh.vertices[i as usize].coords);
                (b - a).cross(&(c - a)).dot(&(a - center)) > 0.0
            })
            .count();
        assert!(
            facing as f64 > 0.99 * mesh.triangles.len() as f64,
            "{facing} of {}",
            mesh.triangles.len()
        );
    }

    #[test]
    fn what_one_view_alone_saw_is_no_surface() {
        assert!(fuse(&[map(0.0)], &SurfaceSettings::default()).is_some());
        let mut far = map(0.0);
        far.depth.fill(0.0);
        assert!(fuse(&[map(0.0), far], &SurfaceSettings::default()).is_none());
    }
}
