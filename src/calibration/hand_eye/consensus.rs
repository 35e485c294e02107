//! Stations that contradict the rest: least median of squares over small samples (Rousseeuw 1984), as a wrong pose spoils every motion it
//! takes part in and so cannot be told from motions alone.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::calibration::hand_eye::motion::{Demands, Station, check, motions};
use crate::calibration::hand_eye::robot_world::{LEVER_MM, board_of};
use crate::calibration::hand_eye::rotation_first::park_martin;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

/// Stations in a sample: the fewest whose motions have two axes, and one more against noise.
const SAMPLE: usize = 4;
/// Samples drawn at most.
const SAMPLES: usize = 400;
/// A station farther off than so many robust standard deviations is out.
const FAR: f64 = 4.0;
/// And farther than this, whatever the rest do: exact data have no spread, mm.
const LEAST_FAR_MM: f64 = 0.05;

/// What most stations agree on.
#[derive(Clone, Debug)]
pub struct Agreement {
    /// From those that agree.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// One a station.
    pub agrees: Vec<bool>,
    /// How far each station puts the board from where it lies, mm, a rotation counted at [`LEVER_MM`].
    pub off_mm: Vec<f64>,
}

/// Find what most stations agree on. `None` where no sample tells anything.
pub fn agreement(stations: &[Station], seed: u64) -> Option<Agreement> {
    let mut best: Option<(f64, Transform<Hand, Camera>)> = None;
    for sample in samples(stations.len(), seed) {
        let chosen: Vec<Station> = sample.iter().map(|&index| stations[index]).collect();
        if check(&chosen, &Demands::default()).is_err() {
            continue;
        }
        let Some(candidate) = park_martin(&motions(&chosen)) else {
            continue;
        };
        let median = median_of(off(stations, &candidate)?);
        if best.as_ref().is_none_or(|(least, _)| median < *least) {
            best = Some((median, candidate));
        }
    }
    let (_, mut hand_from_camera) = best?;
    let mut agrees = vec![true; stations.len()];
    let mut off_mm = off(stations, &hand_from_camera)?;
    for _ in 0..5 {
        // Rousseeuw and Leroy 1987: the median made the deviation of Gaussian noise, with their factor for few data.
        let few = 1.0 + 5.0 / (stations.len() as f64 - 3.0).max(1.0);
        let limit = (FAR * 1.4826 * few * median_of(off_mm.clone()) / 3.0_f64.sqrt()).max(LEAST_FAR_MM);
        let now: Vec<bool> = off_mm.iter().map(|&off| off <= limit).collect();
        let chosen: Vec<Station> = (stations.iter().zip(&now))
            .filter_map(|(station, agrees)| agrees.then_some(*station))
            .collect();
        let Some(refitted) = check(&chosen, &Demands::default())
            .ok()
            .and_then(|()| park_martin(&motions(&chosen)))
        else {
            break;
        };
        hand_from_camera = refitted;
        off_mm = off(stations, &hand_from_camera)?;
        if now == agrees {
            break;
        }
        agrees = now;
    }
    Some(Agreement {
        hand_from_camera,
        agrees,
        off_mm,
    })
}

/// How far each station puts the board from where most put it, mm.
fn off(stations: &[Station], hand_from_camera: &Transform<Hand, Camera>) -> Option<Vec<f64>> {
    let board = board_of(stations, hand_from_camera)?;
    let told = stations
        .iter()
        .map(|station| station.base_from_hand * *hand_from_camera * station.camera_from_board);
    let off = told.map(|told| {
        let place = (told.translation() - board.translation()).norm();
        place.hypot(LEVER_MM * told.rotation().angle_to(&board.rotation()))
    });
    Some(off.collect())
}

fn median_of(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Samples of stations: all there are if they are few.
fn samples(count: usize, seed: u64) -> Vec<Vec<usize>> {
    let size = SAMPLE.min(count);
    if size < 3 {
        return Vec::new();
    }
    if count <= 10 {
        let all = (0_u32..1 << count).filter(|bits| bits.count_ones() as usize == size);
        return all.map(|bits| (0..count).filter(|i| bits >> i & 1 != 0).collect()).collect();
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = || {
        let mut sample: Vec<usize> = Vec::with_capacity(size);
        while sample.len() < size {
            let index = random.random_range(0..count);
            if !sample.contains(&index) {
                sample.push(index);
            }
        }
        sample
    };
    (0..SAMPLES).map(|_| draw()).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::calibration::hand_eye::example::{Example, Noise};

    const NOISE: Noise = Noise {
        place_mm: 0.2,
        turn_rad: 0.001,
        seen_mm: 0.05,
        seen_rad: 0.0005,
    };

    #[test]
    fn wrong_stations_are_found_and_right_ones_kept() {
        for seed in 0..20 {
            let mut example = Example::new(seed, 15, NOISE);
            for wrong in [2, 7, 11] {
                example.disturb(wrong, Vector3::new(6.0, -4.0, 5.0), Vector3::new(0.03, 0.0, -0.04));
            }
            let found = agreement(&example.stations, 1).unwrap();
            let right = (0..15).filter(|i| ![2, 7, 11].contains(i));
            assert!([2, 7, 11].iter().all(|&i| !found.agrees[i]), "{seed}: {:?}", found.off_mm);
            assert!(right.filter(|&i| found.agrees[i]).count() >= 11, "{seed}: {:?}", found.off_mm);
            // As good as if the wrong ones had never been there.
            let clean: Vec<Station> = (0..15)
                .filter(|i| ![2, 7, 11].contains(i))
                .map(|i| example.stations[i])
                .collect();
            let [without, _] = example.error_of(&park_martin(&motions(&clean)).unwrap());
            let [mm, _] = example.error_of(&found.hand_from_camera);
            assert!(mm < without + 0.5, "{seed}: {mm} mm, {without} mm without them");
        }
    }

    #[test]
    fn exact_stations_all_agree() {
        let found = agreement(&Example::new(4, 8, Noise::NONE).stations, 1).unwrap();
        assert!(found.agrees.iter().all(|&agrees| agrees));
    }
}
