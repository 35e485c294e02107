//! Pairs of views that see the same places, and what the motion between two views says of them.

use nalgebra::{Matrix3, Vector3};

use crate::calibration::hand_eye::feature_tracks::FeatureTrack;
use crate::camera::model::CameraModel;
use crate::geometry::space::Camera;
use crate::geometry::transform::Transform;

/// Two views and the places that both see, as directions with z = 1.
#[derive(Clone, Debug)]
pub struct ViewPair {
    /// The earlier view.
    pub first: usize,
    /// The later one.
    pub second: usize,
    /// Where each place is seen in the first and in the second.
    pub rays: Vec<[Vector3<f64>; 2]>,
    /// Per place: a track seen n times in p pairs tells 2n − 3 numbers, not p.
    pub shares: Vec<f64>,
}

/// Views from one to the other in a pair.
pub(super) const STEPS: [usize; 4] = [1, 2, 4, 8];
/// A pair with fewer places in common says little.
const FEWEST_PLACES: usize = 8;

/// Pairs of views from tracks.
pub fn pairs(tracks: &[FeatureTrack], camera: &CameraModel) -> Vec<ViewPair> {
    let mut pairs = std::collections::BTreeMap::<(usize, usize), ViewPair>::new();
    for track in tracks {
        let rays: Vec<(usize, Vector3<f64>)> = (track.places.iter())
            .filter_map(|&(view, pixel)| Some((view, camera.unproject(pixel)?.coords)))
            .collect();
        let chosen: Vec<(usize, usize)> = (0..rays.len())
            .flat_map(|i| (i + 1..rays.len()).map(move |j| (i, j)))
            .filter(|&(i, j)| STEPS.contains(&(rays[j].0 - rays[i].0)))
            .collect();
        let share = ((2.0 * rays.len() as f64 - 3.0) / chosen.len().max(1) as f64).min(1.0);
        for (i, j) in chosen {
            let key = (rays[i].0, rays[j].0);
            let pair = pairs.entry(key).or_insert_with(|| ViewPair {
                first: key.0,
                second: key.1,
                rays: Vec::new(),
                shares: Vec::new(),
            });
            pair.rays.push([rays[i].1, rays[j].1]);
            pair.shares.push(share);
        }
    }
    pairs.into_values().filter(|pair| pair.rays.len() >= FEWEST_PLACES).collect()
}

/// E of `second_from_first`.
pub fn essential(motion: &Transform<Camera, Camera>) -> Matrix3<f64> {
    motion.translation().cross_matrix() * motion.rotation().to_rotation_matrix().matrix()
}

/// Signed distance of two places from fitting the motion, in units of the focal length.
pub(super) fn sampson(essential: &Matrix3<f64>, [from, to]: &[Vector3<f64>; 2]) -> f64 {
    let (line, back) = (essential * from, essential.tr_mul(to));
    let steepness = line.x * line.x + line.y * line.y + back.x * back.x + back.y * back.y;
    to.dot(&line) / steepness.max(1e-24).sqrt()
}
