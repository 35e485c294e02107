//! How the tissue moves: breathing and heartbeat, as small affine motions of the organs.
//!
//! A breath is asymmetric: quicker out than in, then a pause, 12 a minute. It pushes the organs away from the diaphragm, lifts
//! them, and stretches them a little; the heart adds a short push. Affine maps keep straight rays straight, so depth stays exact.

use nalgebra::{Matrix3, Vector3};

/// Amplitudes of the tissue's motion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Motion {
    /// Stroke of a breath, mm.
    pub breathing_mm: f64,
    /// Stroke of a heartbeat, mm.
    pub heartbeat_mm: f64,
}

/// Seconds from breath to breath (12 a minute), in, and out; the rest is the pause.
const BREATH_S: f64 = 5.0;
const BREATH_IN_S: f64 = 2.0;
const BREATH_OUT_S: f64 = 1.3;
/// Seconds from beat to beat (72 a minute).
const BEAT_S: f64 = 60.0 / 72.0;

/// p_rest = linear · p + offset: from the organs where they are to the organs at rest.
#[derive(Clone, Copy, Debug)]
pub struct RestFromMoved {
    /// Linear part.
    pub linear: Matrix3<f64>,
    /// Offset, mm.
    pub offset: Vector3<f64>,
}

impl Motion {
    /// The motion at `seconds`.
    pub fn rest_from_moved(&self, seconds: f64) -> RestFromMoved {
        let breath = self.breathing_mm * breath_share(seconds);
        let beat = self.heartbeat_mm * beat_share(seconds);
        let shift = Vector3::new(0.15, -0.85, 0.5) * breath + Vector3::new(0.2, 0.1, 0.97) * beat;
        // 1 % of stretch a mm along the push, tissue being incompressible, half of that back across.
        let stretch = 0.0035 * breath;
        let linear = Matrix3::new(
            1.0,
            0.3 * stretch,
            0.0,
            0.0,
            1.0 - stretch,
            0.0,
            0.0,
            0.15 * stretch,
            1.0 + 0.5 * stretch,
        );
        RestFromMoved {
            linear,
            offset: -(linear * shift),
        }
    }
}

/// 0 breathed out … 1 breathed in.
pub fn breath_share(seconds: f64) -> f64 {
    let t = seconds.rem_euclid(BREATH_S);
    let ramp = |t: f64| 0.5 - 0.5 * (std::f64::consts::PI * t.clamp(0.0, 1.0)).cos();
    if t < BREATH_IN_S {
        ramp(t / BREATH_IN_S)
    } else {
        1.0 - ramp((t - BREATH_IN_S) / BREATH_OUT_S)
    }
}

fn beat_share(seconds: f64) -> f64 {
    let t = seconds.rem_euclid(BEAT_S) / BEAT_S;
    // A quick push, and a second, weaker one.
    let push = |centre: f64, width: f64| (-((t - centre) / width).powi(2)).exp();
    push(0.22, 0.07) + 0.35 * push(0.52, 0.10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_breath_takes_two_seconds_in_and_less_out() {
        assert!(breath_share(0.0) < 1e-9 && (breath_share(2.0) - 1.0).abs() < 1e-9);
        assert!(breath_share(3.3) < 1e-9 && breath_share(4.7) < 1e-9);
        assert!((breath_share(1.0) - 0.5).abs() < 1e-9 && (breath_share(2.65) - 0.5).abs() < 1e-9);
        assert!((breath_share(6.3) - breath_share(1.3)).abs() < 1e-9);
    }

    #[test]
    fn no_amplitude_is_no_motion() {
        let rest = Motion::default().rest_from_moved(1.7);
        assert_eq!(rest.linear, Matrix3::identity());
        assert_eq!(rest.offset.norm(), 0.0);
    }
}
