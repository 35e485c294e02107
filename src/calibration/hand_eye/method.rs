//! The closed forms by name, for who wants to compare.

use clap::ValueEnum;

use crate::calibration::hand_eye::dual_quaternion::daniilidis;
use crate::calibration::hand_eye::motion::{Station, most_telling, motions};
use crate::calibration::hand_eye::robot_world::shah;
use crate::calibration::hand_eye::rotation_first::{horaud_dornaika, park_martin, tsai_lenz};
use crate::calibration::hand_eye::simultaneous::andreff;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

/// Motions that take part in a closed form at most.
const MOST_MOTIONS: usize = 200;

/// A closed form.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Tsai and Lenz 1989.
    Tsai,
    /// Park and Martin 1994.
    Park,
    /// Horaud and Dornaika 1995.
    Horaud,
    /// Andreff, Horaud and Espiau 2001.
    Andreff,
    /// Daniilidis 1999.
    Daniilidis,
    /// Shah 2013, AX = ZB.
    Shah,
}

/// All of them.
pub const METHODS: [Method; 6] = [
    Method::Tsai,
    Method::Park,
    Method::Horaud,
    Method::Andreff,
    Method::Daniilidis,
    Method::Shah,
];

impl Method {
    /// As a person calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tsai => "Tsai-Lenz",
            Self::Park => "Park-Martin",
            Self::Horaud => "Horaud-Dornaika",
            Self::Andreff => "Andreff",
            Self::Daniilidis => "Daniilidis",
            Self::Shah => "Shah (AX = ZB)",
        }
    }

    /// How the camera sits on the hand; `None` where the stations do not tell.
    pub fn solve(self, stations: &[Station]) -> Option<Transform<Hand, Camera>> {
        let solve = match self {
            Self::Shah => return shah(stations).map(|found| found.hand_from_camera),
            Self::Tsai => tsai_lenz,
            Self::Park => park_martin,
            Self::Horaud => horaud_dornaika,
            Self::Andreff => andreff,
            Self::Daniilidis => daniilidis,
        };
        solve(&most_telling(motions(stations), MOST_MOTIONS))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::hand_eye::example::{Example, Noise};

    #[test]
    fn every_method_finds_the_truth_from_exact_stations_and_another_one_from_inverted_ones() {
        for seed in 0..10 {
            let example = Example::new(seed, 9, Noise::NONE);
            for method in METHODS {
                let found = method.solve(&example.stations).unwrap();
                let [mm, rad] = example.error_of(&found);
                assert!(mm < 1e-6 && rad < 1e-8, "{}: {mm} mm, {rad} rad", method.name());
                // The convention is the point: with the camera's poses inverted nothing may come out right.
                let mut inverted = example.stations.clone();
                for station in &mut inverted {
                    station.camera_from_board = Transform::from_isometry(station.camera_from_board.isometry().inverse());
                }
                if let Some(wrong) = method.solve(&inverted) {
                    let [mm, rad] = example.error_of(&wrong);
                    assert!(mm > 1.0 || rad > 0.05, "{} does not mind inverted poses", method.name());
                }
            }
        }
    }

    #[test]
    fn noise_of_the_arm_costs_every_method_what_its_size_allows() {
        // 20 stations, each wrong by σ_r in rotation and σ_t in place. A motion has twice the variance, its lever is the distance of the
        // board (~90 mm) and the camera on the hand (~300 mm): a station's place is wrong by √(σ_t² + (300 σ_r)²), and 20 of them
        // average it by √20 over tangents of ~0.4 rad. Five times that bounds all but Andreff's, which first fits nine numbers to a
        // rotation's three and is up to twice as far off.
        let noise = Noise {
            place_mm: 0.2,
            turn_rad: 0.001,
            ..Noise::NONE
        };
        let bound_mm = 5.0 * (0.2_f64.hypot(300.0 * 0.001)) * 2.0_f64.sqrt() / 20.0_f64.sqrt() / 0.4;
        let bound_rad = 5.0 * 0.001 * 2.0_f64.sqrt() / 20.0_f64.sqrt() / 0.4;
        for seed in 0..20 {
            let example = Example::new(seed, 20, noise);
            for method in METHODS {
                let [mm, rad] = example.error_of(&method.solve(&example.stations).unwrap());
                let share = if method == Method::Andreff { 0.5 } else { 1.0 };
                let (mm, rad) = (share * mm, share * rad);
                assert!(
                    mm < bound_mm && rad < bound_rad,
                    "{} {seed}: {mm} of {bound_mm} mm, {rad} of {bound_rad} rad",
                    method.name()
                );
            }
        }
    }
}
