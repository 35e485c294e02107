//! Boards and where their corners lie in a picture: checkerboards, ChArUco boards and grids of dots, found in any part and to a few
//! hundredths of a pixel.
//!
//! A [`pattern`] says what was printed. Each finder looks for its features ([`saddle`]s, [`marker_search`], dots), grows them to a
//! [`lattice`], puts that on the board ([`placement`]), drops what does not lie where its neighbours say ([`stray`]) and fits every corner
//! to the pixels around it ([`corner_fit`], [`pattern_fit`]); a [`detection`] is what comes out.

pub mod charuco;
pub mod checkerboard;
pub mod circles;
pub mod corner_fit;
pub mod detection;
pub mod lattice;
pub mod marker;
pub mod marker_search;
pub mod marker_tables;
pub mod pattern;
pub mod pattern_fit;
pub mod placement;
pub mod saddle;
pub mod stray;
