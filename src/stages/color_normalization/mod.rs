//! Color normalization: the same tissue has the same color, whatever camera, lamp and white balance.
//!
//! The colors of a frame form a cluster in RGB space. The stage measures its mean and covariance on a coarse grid without
//! what is not tissue (`statistics`), finds the affine map that brings them to reference statistics (`matching`: cluster
//! rotation after Paulus, Csink, Niemann 1998; gray world; statistics transfer), smooths that map over a second or two,
//! and applies it. A fixed correction of the camera (`image::color_correction`, measured by calibration and kept in `color.yaml`)
//! comes before it, a look-up table (`cube_lut`) after it; whatever of them is in use, each pixel is touched once: by the
//! affine map alone (`affine`), or by one table into which all of them are baked (`cube_lut`). Equalization of the
//! lightness (`clahe`) is a pass of its own, off by default.
//!
//! Without a reference, a correction or a table the stage leaves the picture alone. It must not guess one: a scene that
//! fills with blood would be "corrected" away from red. `reference = "start"` takes the clip's own first seconds for the
//! reference and thereby keeps color from drifting; it is a choice for recordings of one site.
//!
//! The black surround stays exactly what it was, by the image field's mask where known and by its darkness everywhere.

pub mod affine;
pub mod clahe;
pub mod color_file;
pub mod cube_lut;
pub mod matching;
pub mod settings;
pub mod stage;
pub mod statistics;
