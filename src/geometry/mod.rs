//! Geometry: points, directions and rigid motions that know in which space they live. Lengths in mm, angles in rad, f64.

pub mod alignment;
pub mod mesh;
pub mod point;
pub mod space;
pub mod transform;
