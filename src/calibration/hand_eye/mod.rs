//! Hand-eye calibration: how the camera sits on the arm's last link, X = `hand_from_camera`, and where the board lies,
//! Z = `base_from_board`.
//!
//! For every station of the arm, base_from_hand · X · camera_from_board = Z. Two stations make Z disappear: A·X = X·B with the
//! [`motion`]s A = hand_i_from_hand_j and B = camera_i_from_camera_j.
//!
//! 1. [`motion`]: motions that tell most are chosen (Schmidt, Vogt and Niemann 2004), and what cannot be told is said;
//! 2. [`rotation_first`], [`simultaneous`], [`dual_quaternion`], [`robot_world`]: closed forms, all of the literature's;
//! 3. [`consensus`]: stations that contradict the rest are found;
//! 4. [`refinement`]: X, Z and whatever else is unknown, where the board is seen again, with priors and covariance; on demand the camera
//!    too, within what is known of it ([`camera_prior`]);
//! 5. [`calibrate`]: all of it, and tried on views left out.
//!
//! Without a board, tracks of any still scene ([`feature_tracks`]) tell X by their [`epipolar`] constraint.

pub mod calibrate;
pub mod camera_prior;
pub mod consensus;
pub mod dual_quaternion;
pub mod epipolar;
pub mod epipolar_search;
#[cfg(test)]
pub mod example;
pub mod feature_tracks;
pub mod hand_poses;
pub mod method;
pub mod motion;
pub mod plot;
pub mod refinement;
pub mod reprojection;
pub mod robot_world;
pub mod rotation_first;
pub mod simultaneous;
mod spread;
pub mod view_pairs;
