//! Points and directions of a space.

use std::marker::PhantomData;
use std::ops::{Add, Mul, Neg, Sub};

use nalgebra::Vector3;

/// A place in `Space`, mm.
pub struct Point<Space> {
    /// Coordinates x, y, z in mm.
    pub coords: Vector3<f64>,
    space: PhantomData<fn() -> Space>,
}

/// A difference of two places in `Space`, mm; not necessarily of unit length.
pub struct Direction<Space> {
    /// Components x, y, z.
    pub coords: Vector3<f64>,
    space: PhantomData<fn() -> Space>,
}

macro_rules! vector_like {
    ($name:ident) => {
        impl<Space> $name<Space> {
            /// From components.
            pub fn new(x: f64, y: f64, z: f64) -> Self {
                Self::from_coords(Vector3::new(x, y, z))
            }

            /// From a vector of components.
            pub fn from_coords(coords: Vector3<f64>) -> Self {
                Self {
                    coords,
                    space: PhantomData,
                }
            }
        }

        impl<Space> Clone for $name<Space> {
            fn clone(&self) -> Self {
                *self
            }
        }

        impl<Space> Copy for $name<Space> {}

        impl<Space> std::fmt::Debug for $name<Space> {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(
                    f,
                    concat!(stringify!($name), "({}, {}, {})"),
                    self.coords.x, self.coords.y, self.coords.z
                )
            }
        }

        impl<Space> PartialEq for $name<Space> {
            fn eq(&self, other: &Self) -> bool {
                self.coords == other.coords
            }
        }
    };
}

vector_like!(Point);
vector_like!(Direction);

impl<Space> Direction<Space> {
    /// The same direction at length 1; `None` for a vanishing one.
    pub fn unit(self) -> Option<Self> {
        self.coords.try_normalize(1e-300).map(Self::from_coords)
    }
}

impl<Space> Sub for Point<Space> {
    type Output = Direction<Space>;
    fn sub(self, other: Self) -> Direction<Space> {
        Direction::from_coords(self.coords - other.coords)
    }
}

impl<Space> Add<Direction<Space>> for Point<Space> {
    type Output = Self;
    fn add(self, step: Direction<Space>) -> Self {
        Self::from_coords(self.coords + step.coords)
    }
}

impl<Space> Mul<f64> for Direction<Space> {
    type Output = Self;
    fn mul(self, factor: f64) -> Self {
        Self::from_coords(self.coords * factor)
    }
}

impl<Space> Neg for Direction<Space> {
    type Output = Self;
    fn neg(self) -> Self {
        Self::from_coords(-self.coords)
    }
}
