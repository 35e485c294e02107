//! What the arm says about the scope: its pose with errors, on a clock of its own that runs late and slow.

use nalgebra::{UnitQuaternion, Vector3, Vector6};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Normal};

use crate::geometry::space::{Camera, Hand, RobotBase, World};
use crate::geometry::transform::Transform;

/// How the arm measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmSettings {
    /// Poses a second.
    pub rate_hz: f64,
    /// A pose carries a stamp this much later than the instant it was true, s.
    pub late_s: f64,
    /// Standard deviation per axis of the hand's position, mm.
    pub position_noise_mm: f64,
    /// Standard deviation per axis of the hand's orientation, rad.
    pub rotation_noise_rad: f64,
    /// From the hand (the scope's plug) to the lens along the shaft, mm.
    pub scope_mm: f64,
}

impl Default for ArmSettings {
    fn default() -> Self {
        Self {
            rate_hz: 50.0,
            late_s: 0.040,
            position_noise_mm: 0.25,
            rotation_noise_rad: 0.08_f64.to_radians(),
            scope_mm: 300.0,
        }
    }
}

/// One line of `poses.tum`.
#[derive(Clone, Copy, Debug)]
pub struct ArmReading {
    /// The stamp as written, s.
    pub stamp_s: f64,
    /// When it was true on the camera's clock, s.
    pub true_s: f64,
    /// What the arm says.
    pub base_from_hand: Transform<RobotBase, Hand>,
    /// What was so.
    pub true_base_from_hand: Transform<RobotBase, Hand>,
}

/// Where the lens sits in the scope: down the shaft, a little off its axis, not quite straight.
pub fn hand_from_camera(scope_mm: f64) -> Transform<Hand, Camera> {
    Transform::new(
        UnitQuaternion::from_euler_angles(0.011, -0.016, 1.31),
        Vector3::new(1.8, -2.6, scope_mm),
    )
}

/// The arm's readings over `from_s`…`to_s` of the path `world_from_camera`; the world is the robot's base.
pub fn arm_readings(
    settings: &ArmSettings,
    seed: u64,
    from_s: f64,
    to_s: f64,
    world_from_camera: impl Fn(f64) -> Transform<World, Camera>,
) -> Vec<ArmReading> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // The standard deviations come checked; a normal distribution of a finite deviation always exists.
    let deviate = |random: &mut ChaCha8Rng, sigma: f64| Normal::new(0.0, sigma).map_or(0.0, |normal| normal.sample(random));
    let camera_from_hand = hand_from_camera(settings.scope_mm).inverse();
    let count = ((to_s - from_s) * settings.rate_hz).ceil() as usize + 1;
    (0..count)
        .map(|i| {
            let true_s = from_s + i as f64 / settings.rate_hz;
            let hand = world_from_camera(true_s) * camera_from_hand;
            let true_base_from_hand: Transform<RobotBase, Hand> = Transform::from_isometry(*hand.isometry());
            let mut noise = Vector6::zeros();
            for k in 0..3 {
                noise[k] = deviate(&mut random, settings.position_noise_mm);
                noise[k + 3] = deviate(&mut random, settings.rotation_noise_rad);
            }
            ArmReading {
                stamp_s: true_s + settings.late_s,
                true_s,
                base_from_hand: true_base_from_hand.perturbed_right(&noise),
                true_base_from_hand,
            }
        })
        .collect()
}
