//! The light field: colour as a function of point and direction, held as posed views over a surface (freeform, unstructured).

pub mod colmap;
pub mod error;
pub mod file;
pub mod ply;
pub mod rasterize;
pub mod renderer;
pub mod undistort;
pub mod view;
