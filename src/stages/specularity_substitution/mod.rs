//! What other views saw where this frame shows the lamp.
//!
//! Region by region of the specular mask:
//!
//! 1. [`candidates`]: which views looked at the same tissue, best by the unstructured-lumigraph penalties (Buehler et al. 2001) and
//!    by how much of the hole they saw free of the lamp;
//! 2. [`warp`]: each of them drawn as the live camera would see it, over the light field's surface;
//! 3. [`ring`]: the small shift that is left, found on the ring of good pixels around the hole;
//! 4. [`brightness`]: the lamp rides on the camera, so views differ in brightness from place to place; the ratio to the live picture
//!    on the good pixels, carried into the hole by normalized convolution (Knutsson and Westin 1993);
//! 5. [`region`]: the views blended, the ring's fit judged, and the picture replaced where it is *brighter* than what was measured:
//!    the seam lies where both agree, so it cannot be seen.
//!
//! A region whose ring does not fit is left as it was, and says so.

pub mod brightness;
pub mod candidates;
pub mod region;
pub mod ring;
pub mod stage;
pub mod warp;
