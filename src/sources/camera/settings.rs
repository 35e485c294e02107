//! The camera of a live line: `[camera]` in the configuration.

use serde::{Deserialize, Serialize};

use crate::media::layout::Layout;
use crate::sources::camera::device::Wish;

/// Layouts as a user names them.
const LAYOUTS: [(&str, Layout); 6] = [
    ("rgb24", Layout::Rgb24),
    ("bgr24", Layout::Bgr24),
    ("yuyv", Layout::Yuyv),
    ("uyvy", Layout::Uyvy),
    ("nv12", Layout::Nv12),
    ("mjpeg", Layout::Mjpeg),
];
/// Whatever suits best.
const AUTO: &str = "auto";

/// Which camera, and what is asked of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The device node.
    pub device: String,
    /// Columns, 0 = as the device has it.
    pub width: usize,
    /// Rows, 0 = as the device has it.
    pub height: usize,
    /// Frames a second, 0 = as the device has it.
    pub frame_rate_hz: f64,
    /// How pictures lie in memory.
    pub layout: String,
    /// A folder with what was calibrated for this camera.
    pub instrument: String,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            device: "/dev/video0".to_owned(),
            width: 0,
            height: 0,
            frame_rate_hz: 0.0,
            layout: AUTO.to_owned(),
            instrument: String::new(),
        }
    }
}

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        if (self.width == 0) != (self.height == 0) || self.width > 16_384 || self.height > 16_384 {
            let found = format!("{}x{}", self.width, self.height);
            return Err(format!(
                "camera.width, camera.height: expected both 0 or both 1 to 16384, found {found}"
            ));
        }
        if !(0.0..=240.0).contains(&self.frame_rate_hz) {
            return Err(format!(
                "camera.frame_rate_hz: expected 0 to 240, found {}",
                self.frame_rate_hz
            ));
        }
        let known = LAYOUTS.iter().any(|(name, _)| *name == self.layout);
        if !known && self.layout != AUTO {
            let names: Vec<&str> = LAYOUTS.iter().map(|(name, _)| *name).collect();
            let expected = names.join(", ");
            return Err(format!("camera.layout: expected {AUTO}, {expected}, found `{}`", self.layout));
        }
        Ok(())
    }

    /// What to ask the camera for.
    pub fn wish(&self) -> Wish {
        Wish {
            size: (self.width > 0).then_some((self.width, self.height)),
            frame_rate_hz: (self.frame_rate_hz > 0.0).then_some(self.frame_rate_hz),
            layout: LAYOUTS
                .iter()
                .find(|(name, _)| *name == self.layout)
                .map(|(_, layout)| *layout),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_become_wishes() {
        assert_eq!(Settings::default().wish(), Wish::default());
        let settings = Settings {
            width: 1920,
            height: 1080,
            frame_rate_hz: 60.0,
            layout: "nv12".to_owned(),
            ..Settings::default()
        };
        settings.check().unwrap();
        let wish = settings.wish();
        assert_eq!((wish.size, wish.layout), (Some((1920, 1080)), Some(Layout::Nv12)));
        let wrong = |change: fn(&mut Settings)| {
            let mut settings = Settings::default();
            change(&mut settings);
            settings.check().unwrap_err()
        };
        assert!(wrong(|s| s.width = 640).contains("both"));
        assert!(wrong(|s| s.layout = "h264".to_owned()).contains("nv12"));
        assert!(wrong(|s| s.frame_rate_hz = f64::NAN).contains("240"));
    }
}
