//! Motions between stations: which of them tell most, and whether together they tell enough.
//!
//! A motion's rotation axis says nothing of the camera's place along it and turning about it: two axes must cross, the nearer to a right
//! angle and the larger the rotations the better (Tsai and Lenz 1989). Of the many motions of a recording a vector quantization of
//! their rotation vectors keeps the ones that differ (Schmidt, Vogt and Niemann, "Vector quantization based data selection for hand-eye
//! calibration", 2004).

use nalgebra::{Matrix3, SymmetricEigen, UnitQuaternion, Vector3};

use crate::geometry::space::{Board, Camera, Hand, RobotBase};
use crate::geometry::transform::Transform;

/// Below this a rotation's axis drowns in noise, rad.
const LEAST_ANGLE_RAD: f64 = 0.05;
/// Near half a turn the axis's sign is a matter of chance, rad.
const MOST_ANGLE_RAD: f64 = 3.0;
/// Rounds of the vector quantization.
const ROUNDS: usize = 20;

/// The arm at rest, looking at a board.
#[derive(Clone, Copy, Debug)]
pub struct Station {
    /// From the arm.
    pub base_from_hand: Transform<RobotBase, Hand>,
    /// From the picture.
    pub camera_from_board: Transform<Camera, Board>,
}

/// From one station to another, as the arm and as the camera tell it.
#[derive(Clone, Copy, Debug)]
pub struct Motion {
    /// A.
    pub hand: Transform<Hand, Hand>,
    /// B.
    pub camera: Transform<Camera, Camera>,
}

impl Motion {
    /// From station `j` to station `i`.
    pub fn between(i: &Station, j: &Station) -> Self {
        Self {
            hand: i.base_from_hand.inverse() * j.base_from_hand,
            camera: i.camera_from_board * j.camera_from_board.inverse(),
        }
    }

    /// Quaternions of A and B with a scalar part that is not negative, as rotations equal up to X must have.
    pub fn aligned_rotations(&self) -> (UnitQuaternion<f64>, UnitQuaternion<f64>) {
        (upright(self.hand.rotation()), upright(self.camera.rotation()))
    }

    fn angle(&self) -> f64 {
        self.hand.rotation().angle()
    }
}

/// The one of the two quaternions of a rotation whose scalar part is not negative.
pub fn upright(rotation: UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    if rotation.w < 0.0 {
        UnitQuaternion::new_unchecked(-rotation.into_inner())
    } else {
        rotation
    }
}

/// All motions between stations whose axis can be told.
pub fn motions(stations: &[Station]) -> Vec<Motion> {
    let pairs = (0..stations.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    pairs
        .map(|(i, j)| Motion::between(&stations[i], &stations[j]))
        .filter(|motion| (LEAST_ANGLE_RAD..MOST_ANGLE_RAD).contains(&motion.angle()))
        .collect()
}

/// At most `count` of the motions, as different from each other as they come.
pub fn most_telling(motions: Vec<Motion>, count: usize) -> Vec<Motion> {
    if motions.len() <= count || count == 0 {
        return motions;
    }
    // A rotation and its inverse tell the same.
    let vectors: Vec<Vector3<f64>> = (motions.iter())
        .map(|motion| {
            let vector = motion.hand.rotation().scaled_axis();
            let first = vector.iter().copied().find(|v| v.abs() > 1e-9).unwrap_or(0.0);
            if first < 0.0 { -vector } else { vector }
        })
        .collect();
    let mut centers = farthest(&vectors, count);
    let mut nearest = vec![0; vectors.len()];
    for _ in 0..ROUNDS {
        for (nearest, vector) in nearest.iter_mut().zip(&vectors) {
            *nearest = closest(&centers, vector);
        }
        let mut sums = vec![(Vector3::zeros(), 0.0); centers.len()];
        for (&nearest, vector) in nearest.iter().zip(&vectors) {
            sums[nearest].0 += vector;
            sums[nearest].1 += 1.0;
        }
        for (center, (sum, count)) in centers.iter_mut().zip(sums) {
            if count > 0.0 {
                *center = sum / count;
            }
        }
    }
    let mut chosen: Vec<usize> = centers.iter().map(|center| closest(&vectors, center)).collect();
    chosen.sort_unstable();
    chosen.dedup();
    chosen.into_iter().map(|index| motions[index]).collect()
}

/// So many of the vectors, each as far as can be from those before it; the longest first.
fn farthest(vectors: &[Vector3<f64>], count: usize) -> Vec<Vector3<f64>> {
    let mut distance: Vec<f64> = vectors.iter().map(Vector3::norm).collect();
    let mut chosen = Vec::with_capacity(count);
    while chosen.len() < count {
        let Some(next) = (0..vectors.len()).max_by(|&a, &b| distance[a].total_cmp(&distance[b])) else {
            break;
        };
        if chosen.is_empty() {
            distance.fill(f64::INFINITY);
        }
        chosen.push(vectors[next]);
        for (distance, vector) in distance.iter_mut().zip(vectors) {
            *distance = distance.min((vector - vectors[next]).norm());
        }
    }
    chosen
}

fn closest(candidates: &[Vector3<f64>], to: &Vector3<f64>) -> usize {
    let distance = |&index: &usize| (candidates[index] - to).norm_squared();
    (0..candidates.len())
        .min_by(|a, b| distance(a).total_cmp(&distance(b)))
        .unwrap_or(0)
}

/// What stations must offer for a calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Demands {
    /// At least so many stations.
    pub stations: usize,
    /// The largest rotation between two stations is at least this, rad.
    pub angle_rad: f64,
    /// Rotations about axes across the main one add up to at least this share of those about it.
    pub crossing: f64,
}

impl Default for Demands {
    fn default() -> Self {
        Self {
            stations: 3,
            angle_rad: 0.2,
            crossing: 0.08,
        }
    }
}

/// Why stations cannot tell how the camera sits on the hand.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Degenerate {
    /// Too few.
    #[error(
        "expected at least {least} stations at which the whole board was seen, found {found}: record more, each with the arm at rest"
    )]
    TooFew {
        /// Found.
        found: usize,
        /// Needed.
        least: usize,
    },
    /// Hardly turned.
    #[error(
        "the scope turned by no more than {found_deg:.1}° between any two stations, at least {least_deg:.0}° are needed: tilt it much \
        farther to each side, and roll it, while the board stays in sight"
    )]
    SmallRotations {
        /// Found.
        found_deg: f64,
        /// Needed.
        least_deg: f64,
    },
    /// All about one axis.
    #[error(
        "all rotations are about nearly the same axis ({}): the camera's place along it cannot be told. Add stations that tilt the scope \
        about the other axes, by 20° or more; through a trocar this is hardly possible, so calibrate before the scope goes in",
        axis_in_words(.axis)
    )]
    ParallelAxes {
        /// The axis, in the hand's space.
        axis: [f64; 3],
    },
}

fn axis_in_words(axis: &[f64; 3]) -> String {
    format!("({:.2}, {:.2}, {:.2}) of the hand's space", axis[0], axis[1], axis[2])
}

/// Whether `stations` tell enough.
pub fn check(stations: &[Station], demands: &Demands) -> Result<(), Degenerate> {
    if stations.len() < demands.stations {
        return Err(Degenerate::TooFew {
            found: stations.len(),
            least: demands.stations,
        });
    }
    let pairs = (0..stations.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let motions = pairs.map(|(i, j)| Motion::between(&stations[i], &stations[j]));
    let (mut largest, mut spread) = (0.0_f64, Matrix3::zeros());
    for motion in motions {
        largest = largest.max(motion.angle());
        let vector = motion.hand.rotation().scaled_axis();
        spread += vector * vector.transpose();
    }
    if largest < demands.angle_rad {
        return Err(Degenerate::SmallRotations {
            found_deg: largest.to_degrees(),
            least_deg: demands.angle_rad.to_degrees(),
        });
    }
    let eigen = SymmetricEigen::new(spread);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [main, across] = [order[0], order[1]].map(|i| eigen.eigenvalues[i].max(0.0).sqrt());
    if across < demands.crossing * main {
        let axis = eigen.eigenvectors.column(order[0]);
        return Err(Degenerate::ParallelAxes {
            axis: [axis[0], axis[1], axis[2]],
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::hand_eye::example::{Example, Noise};

    #[test]
    fn motions_of_exact_stations_are_the_same_screw() {
        let example = Example::new(1, 12, Noise::NONE);
        for motion in motions(&example.stations) {
            let (a, b) = motion.aligned_rotations();
            assert!((a.w - b.w).abs() < 1e-12);
            let both = motion.hand * example.hand_from_camera;
            let same = example.hand_from_camera * motion.camera;
            assert!((both.translation() - same.translation()).norm() < 1e-9);
        }
    }

    #[test]
    fn the_most_telling_motions_span_more_than_the_first_ones() {
        let example = Example::new(2, 20, Noise::NONE);
        let all = motions(&example.stations);
        let spread = |motions: &[Motion]| {
            let sum: Matrix3<f64> = (motions.iter().map(|m| m.hand.rotation().scaled_axis()))
                .map(|v| v * v.transpose())
                .sum();
            (sum / motions.len() as f64).determinant()
        };
        let chosen = most_telling(all.clone(), 12);
        assert!(chosen.len() > 8 && chosen.len() <= 12);
        assert!(spread(&chosen) > 1.5 * spread(&all[..12]));
        assert_eq!(most_telling(all[..5].to_vec(), 12).len(), 5);
    }

    #[test]
    fn what_cannot_be_told_is_refused() {
        let demands = Demands::default();
        let example = Example::new(3, 12, Noise::NONE);
        assert_eq!(check(&example.stations, &demands), Ok(()));
        assert!(matches!(
            check(&example.stations[..2], &demands),
            Err(Degenerate::TooFew { found: 2, least: 3 })
        ));
        let still = Example::turning(12, |_| Vector3::zeros());
        assert!(matches!(
            check(&still.stations, &demands),
            Err(Degenerate::SmallRotations { .. })
        ));
        let about_one = Example::turning(12, |i| Vector3::new(0.0, 0.1 * i as f64, 0.002 * (i as f64).sin()));
        let Err(Degenerate::ParallelAxes { axis }) = check(&about_one.stations, &demands) else {
            panic!("parallel axes went through");
        };
        assert!(axis[1].abs() > 0.99, "{axis:?}");
    }
}
