//! Rigid motions between spaces.
//!
//! `Transform<To, From>` is T_To_From: it maps a point given in `From` to the same point given in `To`. Products chain like
//! dominoes, `world_from_camera = world_from_hand * hand_from_camera`, and a product that does not chain does not compile.

use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3, Vector6};

use crate::geometry::point::{Direction, Point};

/// T_To_From, rigid; translation in mm.
pub struct Transform<To, From> {
    isometry: Isometry3<f64>,
    spaces: PhantomData<fn() -> (To, From)>,
}

impl<To, From> Transform<To, From> {
    /// From a rotation and the position of `From`'s origin in `To`, mm.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self::from_isometry(Isometry3::from_parts(Translation3::from(translation), rotation))
    }

    /// From nalgebra's rigid motion.
    pub fn from_isometry(isometry: Isometry3<f64>) -> Self {
        Self {
            isometry,
            spaces: PhantomData,
        }
    }

    /// From a rotation matrix (made orthonormal) and a translation, mm.
    pub fn from_matrix(rotation: &Matrix3<f64>, translation: Vector3<f64>) -> Self {
        Self::new(UnitQuaternion::from_matrix(rotation), translation)
    }

    /// Both spaces coincide.
    pub fn identity() -> Self {
        Self::from_isometry(Isometry3::identity())
    }

    /// The rotation part.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        self.isometry.rotation
    }

    /// The translation part, mm: `From`'s origin in `To`.
    pub fn translation(&self) -> Vector3<f64> {
        self.isometry.translation.vector
    }

    /// `From`'s origin in `To`.
    pub fn origin(&self) -> Point<To> {
        Point::from_coords(self.translation())
    }

    /// The underlying rigid motion.
    pub fn isometry(&self) -> &Isometry3<f64> {
        &self.isometry
    }

    /// T_From_To.
    pub fn inverse(&self) -> Transform<From, To> {
        Transform::from_isometry(self.isometry.inverse())
    }

    /// This motion followed by a small one expressed in `To`: exp(twist) · T. `twist` = (translation mm, rotation rad).
    pub fn perturbed_left(&self, twist: &Vector6<f64>) -> Self {
        Self::from_isometry(small_motion(twist) * self.isometry)
    }

    /// A small motion expressed in `From` followed by this one: T · exp(twist). `twist` = (translation mm, rotation rad).
    pub fn perturbed_right(&self, twist: &Vector6<f64>) -> Self {
        Self::from_isometry(self.isometry * small_motion(twist))
    }

    /// Between `self` (t = 0) and `other` (t = 1): linear in translation, SLERP in rotation; t outside 0..1 extrapolates.
    pub fn interpolated(&self, other: &Self, t: f64) -> Self {
        let relative = self.rotation().inverse() * other.rotation();
        Self::new(
            self.rotation() * UnitQuaternion::from_scaled_axis(relative.scaled_axis() * t),
            self.translation() * (1.0 - t) + other.translation() * t,
        )
    }

    /// True when every component is a finite number.
    pub fn is_finite(&self) -> bool {
        self.translation().iter().all(|v| v.is_finite()) && self.rotation().coords.iter().all(|v| v.is_finite())
    }
}

/// Translation and rotation vector taken apart (not the SE(3) exponential): cheap, and exact to first order, which is what
/// Gauss–Newton steps need.
fn small_motion(twist: &Vector6<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(twist[0], twist[1], twist[2]),
        UnitQuaternion::from_scaled_axis(Vector3::new(twist[3], twist[4], twist[5])),
    )
}

impl<To, From> Clone for Transform<To, From> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<To, From> Copy for Transform<To, From> {}

impl<To, From> std::fmt::Debug for Transform<To, From> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Transform {:?}", self.isometry)
    }
}

impl<A, B, C> Mul<Transform<B, C>> for Transform<A, B> {
    type Output = Transform<A, C>;
    fn mul(self, other: Transform<B, C>) -> Transform<A, C> {
        Transform::from_isometry(self.isometry * other.isometry)
    }
}

impl<To, From> Mul<Point<From>> for Transform<To, From> {
    type Output = Point<To>;
    fn mul(self, point: Point<From>) -> Point<To> {
        Point::from_coords(self.isometry.rotation * point.coords + self.isometry.translation.vector)
    }
}

impl<To, From> Mul<Direction<From>> for Transform<To, From> {
    type Output = Direction<To>;
    fn mul(self, direction: Direction<From>) -> Direction<To> {
        Direction::from_coords(self.isometry.rotation * direction.coords)
    }
}
