//! Temporal color median: what flies past the lens goes, what the lens looks at stays.
//!
//! Drops, smoke flakes and sparks cover a pixel for one or two frames; the median of the colors that the pixel had during
//! the last milliseconds does not see them. In a double-blind trial fourteen surgeons found five frames better than three
//! (Krueger et al., Methods Inf Med 2004). The window is causal: it ends with the newest frame, whose time stamp the
//! result carries, so nothing waits.
//!
//! The price of a causal median is that whatever moves would be shown `(n - 1) / 2` frames late and would drag a ghost.
//! Therefore a motion guard decides from the picture where the median may speak:
//!
//! 1. `motion` compares, block by block, the newest frame with older ones and with the noise (`noise`): a block whose
//!    differences are noise is *still* and takes the median; one with small systematic differences is *slow*, one with
//!    large ones is *moving* and stays as it came.
//! 2. `particles` looks at each connected blob where the newest frame departs from the median. A particle stands out from
//!    its surroundings and the median makes them smooth again; the edge of something that moves is as sharp in the median
//!    as in the newest frame, only elsewhere. Only particles are replaced, in still and in slow blocks.

pub mod guard;
pub mod history;
pub mod motion;
pub mod noise;
pub mod particles;
pub mod settings;
pub mod stage;
pub mod vector_median;
