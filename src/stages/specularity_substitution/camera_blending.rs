//! Which views may speak, and how loud: chosen at the corners of blocks, blended in between.
//!
//! The unstructured lumigraph (Buehler et al. 2001) calls this the camera blending field: weights at the vertices of a lattice,
//! interpolated over its faces, so that a view fades in and out and makes no seam.

use rayon::prelude::*;

use crate::stages::specularity_substitution::ensemble::{Ensemble, MOST_MEMBERS};
use crate::stages::specularity_substitution::grid::{CELLS_PER_BLOCK, Grid};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::{PLACES_AT_ONCE, Place, Views};
use crate::stages::specularity_substitution::single_pixels::{MOST_ADDITIONS, needed};

/// At most so many views speak at a corner for its places …
const MAX_VIEWS: usize = 8;
/// … and so many with those that single pixels need.
const MAX_WITH_MORE: usize = 12;

/// So many views are enough once every place was seen.
const ENOUGH_VIEWS: usize = 4;

/// Every place should be seen clean by so many views.
const WANTED_SIGHTINGS: usize = 3;

/// What sighting all places still wanted is worth against a worse angle, rad.
const SIGHTING_WORTH: f32 = 0.6;

/// Who is needed is heard, however badly it sees.
const LEAST_WEIGHT: f32 = 0.02;

/// The first sighting of a place is worth more than the second, and that more than the third.
const WORTH_OF_NEXT: [f32; WANTED_SIGHTINGS] = [1.0, 0.15, 0.05];

/// What a hazy sight of a place is worth that no chosen view sees clean.
const WORTH_OF_A_GLIMPSE: f32 = 0.3;

/// A view that speaks at a neighbouring corner already costs this much less, rad: fewer views are drawn, and they change less often.
const WORTH_OF_COMPANY: f32 = 0.08;

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
    voices: [Voice; MAX_WITH_MORE],
    count: usize,
    /// A bit for every member of the ensemble that speaks.
    members: u64,
}

impl Corner {
    /// Who speaks here.
    pub fn voices(&self) -> &[Voice] {
        &self.voices[..self.count]
    }

    fn has(&self, member: usize) -> bool {
        self.members >> member & 1 != 0
    }

    /// A member speaks too, not loud.
    fn add(&mut self, member: usize, view: u16) {
        if !self.has(member) && self.count < MAX_WITH_MORE {
            self.voices[self.count] = Voice {
                view,
                weight: LEAST_WEIGHT,
            };
            self.count += 1;
            self.members |= 1 << member;
        }
    }
}

/// Farther from the mask than this one place of a cell is enough; for a picture of the usual width.
const NEAR_PX: f32 = 5.0;

/// Places of a cell: what a view sees clean between two lobes may be no wider than half a cell.
const PLACES_PER_CELL: usize = 4;

/// The choice for one frame; keeps its memory.
#[derive(Debug, Default)]
pub struct CameraBlending {
    /// A pixel for every quarter of a cell.
    lattice: Vec<Place>,
    /// Those of them that lie in a hole, row by row of cells.
    places: Vec<Place>,
    /// Where each quarter of a cell stands among them.
    numbers: Vec<u32>,
    /// Per place a bit for every member of the ensemble that sees it clean.
    clean: Vec<u64>,
    /// The same for every one that sees it at all.
    seen: Vec<u64>,
    /// One place for every block with a hole.
    samples: Vec<Place>,
    ensemble: Ensemble,
    corners: Vec<Corner>,
    /// Per block, the members that its single pixels need.
    additions: Vec<[Option<u8>; MOST_ADDITIONS]>,
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

    /// Forget the last frame.
    pub fn forget(&mut self) {
        self.ensemble.forget();
    }

    /// Choose for the frame, at most `limit` views in all; `holes` is 1 for every cell with a pixel that may be replaced.
    ///
    /// The lamp's image moves little between neighbouring views, so the best views by angle are often dazzled at the very place that is
    /// asked for: views are taken one by one, each for its angle and for the places that too few of those before it saw.
    pub fn choose(&mut self, scene: &Scene<'_>, holes: &[u8], views: &Views<'_>, limit: usize) {
        self.find_places(scene, holes);
        self.ensemble.gather(views, &self.samples, limit);
        self.look(views);
        let (across, down) = scene.grid.blocks();
        self.corners.clear();
        for j in 0..=down {
            for i in 0..=across {
                let corner = self.choose_at(scene.grid, views, i, j);
                self.corners.push(corner);
            }
        }
        self.add_for_pixels(scene, views);
    }

    /// Between the lobes a view may see no more than a few pixels clean, fewer than a place stands for: what is specular and seen clean by
    /// nobody who speaks there is asked for pixel by pixel.
    fn add_for_pixels(&mut self, scene: &Scene<'_>, views: &Views<'_>) {
        let (blocks, rows) = scene.grid.blocks();
        let across = Self::corners_across(scene.grid);
        let corners_of = |(i, j): (usize, usize)| [0, 1, across, across + 1].map(|step| j * across + i + step);
        let members = self.ensemble.members();
        self.additions.clear();
        self.additions.resize(blocks * rows, [None; MOST_ADDITIONS]);
        let corners = &self.corners;
        self.additions.par_iter_mut().enumerate().for_each(|(index, additions)| {
            let block = (index % blocks, index / blocks);
            let heard = corners_of(block).iter().fold(0, |all, &corner| all | corners[corner].members);
            if heard != 0 {
                *additions = needed(scene, views, (members, heard), block);
            }
        });
        for (index, additions) in self.additions.iter().enumerate() {
            for member in additions.iter().flatten().map(|&member| usize::from(member)) {
                for corner in corners_of((index % blocks, index / blocks)) {
                    self.corners[corner].add(member, members[member]);
                }
            }
        }
    }

    /// A pixel for every quarter of a cell with a hole: the specular one nearest to the quarter's middle, else the one nearest to the mask.
    fn find_places(&mut self, scene: &Scene<'_>, holes: &[u8]) {
        let grid = scene.grid;
        let near = Scene::distance_of(NEAR_PX * scene.scale);
        self.lattice.clear();
        self.lattice.resize(grid.count() * PLACES_PER_CELL, Place::default());
        self.lattice
            .par_chunks_mut(grid.across * PLACES_PER_CELL)
            .enumerate()
            .for_each(|(row, places)| {
                for (index, place) in places.iter_mut().enumerate() {
                    let half = grid.cell / 2;
                    let (column, quarter) = (index / PLACES_PER_CELL, index % PLACES_PER_CELL);
                    if holes[row * grid.across + column] == 0 {
                        continue;
                    }
                    let (left, top) = (column * grid.cell + quarter % 2 * half, row * grid.cell + quarter / 2 * half);
                    let found = place_in(scene, left, top, half);
                    if quarter == 0 || scene.distance.at(found.x as usize, found.y as usize) <= near {
                        *place = found;
                    }
                }
            });
        self.places.clear();
        self.numbers.clear();
        for place in &self.lattice {
            self.numbers.push(self.places.len() as u32);
            if place.depth > 0.0 {
                self.places.push(*place);
            }
        }
        self.samples.clear();
        for (i, j) in grid.everywhere().places() {
            let places = places_of_block(grid, i, j).map(|p| self.lattice[p]).filter(|p| p.depth > 0.0);
            // The one nearest to the mask stands for all.
            self.samples
                .extend(places.min_by_key(|p| scene.distance.at(p.x as usize, p.y as usize)));
        }
    }

    /// How every member sees every place.
    fn look(&mut self, views: &Views<'_>) {
        let members = self.ensemble.members();
        self.clean.resize(self.places.len(), 0);
        self.seen.resize(self.places.len(), 0);
        (self.places.par_chunks(PLACES_AT_ONCE))
            .zip(self.clean.par_chunks_mut(PLACES_AT_ONCE))
            .zip(self.seen.par_chunks_mut(PLACES_AT_ONCE))
            .for_each(|((places, clean), seen)| {
                // A row for every member with a bit for every place; turned over, the other way round.
                let mut rows = [[0_u64; MOST_MEMBERS]; 2];
                for (member, &view) in members.iter().enumerate() {
                    let sights = views.look(view, places);
                    (rows[0][member], rows[1][member]) = (sights.clean, sights.seen);
                }
                for (rows, out) in rows.iter_mut().zip([clean, seen]) {
                    transpose(rows);
                    out.copy_from_slice(&rows[..out.len()]);
                }
            });
    }

    /// The places around corner (i, j).
    fn gather(&self, grid: Grid, i: usize, j: usize) -> Holes {
        let mut holes = Holes {
            index: [0; 4 * SUPPORT * SUPPORT * PLACES_PER_CELL],
            count: 0,
        };
        for place in places_around(grid, i, j).filter(|&p| self.lattice[p].depth > 0.0) {
            holes.index[holes.count] = self.numbers[place] as usize;
            holes.count += 1;
        }
        holes
    }

    fn choose_at(&self, grid: Grid, views: &Views<'_>, i: usize, j: usize) -> Corner {
        let mut corner = Corner::default();
        let holes = self.gather(grid, i, j);
        if holes.count == 0 {
            return corner;
        }
        let places = &holes.index[..holes.count];
        let across = Self::corners_across(grid);
        let before = [
            (i > 0).then(|| j * across + i - 1),
            (j > 0).then(|| (j - 1) * across + i),
            (i > 0 && j > 0).then(|| (j - 1) * across + i - 1),
            (j > 0 && i + 1 < across).then(|| (j - 1) * across + i + 1),
        ];
        let company = (before.into_iter().flatten()).fold(0, |all, corner| all | self.corners[corner].members);
        let members = self.ensemble.members();
        let first = self.places[places[0]];
        // Per member: its penalty, and a bit for every place that it sees clean, and that it sees at all.
        let mut penalties = [f32::INFINITY; MOST_MEMBERS];
        for (penalty, &view) in penalties.iter_mut().zip(members) {
            *penalty = views.penalty(view, first);
        }
        let (mut clean, mut seen) = ([0_u64; MOST_MEMBERS], [0_u64; MOST_MEMBERS]);
        for ((clean, seen), &place) in clean.iter_mut().zip(&mut seen).zip(places) {
            (*clean, *seen) = (self.clean[place], self.seen[place]);
        }
        transpose(&mut clean);
        transpose(&mut seen);
        let all = u64::MAX >> (u64::BITS as usize - places.len());
        let could_be_seen = (penalties.iter().zip(&clean))
            .filter(|(penalty, _)| penalty.is_finite())
            .fold(0, |all, (_, clean)| all | clean);
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
            let mut best: Option<(f32, usize)> = None;
            for member in 0..members.len() {
                let (penalty, clean, seen) = (penalties[member], clean[member], seen[member]);
                if !penalty.is_finite() || seen == 0 || corner.has(member) {
                    continue;
                }
                let mut worth = WORTH_OF_A_GLIMPSE * (seen & !clean & unseen).count_ones() as f32;
                for (wanted, next) in wanted.iter().zip(WORTH_OF_NEXT) {
                    worth += next * (clean & wanted).count_ones() as f32;
                }
                let cost =
                    penalty - SIGHTING_WORTH * worth / total - if company >> member & 1 != 0 { WORTH_OF_COMPANY } else { 0.0 };
                if best.is_none_or(|b| cost < b.0) {
                    best = Some((cost, member));
                }
            }
            // Places that no view saw stay unseen: nothing more is gained for them.
            let Some((_, member)) = best else { break };
            let (clean, seen) = (clean[member], seen[member]);
            for step in (0..WANTED_SIGHTINGS).rev() {
                let newly = wanted[step] & clean;
                wanted[step] &= !newly;
                if let Some(next) = wanted.get_mut(step + 1) {
                    *next |= newly;
                }
            }
            glimpsed_twice |= glimpsed & seen;
            glimpsed |= seen;
            // Until the threshold is known the weight holds the penalty.
            corner.voices[corner.count] = Voice {
                view: members[member],
                weight: penalties[member],
            };
            corner.count += 1;
            corner.members |= 1 << member;
        }
        // Buehler 2001: weights fall to zero at a threshold; here beyond the worst view that was needed.
        let threshold = 1.3 * corner.voices().iter().map(|v| v.weight).fold(0.01, f32::max);
        for voice in &mut corner.voices[..corner.count] {
            voice.weight = (1.0 - voice.weight / threshold).max(LEAST_WEIGHT);
        }
        corner
    }
}

/// Turn a matrix of bits over: bit `c` of row `r` becomes bit `r` of row `c`. Quarters of quarters are exchanged (Warren, Hacker's Delight,
/// 2nd ed., §7-3).
fn transpose(rows: &mut [u64; 64]) {
    let mut mask = 0x0000_0000_ffff_ffff_u64;
    let mut side = 32;
    while side > 0 {
        for row in (0..64).filter(|row| row & side == 0) {
            let exchanged = (rows[row] >> side ^ rows[row + side]) & mask;
            rows[row] ^= exchanged << side;
            rows[row + side] ^= exchanged;
        }
        side /= 2;
        mask ^= mask << side;
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

/// The cells of the blocks that meet at corner (i, j).
pub fn support(grid: Grid, i: usize, j: usize) -> impl Iterator<Item = usize> {
    let columns = (i * CELLS_PER_BLOCK).saturating_sub(SUPPORT)..(i * CELLS_PER_BLOCK + SUPPORT).min(grid.across);
    let rows = (j * CELLS_PER_BLOCK).saturating_sub(SUPPORT)..(j * CELLS_PER_BLOCK + SUPPORT).min(grid.down);
    rows.flat_map(move |row| columns.clone().map(move |column| row * grid.across + column))
}

fn places_of_block(grid: Grid, i: usize, j: usize) -> impl Iterator<Item = usize> {
    let columns = i * CELLS_PER_BLOCK..((i + 1) * CELLS_PER_BLOCK).min(grid.across);
    let rows = j * CELLS_PER_BLOCK..((j + 1) * CELLS_PER_BLOCK).min(grid.down);
    let cells = rows.flat_map(move |row| columns.clone().map(move |column| row * grid.across + column));
    cells.flat_map(|cell| cell * PLACES_PER_CELL..(cell + 1) * PLACES_PER_CELL)
}

fn places_around(grid: Grid, i: usize, j: usize) -> impl Iterator<Item = usize> {
    support(grid, i, j).flat_map(|cell| cell * PLACES_PER_CELL..(cell + 1) * PLACES_PER_CELL)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{DEPTH, Example, HOLE};
    use crate::stages::specularity_substitution::live::Live;

    /// Voices at the corner nearest to the hole's middle.
    fn voices(example: &Example) -> Vec<Voice> {
        let (scene, vantages) = (example.scene(), example.vantages());
        let views = example.views(&vantages);
        let mut blending = CameraBlending::default();
        let mut live = Live::default();
        live.look(&scene);
        blending.choose(&scene, &live.holes, &views, MOST_MEMBERS);
        let block = scene.grid.block();
        let corner = (HOLE.1 / block) * CameraBlending::corners_across(scene.grid) + HOLE.0 / block;
        blending.corners()[corner].voices().to_vec()
    }

    #[test]
    fn a_matrix_of_bits_is_turned_over() {
        let mut random = 1_u64;
        let rows: [u64; 64] = std::array::from_fn(|_| {
            random = random
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            random ^ random >> 29
        });
        let mut turned = rows;
        transpose(&mut turned);
        for (r, row) in rows.iter().enumerate() {
            for (c, column) in turned.iter().enumerate() {
                assert_eq!(row >> c & 1, column >> r & 1, "({r}, {c})");
            }
        }
    }

    #[test]
    fn the_nearest_views_speak_and_the_nearer_the_louder() {
        let moves: Vec<_> = (0..10).map(|i| (4.0 * (i + 1) as f32, 0.0)).collect();
        let voices = voices(&Example::new(&moves, [1.0; 3], (0.0, 0.0)));
        // All see the hole equally well, so the angle decides; three sightings are enough.
        assert_eq!(voices.iter().map(|v| v.view).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(voices.windows(2).all(|pair| pair[0].weight > pair[1].weight), "{voices:?}");
    }

    #[test]
    fn a_single_pixel_that_one_far_view_sees_clean_makes_it_speak() {
        let moves: Vec<_> = (0..5).map(|i| (1.0 + i as f32, 0.0)).chain([(0.0, 15.0)]).collect();
        for at in 0..16 {
            let place = (HOLE.0 + at % 4, HOLE.1 + at / 4);
            let mut example = Example::new(&moves, [1.0; 3], (0.0, 0.0));
            let vantages = example.vantages();
            for (view, vantage) in vantages.iter().enumerate().take(5) {
                let (u, v, _) = vantage.unwrap().mapping.apply(place.0 as f32, place.1 as f32, DEPTH);
                let confidence = &mut example.light_field.views[view].confidence;
                confidence.set((u + 0.5) as usize, (v + 0.5) as usize, 0);
            }
            example.look_again();
            let voices = voices(&example);
            assert!(voices.iter().any(|v| v.view == 5), "{place:?}: {voices:?}");
        }
    }

    #[test]
    fn a_dazzled_view_does_not_speak_however_near_it_is() {
        let mut example = Example::new(&[(1.0, 0.0), (6.0, 0.0), (8.0, 0.0), (9.0, 0.0)], [1.0; 3], (0.0, 0.0));
        example.light_field.views[0].confidence.fill(0);
        example.look_again();
        let voices = voices(&example);
        assert!(!voices.is_empty() && voices.iter().all(|v| v.view != 0), "{voices:?}");
    }
}
