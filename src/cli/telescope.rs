//! `--telescope-angle-deg`: a recording taken through an oblique scope whose telescope was turned.

use crate::cli::context::UsageError;
use crate::recording::folder::Recording;

/// The recording with camera and hand-eye at this angle; as it is where none is given.
pub fn turned(recording: Recording, angle_deg: Option<f64>) -> anyhow::Result<Recording> {
    match angle_deg {
        None => Ok(recording),
        Some(angle_deg) if angle_deg.is_finite() => Ok(recording.with_telescope_at(angle_deg.to_radians())?),
        Some(angle_deg) => Err(UsageError(format!("--telescope-angle-deg: expected degrees, found {angle_deg}")).into()),
    }
}
