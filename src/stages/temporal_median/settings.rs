//! What a user may choose about the temporal median.

use serde::{Deserialize, Serialize};

/// How the colors of a window are put in order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The color with the smallest summed distance to the others: always a color that was seen.
    #[default]
    Vector,
    /// The median of each channel by itself: a little quieter, but it may invent colors.
    Marginal,
}

/// How the distance of two colors is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distance {
    /// Sum of the absolute differences of the channels.
    #[default]
    L1,
    /// Euclidean.
    L2,
}

/// The temporal median's settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Length of the window, ms; becomes 3, 5 or 7 frames by the frame period. 200 ms are five frames at 25 and 30 Hz,
    /// which surgeons judged better than three, and seven from 35 Hz on. The motion guard pays for the length: it keeps
    /// what moves out of the window.
    pub window_ms: f64,
    /// `vector` or `marginal`.
    pub method: Method,
    /// `l1` or `l2`; the vector median only.
    pub distance: Distance,
    /// Whether the picture is searched for motion. Without it everything that moves leaves a ghost.
    pub motion_guard: bool,
    /// Largest extent of a particle, as a share of the picture's height; larger changes are taken for instruments.
    pub max_particle_share: f64,
    /// Smallest departure from the history that counts as a particle, gray levels.
    pub min_particle_levels: f64,
    /// The median rests while the arm moves the picture faster than this, px per frame.
    pub max_camera_motion_px: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            window_ms: 200.0,
            method: Method::Vector,
            distance: Distance::L1,
            motion_guard: true,
            max_particle_share: 0.045,
            min_particle_levels: 12.0,
            max_camera_motion_px: 6.0,
        }
    }
}

/// A setting out of its bounds.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("median.{key} is {value}, expected {bound}; change it in the configuration or with --set")]
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
        let rules: [(&'static str, f64, std::ops::RangeInclusive<f64>, &'static str); 4] = [
            ("window_ms", self.window_ms, 10.0..=1000.0, "10 to 1000 ms"),
            (
                "max_particle_share",
                self.max_particle_share,
                0.0..=0.5,
                "0 to 0.5 of the picture's height",
            ),
            (
                "min_particle_levels",
                self.min_particle_levels,
                4.0..=60.0,
                "4 to 60 gray levels",
            ),
            (
                "max_camera_motion_px",
                self.max_camera_motion_px,
                0.1..=1000.0,
                "0.1 to 1000 px per frame",
            ),
        ];
        for (key, value, range, bound) in rules {
            if !range.contains(&value) {
                return Err(SettingsError { key, value, bound });
            }
        }
        Ok(())
    }

    /// How many frames the window holds at this frame period: 3, 5 or 7.
    pub fn frames_from_period(&self, period_ms: f64) -> usize {
        if period_ms.is_nan() || period_ms <= 0.0 {
            return 3;
        }
        // Half a frame of tolerance: 200 ms at 29.97 Hz are 5.99 periods, and time stamps tremble.
        let frames = self.window_ms / period_ms + 0.5;
        if frames >= 7.0 {
            7
        } else if frames >= 5.0 {
            5
        } else {
            3
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_window_is_five_frames_at_video_rates_and_seven_above() {
        let settings = Settings::default();
        for (hz, frames) in [(15.0, 3), (24.0, 5), (25.0, 5), (29.97, 5), (50.0, 7), (59.94, 7)] {
            assert_eq!(settings.frames_from_period(1000.0 / hz), frames, "{hz} Hz");
        }
    }

    #[test]
    fn a_setting_out_of_bounds_is_named() {
        let settings = Settings {
            window_ms: f64::NAN,
            ..Settings::default()
        };
        let error = settings.check().map_err(|e| e.to_string());
        assert!(error.is_err_and(|text| text.contains("window_ms") && text.contains("10 to 1000")));
        assert!(Settings::default().check().is_ok());
    }
}
