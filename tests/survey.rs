//! Refining a survey of a rendered bumpy surface whose poses are known exactly.

use endofield::camera::distortion::Distortion;
use endofield::camera::intrinsics::{Intrinsics, Pixel};
use endofield::camera::model::CameraModel;
use endofield::geometry::alignment::{PosePair, Scale, Similarity};
use endofield::geometry::space::{Camera, World};
use endofield::geometry::transform::Transform;
use endofield::image::buffer::Image;
use endofield::light_field::survey::{PosePrior, Settings, SurveyError, SurveyFrame, refine};
use endofield::progress::Silent;
use endofield::time::Timestamp;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};

fn camera() -> CameraModel {
    CameraModel {
        width: 480,
        height: 270,
        intrinsics: Intrinsics {
            fx: 432.0,
            fy: 431.0,
            cx: 241.0,
            cy: 133.5,
        },
        distortion: Distortion::None,
    }
}

/// Smooth random brightness or height: sines of random direction, wavelength and phase.
struct Waves(Vec<(f64, f64, f64, f64)>);

impl Waves {
    fn new(seed: u64, count: usize, shortest_mm: f64, longest_mm: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let wave = |rng: &mut ChaCha8Rng| {
            let length = shortest_mm * (longest_mm / shortest_mm).powf(rng.random_range(0.0..1.0));
            let angle: f64 = rng.random_range(0.0..std::f64::consts::TAU);
            let k = std::f64::consts::TAU / length;
            (
                k * angle.cos(),
                k * angle.sin(),
                rng.random_range(0.0..std::f64::consts::TAU),
                length.sqrt(),
            )
        };
        let waves: Vec<_> = (0..count).map(|_| wave(&mut rng)).collect();
        let power: f64 = waves.iter().map(|w| 0.5 * w.3 * w.3).sum::<f64>().sqrt();
        Self(waves.into_iter().map(|(a, b, p, w)| (a, b, p, w / power)).collect())
    }

    /// Standard deviation 1.
    fn at(&self, x: f64, y: f64) -> f64 {
        self.0.iter().map(|(a, b, p, w)| w * (a * x + b * y + p).sin()).sum()
    }
}

struct Scene {
    height: Waves,
    texture: Waves,
}

impl Scene {
    fn new() -> Self {
        Self {
            height: Waves::new(1, 8, 20.0, 60.0),
            texture: Waves::new(2, 50, 1.2, 14.0),
        }
    }

    fn picture(&self, pose: &Transform<World, Camera>, seed: u64) -> Image<[u8; 3]> {
        let camera = camera();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut image = Image::filled(camera.width, camera.height, [0u8; 3]);
        let origin = pose.translation();
        for y in 0..camera.height {
            for x in 0..camera.width {
                let ray = camera
                    .unproject(Pixel {
                        x: x as f64,
                        y: y as f64,
                    })
                    .unwrap();
                let d = (*pose * ray).coords;
                // The surface is shallow against its distance: stepping to its height under the last guess converges.
                let mut s = 75.0;
                for _ in 0..6 {
                    let p = origin + d * s;
                    s = (75.0 + 2.0 * self.height.at(p.x, p.y) - origin.z) / d.z;
                }
                let p = origin + d * s;
                // The lamp rides on the camera.
                let lamp = (75.0 / (d * s).norm()).powi(2);
                let noise: f64 = StandardNormal.sample(&mut rng);
                let gray = lamp * (110.0 + 14.0 * self.texture.at(p.x, p.y)) + 1.5 * noise;
                image.set(
                    x,
                    y,
                    [gray as u8, (0.7 * gray) as u8, (0.6 * gray) as u8].map(|v| v.clamp(0, 255)),
                );
            }
        }
        image
    }
}

fn path(t: f64) -> Transform<World, Camera> {
    let a = 2.6 * (t + 0.1 * (3.0 * t).sin());
    let (x, y) = (9.0 * a.cos(), 9.0 * a.sin());
    let turn = UnitQuaternion::from_euler_angles(0.09 * a.sin(), -0.09 * a.cos(), 0.06 * (1.7 * a).sin());
    Transform::new(turn, Vector3::new(x, y, 5.0 * (0.8 * a).sin()))
}

struct Arm(Vec<(f64, Transform<World, Camera>)>);

const SIGMA_MM: f64 = 0.25;
const SIGMA_RAD: f64 = 0.0014;

impl Arm {
    fn new(late_s: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut noise = |sigma: f64| {
            Vector3::from_fn(|_, _| {
                let n: f64 = StandardNormal.sample(&mut rng);
                sigma * n
            })
        };
        let samples = (0..160).map(|i| f64::from(i) * 0.02 - 0.5).map(|t| {
            let pose = path(t - late_s);
            let turn = UnitQuaternion::from_scaled_axis(noise(SIGMA_RAD));
            (
                t,
                Transform::new(pose.rotation() * turn, pose.translation() + noise(SIGMA_MM)),
            )
        });
        Self(samples.collect())
    }
}

impl PosePrior for Arm {
    fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>> {
        let t = at.seconds();
        let i = self.0.partition_point(|s| s.0 <= t);
        let (a, b) = (self.0.get(i.checked_sub(1)?)?, self.0.get(i)?);
        Some(a.1.interpolated(&b.1, (t - a.0) / (b.0 - a.0)))
    }
    fn sigma_mm(&self) -> f64 {
        SIGMA_MM
    }
    fn sigma_rad(&self) -> f64 {
        SIGMA_RAD
    }
}

fn frames(count: usize) -> (Vec<SurveyFrame>, Vec<Transform<World, Camera>>) {
    let scene = Scene::new();
    let times: Vec<f64> = (0..count).map(|i| 1.6 * i as f64 / (count - 1) as f64).collect();
    let truth: Vec<_> = times.iter().map(|t| path(*t)).collect();
    let frames = truth
        .iter()
        .zip(&times)
        .enumerate()
        .map(|(i, (pose, t))| SurveyFrame {
            frame_number: i as u32,
            image: scene.picture(pose, i as u64),
            confidence: Image::filled(480, 270, 255),
            exposed_at: Timestamp::from_seconds(*t),
        })
        .collect();
    (frames, truth)
}

/// Root mean square position (mm) and rotation (degrees) errors after a rigid alignment.
pub fn pose_errors(pairs: &[(Isometry3<f64>, Isometry3<f64>)]) -> (f64, f64) {
    let pairs: Vec<PosePair> = pairs
        .iter()
        .map(|(fixed, moving)| PosePair {
            fixed: *fixed,
            moving: *moving,
            per_mm2: 1.0,
            per_rad2: 1e4,
        })
        .collect();
    let gauge = Similarity::between(&pairs, Scale::Rigid).unwrap();
    let (mut mm, mut rad) = (0.0, 0.0);
    for p in &pairs {
        let moved = gauge.moved(&p.moving);
        mm += (moved.translation.vector - p.fixed.translation.vector).norm_squared();
        rad += moved.rotation.angle_to(&p.fixed.rotation).powi(2);
    }
    let n = pairs.len() as f64;
    ((mm / n).sqrt(), (rad / n).sqrt().to_degrees())
}

/// Scale and slow bending are known from the arm only: 24 smoothed poses of about 0.15 mm leave the scale of a 9 mm path
/// uncertain by 0.15/(9·√24) = 0.3 %, i.e. 0.03 mm, and the offset by 0.15/23 mm/s/√48 = 1 ms: 0.1 mm, 0.1° and 5 ms are three or more of each.
#[test]
fn a_noisy_late_arm_is_set_right() {
    let (frames, truth) = frames(24);
    let arm = Arm::new(0.04);
    let refined = refine(&frames, &camera(), &arm, &Settings::default(), &Silent).unwrap();
    let pairs: Vec<_> = refined
        .world_from_camera
        .iter()
        .zip(&truth)
        .filter_map(|(found, truth)| Some((*truth.isometry(), *found.as_ref()?.isometry())))
        .collect();
    assert_eq!(pairs.len(), truth.len(), "{:?}", refined.report);
    let (mm, deg) = pose_errors(&pairs);
    println!("{mm:.4} mm {deg:.4} deg {:?}", refined.report);
    assert!(mm < 0.1 && deg < 0.1, "{mm} mm, {deg} deg; {:?}", refined.report);
    assert!((refined.report.time_offset_ms + 40.0).abs() < 5.0, "{:?}", refined.report);
    assert!(refined.report.refined_reprojection_px < 0.4 && refined.report.prior_reprojection_px > 0.5);
    assert!(refined.points.len() > 100);
    // The inverse of a pose is not its pose.
    let inverted: Vec<_> = pairs.iter().map(|(t, f)| (*t, f.inverse())).collect();
    assert!(pose_errors(&inverted).0 > 1.0);
}

#[test]
fn pictures_without_texture_are_refused_with_a_reason() {
    let (mut frames, _) = frames(4);
    frames.iter_mut().for_each(|f| f.image.fill([120, 80, 70]));
    let error = refine(&frames, &camera(), &Arm::new(0.0), &Settings::default(), &Silent).unwrap_err();
    assert!(
        matches!(error, SurveyError::NoParallax | SurveyError::TooFewPoints { .. }),
        "{error}"
    );
}
