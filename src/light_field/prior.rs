//! What the arm says about where the camera was, smoothed over neighbouring samples.

use nalgebra::{UnitQuaternion, Vector3};

use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::time::{Span, Timestamp};

/// How far the poses of a survey are trusted before the pictures have spoken.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PriorSettings {
    /// Standard deviation of a pose's position per axis, mm.
    pub arm_sigma_mm: f64,
    /// Standard deviation of a pose's rotation per axis, rad.
    pub arm_sigma_rad: f64,
}

impl Default for PriorSettings {
    fn default() -> Self {
        Self {
            arm_sigma_mm: 0.5,
            arm_sigma_rad: 0.003,
        }
    }
}

impl PriorSettings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        for (key, value, low, high) in [
            ("arm_sigma_mm", self.arm_sigma_mm, 1e-3, 100.0),
            ("arm_sigma_rad", self.arm_sigma_rad, 1e-5, 1.0),
        ] {
            if !(low..=high).contains(&value) {
                return Err(format!("survey.{key}: expected {low} to {high}, found {value}"));
            }
        }
        Ok(())
    }
}

/// The camera's pose by the arm's clock: base_from_hand by time, times hand_from_camera.
pub trait PosePrior: Sync {
    /// The pose stamped `at` by the arm; `None` where the arm said nothing.
    fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>>;
    /// Standard deviation of a pose's position per axis, mm.
    fn sigma_mm(&self) -> f64;
    /// Standard deviation of a pose's rotation per axis, rad.
    fn sigma_rad(&self) -> f64;
}

/// A Gaussian mean of the arm's poses around an instant.
///
/// Interpolating noisy samples gives noise that depends on where between two samples one asks, which would pull the search
/// for the time offset toward mid-samples; a mean over several samples is rid of that, and of half the noise.
pub(crate) fn smoothed_pose(prior: &dyn PosePrior, at: Timestamp, sigma_ms: f64) -> Option<Transform<World, Camera>> {
    let centre = prior.world_from_camera(at).filter(Transform::is_finite)?;
    if sigma_ms <= 0.0 {
        return Some(centre);
    }
    let (mut t, mut r, mut weight) = (Vector3::zeros(), Vector3::zeros(), 0.0);
    for step in -8i32..=8 {
        let distance = f64::from(step) * 0.25;
        let Some(pose) = prior
            .world_from_camera(at + Span::from_milliseconds(distance * sigma_ms))
            .filter(Transform::is_finite)
        else {
            // Lopsided means would shift the pose along the path: at the ends of the record take the sample itself.
            return Some(centre);
        };
        let w = (-0.5 * distance * distance).exp();
        t += pose.translation() * w;
        r += (centre.rotation().inverse() * pose.rotation()).scaled_axis() * w;
        weight += w;
    }
    Some(Transform::new(
        centre.rotation() * UnitQuaternion::from_scaled_axis(r / weight),
        t / weight,
    ))
}
