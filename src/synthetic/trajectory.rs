//! Where the scope goes: an arm swings it about the trocar, in and out.
//!
//! The trocar holds the scope's shaft at one point (the remote centre of motion), so the tip has four freedoms: two tilts, the
//! depth, and the roll about the shaft. All paths are smooth functions of time.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Vector3};

use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::synthetic::scene::Scene;

/// Which path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Course {
    /// A sweep over the field, for a light field.
    Survey,
    /// A slower look around inside the surveyed region.
    Live,
    /// No motion.
    Still,
}

/// A path of the camera.
#[derive(Clone, Copy, Debug)]
pub struct Trajectory {
    course: Course,
    duration_s: f64,
    world_from_organs: Transform<World, Scene>,
}

/// The shaft's freedoms at one instant.
#[derive(Clone, Copy, Debug)]
struct Shaft {
    tilt_x: f64,
    tilt_y: f64,
    distance_mm: f64,
    roll: f64,
}

/// The trocar in the organs' space, mm.
const TROCAR_MM: [f64; 3] = [8.0, -34.0, 158.0];
/// What the shaft points at when not tilted.
const FOCUS_MM: [f64; 3] = [-2.0, 3.0, 4.0];
/// Mean speed of the survey, mm/s.
const SURVEY_MM_PER_S: f64 = 24.0;
/// Length of one row of the survey's sweep and back, mm, at full tilt.
const SURVEY_ROW_MM: f64 = 62.0;

impl Trajectory {
    /// A path that lasts `duration_s`.
    pub fn new(course: Course, duration_s: f64, world_from_organs: Transform<World, Scene>) -> Self {
        Self {
            course,
            duration_s: duration_s.max(0.1),
            world_from_organs,
        }
    }

    /// Camera pose at `seconds`.
    pub fn world_from_camera(&self, seconds: f64) -> Transform<World, Camera> {
        let shaft = self.shaft(seconds);
        let trocar = Vector3::from(TROCAR_MM);
        let straight = Vector3::from(FOCUS_MM) - trocar;
        let length = straight.norm();
        let forward = straight / length;
        let right = Vector3::x() - forward * forward.x;
        let right = right.normalize();
        let down = forward.cross(&right);
        let axis = (forward + right * shaft.tilt_x.tan() + down * shaft.tilt_y.tan()).normalize();
        let x = (right - axis * axis.dot(&right)).normalize();
        let y = axis.cross(&x);
        let (sin, cos) = shaft.roll.sin_cos();
        let rotation = Matrix3::from_columns(&[x * cos + y * sin, y * cos - x * sin, axis]);
        let organs_from_camera: Transform<Scene, Camera> =
            Transform::from_matrix(&rotation, trocar + axis * (length - shaft.distance_mm));
        self.world_from_organs * organs_from_camera
    }

    fn shaft(&self, seconds: f64) -> Shaft {
        match self.course {
            Course::Still => Shaft {
                tilt_x: 0.0,
                tilt_y: 0.0,
                distance_mm: 72.0,
                roll: 0.02,
            },
            Course::Survey => {
                // Rows from side to side while the other tilt goes once through; as many rows as the time allows.
                let rows = (self.duration_s * SURVEY_MM_PER_S / SURVEY_ROW_MM).max(0.9);
                let share = seconds / self.duration_s;
                let phase = TAU * rows * share;
                Shaft {
                    tilt_x: 0.205 * (phase + 0.4).sin(),
                    tilt_y: 0.16 * (TAU * (0.5 * share + 0.25)).sin() + 0.035 * (0.5 * phase).cos() - 0.01,
                    distance_mm: 74.0 + 12.0 * (TAU * share * (0.37 * rows).max(0.8) + 2.1).sin(),
                    roll: 0.06 * (TAU * 0.45 * share).sin(),
                }
            }
            Course::Live => Shaft {
                tilt_x: 0.125 * (0.98 * seconds + 0.2).sin() + 0.02 * (2.3 * seconds).sin(),
                tilt_y: 0.07 * (0.71 * seconds + 2.6).sin(),
                distance_mm: 71.0 + 6.5 * (0.62 * seconds + 0.8).sin(),
                roll: 0.035 * (0.5 * seconds).sin() + 0.02,
            },
        }
    }
}
