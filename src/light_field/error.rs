//! What can go wrong with a light field.

use std::path::{Path, PathBuf};

/// Why a light field could not be read, written or made.
#[derive(Debug, thiserror::Error)]
pub enum LightFieldError {
    /// The file system said no.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What it said.
        source: std::io::Error,
    },
    /// A folder without a COLMAP model.
    #[error(
        "{0}: expected a light field or a COLMAP model (cameras and images, .txt or .bin, in sparse/, sparse/0/ or the folder itself), found none; make one with `endofield light-field build RECORDING -o LF`"
    )]
    NotALightField(PathBuf),
    /// A picture that the model names is not there.
    #[error("{path}: the light field names this picture, but it is not there; copy it back, or build the light field again")]
    MissingImage {
        /// Where it should be.
        path: PathBuf,
    },
    /// A file does not hold what its name promises.
    #[error("{path}: {what}")]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// Expected, found, what to do.
        what: String,
    },
    /// A picture of another size than its camera's.
    #[error(
        "{path}: expected {expected_width}×{expected_height} pixels as the camera says, found {width}×{height}; rescale the pictures or mend cameras.txt"
    )]
    WrongSize {
        /// The picture.
        path: PathBuf,
        /// From the camera.
        expected_width: usize,
        /// From the camera.
        expected_height: usize,
        /// As found.
        width: usize,
        /// As found.
        height: usize,
    },
    /// Too little to work with.
    #[error("{0}")]
    TooLittle(String),
    /// The user asked to stop.
    #[error("stopped before it was done")]
    Stopped,
}

impl LightFieldError {
    /// Names the file that an I/O error is about.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { path, source }
    }

    /// A file that makes no sense.
    pub(crate) fn corrupt(path: &Path, what: impl Into<String>) -> Self {
        Self::Corrupt {
            path: path.to_path_buf(),
            what: what.into(),
        }
    }
}
