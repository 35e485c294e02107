//! Recordings and truth on disk, in the layout of the project's formats.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use image::ImageEncoder as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};

use crate::camera::distortion::Distortion;
use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Mask, Rgb8};

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

/// Lines of a TUM file: `stamp tx ty tz qx qy qz qw`.
pub fn tum_text<To, From>(header: &str, poses: impl IntoIterator<Item = (f64, Transform<To, From>)>) -> String {
    let mut text = format!("# {header}\n");
    for (stamp, pose) in poses {
        let (t, q) = (pose.translation(), pose.rotation());
        // Writing to a String cannot fail.
        let _infallible = writeln!(
            text,
            "{stamp:.6} {:.6} {:.6} {:.6} {:.9} {:.9} {:.9} {:.9}",
            t.x, t.y, t.z, q.i, q.j, q.k, q.w
        );
    }
    text
}

/// ROS `camera_info` YAML.
pub fn camera_yaml(camera: &CameraModel, name: &str) -> String {
    let k = &camera.intrinsics;
    let (model, coefficients) = match &camera.distortion {
        Distortion::None => ("plumb_bob", vec![0.0; 5]),
        Distortion::BrownConrady { k, p } if k[3..] == [0.0; 3] => ("plumb_bob", vec![k[0], k[1], p[0], p[1], k[2]]),
        Distortion::BrownConrady { k, p } => ("rational_polynomial", vec![k[0], k[1], p[0], p[1], k[2], k[3], k[4], k[5]]),
        Distortion::KannalaBrandt { k } => ("equidistant", k.to_vec()),
    };
    let count = coefficients.len();
    let listed: Vec<String> = coefficients.iter().map(|c| format!("{c:?}")).collect();
    format!(
        "image_width: {}\nimage_height: {}\ncamera_name: {name}\n\
         camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{:?}, 0.0, {:?}, 0.0, {:?}, {:?}, 0.0, 0.0, 1.0]\n\
         distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {count}\n  data: [{}]\n\
         rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n\
         projection_matrix:\n  rows: 3\n  cols: 4\n  data: [{:?}, 0.0, {:?}, 0.0, 0.0, {:?}, {:?}, 0.0, 0.0, 0.0, 1.0, 0.0]\n",
        camera.width,
        camera.height,
        k.fx,
        k.cx,
        k.fy,
        k.cy,
        listed.join(", "),
        k.fx,
        k.cx,
        k.fy,
        k.cy
    )
}

/// `hand_eye.yaml`.
pub fn hand_eye_yaml(hand_from_camera: &Transform<Hand, Camera>) -> String {
    let (t, q) = (hand_from_camera.translation(), hand_from_camera.rotation());
    format!(
        "# hand_from_camera, mm\nunit: mm\ntranslation: {{x: {:?}, y: {:?}, z: {:?}}}\nrotation: {{x: {:?}, y: {:?}, z: {:?}, w: {:?}}}\n",
        t.x, t.y, t.z, q.i, q.j, q.k, q.w
    )
}
