//! What other views saw where this frame shows the lamp.
//!
//! The frame is laid out in cells of about 8 px, four of which are a block. Around specularities:
//!
//! 0. [`support`]: where the surface is known, and what may be filled of it;
//! 1. [`ensemble`] and [`camera_blending`]: which views looked at the same tissue, best by the unstructured-lumigraph penalties and by
//!    how much of the hole they saw free of the lamp, chosen at the corners of blocks and blended in between (Buehler et al. 2001),
//!    and [`single_pixels`]: who is needed besides for what the chosen see clean nowhere;
//! 2. [`live`] and [`view_fit`]: each of these views, drawn small over the good pixels around the holes, gives its brightness against
//!    the live picture (the lamp rides on the camera, so views differ from place to place), the small shift that is left, and how
//!    well it then fits: three smooth fields by normalized convolution (Knutsson and Westin 1993);
//! 3. [`blend`], [`drawing`] and [`drawn`]: the views drawn in full over the holes, [`lookup`] by [`lookup`], and blended, the darker
//!    heard rather than the brighter, since the lamp only adds light; what all of them show under it loses the [`residual_lamp`];
//! 4. [`replacement`]: the picture replaced where it is *brighter* than what was measured: the seam lies where both agree, so it
//!    cannot be seen; [`cut_patches`] are left whole where it would be.
//!
//! Where no view fits, the picture is left as it was, and says so.

pub mod blend;
pub mod camera_blending;
mod cut_patches;
pub mod drawing;
pub mod drawn;
pub mod ensemble;
#[cfg(test)]
pub mod example;
pub mod grid;
pub mod lamp_light;
pub mod live;
pub mod lookup;
mod replacement;
mod residual_lamp;
pub mod scene;
pub mod settings;
pub mod sight;
pub mod single_pixels;
pub mod small_view;
pub mod speaker;
pub mod spots;
pub mod stage;
pub mod support;
mod surface_depth;
mod tile;
pub mod view_fit;
