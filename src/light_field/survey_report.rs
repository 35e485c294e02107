//! What refining a survey did, in figures.

/// How far a set of poses was moved.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Corrections {
    /// Root mean square of the positions' changes, mm.
    pub rms_mm: f64,
    /// Largest of them, mm.
    pub max_mm: f64,
    /// Root mean square of the turns, degrees.
    pub rms_deg: f64,
    /// Largest of them, degrees.
    pub max_deg: f64,
}

/// What refining a survey did.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct SurveyReport {
    /// Views given.
    pub views: usize,
    /// Views tied into the refined survey.
    pub refined_views: usize,
    /// Frame numbers of views left out, because the pictures do not tie them to the others.
    pub dropped_frames: Vec<u32>,
    /// Frame numbers without a pose from the arm; placed by the pictures alone.
    pub frames_without_prior: Vec<u32>,
    /// Scene points.
    pub points: usize,
    /// Their observations.
    pub observations: usize,
    /// Root mean square reprojection error with the arm's poses (points triangulated anew), px of the given pictures.
    pub prior_reprojection_px: f64,
    /// The same with the refined poses.
    pub refined_reprojection_px: f64,
    /// From the arm's poses (at the estimated offset) to the refined ones.
    pub corrections: Corrections,
    /// Add to a pose stamp to get the camera's clock, ms.
    pub time_offset_ms: f64,
    /// Its standard deviation, ms; absent when the motion does not tell the offset.
    pub time_offset_sigma_ms: Option<f64>,
    /// Median distance of the scene points along the optical axis, mm.
    pub median_depth_mm: f64,
    /// What the user should know.
    pub notes: Vec<String>,
}
