//! What counts as a specularity, and at which scale.

/// Width of the picture for which lengths are given, px.
pub const REFERENCE_WIDTH_PX: f32 = 960.0;

/// Background and steel are found on cells, about so many across the picture.
pub(super) const CELLS_ACROSS: usize = 240;

/// What counts as a specularity.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A core stands at least so far above its background, levels of the darkest channel in a well exposed picture.
    pub core_levels: f32,
    /// A halo stands at least so far above.
    pub halo_levels: f32,
    /// A halo reaches at most so far from a core, px at 960 px width.
    pub halo_reach_px: f32,
    /// The background is a mean over about this radius, px at 960 px width.
    pub background_sigma_px: f32,
    /// Bright things wider than this are background, unless clipped, px at 960 px width.
    pub max_width_px: f32,
    /// The same for cores, which are narrower, px at 960 px width.
    pub core_max_width_px: f32,
    /// The darkest channel rises at least this much of what the brightest does.
    pub whiteness: f32,
    /// The same for cores: light added to tissue, in coded levels, lifts the dark channel more than the bright one.
    pub core_whiteness: f32,
    /// Regions beyond this share of the picture are specular only if a good part of them is clipped.
    pub max_region_share: f32,
    /// Steel: (max − min)/max of the channels is below this.
    pub steel_saturation: f32,
    /// Steel: a region covers at least this share of the picture.
    pub steel_min_share: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            core_levels: 26.0,
            halo_levels: 10.0,
            halo_reach_px: 9.0,
            background_sigma_px: 28.0,
            max_width_px: 44.0,
            core_max_width_px: 36.0,
            whiteness: 0.72,
            core_whiteness: 1.0,
            max_region_share: 0.03,
            steel_saturation: 0.2,
            steel_min_share: 0.004,
        }
    }
}
