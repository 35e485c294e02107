//! Calibration: what a camera is, how it sits on the arm, how far the clocks are apart, and what its colours mean; each with its errors.

pub mod board;
pub mod charuco;
pub mod checkerboard;
pub mod circles;
pub mod corner_fit;
pub mod coverage;
pub mod cross_validation;
pub mod detection;
pub mod error;
pub mod hand_eye;
pub mod homography;
pub mod lattice;
pub mod lens;
pub mod marker;
pub mod marker_search;
pub mod marker_tables;
pub mod pattern_fit;
pub mod placement;
pub mod plot;
pub mod pose;
pub mod refine;
pub mod report;
pub mod saddle;
pub mod time_offset;
pub mod zhang;
