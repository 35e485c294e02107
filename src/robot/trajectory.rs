//! Where the arm's hand was, and when: `poses.tum`.
//!
//! The layout of the TUM RGB-D benchmark (Sturm et al. 2012): `timestamp_s tx ty tz qx qy qz qw` a line. The benchmark knows
//! metres and no transform; here a comment line says both: `# T_base_hand, mm`.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3, UnitQuaternion};

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::robot::quaternion::{QuaternionFault, rotation_from_xyzw, xyzw_from_rotation};
use crate::time::Timestamp;

/// A pose of the hand and the arm's stamp of it.
#[derive(Clone, Copy, Debug)]
pub struct TimedPose {
    /// On the arm's clock.
    pub stamp: Timestamp,
    /// Where the hand was, mm.
    pub base_from_hand: Transform<RobotBase, Hand>,
}

/// Poses of the hand in the order of time; never empty, stamps strictly increasing.
#[derive(Clone, Debug)]
pub struct Trajectory {
    poses: Vec<TimedPose>,
}

/// Why a file of poses cannot be trusted.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    /// The disk said no.
    #[error("cannot read the poses {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The disk said no.
    #[error("cannot write the poses {}: {source}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line is wrong.
    #[error("{}, line {line}: {fault}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What.
        fault: PoseFault,
    },
    /// Nothing in it.
    #[error("{}: expected poses, found none", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
}

/// What can be wrong with a line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PoseFault {
    /// Too few or too many fields.
    #[error("expected {expected} numbers ({layout}), found {found}")]
    FieldCount {
        /// How many are due.
        expected: usize,
        /// Their names.
        layout: String,
        /// How many there are.
        found: usize,
    },
    /// Text.
    #[error("expected a number, found `{0}`")]
    NotANumber(String),
    /// NaN or infinite.
    #[error("expected finite numbers, found `{0}`")]
    NotFinite(String),
    /// No rotation.
    #[error("{0}")]
    Rotation(#[from] QuaternionFault),
    /// Earlier than the line before.
    #[error("time runs backwards: {found_s:.6} s after {previous_s:.6} s")]
    Backwards {
        /// The stamp before.
        previous_s: f64,
        /// This stamp.
        found_s: f64,
    },
    /// The comment names another transform.
    #[error("expected poses T_base_hand, the comment says `{0}`")]
    OtherTransform(String),
    /// Joint values that the arm cannot take.
    #[error("{0}")]
    Joints(String),
}

impl Trajectory {
    /// From poses; `None` when there are none, time does not strictly increase, or a number is not finite.
    pub fn new(poses: Vec<TimedPose>) -> Option<Self> {
        let increasing = poses.windows(2).all(|pair| pair[0].stamp < pair[1].stamp);
        let finite = poses.iter().all(|pose| pose.base_from_hand.is_finite());
        (!poses.is_empty() && increasing && finite).then_some(Self { poses })
    }

    /// The poses in the order of time.
    pub fn poses(&self) -> &[TimedPose] {
        &self.poses
    }

    /// Median step between stamps, s; 0 for a single pose.
    pub fn median_interval_s(&self) -> f64 {
        let mut steps: Vec<i64> = self.poses.windows(2).map(|pair| (pair[1].stamp - pair[0].stamp).0).collect();
        steps.sort_unstable();
        steps.get(steps.len() / 2).map_or(0.0, |step| *step as f64 * 1e-9)
    }

    /// Read `poses.tum`.
    pub fn read(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrajectoryError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let file = TumFile::parse(&text).map_err(|(line, fault)| TrajectoryError::Line {
            path: path.to_owned(),
            line,
            fault,
        })?;
        let inverted = match file.transform.as_deref() {
            None | Some("T_base_hand" | "T_base_flange") => false,
            Some("T_hand_base" | "T_flange_base") => true,
            Some(other) => {
                let fault = PoseFault::OtherTransform(other.to_owned());
                return Err(TrajectoryError::Line {
                    path: path.to_owned(),
                    line: file.transform_line,
                    fault,
                });
            }
        };
        if !file.unit_known {
            tracing::warn!("{} says no unit in its first line; mm assumed", path.display());
        }
        if file.repeated_stamps > 0 {
            tracing::warn!(
                "{}: {} lines repeat the stamp before them; left out",
                path.display(),
                file.repeated_stamps
            );
        }
        let poses: Vec<TimedPose> = file
            .poses
            .into_iter()
            .map(|(stamp, pose)| TimedPose {
                stamp,
                base_from_hand: Transform::from_isometry(if inverted { pose.inverse() } else { pose }),
            })
            .collect();
        Self::new(poses).ok_or_else(|| TrajectoryError::Empty { path: path.to_owned() })
    }

    /// Write `poses.tum`; an existing file is replaced.
    pub fn write(&self, path: &Path) -> Result<(), TrajectoryError> {
        let poses = self.poses.iter().map(|pose| (pose.stamp, *pose.base_from_hand.isometry()));
        write_tum(path, "T_base_hand", poses)
    }
}

/// Any file in TUM layout, lengths in mm.
#[derive(Clone, Debug, Default)]
pub struct TumFile {
    /// `T_a_b` as the comment has it.
    pub transform: Option<String>,
    /// Where that was said; 0 if nowhere.
    pub transform_line: usize,
    /// True when the comment says mm or m.
    pub unit_known: bool,
    /// Lines left out because they repeat the stamp of the line before them.
    pub repeated_stamps: usize,
    /// Stamps (strictly increasing) and poses, mm.
    pub poses: Vec<(Timestamp, Isometry3<f64>)>,
}

impl TumFile {
    /// Read any file in TUM layout, such as camera poses (`# T_world_camera, mm`).
    pub fn read(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read_to_string(path).map_err(|source| TrajectoryError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let file = Self::parse(&text).map_err(|(line, fault)| TrajectoryError::Line {
            path: path.to_owned(),
            line,
            fault,
        })?;
        if file.poses.is_empty() {
            Err(TrajectoryError::Empty { path: path.to_owned() })
        } else {
            Ok(file)
        }
    }

    /// From a text; a fault comes with its line number.
    pub fn parse(text: &str) -> Result<Self, (usize, PoseFault)> {
        let mut file = Self::default();
        let mut mm_per_unit = 1.0;
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            if let Some(comment) = line.strip_prefix('#') {
                // Only the head of the file speaks for all of it.
                if file.poses.is_empty() {
                    file.understand_comment(comment, number, &mut mm_per_unit);
                }
                continue;
            }
            if line.is_empty() {
                continue;
            }
            let (stamp, pose) = pose_of_line(line, mm_per_unit).map_err(|fault| (number, fault))?;
            match file.poses.last() {
                Some((previous, _)) if *previous > stamp => {
                    let fault = PoseFault::Backwards {
                        previous_s: previous.seconds(),
                        found_s: stamp.seconds(),
                    };
                    return Err((number, fault));
                }
                Some((previous, _)) if *previous == stamp => file.repeated_stamps += 1,
                _ => file.poses.push((stamp, pose)),
            }
        }
        Ok(file)
    }

    fn understand_comment(&mut self, comment: &str, line: usize, mm_per_unit: &mut f64) {
        for word in comment.split(|c: char| !c.is_alphanumeric() && c != '_') {
            match word.to_lowercase().as_str() {
                "mm" | "millimetre" | "millimetres" | "millimeter" | "millimeters" => {
                    (self.unit_known, *mm_per_unit) = (true, 1.0);
                }
                "m" | "metre" | "metres" | "meter" | "meters" => {
                    (self.unit_known, *mm_per_unit) = (true, 1000.0);
                }
                _ if word.starts_with("T_") && self.transform.is_none() => {
                    self.transform = Some(word.to_owned());
                    self.transform_line = line;
                }
                _ => {}
            }
        }
    }
}

/// Finite numbers of one line, separated by blanks or commas.
pub(crate) fn numbers_of_line(line: &str, expected: usize, layout: &str) -> Result<Vec<f64>, PoseFault> {
    let words: Vec<&str> = line
        .split(|c: char| c.is_whitespace() || c == ',')
        .filter(|word| !word.is_empty())
        .collect();
    if words.len() != expected {
        return Err(PoseFault::FieldCount {
            expected,
            layout: layout.to_owned(),
            found: words.len(),
        });
    }
    words
        .into_iter()
        .map(|word| match word.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            Ok(_) => Err(PoseFault::NotFinite(word.to_owned())),
            Err(_) => Err(PoseFault::NotANumber(word.to_owned())),
        })
        .collect()
}

fn pose_of_line(line: &str, mm_per_unit: f64) -> Result<(Timestamp, Isometry3<f64>), PoseFault> {
    let v = numbers_of_line(line, 8, "timestamp_s tx ty tz qx qy qz qw")?;
    let rotation: UnitQuaternion<f64> = rotation_from_xyzw([v[4], v[5], v[6], v[7]])?;
    let translation = Translation3::new(v[1] * mm_per_unit, v[2] * mm_per_unit, v[3] * mm_per_unit);
    Ok((Timestamp::from_seconds(v[0]), Isometry3::from_parts(translation, rotation)))
}

/// The first lines of a file in TUM layout; `transform` as in `T_base_hand`.
pub fn tum_head(transform: &str) -> String {
    format!("# {transform}, mm\n# timestamp_s tx ty tz qx qy qz qw\n")
}

/// A stamp as files hold it, s.
pub fn stamp_text(stamp: Timestamp) -> String {
    let (seconds, nanoseconds) = (stamp.0.div_euclid(1_000_000_000), stamp.0.rem_euclid(1_000_000_000));
    // Negative stamps hardly occur but must not be garbled.
    if seconds >= 0 {
        format!("{seconds}.{nanoseconds:09}")
    } else {
        format!("{:.9}", stamp.seconds())
    }
}

/// A line of a file in TUM layout, mm.
pub fn tum_line(stamp: Timestamp, pose: &Isometry3<f64>) -> String {
    let t = pose.translation.vector;
    let [x, y, z, w] = xyzw_from_rotation(&pose.rotation);
    let stamp = stamp_text(stamp);
    format!("{stamp} {:.6} {:.6} {:.6} {x:.12} {y:.12} {z:.12} {w:.12}\n", t.x, t.y, t.z)
}

/// Write poses (mm) in TUM layout; `transform` as in `T_base_hand`. An existing file is replaced.
pub fn write_tum(
    path: &Path,
    transform: &str,
    poses: impl Iterator<Item = (Timestamp, Isometry3<f64>)>,
) -> Result<(), TrajectoryError> {
    let mut text = tum_head(transform);
    for (stamp, pose) in poses {
        text.push_str(&tum_line(stamp, &pose));
    }
    std::fs::write(path, text).map_err(|source| TrajectoryError::Unwritable {
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Trajectory, TrajectoryError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.tum");
        std::fs::write(&path, text).unwrap();
        Trajectory::read(&path)
    }

    #[test]
    fn units_and_names_are_understood() {
        for (head, tx, expected) in [
            ("# T_base_hand, mm", "100.0", 100.0),
            ("# T_base_flange, m", "0.1", 100.0),
            ("# timestamp tx ty tz qx qy qz qw", "100.0", 100.0),
            ("# T_hand_base, mm", "100.0", -100.0),
            ("", "100.0", 100.0),
        ] {
            let trajectory = read(&format!("{head}\n1.5 {tx} 0 0 0 0 0 1\n")).unwrap();
            let pose = trajectory.poses()[0];
            assert_eq!(pose.stamp, Timestamp(1_500_000_000));
            assert!((pose.base_from_hand.translation().x - expected).abs() < 1e-9, "{head}");
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let poses: Vec<TimedPose> = (0..20)
            .map(|i| TimedPose {
                stamp: Timestamp(20_000_000 * i + 7),
                base_from_hand: Transform::new(
                    UnitQuaternion::from_euler_angles(0.1 * i as f64, -0.2, 2.0),
                    nalgebra::Vector3::new(i as f64, -3.25, 1e-3),
                ),
            })
            .collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.tum");
        Trajectory::new(poses.clone()).unwrap().write(&path).unwrap();
        for (before, after) in poses.iter().zip(Trajectory::read(&path).unwrap().poses()) {
            assert_eq!(before.stamp, after.stamp);
            let difference = before.base_from_hand * after.base_from_hand.inverse();
            assert!(difference.translation().norm() < 2e-6 && difference.rotation().angle() < 1e-7);
        }
    }

    #[test]
    fn faults_name_file_and_line() {
        let good = "# T_base_hand, mm\n0.0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n";
        for (line, word) in [
            ("0.05 0 0 0 0 0 0 1", "backwards"),
            ("0.2 nan 0 0 0 0 0 1", "finite"),
            ("nan 0 0 0 0 0 0 1", "finite"),
            ("0.2 0 0 0 0 0 0 0", "length 0"),
            ("0.2 0 0 0 0 0 1", "8 numbers"),
            ("0.2 0 0 x 0 0 0 1", "`x`"),
        ] {
            let message = read(&format!("{good}{line}\n")).unwrap_err().to_string();
            assert!(message.contains(word) && message.contains("poses.tum, line 4"), "{message}");
        }
        assert!(read("# T_base_hand, mm\n").unwrap_err().to_string().contains("found none"));
        assert!(
            read("# T_world_camera, mm\n0 0 0 0 0 0 0 1\n")
                .unwrap_err()
                .to_string()
                .contains("T_world_camera")
        );
    }

    #[test]
    fn a_repeated_stamp_is_left_out() {
        assert_eq!(
            read("# mm\n0.1 0 0 0 0 0 0 1\n0.1 5 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 1\n")
                .unwrap()
                .poses()
                .len(),
            2
        );
    }
}
