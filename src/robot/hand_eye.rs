//! `hand_eye.yaml`: how the camera sits on the arm's last link, and how late the arm's stamps are.
//!
//! Two forms are read: `translation: {x, y, z}` with `rotation: {x, y, z, w}`, and the one-line
//! `transformation: {x, y, z, qx, qy, qz, qw}` (as easy_handeye writes it); `unit` is `mm` or `m`.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix6, Vector3};

use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;
use crate::robot::quaternion::{QuaternionFault, rotation_from_xyzw, xyzw_from_rotation};
use crate::time::Span;
use crate::yaml::{Node, YamlError, format_number};

/// The result of a hand-eye calibration.
#[derive(Clone, Debug)]
pub struct HandEye {
    /// Where the camera is in the hand, mm.
    pub hand_from_camera: Transform<Hand, Camera>,
    /// Add to a pose stamp to get the camera's clock; `None` when the file does not tell.
    pub time_offset: Option<Span>,
    /// Of (translation mm, rotation rad), in that order.
    pub covariance: Option<Matrix6<f64>>,
    /// What the calibration said about itself; kept, not understood.
    pub report: Option<Node>,
}

/// Why a hand-eye file gives none.
#[derive(Debug, thiserror::Error)]
pub enum HandEyeError {
    /// The disk said no.
    #[error("cannot read the hand-eye file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The disk said no.
    #[error("cannot write the hand-eye file {}: {source}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not YAML at all.
    #[error("{}, {fault}", path.display())]
    NotYaml {
        /// The file.
        path: PathBuf,
        /// Where and what.
        fault: YamlError,
    },
    /// YAML, but no hand-eye calibration.
    #[error("{}: {fault}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What.
        fault: HandEyeFault,
    },
}

/// Why a tree describes no hand-eye calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum HandEyeFault {
    /// Neither form.
    #[error(
        "expected `translation: {{x, y, z}}` and `rotation: {{x, y, z, w}}`, or `transformation: {{x, y, z, qx, qy, qz, qw}}`; found neither"
    )]
    NoTransform,
    /// A component that is not there or no finite number.
    #[error("`{group}`: expected a finite number `{key}`, found {found}")]
    Component {
        /// translation, rotation or transformation.
        group: String,
        /// The component.
        key: String,
        /// In words.
        found: String,
    },
    /// No rotation.
    #[error("`rotation`: {0}")]
    Rotation(QuaternionFault),
    /// A unit nobody knows.
    #[error("`unit`: expected mm or m, found `{0}`")]
    Unit(String),
    /// An optional key with something else in it.
    #[error("`{key}`: expected {expected}")]
    Unexpected {
        /// The key.
        key: &'static str,
        /// In words.
        expected: &'static str,
    },
}

impl HandEye {
    /// A calibration that says no more than where the camera is.
    pub fn new(hand_from_camera: Transform<Hand, Camera>) -> Self {
        Self {
            hand_from_camera,
            time_offset: None,
            covariance: None,
            report: None,
        }
    }

    /// The same for a camera that was moved on the hand: its place comes from the old one's by `moved_from_camera`.
    ///
    /// An error of rotation swings the new place about the old one, so the covariance of the place changes with the distance.
    pub fn with_camera_moved(&self, moved_from_camera: &Transform<Camera, Camera>) -> Self {
        let hand_from_moved = self.hand_from_camera * moved_from_camera.inverse();
        let shift = hand_from_moved.translation() - self.hand_from_camera.translation();
        let covariance = self.covariance.map(|covariance| {
            let mut change = Matrix6::identity();
            change.fixed_view_mut::<3, 3>(0, 3).copy_from(&-shift.cross_matrix());
            change * covariance * change.transpose()
        });
        Self {
            hand_from_camera: hand_from_moved,
            covariance,
            time_offset: self.time_offset,
            report: self.report.clone(),
        }
    }

    /// Read `hand_eye.yaml`.
    pub fn read(path: &Path) -> Result<Self, HandEyeError> {
        let text = std::fs::read_to_string(path).map_err(|source| HandEyeError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let tree = Node::parse(&text).map_err(|fault| HandEyeError::NotYaml {
            path: path.to_owned(),
            fault,
        })?;
        if tree.get("unit").is_none() {
            tracing::warn!("{} says no unit; mm assumed", path.display());
        }
        Self::from_node(&tree).map_err(|fault| HandEyeError::Content {
            path: path.to_owned(),
            fault,
        })
    }

    /// Write `hand_eye.yaml`; an existing file is replaced.
    pub fn write(&self, path: &Path) -> Result<(), HandEyeError> {
        std::fs::write(path, self.to_yaml()).map_err(|source| HandEyeError::Unwritable {
            path: path.to_owned(),
            source,
        })
    }

    /// The calibration that a tree describes.
    pub fn from_node(tree: &Node) -> Result<Self, HandEyeFault> {
        // Some writers put everything below one key.
        let tree = tree
            .get("hand_from_camera")
            .filter(|inner| matches!(inner, Node::Map(_)))
            .unwrap_or(tree);
        let mm_per_unit = match tree.get("unit") {
            None => 1.0,
            Some(Node::Text(unit)) if unit == "mm" => 1.0,
            Some(Node::Text(unit)) if unit == "m" => 1000.0,
            Some(other) => return Err(HandEyeFault::Unit(other.text().unwrap_or("something else").to_owned())),
        };
        let (t, q) = if let Some(group) = tree.get("transformation") {
            let read = |keys| components(group, "transformation", keys);
            (read(&["x", "y", "z"])?, read(&["qx", "qy", "qz", "qw"])?)
        } else {
            let (Some(translation), Some(rotation)) = (tree.get("translation"), tree.get("rotation")) else {
                return Err(HandEyeFault::NoTransform);
            };
            (
                components(translation, "translation", &["x", "y", "z"])?,
                components(rotation, "rotation", &["x", "y", "z", "w"])?,
            )
        };
        let rotation = rotation_from_xyzw([q[0], q[1], q[2], q[3]]).map_err(HandEyeFault::Rotation)?;
        let time_offset = match tree.get("time_offset_s") {
            None | Some(Node::Null) => None,
            Some(node) => Some(node.number().filter(|s| s.abs() < 1e6).map(Span::from_seconds).ok_or(
                HandEyeFault::Unexpected {
                    key: "time_offset_s",
                    expected: "a finite number of seconds",
                },
            )?),
        };
        let covariance = match tree.get("covariance") {
            None | Some(Node::Null) => None,
            Some(node) => Some(covariance(node, mm_per_unit)?),
        };
        Ok(Self {
            hand_from_camera: Transform::new(rotation, Vector3::new(t[0], t[1], t[2]) * mm_per_unit),
            time_offset,
            covariance,
            report: tree.get("report").cloned(),
        })
    }

    /// The text of `hand_eye.yaml`.
    pub fn to_yaml(&self) -> String {
        let number = format_number;
        let t = self.hand_from_camera.translation();
        let [x, y, z, w] = xyzw_from_rotation(&self.hand_from_camera.rotation());
        let mut text = format!(
            "# hand_from_camera: maps a point of the camera (x right, y down, z forward) to the hand\nunit: mm\n\
             translation: {{x: {}, y: {}, z: {}}}\nrotation: {{x: {}, y: {}, z: {}, w: {}}}\n",
            number(t.x),
            number(t.y),
            number(t.z),
            number(x),
            number(y),
            number(z),
            number(w)
        );
        if let Some(offset) = self.time_offset {
            text.push_str("# added to a pose stamp gives the camera's clock\n");
            text.push_str(&format!("time_offset_s: {}\n", number(offset.seconds())));
        }
        if let Some(covariance) = &self.covariance {
            text.push_str("# of translation (mm) and rotation (rad), row by row\ncovariance:\n");
            for row in covariance.row_iter() {
                let list: Vec<String> = row.iter().map(|v| number(*v)).collect();
                text.push_str(&format!("  - [{}]\n", list.join(", ")));
            }
        }
        if let Some(report) = &self.report {
            report.write(&mut text, "report", 0);
        }
        text
    }
}

fn components(node: &Node, group: &str, keys: &[&str]) -> Result<Vec<f64>, HandEyeFault> {
    // A bare list in the same order is unambiguous too.
    if let Node::List(items) = node
        && items.len() == keys.len()
        && let Some(values) = node.numbers().filter(|values| values.iter().all(|v| v.is_finite()))
    {
        return Ok(values);
    }
    keys.iter()
        .map(|key| {
            let value = node.get(key).and_then(Node::number);
            value.filter(|v| v.is_finite()).ok_or_else(|| HandEyeFault::Component {
                group: group.to_owned(),
                key: (*key).to_owned(),
                found: value.map_or_else(|| "none".to_owned(), |v| v.to_string()),
            })
        })
        .collect()
}

fn covariance(node: &Node, mm_per_unit: f64) -> Result<Matrix6<f64>, HandEyeFault> {
    let fault = HandEyeFault::Unexpected {
        key: "covariance",
        expected: "6 × 6 finite numbers, symmetric, the diagonal not negative (translation first)",
    };
    let Some(data) = node
        .numbers()
        .filter(|data| data.len() == 36 && data.iter().all(|v| v.is_finite()))
    else {
        return Err(fault);
    };
    let scale = |i: usize| if i < 3 { mm_per_unit } else { 1.0 };
    let matrix = Matrix6::from_fn(|i, j| data[i * 6 + j] * scale(i) * scale(j));
    let largest = matrix.amax();
    let symmetric = (matrix - matrix.transpose()).amax() <= 1e-6 * largest;
    if symmetric && matrix.diagonal().iter().all(|v| *v >= 0.0) {
        Ok(matrix)
    } else {
        Err(fault)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Result<HandEye, HandEyeFault> {
        HandEye::from_node(&Node::parse(text).unwrap())
    }

    const LONG: &str = "unit: mm\ntranslation: {x: 1.5, y: -2, z: 300}\nrotation: {x: 0, y: 0, z: 0.6, w: 0.8}\n";

    #[test]
    fn a_moved_camera_takes_its_deviations_with_it() {
        use nalgebra::{UnitQuaternion, Vector3, Vector6};
        let about = |x, y, z| UnitQuaternion::from_scaled_axis(Vector3::new(x, y, z));
        let moved_from_camera = Transform::new(about(0.1, 0.4, -0.2), Vector3::new(3.0, -20.0, 7.0));
        let truth = Transform::new(about(1.0, -0.3, 0.2), Vector3::new(10.0, 20.0, 300.0));
        // The place errs by (dt, dr) in the hand's space: small enough that squares do not count.
        let erring = |error: Vector6<f64>| {
            let turn = UnitQuaternion::from_scaled_axis(error.fixed_rows::<3>(3).into_owned());
            let place = truth.translation() + error.fixed_rows::<3>(0);
            HandEye::new(Transform::new(turn * truth.rotation(), place)).with_camera_moved(&moved_from_camera)
        };
        let exact = erring(Vector6::zeros()).hand_from_camera;
        let mut expected = Matrix6::zeros();
        let deviations = [0.3, 0.1, 0.2, 0.01, 0.02, 0.005];
        for (place, deviation) in deviations.into_iter().enumerate() {
            let mut error = Vector6::zeros();
            error[place] = 1e-6 * deviation;
            let off = erring(error).hand_from_camera;
            let shift = (off.translation() - exact.translation()) / 1e-6;
            let turn = (off.rotation() * exact.rotation().inverse()).scaled_axis() / 1e-6;
            let column = Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z);
            expected += column * column.transpose();
        }
        let stated = HandEye {
            covariance: Some(Matrix6::from_diagonal(&Vector6::from(deviations.map(|d| d * d)))),
            ..HandEye::new(truth)
        };
        let found = stated.with_camera_moved(&moved_from_camera).covariance.unwrap();
        assert!((found - expected).amax() < 1e-5, "{found} {expected}");
    }

    #[test]
    fn both_forms_and_units_agree() {
        let long = parsed(LONG).unwrap();
        let short = parsed("unit: m\ntransformation: {x: 0.0015, y: -0.002, z: 0.3, qx: 0, qy: 0, qz: 0.6, qw: 0.8}\n").unwrap();
        let difference = long.hand_from_camera * short.hand_from_camera.inverse();
        assert!(difference.translation().norm() < 1e-9);
        assert!(difference.rotation().angle() < 1e-12);
        assert_eq!(long.hand_from_camera.translation(), Vector3::new(1.5, -2.0, 300.0));
        assert_eq!(long.time_offset, None);
    }

    #[test]
    fn what_is_written_is_read() {
        let mut hand_eye = parsed(LONG).unwrap();
        hand_eye.time_offset = Some(Span::from_milliseconds(40.0));
        hand_eye.covariance = Some(Matrix6::identity() * 1e-7);
        hand_eye.report = Some(Node::Map(vec![
            ("rms_px".into(), Node::Number(0.4)),
            ("motions".into(), Node::Number(12.0)),
        ]));
        let back = parsed(&hand_eye.to_yaml()).unwrap();
        assert!((back.hand_from_camera.isometry().to_matrix() - hand_eye.hand_from_camera.isometry().to_matrix()).amax() < 1e-12);
        assert_eq!(back.time_offset, hand_eye.time_offset);
        assert_eq!(back.covariance, hand_eye.covariance);
        assert_eq!(back.report, hand_eye.report);
    }

    #[test]
    fn a_covariance_in_metres_becomes_millimetres() {
        let rows: Vec<String> = (0..6)
            .map(|i| {
                format!(
                    "[{}]",
                    (0..6)
                        .map(|j| if i == j { "1e-6" } else { "0" })
                        .collect::<Vec<_>>()
                        .join(",")
                )
            })
            .collect();
        let text = format!("{}covariance: [{}]\n", LONG.replace("mm", "m"), rows.join(", "));
        let covariance = parsed(&text).unwrap().covariance.unwrap();
        assert!((covariance[(0, 0)] - 1.0).abs() < 1e-12 && (covariance[(5, 5)] - 1e-6).abs() < 1e-18);
    }

    #[test]
    fn faults_are_named() {
        for (text, word) in [
            (LONG.replace("0.6, w: 0.8", "0, w: 0"), "length 0"),
            (LONG.replace("0.6, w: 0.8", ".nan, w: 0"), "finite"),
            (LONG.replace("z: 300", "depth: 300"), "`z`"),
            (LONG.replace("unit: mm", "unit: inch"), "inch"),
            (LONG.replace("rotation", "euler"), "transformation"),
            (format!("{LONG}time_offset_s: late\n"), "time_offset_s"),
            (format!("{LONG}covariance: [1, 2, 3]\n"), "covariance"),
            (String::new(), "neither"),
        ] {
            let message = parsed(&text).unwrap_err().to_string();
            assert!(message.contains(word), "`{message}` should say `{word}`");
        }
    }
}
