//! A camera and its poses as JSON, as scripts around COLMAP write them: one file instead of a model's folder.
//!
//! `{"model": "SIMPLE_RADIAL", "width", "height", "f" (or "fx", "fy"), "cx", "cy", "k1", …,
//! "frames": [{"video_frame": 0, "world_to_cam": 4×4}, …]}` with COLMAP's names and conventions, and optionally
//! `sparse_points.csv` (`x,y,z,…` by its head) beside it.

use std::fs;
use std::path::Path;

use nalgebra::{Matrix3, Matrix4, Vector3};
use serde::Deserialize;
use serde_json::Value;

use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::colmap::{ColmapImage, ColmapModel, ColmapPoint, camera_model};
use crate::light_field::error::LightFieldError;

/// Beside the poses.
const POINTS: &str = "sparse_points.csv";
/// The numbers of a rotation written with a few digits are so far from orthonormal at most.
const MAX_SKEW: f64 = 1e-2;

#[derive(Deserialize)]
struct PoseList {
    model: String,
    width: usize,
    height: usize,
    frames: Vec<PosedFrame>,
    /// The camera's parameters by name.
    #[serde(flatten)]
    parameters: serde_json::Map<String, Value>,
}

#[derive(Deserialize)]
struct PosedFrame {
    #[serde(alias = "frame")]
    video_frame: u32,
    #[serde(alias = "camera_from_world")]
    world_to_cam: Vec<Vec<f64>>,
}

/// Reads the list, and the points beside it; images are named by their frame: `000123.png`.
pub fn read(path: &Path) -> Result<ColmapModel, LightFieldError> {
    let text = fs::read_to_string(path).map_err(LightFieldError::io(path))?;
    let mut model = parsed(&text).map_err(|what| LightFieldError::corrupt(path, what))?;
    let points = path.with_file_name(POINTS);
    if points.is_file() {
        let text = fs::read_to_string(&points).map_err(LightFieldError::io(&points))?;
        model.points = parsed_points(&text).map_err(|what| LightFieldError::corrupt(&points, what))?;
    }
    Ok(model)
}

fn parsed(text: &str) -> Result<ColmapModel, String> {
    let list: PoseList = serde_json::from_str(text).map_err(|error| {
        format!("expected JSON with model, width, height, the camera's parameters and frames (video_frame, world_to_cam), found none: {error}")
    })?;
    // Some add a formula after the name.
    let name = list
        .model
        .split(|c: char| !c.is_alphanumeric() && c != '_')
        .next()
        .unwrap_or("");
    let parameters = parameters(name, &list.parameters)?;
    let mut model = ColmapModel::default();
    model
        .cameras
        .insert(1, camera_model(name, list.width, list.height, &parameters)?);
    for (id, frame) in (1..).zip(&list.frames) {
        model.images.push(ColmapImage {
            id,
            name: format!("{:06}.png", frame.video_frame),
            camera_id: 1,
            world_from_camera: world_from_camera(&frame.world_to_cam)
                .map_err(|what| format!("frame {}: {what}", frame.video_frame))?,
        });
    }
    Ok(model)
}

/// In COLMAP's order.
fn parameters(model: &str, named: &serde_json::Map<String, Value>) -> Result<Vec<f64>, String> {
    let names: &[&str] = match model {
        "SIMPLE_PINHOLE" => &["f", "cx", "cy"],
        "PINHOLE" => &["fx", "fy", "cx", "cy"],
        "SIMPLE_RADIAL" => &["f", "cx", "cy", "k1"],
        "RADIAL" => &["f", "cx", "cy", "k1", "k2"],
        "OPENCV" => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"],
        "OPENCV_FISHEYE" => &["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
        "FULL_OPENCV" => &["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
        other => {
            return Err(format!(
                "expected a camera model of COLMAP's such as SIMPLE_RADIAL, found `{other}`"
            ));
        }
    };
    let value = |name: &&str| {
        let number = named.get(*name).and_then(Value::as_f64);
        number.ok_or_else(|| format!("{model} needs the numbers {}; `{name}` is missing", names.join(", ")))
    };
    names.iter().map(value).collect()
}

fn world_from_camera(rows: &[Vec<f64>]) -> Result<Transform<World, Camera>, String> {
    let expected =
        || format!("expected world_to_cam as 4 rows of 4 finite numbers, a rotation and a translation, found {rows:?}");
    let numbers: Vec<f64> = rows.iter().flatten().copied().collect();
    let square = rows.len() == 4 && rows.iter().all(|row| row.len() == 4);
    if !square || !numbers.iter().all(|v| v.is_finite()) {
        return Err(expected());
    }
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let skew = (rotation * rotation.transpose() - Matrix3::identity()).abs().max();
    if skew > MAX_SKEW || rotation.determinant() < 0.0 {
        return Err(expected());
    }
    let translation = Vector3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]);
    Ok(Transform::<Camera, World>::from_matrix(&rotation, translation).inverse())
}

fn parsed_points(text: &str) -> Result<Vec<ColmapPoint>, String> {
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let Some((_, head)) = lines.next() else {
        return Ok(Vec::new());
    };
    if !head.replace(' ', "").starts_with("x,y,z") {
        return Err(format!("expected the head x,y,z,…, found `{head}`"));
    }
    lines
        .map(|(number, line)| {
            let mut words = line
                .split(',')
                .map(|word| word.trim().parse::<f64>().ok().filter(|v| v.is_finite()));
            match (words.next().flatten(), words.next().flatten(), words.next().flatten()) {
                (Some(x), Some(y), Some(z)) => Ok(ColmapPoint {
                    position: Point::new(x, y, z),
                    observations: Vec::new(),
                }),
                _ => Err(format!("line {number}: expected finite x,y,z, found `{line}`")),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIST: &str = r#"{"source": "a test", "model": "SIMPLE_RADIAL: x_d = x*(1+k1*r^2)", "width": 64, "height": 48, "f": 50,
        "cx": 32, "cy": 24, "k1": -0.1, "frames": [
        {"video_frame": 5, "world_to_cam": [[0, 1, 0, 1], [-1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]}]}"#;

    #[test]
    fn camera_and_poses_are_read() {
        let model = parsed(LIST).unwrap();
        // The centre of the first pixel is (0.5, 0.5) for COLMAP.
        assert_eq!(model.cameras[&1].intrinsics.cx, 31.5);
        assert_eq!(model.images[0].name, "000005.png");
        // −Rᵀ t.
        let centre = model.images[0].world_from_camera.translation();
        assert!((centre - Vector3::new(2.0, -1.0, -3.0)).norm() < 1e-12, "{centre}");
    }

    #[test]
    fn faults_are_named() {
        for (from, to, word) in [
            ("SIMPLE_RADIAL", "PANORAMA", "PANORAMA"),
            ("\"k1\": -0.1,", "", "`k1` is missing"),
            ("[0, 1, 0, 1]", "[0, 1, 0]", "frame 5: expected world_to_cam"),
            ("[0, 1, 0, 1]", "[0, 2, 0, 1]", "a rotation"),
            ("\"frames\"", "\"pictures\"", "expected JSON with"),
            ("\"width\": 64", "\"width\": 0", "0×48"),
        ] {
            let message = parsed(&LIST.replacen(from, to, 1)).unwrap_err();
            assert!(message.contains(word), "{from} → {to}: {message}");
        }
    }

    #[test]
    fn points_have_a_head() {
        let points = parsed_points("x,y,z,r\n1,2,3,4\n\n-1, 0.5, 7,1\n").unwrap();
        assert_eq!((points.len(), points[1].position.coords.z), (2, 7.0));
        assert!(parsed_points("a,b\n1,2\n").unwrap_err().contains("head"));
        assert!(parsed_points("x,y,z\n1,2,nan\n").unwrap_err().contains("line 2"));
    }
}
