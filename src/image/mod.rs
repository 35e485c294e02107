//! Images: pixel buffers, their pool, and what is done to pixels without knowing what they show.

pub mod blur;
pub mod buffer;
pub mod canvas;
pub mod color;
pub mod color_correction;
pub mod components;
pub mod corners;
pub mod distance;
pub mod field_of_view;
pub mod gradient;
pub mod hole_filling;
pub mod patch;
pub mod pool;
pub mod pyramid;
pub mod reduction;
pub mod remap;
mod remap_bicubic;
mod remap_bilinear;
mod remap_octets;
pub mod specularity;
pub mod wide;
