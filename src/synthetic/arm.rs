//! What the arm says about the scope: its pose with errors, on a clock of its own that runs late and slow.

use nalgebra::{UnitQuaternion, Vector3, Vector6};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Normal};

use crate::geometry::space::{Camera, Hand, RobotBase, World};
use crate::geometry::transform::Transform;
use crate::robot::kinematics::{Arm, ArmError};
use crate::synthetic::arm_joints::{AT_WORK, JointErrors, encoder_readings, joint_path};

/// How the arm errs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ArmModel {
    /// White noise on the poses of the hand.
    PoseNoise {
        /// Standard deviation per axis of the position, mm.
        position_mm: f64,
        /// Standard deviation per axis of the orientation, rad.
        rotation_rad: f64,
    },
    /// An AESOP 3000 whose joints err.
    Joints(JointErrors),
}

/// How the arm measures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmSettings {
    /// Poses a second.
    pub rate_hz: f64,
    /// A pose carries a stamp this much later than the instant it was true, s.
    pub late_s: f64,
    /// How it errs.
    pub model: ArmModel,
    /// From the hand (the scope's plug) to the lens along the shaft, mm.
    pub scope_mm: f64,
}

impl Default for ArmSettings {
    fn default() -> Self {
        Self {
            rate_hz: 50.0,
            late_s: 0.040,
            model: ArmModel::PoseNoise { position_mm: 0.25, rotation_rad: 0.08_f64.to_radians() },
            scope_mm: 300.0,
        }
    }
}

/// One line of `poses.tum` or `joints.csv`.
#[derive(Clone, Debug)]
pub struct ArmReading {
    /// The stamp as written, s.
    pub stamp_s: f64,
    /// When it was true on the camera's clock, s.
    pub true_s: f64,
    /// What the arm says.
    pub base_from_hand: Transform<RobotBase, Hand>,
    /// What was so.
    pub true_base_from_hand: Transform<RobotBase, Hand>,
    /// What the encoders say, and what was so, where the arm is a chain of joints; mm and rad.
    pub joints: Option<Joints>,
}

/// Joint values.
#[derive(Clone, Debug)]
pub struct Joints {
    /// As read.
    pub read: Vec<f64>,
    /// As they were.
    pub exact: Vec<f64>,
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
) -> Result<Vec<ArmReading>, ArmError> {
    let camera_from_hand = hand_from_camera(settings.scope_mm).inverse();
    let count = ((to_s - from_s) * settings.rate_hz).ceil() as usize + 1;
    let mut readings: Vec<ArmReading> = (0..count)
        .map(|i| {
            let true_s = from_s + i as f64 / settings.rate_hz;
            let hand = world_from_camera(true_s) * camera_from_hand;
            let base_from_hand: Transform<RobotBase, Hand> = Transform::from_isometry(*hand.isometry());
            let stamp_s = true_s + settings.late_s;
            ArmReading { stamp_s, true_s, base_from_hand, true_base_from_hand: base_from_hand, joints: None }
        })
        .collect();
    match &settings.model {
        ArmModel::PoseNoise { position_mm, rotation_rad } => {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            // A normal distribution of a finite deviation always exists.
            let mut deviate = |sigma: f64| Normal::new(0.0, sigma).map_or(0.0, |normal| normal.sample(&mut random));
            for reading in &mut readings {
                let mut noise = Vector6::zeros();
                for k in 0..3 {
                    noise[k] = deviate(*position_mm);
                    noise[k + 3] = deviate(*rotation_rad);
                }
                reading.base_from_hand = reading.base_from_hand.perturbed_right(&noise);
            }
        }
        ArmModel::Joints(errors) => {
            let arm = Arm::aesop_3000()?;
            let hands: Vec<_> = readings.iter().map(|reading| reading.true_base_from_hand).collect();
            let exact = joint_path(&arm, &AT_WORK, &hands)?;
            let read = encoder_readings(&arm, errors, seed, &exact);
            for (reading, (read, exact)) in readings.iter_mut().zip(read.into_iter().zip(exact)) {
                reading.base_from_hand = arm.base_from_hand(&read)?;
                reading.joints = Some(Joints { read, exact });
            }
        }
    }
    Ok(readings)
}

/// Where the lens is when an AESOP 3000 stands [`AT_WORK`]; the world is the robot's base.
pub fn world_from_camera_at_work(scope_mm: f64) -> Result<Transform<World, Camera>, ArmError> {
    let hand = Arm::aesop_3000()?.base_from_hand(&AT_WORK)? * hand_from_camera(scope_mm);
    Ok(Transform::from_isometry(*hand.isometry()))
}
