//! Why a calibration gave no camera.

/// What was expected, what was found, what to do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Not enough pictures with a board in them.
    #[error(
        "expected the board in at least {} pictures, found it in {found} of {pictures}; {advice}",
        LEAST_VIEWS
    )]
    TooFewViews {
        /// Pictures with a board.
        found: usize,
        /// Pictures looked at.
        pictures: usize,
        /// What to do.
        advice: String,
    },
    /// Pictures of several sizes.
    #[error("expected pictures of one size, found {first} and {other}; calibrate each size (each camera mode) by itself")]
    SizesDiffer {
        /// Name and size of the first.
        first: String,
        /// Name and size of the odd one.
        other: String,
    },
    /// No start from which the camera could be refined.
    #[error(
        "the boards do not tell the camera: {0}; take pictures with the board tilted by 20° to 45° in several directions, filling the picture"
    )]
    Undetermined(&'static str),
}

/// Views of a plane that a camera needs at least; its focal length would take two, its distortion more.
pub const LEAST_VIEWS: usize = 3;
