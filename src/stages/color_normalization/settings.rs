//! What a user may choose about color normalization.

use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::stages::color_normalization::statistics::Statistics;

/// How the tissue's colors are brought to the reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Not at all; a correction and a table may still be applied.
    None,
    /// Color cluster rotation.
    Rotation,
    /// Transfer of mean and covariance. The default: it takes channel gains (white balance) back exactly.
    #[default]
    Statistics,
    /// Transfer of mean and deviation of each channel.
    Reinhard,
    /// One gain a channel.
    GrayWorld,
}

/// Whose colors are the right ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReferenceSource {
    /// The recording's `color.yaml` or `reference_mean`; without them colors stay as they are.
    #[default]
    Given,
    /// The clip's own first seconds: keeps colors from drifting.
    Start,
    /// Gray world to gray. In a red scene this turns tissue gray.
    Gray,
}

/// Color normalization's settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// `statistics`, `rotation`, `reinhard`, `gray_world` or `none`.
    pub method: Method,
    /// `given`, `start` or `gray`.
    pub reference: ReferenceSource,
    /// Mean color to aim at, 8-bit sRGB; wins over `color.yaml`.
    pub reference_mean: Option<[f64; 3]>,
    /// Covariance to aim at, row by row; needs `reference_mean`.
    pub reference_covariance: Option<[[f64; 3]; 3]>,
    /// How far to go, 0 (not at all) to 1 (all the way).
    pub strength: f64,
    /// Time constant of the map's smoothing, ms.
    pub smoothing_ms: f64,
    /// How long `start` looks at the clip, ms.
    pub start_ms: f64,
    /// The map is frozen while more of the lit picture than this is instrument.
    pub max_instrument_share: f64,
    /// A `.cube` table applied last.
    pub lut: Option<PathBuf>,
    /// Equalize the lightness locally (CLAHE), 0 (off) to 1.
    pub equalization: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            method: Method::default(),
            reference: ReferenceSource::default(),
            reference_mean: None,
            reference_covariance: None,
            strength: 1.0,
            smoothing_ms: 1500.0,
            start_ms: 2000.0,
            max_instrument_share: 0.4,
            lut: None,
            equalization: 0.0,
        }
    }
}

/// A setting out of its bounds.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("color.{key} is {value}, expected {bound}; change it in the configuration or with --set")]
pub struct SettingsError {
    /// Which setting.
    pub key: &'static str,
    /// What it was.
    pub value: f64,
    /// What it may be.
    pub bound: &'static str,
}

impl Settings {
    /// The first setting that is out of bounds, if any.
    pub fn check(&self) -> Result<(), SettingsError> {
        let rules: [(&'static str, f64, std::ops::RangeInclusive<f64>, &'static str); 5] = [
            ("strength", self.strength, 0.0..=1.0, "0 to 1"),
            ("smoothing_ms", self.smoothing_ms, 0.0..=60_000.0, "0 to 60000 ms"),
            ("start_ms", self.start_ms, 0.0..=600_000.0, "0 to 600000 ms"),
            ("max_instrument_share", self.max_instrument_share, 0.0..=1.0, "0 to 1"),
            ("equalization", self.equalization, 0.0..=1.0, "0 to 1"),
        ];
        for (key, value, range, bound) in rules {
            if !range.contains(&value) {
                return Err(SettingsError { key, value, bound });
            }
        }
        for value in self.reference_mean.iter().flatten() {
            if !(0.0..=255.0).contains(value) {
                return Err(SettingsError {
                    key: "reference_mean",
                    value: *value,
                    bound: "0 to 255 levels",
                });
            }
        }
        if let Some(covariance) = &self.reference_covariance {
            let bad = covariance.iter().flatten().find(|v| !v.is_finite() || v.abs() > 65_025.0);
            if let Some(value) = bad {
                let bound = "finite and at most 255 squared";
                return Err(SettingsError {
                    key: "reference_covariance",
                    value: *value,
                    bound,
                });
            }
        }
        Ok(())
    }

    /// The reference the settings give, if they do. Without a covariance the frame keeps its own.
    pub fn reference_statistics(&self) -> Option<(Vector3<f64>, Option<Matrix3<f64>>)> {
        let mean = Vector3::from(self.reference_mean?);
        let covariance = self.reference_covariance.map(|rows| Matrix3::from_fn(|r, c| rows[r][c]));
        Some((mean, covariance))
    }

    /// The same reference as settings.
    pub fn with_reference(mut self, reference: &Statistics) -> Self {
        self.reference_mean = Some(reference.mean.into());
        self.reference_covariance = Some(std::array::from_fn(|r| std::array::from_fn(|c| reference.covariance[(r, c)])));
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_out_of_bounds_is_named() {
        assert!(Settings::default().check().is_ok());
        let error = Settings {
            strength: 1.5,
            ..Settings::default()
        }
        .check()
        .map_err(|e| e.to_string());
        assert!(error.is_err_and(|text| text.contains("strength is 1.5") && text.contains("0 to 1")));
    }
}
