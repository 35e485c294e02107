//! Which views may speak for a region.

use nalgebra::Vector3;

use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::view::{LightField, View};

/// At most so many views are blended.
pub const MAX_VIEWS: usize = 8;

/// Places of a hole that are asked for, at most: one bit each.
pub const MAX_PLACES: usize = 64;

/// So many views are enough once every place was seen.
const ENOUGH_VIEWS: usize = 4;

/// Every place of a hole should be seen by so many views.
const WANTED_SIGHTINGS: usize = 3;

/// What sighting all places still wanted is worth against a worse angle, rad.
const SIGHTING_WORTH: f64 = 0.5;

/// The first sighting of a place is worth more than the second, and that more than the third.
const WORTH_OF_NEXT: [f64; WANTED_SIGHTINGS] = [1.0, 0.2, 0.1];

/// What a hazy sight of a place is worth that no chosen view sees clean.
const WORTH_OF_A_GLIMPSE: f64 = 0.3;

/// A view's pixel counts as a sighting from this confidence on; below it speaks only where nobody else does.
const HEARD_FROM: u8 = 25;

/// Relative difference of depth beyond which a view sees something else.
const OCCLUSION_TOLERANCE: f32 = 0.03;

/// A view that may speak, and how loud.
#[derive(Clone, Copy, Debug, Default)]
pub struct Candidate {
    /// Index of the view.
    pub view: usize,
    /// Its weight by angle, resolution and field of view, 0…1.
    pub weight: f32,
}

/// A view that sees something of the hole.
#[derive(Clone, Copy, Debug)]
struct Sight {
    penalty: f64,
    view: usize,
    /// Seen clean: one bit a place.
    places: u64,
    /// Seen at least through haze: one bit a place.
    hazy: u64,
}

/// Looks for views; keeps its memory.
#[derive(Debug, Default)]
pub struct CandidateSearch {
    sights: Vec<Sight>,
}

impl CandidateSearch {
    /// Choose up to [`MAX_VIEWS`] views for the world points `hole` (at most [`MAX_PLACES`] places of it, seen from `eye`).
    ///
    /// The lamp's image moves little between neighbouring views, so the best views by angle are often dazzled at the very place that is
    /// asked for: views are taken one by one, each for its angle and for the places that too few of those before it saw.
    pub fn choose(
        &mut self,
        light_field: &LightField,
        eye: &Transform<World, Camera>,
        hole: &[Vector3<f64>],
        chosen: &mut Vec<Candidate>,
    ) {
        chosen.clear();
        if hole.is_empty() {
            return;
        }
        let hole = &hole[..hole.len().min(MAX_PLACES)];
        let centre = hole.iter().sum::<Vector3<f64>>() / hole.len() as f64;
        self.sights.clear();
        for (index, view) in light_field.views.iter().enumerate() {
            if let Some(penalty) = penalty(view, eye, &centre) {
                let (places, hazy) = (places_seen(view, hole, HEARD_FROM), places_seen(view, hole, 1));
                if hazy != 0 {
                    self.sights.push(Sight {
                        penalty,
                        view: index,
                        places,
                        hazy,
                    });
                }
            }
        }
        let mut sightings = [0_usize; MAX_PLACES];
        let mut glimpses = [0_usize; MAX_PLACES];
        while chosen.len() < MAX_VIEWS {
            let worth = |clean: u64, hazy: u64| -> f64 {
                let of = |p: usize| {
                    if clean >> p & 1 != 0 {
                        WORTH_OF_NEXT.get(sightings[p]).copied().unwrap_or(0.0)
                    } else if hazy >> p & 1 != 0 && sightings[p] == 0 && glimpses[p] < 2 {
                        WORTH_OF_A_GLIMPSE
                    } else {
                        0.0
                    }
                };
                (0..hole.len()).map(of).sum()
            };
            let wanted = worth(u64::MAX, 0);
            let unseen = (0..hole.len()).any(|p| sightings[p] == 0 && glimpses[p] < 2);
            if wanted == 0.0 || !unseen && chosen.len() >= ENOUGH_VIEWS {
                break;
            }
            let cost = |sight: &Sight| sight.penalty - SIGHTING_WORTH * worth(sight.places, sight.hazy) / wanted;
            // Places that no view saw stay unseen: nothing more is gained for them.
            let Some(best) = (0..self.sights.len()).min_by(|&a, &b| cost(&self.sights[a]).total_cmp(&cost(&self.sights[b])))
            else {
                break;
            };
            let sight = self.sights.swap_remove(best);
            for (place, count) in sightings.iter_mut().enumerate().take(hole.len()) {
                *count += (sight.places >> place & 1) as usize;
                glimpses[place] += (sight.hazy >> place & 1) as usize;
            }
            // Until the threshold is known the weight holds the penalty.
            chosen.push(Candidate {
                view: sight.view,
                weight: sight.penalty as f32,
            });
        }
        // Buehler 2001: weights fall to zero at a threshold; here beyond the worst view that was needed.
        let threshold = 1.3 * chosen.iter().map(|c| c.weight).fold(0.01, f32::max);
        for candidate in chosen {
            candidate.weight = (1.0 - candidate.weight / threshold).max(0.02);
        }
    }
}

/// Angle between the viewing rays, loss of resolution and nearness to the view's border, rad-like; `None` if not in the view.
fn penalty(view: &View, eye: &Transform<World, Camera>, place: &Vector3<f64>) -> Option<f64> {
    let seen = view.world_from_camera.inverse() * Point::<World>::from_coords(*place);
    let pixel = view.camera.project(seen)?;
    let margin = 0.02 * view.camera.width as f64;
    if !view.camera.contains(pixel, margin) {
        return None;
    }
    let (to_view, to_eye) = (place - view.world_from_camera.translation(), place - eye.translation());
    let angle = to_view.angle(&to_eye);
    let resolution = (to_view.norm() / to_eye.norm() - 1.0).max(0.0);
    let border = border_distance(&view.camera, pixel.x, pixel.y) / (0.1 * view.camera.width as f64);
    Some(angle + 0.3 * resolution + 0.1 * (1.0 - border).max(0.0) + 1e-4)
}

fn border_distance(camera: &CameraModel, x: f64, y: f64) -> f64 {
    x.min(y)
        .min(camera.width as f64 - 1.0 - x)
        .min(camera.height as f64 - 1.0 - y)
}

/// The places that the view saw unhidden and with at least some confidence, one bit each.
fn places_seen(view: &View, places: &[Vector3<f64>], least_confidence: u8) -> u64 {
    let camera_from_world = view.world_from_camera.inverse();
    let mut bits = 0;
    for (index, place) in places.iter().enumerate() {
        let p = camera_from_world * Point::<World>::from_coords(*place);
        let seen = view.camera.project(p).is_some_and(|pixel| {
            let (x, y) = (pixel.x.round(), pixel.y.round());
            x >= 0.0
                && y >= 0.0
                && x < view.camera.width as f64
                && y < view.camera.height as f64
                && view.confidence.at(x as usize, y as usize) >= least_confidence
                && is_unoccluded(view.depth.at(x as usize, y as usize), p.coords.z as f32)
        });
        bits |= u64::from(seen) << index;
    }
    bits
}

/// True if a surface seen at depth `held` is what lies at depth `asked`; an unknown depth hides nothing.
#[inline]
pub fn is_unoccluded(held: f32, asked: f32) -> bool {
    held <= 0.0 || (held - asked).abs() <= OCCLUSION_TOLERANCE * asked
}
