//! The whole scene: organs and where they lie, how they move, the lamps and the film.

use nalgebra::{UnitQuaternion, Vector3};

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::Intrinsics;
use crate::camera::model::CameraModel;
use crate::geometry::space::World;
use crate::geometry::transform::Transform;
use crate::synthetic::light::{Film, Lamp};
use crate::synthetic::motion::Motion;
use crate::synthetic::organs::{Anatomy, Organs};

/// The organs' own space: x right, y up as first seen, z towards the camera; mm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scene {}

/// A world with known answers.
#[derive(Clone, Debug)]
pub struct World3d {
    /// Shape and tissue at rest.
    pub organs: Organs,
    /// Where the organs lie in the robot's base.
    pub world_from_organs: Transform<World, Scene>,
    /// How the tissue moves.
    pub motion: Motion,
    /// Lamps on the scope, in the camera's space.
    pub lamps: Vec<Lamp>,
    /// The wet film.
    pub film: Film,
}

impl World3d {
    /// The organs of `seed` before a scope with two lamps; the finest texture is made for pictures `width` px wide.
    pub fn new(anatomy: Anatomy, seed: u64, width: usize) -> Self {
        let texel_mm = (0.1 * 960.0 / width.max(1) as f64).clamp(0.06, 0.30);
        let lamp = |x: f64, y: f64, intensity: f64| Lamp {
            at: Vector3::new(x, y, -0.5),
            axis: Vector3::new(-0.02 * x.signum(), 0.01, 1.0).normalize(),
            intensity,
            colour: [1.0, 0.985, 0.955],
            exponent: 5,
        };
        Self {
            organs: Organs::new(anatomy, seed, texel_mm),
            world_from_organs: Transform::new(
                UnitQuaternion::from_euler_angles(0.12, -0.20, 0.45),
                Vector3::new(310.0, -45.0, 80.0),
            ),
            motion: Motion::default(),
            lamps: vec![lamp(4.2, -1.6, 0.55), lamp(-4.0, -2.2, 0.45)],
            film: Film::default(),
        }
    }
}

/// A wide-angle laparoscope: 57° across, barrel distortion.
pub fn laparoscope(width: usize, height: usize) -> CameraModel {
    let (w, h) = (width as f64, height as f64);
    CameraModel {
        width,
        height,
        intrinsics: Intrinsics {
            fx: 0.920 * w,
            fy: 0.9215 * w,
            cx: 0.5 * w - 0.5 + 0.0057 * w,
            cy: 0.5 * h - 0.5 - 0.0041 * w,
        },
        distortion: Distortion::BrownConrady {
            k: [-0.24, 0.085, -0.012, 0.0, 0.0, 0.0],
            p: [0.0006, -0.0004],
        },
    }
}
