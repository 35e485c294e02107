//! The joint of an oblique scope, from a board seen at several rotations of the telescope.
//!
//! At each station head and board rest while the telescope is turned; at the next station the board lies otherwise. What turning does
//! ([`crate::camera::oblique`]) is the same at every station, so axis, centre and angles are told even if nobody read an encoder:
//! a start from each rotation's board poses ([`start`]), then everything together on the pixels ([`refine`]).
//!
//! A board that moves freely between all pictures would tell nothing of the axis: every picture would have a pose of its own.

pub mod joint;
pub mod plot;
pub mod refine;
pub mod report;
pub mod start;
