//! Camera calibration files: ROS `camera_info` YAML (read and written) and OpenCV's FileStorage (YAML or XML, read).
//!
//! Distortion models by ROS's names: `plumb_bob` (k1 k2 p1 p2 \[k3\]), `rational_polynomial` (k1 k2 p1 p2 k3 k4 k5 k6),
//! `equidistant` (k1 k2 k3 k4; also called `fisheye` or `kannala_brandt`), `none`. A FileStorage names no model: the number of
//! its coefficients decides, or a key `fisheye`/`fisheye_model` that is not 0.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::Intrinsics;
use crate::camera::model::CameraModel;
use crate::camera::oblique::Oblique;
use crate::camera::opencv_xml;
use crate::yaml::{self, Node, YamlError};

/// Why a camera file gives no camera.
#[derive(Debug, thiserror::Error)]
pub enum CameraFileError {
    /// The disk said no.
    #[error("cannot read the camera file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The disk said no.
    #[error("cannot write the camera file {}: {source}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Neither YAML nor XML.
    #[error("{}, {fault}: expected a ROS camera_info or an OpenCV FileStorage file", path.display())]
    NotYaml {
        /// The file.
        path: PathBuf,
        /// Where and what.
        fault: YamlError,
    },
    /// The content describes no camera.
    #[error("{}: {fault}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What.
        fault: CameraFault,
    },
}

/// Why a tree describes no camera.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraFault {
    /// A key is not there.
    #[error("the key `{key}` is missing: {hint}")]
    Missing {
        /// The key by its ROS name.
        key: &'static str,
        /// What should stand there.
        hint: &'static str,
    },
    /// A key holds something else.
    #[error("`{key}`: expected {expected}, found {found}")]
    Unexpected {
        /// The key by its ROS name.
        key: &'static str,
        /// In words.
        expected: String,
        /// In words.
        found: String,
    },
}

const IMAGE_WIDTH: &[&str] = &["imagewidth", "width"];
const IMAGE_HEIGHT: &[&str] = &["imageheight", "height"];
const CAMERA_MATRIX: &[&str] = &["cameramatrix", "k", "k1", "m1", "m", "intrinsicmatrix", "intrinsics"];
const DISTORTION: &[&str] = &[
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoeffs",
    "distcoeff",
    "d",
    "d1",
    "distortion",
];

/// Read a camera from a file.
pub fn read(path: &Path) -> Result<CameraModel, CameraFileError> {
    let text = std::fs::read_to_string(path).map_err(|source| CameraFileError::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    let tree = if text.trim_start().starts_with('<') {
        opencv_xml::parse(&text)
    } else {
        Node::parse(&text)
    }
    .map_err(|fault| CameraFileError::NotYaml {
        path: path.to_owned(),
        fault,
    })?;
    from_node(&tree).map_err(|fault| CameraFileError::Content {
        path: path.to_owned(),
        fault,
    })
}

/// Write `camera` as a ROS `camera_info` file; an existing file is replaced.
pub fn write(path: &Path, camera: &CameraModel, name: &str) -> Result<(), CameraFileError> {
    std::fs::write(path, camera_info(camera, name)).map_err(|source| CameraFileError::Unwritable {
        path: path.to_owned(),
        source,
    })
}

/// Read the joint of an oblique scope from a camera file; `None` if the file tells of none.
pub fn read_oblique(path: &Path) -> Result<Option<Oblique>, CameraFileError> {
    let text = std::fs::read_to_string(path).map_err(|source| CameraFileError::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    // OpenCV's XML knows no such joint.
    if text.trim_start().starts_with('<') {
        return Ok(None);
    }
    let tree = Node::parse(&text).map_err(|fault| CameraFileError::NotYaml {
        path: path.to_owned(),
        fault,
    })?;
    Oblique::from_node(&tree).map_err(|fault| CameraFileError::Content {
        path: path.to_owned(),
        fault,
    })
}

/// Write the camera at angle 0 with the joint of its oblique scope; an existing file is replaced.
pub fn write_oblique(path: &Path, camera: &CameraModel, oblique: &Oblique, name: &str) -> Result<(), CameraFileError> {
    std::fs::write(path, camera_info(camera, name) + &oblique.text()).map_err(|source| CameraFileError::Unwritable {
        path: path.to_owned(),
        source,
    })
}

/// The camera that a tree describes.
pub fn from_node(tree: &Node) -> Result<CameraModel, CameraFault> {
    let width = image_side(tree, "image_width", IMAGE_WIDTH, 0)?;
    let height = image_side(tree, "image_height", IMAGE_HEIGHT, 1)?;
    let intrinsics = camera_matrix(tree)?;
    let distortion = distortion(tree)?;
    Ok(CameraModel {
        width,
        height,
        intrinsics,
        distortion,
    })
}

/// `camera` as the text of a ROS `camera_info` file.
pub fn camera_info(camera: &CameraModel, name: &str) -> String {
    let k = &camera.intrinsics;
    let (model, coefficients) = model_and_coefficients(&camera.distortion);
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(text, "image_width: {}\nimage_height: {}", camera.width, camera.height);
    let _ = writeln!(text, "camera_name: {}", yaml::quoted(name));
    matrix(
        &mut text,
        "camera_matrix",
        3,
        3,
        &[k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0],
    );
    let _ = writeln!(text, "distortion_model: {model}");
    matrix(&mut text, "distortion_coefficients", 1, coefficients.len(), &coefficients);
    matrix(
        &mut text,
        "rectification_matrix",
        3,
        3,
        &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    );
    matrix(
        &mut text,
        "projection_matrix",
        3,
        4,
        &[k.fx, 0.0, k.cx, 0.0, 0.0, k.fy, k.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    );
    text
}

fn matrix(text: &mut String, key: &str, rows: usize, cols: usize, data: &[f64]) {
    let list: Vec<String> = data.iter().map(|v| yaml::format_number(*v)).collect();
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{key}:\n  rows: {rows}\n  cols: {cols}\n  data: [{}]", list.join(", "));
}

fn model_and_coefficients(distortion: &Distortion) -> (&'static str, Vec<f64>) {
    match distortion {
        Distortion::None => ("plumb_bob", vec![0.0; 5]),
        Distortion::BrownConrady { k, p } if k[3..] == [0.0; 3] => ("plumb_bob", vec![k[0], k[1], p[0], p[1], k[2]]),
        Distortion::BrownConrady { k, p } => ("rational_polynomial", vec![k[0], k[1], p[0], p[1], k[2], k[3], k[4], k[5]]),
        Distortion::KannalaBrandt { k } => ("equidistant", k.to_vec()),
    }
}

/// OpenCV's samples spell the same key in half a dozen ways: compare without case and underscores.
fn find<'a>(tree: &'a Node, names: &[&str]) -> Option<&'a Node> {
    let Node::Map(pairs) = tree else {
        return None;
    };
    names.iter().find_map(|name| {
        pairs
            .iter()
            .find(|(key, _)| key.replace('_', "").eq_ignore_ascii_case(name))
            .map(|(_, value)| value)
    })
}

fn image_side(tree: &Node, key: &'static str, names: &[&str], place: usize) -> Result<usize, CameraFault> {
    let value = find(tree, names)
        .and_then(Node::number)
        .or_else(|| {
            find(tree, &["imagesize", "size", "resolution"])?
                .numbers()?
                .get(place)
                .copied()
        })
        .ok_or(CameraFault::Missing {
            key,
            hint: "the size of the pictures that the camera was calibrated with, in px",
        })?;
    if value.fract() == 0.0 && (1.0..=65_536.0).contains(&value) {
        Ok(value as usize)
    } else {
        Err(CameraFault::Unexpected {
            key,
            expected: "a whole number of pixels from 1 to 65536".into(),
            found: value.to_string(),
        })
    }
}

fn camera_matrix(tree: &Node) -> Result<Intrinsics, CameraFault> {
    const KEY: &str = "camera_matrix";
    let node = find(tree, CAMERA_MATRIX).ok_or(CameraFault::Missing {
        key: KEY,
        hint: "nine numbers fx 0 cx 0 fy cy 0 0 1, row by row",
    })?;
    let unexpected = |expected: &str, found: String| CameraFault::Unexpected {
        key: KEY,
        expected: expected.into(),
        found,
    };
    let data = node
        .numbers()
        .ok_or_else(|| unexpected("nine numbers, row by row", "something else".into()))?;
    let &[fx, skew, cx, below_fx, fy, cy, g, h, i] = data.as_slice() else {
        return Err(unexpected("nine numbers, row by row", format!("{} numbers", data.len())));
    };
    if let Some(bad) = data.iter().find(|v| !v.is_finite()) {
        return Err(unexpected("finite numbers", bad.to_string()));
    }
    if fx <= 0.0 || fy <= 0.0 {
        return Err(unexpected("positive focal lengths", format!("fx = {fx}, fy = {fy}")));
    }
    if skew.abs() > 1e-6 * fx || below_fx != 0.0 || [g, h, i] != [0.0, 0.0, 1.0] {
        return Err(unexpected(
            "a matrix fx 0 cx 0 fy cy 0 0 1 (skew is not supported)",
            format!("{data:?}"),
        ));
    }
    Ok(Intrinsics { fx, fy, cx, cy })
}

fn distortion(tree: &Node) -> Result<Distortion, CameraFault> {
    const KEY: &str = "distortion_coefficients";
    let unexpected = |expected: &str, found: String| CameraFault::Unexpected {
        key: KEY,
        expected: expected.into(),
        found,
    };
    let named = find(tree, &["distortionmodel"])
        .and_then(Node::text)
        .map(|name| name.trim().to_lowercase());
    let node = find(tree, DISTORTION);
    if node.is_none() && matches!(named.as_deref(), Some("none" | "pinhole")) {
        return Ok(Distortion::None);
    }
    let node = node.ok_or(CameraFault::Missing {
        key: KEY,
        hint: "4 or 5 numbers for plumb_bob, 8 for rational_polynomial, 4 for equidistant",
    })?;
    let data = node
        .numbers()
        .ok_or_else(|| unexpected("a list of numbers", "something else".into()))?;
    if let Some(bad) = data.iter().find(|v| !v.is_finite()) {
        return Err(unexpected("finite numbers", bad.to_string()));
    }
    let fisheye = find(tree, &["fisheyemodel", "fisheye"])
        .is_some_and(|node| matches!(node, Node::Bool(true)) || node.number().is_some_and(|v| v != 0.0));
    let model = match named.as_deref() {
        Some(name) => name,
        None if fisheye => "equidistant",
        None if data.is_empty() => "none",
        None if data.len() <= 5 => "plumb_bob",
        None => "rational_polynomial",
    };
    let counted = |expected: &str| unexpected(expected, format!("{} for the model `{model}`", data.len()));
    match model {
        "plumb_bob" | "brown_conrady" | "radtan" => match data.as_slice() {
            [k1, k2, p1, p2] => Ok(brown(&[*k1, *k2, 0.0, 0.0, 0.0, 0.0], [*p1, *p2])),
            [k1, k2, p1, p2, k3] => Ok(brown(&[*k1, *k2, *k3, 0.0, 0.0, 0.0], [*p1, *p2])),
            _ => Err(counted("4 or 5 numbers (k1 k2 p1 p2 k3)")),
        },
        "rational_polynomial" | "rational" => match data.as_slice() {
            [k1, k2, p1, p2, k3, k4, k5, k6, rest @ ..]
                // OpenCV pads to 12 or 14 with the thin prism and tilt terms.
                if [0, 4, 6].contains(&rest.len()) && rest.iter().all(|v| *v == 0.0) =>
            {
                Ok(brown(&[*k1, *k2, *k3, *k4, *k5, *k6], [*p1, *p2]))
            }
            _ if data.len() > 8 => Err(counted("8 numbers (k1 k2 p1 p2 k3 k4 k5 k6), thin prism and tilt terms being zero")),
            _ => Err(counted("8 numbers (k1 k2 p1 p2 k3 k4 k5 k6)")),
        },
        "equidistant" | "fisheye" | "kannala_brandt" => match data.as_slice() {
            &[k1, k2, k3, k4] => Ok(Distortion::KannalaBrandt { k: [k1, k2, k3, k4] }),
            _ => Err(counted("4 numbers (k1 k2 k3 k4)")),
        },
        "none" | "pinhole" if data.iter().all(|v| *v == 0.0) => Ok(Distortion::None),
        "none" | "pinhole" => Err(counted("no coefficients")),
        other => Err(CameraFault::Unexpected {
            key: "distortion_model",
            expected: "plumb_bob, rational_polynomial or equidistant".into(),
            found: format!("`{other}`"),
        }),
    }
}

fn brown(k: &[f64; 6], p: [f64; 2]) -> Distortion {
    if *k == [0.0; 6] && p == [0.0; 2] {
        Distortion::None
    } else {
        Distortion::BrownConrady { k: *k, p }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text_with(model: &str, coefficients: &str) -> String {
        format!(
            "image_width: 640\nimage_height: 480\ncamera_name: scope\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 501.5, 240, 0, 0, 1]\n\
             distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{coefficients}]\n"
        )
    }

    fn parsed(text: &str) -> Result<CameraModel, CameraFault> {
        from_node(&Node::parse(text).unwrap())
    }

    #[test]
    fn every_model_survives_writing_and_reading() {
        for (model, coefficients) in [
            ("plumb_bob", "-0.3, 0.1, 1e-3, -2e-4, 0.013"),
            ("plumb_bob", "-0.3, 0.1, 1e-3, -2e-4"),
            ("rational_polynomial", "-0.3, 0.1, 1e-3, -2e-4, 0.01, 0.2, 0.03, 1e-9"),
            ("equidistant", "-0.03, 0.01, 1e-3, -2e-4"),
            ("fisheye", "-0.03, 0.01, 1e-3, -2e-4"),
            ("none", ""),
        ] {
            let camera = parsed(&text_with(model, coefficients)).unwrap();
            assert_eq!(parsed(&camera_info(&camera, "true")).unwrap(), camera, "{model}");
        }
    }

    #[test]
    fn opencv_storage_is_read() {
        let text = "%YAML:1.0\n---\nimage_Width: 768\nimage_Height: 710\nCamera_Matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
                    data: [ 6.5e+02, 0., 4.2e+02, 0., 6.5e+02, 3.6e+02, 0., 0., 1. ]\nDistortion_Coefficients: !!opencv-matrix\n   rows: 5\n   \
                    cols: 1\n   dt: d\n   data: [ -4.9e-01, 3.5e-01, 0., 0., -1.4e-01 ]\n";
        let camera = parsed(text).unwrap();
        assert_eq!((camera.width, camera.height), (768, 710));
        assert_eq!(camera.distortion, brown(&[-0.49, 0.35, -0.14, 0.0, 0.0, 0.0], [0.0, 0.0]));
    }

    #[test]
    fn faults_are_named() {
        let good = text_with("plumb_bob", "0.1, 0, 0, 0, 0");
        for (text, word) in [
            (text_with("plumb_bob", "1, 2, 3"), "4 or 5"),
            (text_with("equidistant", "1, 2, 3, 4, 5"), "4 numbers"),
            (text_with("rational_polynomial", "1, 2, 3, 4, 5"), "8 numbers"),
            (text_with("plumb_bob", ".nan, 0, 0, 0, 0"), "finite"),
            (text_with("moebius", "0, 0, 0, 0, 0"), "moebius"),
            (good.replace("500", "-500"), "positive"),
            (good.replace("500", ".nan"), "finite"),
            (good.replace("640", "0"), "image_width"),
            (good.replace("image_height", "height_of_image"), "image_height"),
            (good.replace("camera_matrix", "matrix"), "camera_matrix"),
            (good.replace("distortion_coefficients", "nothing"), "distortion_coefficients"),
            (good.replace("[500, 0, 320,", "[500, 320,"), "nine numbers"),
            (good.replace("[500, 0, 320,", "[500, 7, 320,"), "skew"),
            (String::new(), "missing"),
        ] {
            let message = parsed(&text).unwrap_err().to_string();
            assert!(message.contains(word), "`{message}` should say `{word}`");
        }
    }

    #[test]
    fn a_broken_file_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.yaml");
        std::fs::write(&path, "a: [1, 2\nb: }").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("camera.yaml"));
        assert!(
            read(&folder.path().join("absent.yaml"))
                .unwrap_err()
                .to_string()
                .contains("absent.yaml")
        );
    }
}
