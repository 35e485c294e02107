//! Recordings and truth on disk, in the layout of the project's formats.

use std::fs;
use std::path::{Path, PathBuf};

use image::ImageEncoder as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};

use crate::camera::file as camera_file;
use crate::camera::file::CameraFileError;
use crate::camera::model::CameraModel;
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::media::error::MediaError;
use crate::robot::hand_eye::{HandEye, HandEyeError};
use crate::robot::trajectory::{TrajectoryError, write_tum};
use crate::synthetic::arm::{ArmReading, hand_from_camera};
use crate::time::Timestamp;

/// Writing failed.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The file system refused.
    #[error("cannot write {path}: {source}; check that the folder exists, is writable and has room")]
    Io {
        /// What was to be written.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The video's encoder or container refused.
    #[error(transparent)]
    Video(#[from] MediaError),
    /// A camera, hand-eye or pose file was not written.
    #[error(transparent)]
    Camera(#[from] CameraFileError),
    /// A camera, hand-eye or pose file was not written.
    #[error(transparent)]
    HandEye(#[from] HandEyeError),
    /// A camera, hand-eye or pose file was not written.
    #[error(transparent)]
    Poses(#[from] TrajectoryError),
    /// The encoder refused.
    #[error("cannot encode {path}: {source}")]
    Encode {
        /// What was to be written.
        path: PathBuf,
        /// Why not.
        source: image::ImageError,
    },
}

/// Make a folder and its parents.
pub fn make_folder(path: &Path) -> Result<(), ExportError> {
    fs::create_dir_all(path).map_err(|source| ExportError::Io {
        path: path.to_owned(),
        source,
    })
}

/// Write a text file.
pub fn write_text(path: &Path, text: &str) -> Result<(), ExportError> {
    fs::write(path, text).map_err(|source| ExportError::Io {
        path: path.to_owned(),
        source,
    })
}

/// Write an 8-bit color PNG, fast.
pub fn write_rgb(path: &Path, picture: &Image<Rgb8>) -> Result<(), ExportError> {
    write_png(path, picture.as_bytes(), picture.size(), image::ExtendedColorType::Rgb8)
}

/// Write an 8-bit gray PNG, fast.
pub fn write_mask(path: &Path, mask: &Mask) -> Result<(), ExportError> {
    write_png(path, mask.as_bytes(), mask.size(), image::ExtendedColorType::L8)
}

/// Write a 16-bit gray PNG, fast.
pub fn write_u16(path: &Path, picture: &Image<u16>) -> Result<(), ExportError> {
    // The encoder takes native byte order.
    write_png(path, picture.as_bytes(), picture.size(), image::ExtendedColorType::L16)
}

fn write_png(path: &Path, bytes: &[u8], size: (usize, usize), color: image::ExtendedColorType) -> Result<(), ExportError> {
    let mut file = Vec::with_capacity(bytes.len() / 2);
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Up)
        .write_image(bytes, size.0 as u32, size.1 as u32, color)
        .map_err(|source| ExportError::Encode {
            path: path.to_owned(),
            source,
        })?;
    fs::write(path, file).map_err(|source| ExportError::Io {
        path: path.to_owned(),
        source,
    })
}

/// Write poses, mm; `transform` as in `T_base_hand`.
pub fn write_poses<To, From>(
    path: &Path,
    transform: &str,
    poses: impl Iterator<Item = (f64, Transform<To, From>)>,
) -> Result<(), ExportError> {
    Ok(write_tum(path, transform, poses.map(|(s, pose)| (Timestamp::from_seconds(s), *pose.isometry())))?)
}

/// Write what the arm said: `joints.csv` where it is a chain of joints, else `poses.tum`.
pub fn write_arm(folder: &Path, readings: &[ArmReading]) -> Result<(), ExportError> {
    let joints = joints_text(readings, |reading| Some((reading.stamp_s, reading.joints.as_ref()?.read.as_slice())));
    match joints {
        Some(text) => write_text(&folder.join("joints.csv"), &text),
        None => {
            write_poses(&folder.join("poses.tum"), "T_base_hand", readings.iter().map(|r| (r.stamp_s, r.base_from_hand)))
        }
    }
}

/// Write where the hand was: `hand_poses.tum` and, where the arm is a chain of joints, `joints.csv`.
pub fn write_true_arm(folder: &Path, readings: &[ArmReading]) -> Result<(), ExportError> {
    let hands = readings.iter().map(|r| (r.true_s, r.true_base_from_hand));
    write_poses(&folder.join("hand_poses.tum"), "T_base_hand", hands)?;
    match joints_text(readings, |reading| Some((reading.true_s, reading.joints.as_ref()?.exact.as_slice()))) {
        Some(text) => write_text(&folder.join("joints.csv"), &text),
        None => Ok(()),
    }
}

fn joints_text(readings: &[ArmReading], of: impl Fn(&ArmReading) -> Option<(f64, &[f64])>) -> Option<String> {
    let count = of(readings.first()?)?.1.len();
    let mut text = String::from("timestamp_s");
    for number in 1..=count {
        text.push_str(&format!(",q{number}"));
    }
    text.push('\n');
    for (stamp, values) in readings.iter().filter_map(of) {
        text.push_str(&format!("{stamp:.6}"));
        for value in values {
            text.push_str(&format!(",{value:.9}"));
        }
        text.push('\n');
    }
    Some(text)
}

/// Write `camera.yaml`.
pub fn write_camera(path: &Path, camera: &CameraModel) -> Result<(), ExportError> {
    Ok(camera_file::write(path, camera, "simulated_laparoscope")?)
}

/// Write `hand_eye.yaml`; it does not tell the time offset.
pub fn write_hand_eye(path: &Path, scope_mm: f64) -> Result<(), ExportError> {
    Ok(HandEye::new(hand_from_camera(scope_mm)).write(path)?)
}
