//! Which views get a depth map of their own, and whom each is matched with.
//!
//! Wide baselines resolve depth best, but what only the last views of a survey see at their border has but narrow ones: every part of a
//! picture should have a partner, and every place two maps.

use nalgebra::Vector3;

use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;

/// Places of a picture, shares of its width and height.
const COLUMNS: [f64; 5] = [0.05, 0.275, 0.5, 0.725, 0.95];
const ROWS: [f64; 4] = [0.06, 0.35, 0.65, 0.94];
/// A view sees what is farther from its border than this share of its size.
const BORDER: f64 = 0.03;
/// A view whose aim is nearer to another's border than this share is no partner for all of its picture.
const AIM_BORDER: f64 = 0.15;
/// A place whose partners are together worth this much needs no more; one at the best angle is worth 1.
const ENOUGH: f64 = 0.3;
/// A partner that adds less is none.
const LEAST_WORTH: f64 = 0.05;
/// So many more partners than usual for places that the usual ones do not see.
const MORE_PARTNERS: usize = 3;
/// Every place should lie in so many depth maps: a surface needs two.
const WANTED_MAPS: u32 = 2;
/// So many more maps than usual, as a share of them, for places that the usual ones do not see …
const MORE_MAPS: f64 = 0.3;
/// … if one adds at least so many sightings of places.
const LEAST_GAIN: u32 = 3;

/// A view as pairing sees it.
#[derive(Debug)]
pub struct Station {
    camera_from_world: Transform<Camera, World>,
    camera: CameraModel,
    /// The optical centre.
    center: Vector3<f64>,
    /// What it looks at.
    aim: Vector3<f64>,
    /// Places of its picture, at the same depth.
    places: Vec<Vector3<f64>>,
}

impl Station {
    /// Of a pinhole `camera` that looks at something `depth` mm away.
    pub fn new(camera: &CameraModel, world_from_camera: Transform<World, Camera>, depth: f64) -> Self {
        let k = camera.intrinsics;
        let (width, height) = (camera.width as f64, camera.height as f64);
        let at = |x: f64, y: f64| {
            let local = Point::from_coords(Vector3::new((x * width - k.cx) / k.fx, (y * height - k.cy) / k.fy, 1.0) * depth);
            (world_from_camera * local).coords
        };
        Self {
            camera_from_world: world_from_camera.inverse(),
            camera: camera.clone(),
            center: world_from_camera.translation(),
            aim: (world_from_camera * Point::from_coords(Vector3::new(0.0, 0.0, depth))).coords,
            places: ROWS.into_iter().flat_map(|y| COLUMNS.map(|x| at(x, y))).collect(),
        }
    }

    /// Whether `place` lies in the picture, farther from its border than a share of its size.
    fn sees(&self, place: &Vector3<f64>, border: f64) -> bool {
        let local = self.camera_from_world * Point::from_coords(*place);
        let (width, height) = (self.camera.width as f64, self.camera.height as f64);
        self.camera.project(local).is_some_and(|pixel| {
            let (x, y) = (pixel.x / width, pixel.y / height);
            x > border && y > border && x < 1.0 - border && y < 1.0 - border
        })
    }

    /// What matching with `other` at `place` is worth, 1 at the best angle and equal distance.
    fn worth(&self, other: &Self, place: &Vector3<f64>, best_angle_rad: f64) -> f64 {
        let (off, ratio) = self.apart(other, place, best_angle_rad);
        (-off * off / 0.5 - ratio * ratio / 0.12).exp()
    }

    /// The same where nothing better may be had: depth from a narrow angle is vague, but from a wide one there is none.
    fn worth_at_need(&self, other: &Self, place: &Vector3<f64>, best_angle_rad: f64) -> f64 {
        let (off, ratio) = self.apart(other, place, best_angle_rad);
        let narrow_or_wide = if off > 0.0 { -off * off / 0.2 } else { off };
        (narrow_or_wide - ratio * ratio / 0.12).exp()
    }

    /// Logarithms of the angle over the best one, and of the distances' ratio.
    fn apart(&self, other: &Self, place: &Vector3<f64>, best_angle_rad: f64) -> (f64, f64) {
        let (from, to) = (self.center - place, other.center - place);
        let off = (from.angle(&to).max(1e-6) / best_angle_rad).ln();
        (off, (from.norm() / to.norm()).ln())
    }
}

/// Views that cover the survey evenly: farthest-point sampling over where they stand and where they look; then some more for what these
/// do not see.
pub fn references(stations: &[Station], count: usize) -> Vec<usize> {
    let mut chosen = evenly_spread(stations, count);
    complete_references(stations, &mut chosen);
    chosen.sort_unstable();
    chosen
}

fn evenly_spread(stations: &[Station], count: usize) -> Vec<usize> {
    let places: Vec<Vector3<f64>> = stations.iter().map(|s| s.center + s.aim * 0.5).collect();
    let mut chosen = vec![places.len() / 2];
    let mut distance: Vec<f64> = vec![f64::INFINITY; places.len()];
    while chosen.len() < count.min(places.len()) {
        let last = places[chosen[chosen.len() - 1]];
        for (d, place) in distance.iter_mut().zip(&places) {
            *d = d.min((place - last).norm());
        }
        let next = (0..places.len())
            .max_by(|&a, &b| distance[a].total_cmp(&distance[b]))
            .unwrap_or(0);
        chosen.push(next);
    }
    chosen.sort_unstable();
    chosen.dedup();
    chosen
}

/// Add the views that see most of what fewer than two of the chosen see.
fn complete_references(stations: &[Station], chosen: &mut Vec<usize>) {
    let most = chosen.len() + (chosen.len() as f64 * MORE_MAPS).ceil() as usize;
    // Per view, per place of any view: whether it sees it.
    let seen: Vec<Vec<bool>> = (stations.iter())
        .map(|by| {
            let all = stations.iter().flat_map(|s| &s.places);
            all.map(|place| by.sees(place, BORDER)).collect()
        })
        .collect();
    let all = stations.iter().map(|s| s.places.len()).sum();
    let mut maps: Vec<u32> = (0..all)
        .map(|p| chosen.iter().filter(|&&v| seen[v][p]).count() as u32)
        .collect();
    while chosen.len() < most {
        let gain = |view: &usize| -> u32 {
            let places = seen[*view].iter().zip(&maps);
            places.filter(|(seen, maps)| **seen && **maps < WANTED_MAPS).count() as u32
        };
        let rest = (0..stations.len()).filter(|view| !chosen.contains(view));
        let Some(best) = rest.max_by_key(|view| gain(view)).filter(|view| gain(view) >= LEAST_GAIN) else {
            break;
        };
        for (maps, seen) in maps.iter_mut().zip(&seen[best]) {
            *maps += u32::from(*seen);
        }
        chosen.push(best);
    }
}

/// Whom a view is matched with: `count` near the best angle, at a like distance, and from different sides; then some more for what these
/// do not see.
pub fn neighbours(stations: &[Station], view: usize, count: usize, best_angle_rad: f64) -> Vec<usize> {
    let mut chosen = around_the_aim(stations, view, count, best_angle_rad);
    complete_neighbours(stations, view, best_angle_rad, &mut chosen);
    chosen
}

fn around_the_aim(stations: &[Station], view: usize, count: usize, best_angle_rad: f64) -> Vec<usize> {
    let own = &stations[view];
    let mut scored: Vec<(f64, usize, Vector3<f64>)> = (stations.iter().enumerate())
        .filter(|&(other, station)| other != view && station.sees(&own.aim, AIM_BORDER))
        .filter_map(|(other, station)| {
            let side = (station.center - own.center).try_normalize(1e-9)?;
            Some((own.worth(station, &own.aim, best_angle_rad), other, side))
        })
        .collect();
    let mut chosen = Vec::new();
    while chosen.len() < count {
        let Some(best) = (0..scored.len()).max_by(|&a, &b| scored[a].0.total_cmp(&scored[b].0)) else {
            break;
        };
        let (score, other, side) = scored.swap_remove(best);
        if score < 1e-4 && chosen.len() >= 2 {
            break;
        }
        chosen.push(other);
        for (score, _, direction) in &mut scored {
            *score *= 1.0 - 0.8 * direction.dot(&side).max(0.0).powi(2);
        }
    }
    chosen
}

/// Add the partners that are worth most for the places for which the chosen are not worth enough.
fn complete_neighbours(stations: &[Station], view: usize, best_angle_rad: f64, chosen: &mut Vec<usize>) {
    let own = &stations[view];
    let worth = |other: usize| -> Vec<f64> {
        let station: &Station = &stations[other];
        let worth = |place| {
            if station.sees(place, BORDER) {
                own.worth_at_need(station, place, best_angle_rad)
            } else {
                0.0
            }
        };
        own.places.iter().map(worth).collect()
    };
    let mut sum = vec![0.0; own.places.len()];
    for &other in &*chosen {
        sum.iter_mut().zip(worth(other)).for_each(|(sum, worth)| *sum += worth);
    }
    let mut rest: Vec<(usize, Vec<f64>)> = (0..stations.len())
        .filter(|other| *other != view && !chosen.contains(other))
        .map(|other| (other, worth(other)))
        .collect();
    for _ in 0..MORE_PARTNERS {
        let gain = |worth: &[f64]| -> f64 {
            let gains = sum.iter().zip(worth).map(|(sum, worth)| worth.min((ENOUGH - sum).max(0.0)));
            gains.sum()
        };
        let Some(best) = (0..rest.len()).max_by(|&a, &b| gain(&rest[a].1).total_cmp(&gain(&rest[b].1))) else {
            break;
        };
        if gain(&rest[best].1) <= LEAST_WORTH {
            break;
        }
        let (other, worth) = rest.swap_remove(best);
        sum.iter_mut().zip(worth).for_each(|(sum, worth)| *sum += worth);
        chosen.push(other);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;

    const DEPTH: f64 = 80.0;

    /// A row of views along x that look straight ahead, `apart` mm from one to the next.
    fn row(count: usize, apart: f64) -> Vec<Station> {
        let intrinsics = Intrinsics {
            fx: 300.0,
            fy: 300.0,
            cx: 159.5,
            cy: 89.5,
        };
        let camera = CameraModel {
            width: 320,
            height: 180,
            intrinsics,
            distortion: Distortion::None,
        };
        (0..count)
            .map(|i| {
                let pose = Transform::new(UnitQuaternion::identity(), Vector3::new(apart * i as f64, 0.0, 0.0));
                Station::new(&camera, pose, DEPTH)
            })
            .collect()
    }

    #[test]
    fn partners_of_a_view_in_the_middle_are_near_the_best_angle_and_on_both_sides() {
        let stations = row(41, 2.0);
        let best_mm = DEPTH * 0.13_f64.tan();
        let chosen = neighbours(&stations, 20, 4, 0.13);
        let away: Vec<f64> = chosen.iter().take(4).map(|&v| 2.0 * (v as f64 - 20.0)).collect();
        assert!(away.iter().all(|a| (a.abs() - best_mm).abs() < 0.6 * best_mm), "{away:?}");
        assert!(away.iter().any(|a| *a > 0.0) && away.iter().any(|a| *a < 0.0), "{away:?}");
    }

    #[test]
    fn what_only_the_last_views_see_gets_partners_and_maps() {
        let stations = row(81, 1.0);
        // The usual partners of the last view stand about 10 mm before it and do not see its outermost places.
        let rim = &stations[80].places[COLUMNS.len() - 1];
        let partners = neighbours(&stations, 80, 4, 0.13);
        assert!(partners[..4].iter().all(|&v| !stations[v].sees(rim, BORDER)), "{partners:?}");
        assert!(partners[4..].iter().any(|&v| stations[v].sees(rim, BORDER)), "{partners:?}");
        assert!(partners.len() <= 4 + MORE_PARTNERS && !partners.contains(&80), "{partners:?}");

        // Five views 20 mm apart see each place but once or twice, and the rims once.
        let references = references(&stations, 5);
        assert!(references.is_sorted() && references.len() == 7, "{references:?}");
        let seen_twice = |references: &[usize]| {
            let twice = |place: &&Vector3<f64>| references.iter().filter(|&&v| stations[v].sees(place, BORDER)).count() >= 2;
            stations.iter().flat_map(|s| &s.places).filter(twice).count()
        };
        let usual = [0, 20, 40, 60, 80];
        assert!(usual.iter().all(|v| references.contains(v)), "{references:?}");
        assert!(seen_twice(&references) > seen_twice(&usual), "{references:?}");
    }
}
