//! Which views may speak, and how loud: chosen at the corners of blocks, blended in between.
//!
//! The unstructured lumigraph (Buehler et al. 2001) calls this the camera blending field: weights at the vertices of a lattice,
//! interpolated over its faces, so that a view fades in and out and makes no seam.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::camera::model::CameraModel;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Grid};
use crate::stages::specularity_substitution::scene::Scene;

/// At most so many views speak at a corner.
pub const MAX_VIEWS: usize = 8;

/// So many views are enough once every place was seen.
const ENOUGH_VIEWS: usize = 4;

/// Every place should be seen clean by so many views.
const WANTED_SIGHTINGS: usize = 3;

/// What sighting all places still wanted is worth against a worse angle, rad.
const SIGHTING_WORTH: f32 = 0.6;

/// The first sighting of a place is worth more than the second, and that more than the third.
const WORTH_OF_NEXT: [f32; WANTED_SIGHTINGS] = [1.0, 0.15, 0.05];

/// What a hazy sight of a place is worth that no chosen view sees clean.
const WORTH_OF_A_GLIMPSE: f32 = 0.3;

/// A view that speaks at a neighbouring corner already costs this much less, rad: fewer views are drawn, and they change less often.
const WORTH_OF_COMPANY: f32 = 0.08;

/// A view's pixel counts as a sighting from this confidence on; below it speaks only where nobody else does.
const HEARD_FROM: u8 = 120;

/// Cells around a corner that its views should see.
const SUPPORT: usize = CELLS_PER_BLOCK;

/// A view that speaks, and how loud.
#[derive(Clone, Copy, Debug, Default)]
pub struct Voice {
    /// Index of the view.
    pub view: u16,
    /// Its weight by angle, resolution and field of view, 0…1.
    pub weight: f32,
}

/// Who speaks at a corner of blocks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Corner {
    voices: [Voice; MAX_VIEWS],
    count: usize,
}

impl Corner {
    /// Who speaks here.
    pub fn voices(&self) -> &[Voice] {
        &self.voices[..self.count]
    }

    fn speaks(&self, view: u16) -> bool {
        self.voices().iter().any(|v| v.view == view)
    }
}

/// A pixel of a hole, standing for a quarter of its cell.
#[derive(Clone, Copy, Debug, Default)]
struct Place {
    x: f32,
    y: f32,
    /// mm; 0 where the quarter has no hole.
    depth: f32,
}

/// Places of a cell: what a view sees clean between two lobes may be no wider than half a cell.
const PLACES_PER_CELL: usize = 4;

/// How a view sees a place.
const UNSEEN: u8 = 0;
const HAZY: u8 = 1;
const CLEAN: u8 = 2;

/// The choice for one frame; keeps its memory.
#[derive(Debug, Default)]
pub struct CameraBlending {
    places: Vec<Place>,
    sights: Vec<u8>,
    corners: Vec<Corner>,
    penalties: Vec<f32>,
}

impl CameraBlending {
    /// Corners in a row.
    pub fn corners_across(grid: Grid) -> usize {
        grid.blocks().0 + 1
    }

    /// Who speaks at every corner, row by row.
    pub fn corners(&self) -> &[Corner] {
        &self.corners
    }

    /// Choose for the frame. `mappings` holds one entry a view, `None` where it cannot see the frame.
    ///
    /// The lamp's image moves little between neighbouring views, so the best views by angle are often dazzled at the very place that is
    /// asked for: views are taken one by one, each for its angle and for the places that too few of those before it saw.
    pub fn choose(&mut self, scene: &Scene<'_>, mappings: &[Option<Mapping>]) {
        self.find_places(scene);
        self.look(scene, mappings);
        let (across, down) = scene.grid.blocks();
        let views = mappings.len();
        self.penalties.clear();
        self.penalties.resize((across + 1) * (down + 1) * views, f32::INFINITY);
        let places = &self.places;
        self.penalties
            .par_chunks_mut(((across + 1) * views).max(1))
            .enumerate()
            .for_each(|(j, row)| {
                for (i, penalties) in row.chunks_mut(views.max(1)).enumerate() {
                    let Some(place) = places_around(scene.grid, i, j).map(|p| places[p]).find(|p| p.depth > 0.0) else {
                        continue;
                    };
                    let point = world_point(scene, place);
                    for ((penalty, view), mapping) in penalties.iter_mut().zip(&scene.light_field.views).zip(mappings) {
                        *penalty = mapping
                            .as_ref()
                            .map_or(f32::INFINITY, |m| penalty_of(view, m, scene, place, &point));
                    }
                }
            });
        self.corners.clear();
        for j in 0..=down {
            for i in 0..=across {
                let corner = self.choose_at(scene.grid, i, j, views);
                self.corners.push(corner);
            }
        }
    }

    /// A pixel for every quarter of a cell with a hole: the specular one nearest to the quarter's middle, else the one nearest to the mask.
    fn find_places(&mut self, scene: &Scene<'_>) {
        let grid = scene.grid;
        self.places.clear();
        self.places.resize(grid.count() * PLACES_PER_CELL, Place::default());
        self.places
            .par_chunks_mut(grid.across * PLACES_PER_CELL)
            .enumerate()
            .for_each(|(row, places)| {
                for (index, place) in places.iter_mut().enumerate() {
                    let half = grid.cell / 2;
                    let (column, quarter) = (index / PLACES_PER_CELL, index % PLACES_PER_CELL);
                    let (left, top) = (column * grid.cell + quarter % 2 * half, row * grid.cell + quarter / 2 * half);
                    *place = place_in(scene, left, top, half);
                }
            });
    }

    /// How every view sees every place.
    fn look(&mut self, scene: &Scene<'_>, mappings: &[Option<Mapping>]) {
        let views = mappings.len();
        self.sights.clear();
        self.sights.resize(self.places.len() * views, UNSEEN);
        self.sights
            .par_chunks_mut(views.max(1))
            .zip(&self.places)
            .with_min_len(256)
            .for_each(|(sights, place)| {
                if place.depth > 0.0 {
                    for ((sight, mapping), view) in sights.iter_mut().zip(mappings).zip(&scene.light_field.views) {
                        *sight = mapping.as_ref().map_or(UNSEEN, |m| sight_of(view, m, *place));
                    }
                }
            });
    }

    fn choose_at(&self, grid: Grid, i: usize, j: usize, views: usize) -> Corner {
        let mut corner = Corner::default();
        let holes = gather(grid, i, j, &self.places);
        if holes.count == 0 {
            return corner;
        }
        let places = &holes.index[..holes.count];
        let across = Self::corners_across(grid);
        let neighbours = [
            (i > 0).then(|| &self.corners[j * across + i - 1]),
            (j > 0).then(|| &self.corners[(j - 1) * across + i]),
            (i > 0 && j > 0).then(|| &self.corners[(j - 1) * across + i - 1]),
            (j > 0 && i + 1 < across).then(|| &self.corners[(j - 1) * across + i + 1]),
        ];
        let penalties = &self.penalties[(j * across + i) * views..][..views];
        let bits = |view: usize, least: u8| -> u64 {
            let seen = |(bit, &place): (usize, &usize)| u64::from(self.sights[place * views + view] >= least) << bit;
            places.iter().enumerate().map(seen).sum()
        };
        let all = u64::MAX >> (u64::BITS as usize - places.len());
        let could_be_seen = (penalties.iter().enumerate())
            .filter(|(_, penalty)| penalty.is_finite())
            .fold(0, |seen, (view, _)| seen | bits(view, CLEAN));
        // Places seen so often, and places that were glimpsed twice.
        let mut wanted = [all, 0, 0];
        let (mut glimpsed, mut glimpsed_twice) = (0_u64, 0_u64);
        while corner.count < MAX_VIEWS {
            let unseen = wanted[0] & !glimpsed_twice;
            let still_to_be_seen = wanted[0] & could_be_seen != 0 || unseen != 0;
            let total: f32 = wanted
                .iter()
                .zip(WORTH_OF_NEXT)
                .map(|(w, worth)| worth * w.count_ones() as f32)
                .sum();
            if total == 0.0 || !still_to_be_seen && corner.count >= ENOUGH_VIEWS {
                break;
            }
            let mut best: Option<(f32, u16, u64, u64)> = None;
            for (view, &penalty) in penalties.iter().enumerate() {
                if !penalty.is_finite() || corner.speaks(view as u16) {
                    continue;
                }
                let (clean, hazy) = (bits(view, CLEAN), bits(view, HAZY));
                if hazy == 0 {
                    continue;
                }
                let mut worth = WORTH_OF_A_GLIMPSE * (hazy & !clean & unseen).count_ones() as f32;
                for (wanted, next) in wanted.iter().zip(WORTH_OF_NEXT) {
                    worth += next * (clean & wanted).count_ones() as f32;
                }
                let company = neighbours.iter().flatten().any(|n| n.speaks(view as u16));
                let cost = penalty - SIGHTING_WORTH * worth / total - if company { WORTH_OF_COMPANY } else { 0.0 };
                if best.is_none_or(|b| cost < b.0) {
                    best = Some((cost, view as u16, clean, hazy));
                }
            }
            // Places that no view saw stay unseen: nothing more is gained for them.
            let Some((_, view, clean, hazy)) = best else { break };
            for step in (0..WANTED_SIGHTINGS).rev() {
                let seen = wanted[step] & clean;
                wanted[step] &= !seen;
                if let Some(next) = wanted.get_mut(step + 1) {
                    *next |= seen;
                }
            }
            glimpsed_twice |= glimpsed & hazy;
            glimpsed |= hazy;
            // Until the threshold is known the weight holds the penalty.
            corner.voices[corner.count] = Voice {
                view,
                weight: penalties[usize::from(view)],
            };
            corner.count += 1;
        }
        // Buehler 2001: weights fall to zero at a threshold; here beyond the worst view that was needed.
        let threshold = 1.3 * corner.voices().iter().map(|v| v.weight).fold(0.01, f32::max);
        for voice in &mut corner.voices[..corner.count] {
            voice.weight = (1.0 - voice.weight / threshold).max(0.02);
        }
        corner
    }
}

/// The pixel that stands for a square.
fn place_in(scene: &Scene<'_>, left: usize, top: usize, side: usize) -> Place {
    let (mut best, mut place) = (u32::MAX, Place::default());
    for y in top..(top + side).min(scene.grid.height) {
        let columns = left..(left + side).min(scene.grid.width);
        if columns.is_empty() {
            break;
        }
        for (x, &distance) in columns.clone().zip(&scene.distance.row(y)[columns]) {
            if distance > scene.reach || scene.forbidden.at(x, y) != 0 {
                continue;
            }
            let off_centre = (x - left).abs_diff(side / 2).max((y - top).abs_diff(side / 2));
            let cost = u32::from(distance) * 64 + off_centre as u32;
            let depth = scene.depth_at(x, y);
            if cost < best && depth > 0.0 {
                best = cost;
                place = Place {
                    x: x as f32,
                    y: y as f32,
                    depth,
                };
            }
        }
    }
    place
}

/// Places of a corner's support that have a hole.
struct Holes {
    index: [usize; 4 * SUPPORT * SUPPORT * PLACES_PER_CELL],
    count: usize,
}

fn gather(grid: Grid, i: usize, j: usize, places: &[Place]) -> Holes {
    let mut holes = Holes {
        index: [0; 4 * SUPPORT * SUPPORT * PLACES_PER_CELL],
        count: 0,
    };
    for place in places_around(grid, i, j).filter(|&p| places[p].depth > 0.0) {
        holes.index[holes.count] = place;
        holes.count += 1;
    }
    holes
}

/// The cells of the blocks that meet at corner (i, j).
pub fn support(grid: Grid, i: usize, j: usize) -> impl Iterator<Item = usize> {
    let columns = (i * CELLS_PER_BLOCK).saturating_sub(SUPPORT)..(i * CELLS_PER_BLOCK + SUPPORT).min(grid.across);
    let rows = (j * CELLS_PER_BLOCK).saturating_sub(SUPPORT)..(j * CELLS_PER_BLOCK + SUPPORT).min(grid.down);
    rows.flat_map(move |row| columns.clone().map(move |column| row * grid.across + column))
}

fn places_around(grid: Grid, i: usize, j: usize) -> impl Iterator<Item = usize> {
    support(grid, i, j).flat_map(|cell| cell * PLACES_PER_CELL..(cell + 1) * PLACES_PER_CELL)
}

fn world_point(scene: &Scene<'_>, place: Place) -> Vector3<f64> {
    let k = &scene.camera.intrinsics;
    let z = f64::from(place.depth);
    let point = Point3::new(
        (f64::from(place.x) - k.cx) / k.fx * z,
        (f64::from(place.y) - k.cy) / k.fy * z,
        z,
    );
    (scene.eye.isometry() * point).coords
}

/// Angle between the viewing rays, loss of resolution and nearness to the view's border, rad-like; infinite if not in the view.
fn penalty_of(view: &View, mapping: &Mapping, scene: &Scene<'_>, place: Place, point: &Vector3<f64>) -> f32 {
    let (x, y, depth) = mapping.apply(place.x, place.y, place.depth);
    let margin = border_distance(&view.camera, x, y);
    if depth <= 0.0 || margin.is_nan() || margin < 0.02 * view.camera.width as f32 {
        return f32::INFINITY;
    }
    let (to_view, to_eye) = (point - view.world_from_camera.translation(), point - scene.eye.translation());
    let angle = to_view.angle(&to_eye);
    let resolution = (to_view.norm() / to_eye.norm() - 1.0).max(0.0);
    let border = margin / (0.1 * view.camera.width as f32);
    (angle + 0.3 * resolution + 1e-4) as f32 + 0.1 * (1.0 - border).max(0.0)
}

fn border_distance(camera: &CameraModel, x: f32, y: f32) -> f32 {
    x.min(y)
        .min(camera.width as f32 - 1.0 - x)
        .min(camera.height as f32 - 1.0 - y)
}

fn sight_of(view: &View, mapping: &Mapping, place: Place) -> u8 {
    let (x, y, depth) = mapping.apply(place.x, place.y, place.depth);
    let (width, height) = view.image.size();
    if !(depth > 0.0 && x >= 1.0 && y >= 1.0 && x < width as f32 - 2.0 && y < height as f32 - 2.0) {
        return UNSEEN;
    }
    let (column, row) = ((x + 0.5) as usize, (y + 0.5) as usize);
    let confidence = view.confidence.at(column, row);
    if confidence == 0 || !is_unoccluded(view.depth.at(column, row), depth) {
        UNSEEN
    } else if confidence < HEARD_FROM {
        HAZY
    } else {
        CLEAN
    }
}
