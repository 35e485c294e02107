//! How specularities are replaced.

/// How specularities are replaced. Lengths are for a picture 960 px wide and scale with its width.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Pixels nearer than this to a specular one are not trusted for fitting: the lobe's haze, px.
    pub guard_px: f32,
    /// Replacement reaches at most so far beyond the mask, px.
    pub reach_px: f32,
    /// Good pixels so far around a hole are looked at, px.
    pub margin_px: f32,
    /// A pixel this much brighter than what was measured begins to be replaced, levels.
    pub excess_low_levels: f32,
    /// A pixel this much brighter is replaced wholly, levels.
    pub excess_high_levels: f32,
    /// At most so many views take part in a frame, 64 at the most: each costs its fit.
    pub max_views: usize,
    /// Whether a small shift is looked for around each hole.
    pub align_on_ring: bool,
    /// Rounds of that search.
    pub ring_rounds: usize,
    /// The longest shift, px.
    pub max_shift_px: f32,
    /// A view fits where its root mean square difference around the hole is at most this, levels …
    pub max_ring_levels: f32,
    /// … or at most this share of the tissue's own detail there.
    pub max_ring_share: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            guard_px: 5.0,
            reach_px: 12.0,
            margin_px: 24.0,
            excess_low_levels: 2.0,
            excess_high_levels: 5.0,
            max_views: 40,
            align_on_ring: true,
            ring_rounds: 2,
            max_shift_px: 4.0,
            max_ring_levels: 6.0,
            max_ring_share: 0.7,
        }
    }
}
