//! The folder of a recording: which of its files are there, what they say, and what stays dark without the others.
//!
//! A file that is absent is no error: what needs it is switched off with one clear line ([`Recording::missing`]). A file that is
//! there and wrong is an error.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::camera::file::{self as camera_file, CameraFileError};
use crate::camera::model::CameraModel;
use crate::camera::oblique::Oblique;
use crate::recording::frame_times::{self, FrameTimeFault};
use crate::robot::hand_eye::{HandEye, HandEyeError};
use crate::robot::kinematics::{Arm, ArmError};
use crate::robot::trajectory::{Trajectory, TrajectoryError};
use crate::time::Timestamp;

const VIDEO_EXTENSIONS: &[&str] = &[
    "mp4", "mkv", "avi", "mov", "m4v", "webm", "mpg", "mpeg", "ts", "mts", "m2ts", "mxf", "vob", "wmv", "flv", "ogv", "y4m", "dv",
];
const IMAGE_EXTENSIONS: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff", "bmp", "ppm", "pgm"];

/// Where the pictures are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Video {
    /// A video file.
    File(PathBuf),
    /// A folder of numbered pictures.
    Frames(PathBuf),
}

impl Video {
    /// The file or folder.
    pub fn path(&self) -> &Path {
        match self {
            Self::File(path) | Self::Frames(path) => path,
        }
    }
}

/// A part that a recording may lack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// `camera.yaml`.
    Camera,
    /// `poses.tum` or `joints.csv`.
    Poses,
    /// `hand_eye.yaml`.
    HandEye,
}

/// What is missing and what that means; one line for the user.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Missing {
    /// The part.
    pub what: Part,
    /// What cannot run, and how the part is made.
    pub consequence: &'static str,
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let file = match self.what {
            Part::Camera => "camera.yaml",
            Part::Poses => "poses.tum",
            Part::HandEye => "hand_eye.yaml",
        };
        write!(f, "no {file}: {}", self.consequence)
    }
}

/// Everything one camera saw, and what is known about it.
#[derive(Clone, Debug)]
pub struct Recording {
    /// The pictures.
    pub video: Video,
    /// When each frame was exposed; without it the container's stamps count.
    pub frame_times: Option<Vec<Timestamp>>,
    /// Where the arm's hand was.
    pub trajectory: Option<Trajectory>,
    /// How the camera sits on the hand.
    pub hand_eye: Option<HandEye>,
    /// Explains the pixels.
    pub camera: Option<CameraModel>,
    /// How an oblique scope's telescope turns against the camera head; camera and hand-eye are those of angle 0.
    pub oblique: Option<Oblique>,
    /// `color.yaml`, for the color stage to read.
    pub color: Option<PathBuf>,
}

/// Why a path is no recording.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// Nothing there.
    #[error("{}: no such file or folder", .0.display())]
    Absent(PathBuf),
    /// The disk said no.
    #[error("cannot read {}: {source}", path.display())]
    Unreadable {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder without pictures.
    #[error("{}: expected a video (video.mp4, .mkv, .avi, .mov, …), a folder frames/ or pictures; found none", .0.display())]
    NoVideo(PathBuf),
    /// Several videos and none called `video`.
    #[error("{}: expected one video, found {} and {}; call the right one video.*, or give its path", folder.display(), first.display(), second.display())]
    SeveralVideos {
        /// The folder.
        folder: PathBuf,
        /// One.
        first: PathBuf,
        /// Another.
        second: PathBuf,
    },
    /// `camera.yaml` is wrong.
    #[error(transparent)]
    Camera(#[from] CameraFileError),
    /// `hand_eye.yaml` is wrong.
    #[error(transparent)]
    HandEye(#[from] HandEyeError),
    /// `poses.tum` or `joints.csv` is wrong.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    /// `arm.toml` is wrong.
    #[error(transparent)]
    Arm(#[from] ArmError),
    /// `frames.csv` is wrong.
    #[error("{}, line {line}: {fault}", path.display())]
    FrameTimes {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What.
        fault: FrameTimeFault,
    },
    /// An angle, but nothing that turns.
    #[error(
        "an angle of the telescope is given, but camera.yaml has no block `oblique` that says how it turns: `endofield calibrate oblique` makes it"
    )]
    NoTelescope,
    /// The camera was calibrated with pictures of another size.
    #[error(
        "camera.yaml is for pictures of {camera_width}x{camera_height}, the video has {video_width}x{video_height}: \
         calibrate at the video's size, or give the camera.yaml that belongs to this video"
    )]
    OtherSize {
        /// In camera.yaml.
        camera_width: usize,
        /// In camera.yaml.
        camera_height: usize,
        /// Of the video.
        video_width: usize,
        /// Of the video.
        video_height: usize,
    },
}

impl Recording {
    /// A video and nothing else.
    pub fn plain(video: Video) -> Self {
        Self {
            video,
            frame_times: None,
            trajectory: None,
            hand_eye: None,
            camera: None,
            oblique: None,
            color: None,
        }
    }

    /// A recording's folder, a video file, or a folder of pictures.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let metadata = std::fs::metadata(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::NotFound => RecordingError::Absent(path.to_owned()),
            _ => RecordingError::Unreadable {
                path: path.to_owned(),
                source,
            },
        })?;
        if !metadata.is_dir() {
            return Ok(Self::plain(Video::File(path.to_owned())));
        }
        let there = |name: &str| Some(path.join(name)).filter(|file| file.exists());
        Ok(Self {
            video: video_in(path)?,
            frame_times: there("frames.csv").map(|file| read_frame_times(&file)).transpose()?,
            trajectory: trajectory_in(path)?,
            hand_eye: there("hand_eye.yaml").map(|file| HandEye::read(&file)).transpose()?,
            camera: there("camera.yaml").map(|file| camera_file::read(&file)).transpose()?,
            oblique: there("camera.yaml")
                .map(|file| camera_file::read_oblique(&file))
                .transpose()?
                .flatten(),
            color: there("color.yaml"),
        })
    }

    /// The recording as taken with the telescope turned by this angle: camera and hand-eye are brought there from angle 0.
    pub fn with_telescope_at(self, angle_rad: f64) -> Result<Self, RecordingError> {
        let (Some(camera), Some(oblique)) = (&self.camera, &self.oblique) else {
            return Err(RecordingError::NoTelescope);
        };
        Ok(Self {
            camera: Some(oblique.camera_at(camera, angle_rad)),
            hand_eye: (self.hand_eye.as_ref()).map(|hand_eye| hand_eye.with_camera_moved(&oblique.turned_from_zero(angle_rad))),
            ..self
        })
    }

    /// What is not there, and what cannot run without it.
    pub fn missing(&self) -> Vec<Missing> {
        let mut missing = Vec::new();
        if self.camera.is_none() {
            missing.push(Missing {
                what: Part::Camera,
                consequence: "the picture is not undistorted, and specularities cannot be substituted (`endofield calibrate camera` makes it)",
            });
        }
        if self.trajectory.is_none() {
            missing.push(Missing {
                what: Part::Poses,
                consequence: "the camera's place is unknown, so specularities cannot be substituted from a light field",
            });
        }
        if self.hand_eye.is_none() && self.trajectory.is_some() {
            missing.push(Missing {
                what: Part::HandEye,
                consequence: "the arm's poses say nothing about the camera, so specularities cannot be substituted \
                              (`endofield calibrate hand-eye` makes it)",
            });
        }
        missing
    }

    /// An error when `camera.yaml` belongs to pictures of another size than the video's.
    pub fn check_video_size(&self, video_width: usize, video_height: usize) -> Result<(), RecordingError> {
        match &self.camera {
            Some(camera) if (camera.width, camera.height) != (video_width, video_height) => Err(RecordingError::OtherSize {
                camera_width: camera.width,
                camera_height: camera.height,
                video_width,
                video_height,
            }),
            _ => Ok(()),
        }
    }
}

fn trajectory_in(folder: &Path) -> Result<Option<Trajectory>, RecordingError> {
    let poses = folder.join("poses.tum");
    if poses.exists() {
        return Ok(Some(Trajectory::read(&poses)?));
    }
    let joints = folder.join("joints.csv");
    if !joints.exists() {
        return Ok(None);
    }
    let own_arm = folder.join("arm.toml");
    let arm = if own_arm.exists() {
        Arm::read(&own_arm)?
    } else {
        Arm::aesop_3000()?
    };
    tracing::info!("{}: turned into poses by the kinematics of {}", joints.display(), arm.name);
    Ok(Some(arm.read_joints(&joints)?))
}

fn read_frame_times(path: &Path) -> Result<Vec<Timestamp>, RecordingError> {
    let text = std::fs::read_to_string(path).map_err(|source| RecordingError::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    frame_times::parse(&text).map_err(|(line, fault)| RecordingError::FrameTimes {
        path: path.to_owned(),
        line,
        fault,
    })
}

fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    path.extension()
        .and_then(|e| e.to_str())
        .is_some_and(|e| extensions.contains(&e.to_lowercase().as_str()))
}

fn video_in(folder: &Path) -> Result<Video, RecordingError> {
    let unreadable = |source| RecordingError::Unreadable {
        path: folder.to_owned(),
        source,
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        files.push(entry.map_err(unreadable)?.path());
    }
    files.sort();
    let videos: Vec<&PathBuf> = files
        .iter()
        .filter(|file| file.is_file() && has_extension(file, VIDEO_EXTENSIONS))
        .collect();
    if let Some(named) = videos
        .iter()
        .find(|file| file.file_stem().is_some_and(|stem| stem == "video"))
    {
        return Ok(Video::File((*named).clone()));
    }
    let frames = folder.join("frames");
    if frames.is_dir() {
        return Ok(Video::Frames(frames));
    }
    match videos.as_slice() {
        [only] => Ok(Video::File((*only).clone())),
        [first, second, ..] => Err(RecordingError::SeveralVideos {
            folder: folder.to_owned(),
            first: (*first).clone(),
            second: (*second).clone(),
        }),
        [] if files.iter().any(|file| has_extension(file, IMAGE_EXTENSIONS)) => Ok(Video::Frames(folder.to_owned())),
        [] => Err(RecordingError::NoVideo(folder.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: &str = "image_width: 64\nimage_height: 48\ncamera_matrix: {rows: 3, cols: 3, data: [50, 0, 32, 0, 50, 24, 0, 0, 1]}\n\
                          distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n";

    #[test]
    fn a_plain_video_lacks_the_rest() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("op.mp4");
        std::fs::write(&path, "x").unwrap();
        let recording = Recording::open(&path).unwrap();
        assert_eq!(recording.video, Video::File(path));
        let missing: Vec<Part> = recording.missing().iter().map(|m| m.what).collect();
        assert_eq!(missing, [Part::Camera, Part::Poses]);
        assert!(recording.check_video_size(1, 1).is_ok());
    }

    #[test]
    fn a_telescope_is_turned_where_its_joint_is_known() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        put("video.mkv", "x");
        put("camera.yaml", CAMERA);
        put(
            "hand_eye.yaml",
            "unit: mm\ntranslation: {x: 1, y: 2, z: 3}\nrotation: {x: 0, y: 0, z: 0, w: 1}\n",
        );
        let straight = Recording::open(folder.path()).unwrap();
        let refusal = straight.with_telescope_at(0.5).unwrap_err().to_string();
        assert!(refusal.contains("calibrate oblique"), "{refusal}");

        let joint = "oblique:\n  axis: [0, 0.5, 0.866]\n  point_mm: [0, 0, 0]\n  center_px: [30, 25]\n";
        put("camera.yaml", &format!("{CAMERA}{joint}"));
        let at_zero = Recording::open(folder.path()).unwrap();
        let turned = at_zero.clone().with_telescope_at(std::f64::consts::FRAC_PI_2).unwrap();
        let [from, to] = [&at_zero, &turned].map(|recording| recording.camera.as_ref().unwrap().intrinsics);
        // A quarter turn, right to down, about (30, 25).
        assert!((to.cx - (30.0 - (from.cy - 25.0))).abs() < 1e-9 && (to.cy - (25.0 + (from.cx - 30.0))).abs() < 1e-9);
        // The axis goes through the camera: it stays where it is and looks elsewhere, as far from the axis as before.
        let [from, to] = [&at_zero, &turned].map(|recording| recording.hand_eye.as_ref().unwrap().hand_from_camera);
        assert!((from.translation() - to.translation()).norm() < 1e-9);
        let axis = nalgebra::Vector3::new(0.0, 0.5, 0.866).normalize();
        let forward = nalgebra::Vector3::z();
        let [before, after] = [from, to].map(|pose| (pose.rotation() * forward).dot(&axis));
        assert!((before - after).abs() < 1e-9 && (from.rotation() * forward - to.rotation() * forward).norm() > 0.6);
    }

    #[test]
    fn a_full_folder_lacks_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        put("video.mkv", "x");
        put("other.mp4", "x");
        put("camera.yaml", CAMERA);
        put("frames.csv", "frame,timestamp_s\n0,0\n1,0.04\n");
        put("poses.tum", "# T_base_hand, mm\n0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n");
        put(
            "hand_eye.yaml",
            "unit: mm\ntranslation: {x: 0, y: 0, z: 1}\nrotation: {x: 0, y: 0, z: 0, w: 1}\n",
        );
        let recording = Recording::open(folder.path()).unwrap();
        assert!(recording.missing().is_empty());
        assert_eq!(recording.video, Video::File(folder.path().join("video.mkv")));
        assert_eq!(recording.frame_times.as_ref().unwrap().len(), 2);
        let message = recording.check_video_size(640, 480).unwrap_err().to_string();
        assert!(message.contains("64x48") && message.contains("640x480"), "{message}");
        put("frames.csv", "0,0\n1,-1\n");
        assert!(Recording::open(folder.path()).unwrap_err().to_string().contains("line 2"));
    }

    #[test]
    fn pictures_are_a_video_too() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(Recording::open(folder.path()), Err(RecordingError::NoVideo(_))));
        std::fs::write(folder.path().join("000000.png"), "x").unwrap();
        assert_eq!(
            Recording::open(folder.path()).unwrap().video,
            Video::Frames(folder.path().to_owned())
        );
        assert!(matches!(
            Recording::open(&folder.path().join("none")),
            Err(RecordingError::Absent(_))
        ));
    }
}
