//! Which pixels of one picture show the lamp's mirror image, and which show steel.
//!
//! The lamp's mirror image adds light of the lamp's colour to the tissue's own (Shafer 1985): it lifts the *least* of the
//! three channels, which red tissue keeps low. So the picture's darkest channel m = min(R, G, B) is compared with its own
//! background: a wide mean of m that leaves out what stands above it (the way Arnold et al. 2010 compare with a picture in which
//! candidates are filled by their surroundings, and El Meslouhi et al. 2011 weigh intensity by min/max), and with m's morphological
//! opening, which holds every bright thing that is wide. What stands out must do so by *white* light: m must rise about as much as
//! max(R, G, B) does. White gauze or fat as a whole is its own background and does not stand out; a core must stand far above, its halo
//! may stand less far but must touch a core.
//!
//! Steel is grey where tissue is red, over a connected area that is dark or of much contrast; its highlights lie inside.
//!
//! All lengths below are given for a picture 960 px wide and scale with the width.
//!
//! The order of work: `cells` averages the picture over cells, `steel` and `background` look at the cells alone, `classify` holds the
//! pixels of cells that are bright enough against bounds that are interpolated between cells, `detector` does it all and joins halos to
//! cores.

mod background;
mod cells;
mod classify;
mod detector;
mod settings;
mod steel;

pub use detector::SpecularityDetector;
pub use settings::{REFERENCE_WIDTH_PX, Settings};
