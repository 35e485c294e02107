//! A camera model as a list of numbers to be estimated.

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::Intrinsics;
use crate::camera::model::CameraModel;

/// Which lens model is fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LensModel {
    /// k1 k2 p1 p2 k3: enough for rigid scopes.
    PlumbBob,
    /// With k4 k5 k6 in the denominator: very wide lenses; needs corners up to the border.
    RationalPolynomial,
    /// Kannala–Brandt, by the angle to the axis: fisheyes.
    Equidistant,
}

const PLUMB_BOB: &[&str] = &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];
const RATIONAL: &[&str] = &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];
const EQUIDISTANT: &[&str] = &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"];

impl LensModel {
    /// Its parameters, in order.
    pub fn names(self) -> &'static [&'static str] {
        match self {
            Self::PlumbBob => PLUMB_BOB,
            Self::RationalPolynomial => RATIONAL,
            Self::Equidistant => EQUIDISTANT,
        }
    }

    /// Its name in ROS.
    pub fn ros_name(self) -> &'static str {
        match self {
            Self::PlumbBob => "plumb_bob",
            Self::RationalPolynomial => "rational_polynomial",
            Self::Equidistant => "equidistant",
        }
    }

    /// The simplest of which a camera's lens is one; of a camera without a lens, [`LensModel::PlumbBob`].
    pub fn of(camera: &CameraModel) -> Self {
        match camera.distortion {
            Distortion::KannalaBrandt { .. } => Self::Equidistant,
            Distortion::BrownConrady {
                k: [_, _, _, k4, k5, k6],
                ..
            } if [k4, k5, k6] != [0.0; 3] => Self::RationalPolynomial,
            Distortion::BrownConrady { .. } | Distortion::None => Self::PlumbBob,
        }
    }

    /// The camera with a pinhole of `intrinsics` and no distortion of this model.
    pub fn camera(self, width: usize, height: usize, intrinsics: Intrinsics) -> CameraModel {
        let distortion = match self {
            Self::Equidistant => Distortion::KannalaBrandt { k: [0.0; 4] },
            Self::PlumbBob | Self::RationalPolynomial => Distortion::BrownConrady {
                k: [0.0; 6],
                p: [0.0; 2],
            },
        };
        CameraModel {
            width,
            height,
            intrinsics,
            distortion,
        }
    }
}

/// The number called for, by its place in [`LensModel::names`].
pub fn parameter(camera: &CameraModel, model: LensModel, place: usize) -> f64 {
    let mut copy = camera.clone();
    slot(&mut copy, model, place).map_or(0.0, |slot| *slot)
}

/// Add to one of the numbers.
pub fn add(camera: &mut CameraModel, model: LensModel, place: usize, amount: f64) {
    if let Some(slot) = slot(camera, model, place) {
        *slot += amount;
    }
}

fn slot(camera: &mut CameraModel, model: LensModel, place: usize) -> Option<&mut f64> {
    match (*model.names().get(place)?, &mut camera.distortion) {
        ("fx", _) => Some(&mut camera.intrinsics.fx),
        ("fy", _) => Some(&mut camera.intrinsics.fy),
        ("cx", _) => Some(&mut camera.intrinsics.cx),
        ("cy", _) => Some(&mut camera.intrinsics.cy),
        (name, Distortion::BrownConrady { k, p }) => match name {
            "k1" => Some(&mut k[0]),
            "k2" => Some(&mut k[1]),
            "k3" => Some(&mut k[2]),
            "k4" => Some(&mut k[3]),
            "k5" => Some(&mut k[4]),
            "k6" => Some(&mut k[5]),
            "p1" => Some(&mut p[0]),
            "p2" => Some(&mut p[1]),
            _ => None,
        },
        (name, Distortion::KannalaBrandt { k }) => match name {
            "k1" => Some(&mut k[0]),
            "k2" => Some(&mut k[1]),
            "k3" => Some(&mut k[2]),
            "k4" => Some(&mut k[3]),
            _ => None,
        },
        (_, Distortion::None) => None,
    }
}

/// The radius, px from the principal point, from which on the lens would fold the picture over itself; `None` if not before `reach_px`.
pub fn fold_px(camera: &CameraModel, reach_px: f64) -> Option<f64> {
    let f = camera.intrinsics.fx;
    let mut last = 0.0;
    // Along the ideal radius, until the lens's picture of it has come as far as asked.
    for step in 1..=4000 {
        let ideal = 8.0 * f64::from(step) / 4000.0;
        let radius = radial(&camera.distortion, ideal);
        if radius <= last {
            return (last * f < reach_px).then_some(last * f);
        }
        if radius * f >= reach_px {
            return None;
        }
        last = radius;
    }
    None
}

fn radial(distortion: &Distortion, ideal: f64) -> f64 {
    match distortion {
        Distortion::BrownConrady { k, .. } => Distortion::BrownConrady { k: *k, p: [0.0; 2] }.distort(ideal, 0.0).0,
        other => other.distort(ideal, 0.0).0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_has_its_place() {
        let intrinsics = Intrinsics {
            fx: 500.0,
            fy: 501.0,
            cx: 320.0,
            cy: 240.0,
        };
        for model in [LensModel::PlumbBob, LensModel::RationalPolynomial, LensModel::Equidistant] {
            let mut camera = model.camera(640, 480, intrinsics);
            for place in 0..model.names().len() {
                add(&mut camera, model, place, 0.125 + place as f64);
            }
            for place in 4..model.names().len() {
                assert_eq!(parameter(&camera, model, place), 0.125 + place as f64);
            }
            assert_eq!(LensModel::of(&camera), model);
            assert_eq!(parameter(&camera, model, 1), 502.125);
        }
    }

    #[test]
    fn a_fold_is_found() {
        let intrinsics = Intrinsics {
            fx: 500.0,
            fy: 500.0,
            cx: 320.0,
            cy: 240.0,
        };
        let mut camera = LensModel::PlumbBob.camera(640, 480, intrinsics);
        assert!(fold_px(&camera, 400.0).is_none());
        // r − 0.5 r³ turns at r = √(2/3), where it is 0.544.
        add(&mut camera, LensModel::PlumbBob, 4, -0.5);
        let fold = fold_px(&camera, 400.0).unwrap();
        assert!((fold - 272.2).abs() < 1.0, "{fold}");
        assert!(fold_px(&camera, 200.0).is_none());
    }
}
