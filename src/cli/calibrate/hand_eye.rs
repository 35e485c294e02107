//! `calibrate hand-eye`: how the camera sits on the arm, from a board seen from many stations.

use std::path::PathBuf;

use anyhow::Context as _;

use crate::calibration::board::detection::{Detection, detect};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::camera::pose::board_pose;
use crate::calibration::hand_eye::calibrate::{StationView, calibrate};
use crate::calibration::hand_eye::plot::{self, Drawn};
use crate::calibration::hand_eye::refinement::{HandPoses, Refined, Settings, Sighting};
use crate::camera::file;
use crate::camera::model::CameraModel;
use crate::cli::calibrate::hand_eye_report::{Report, listed};
use crate::cli::calibrate::pictures::{Seen, look_at_all};
use crate::cli::calibrate::pose_files;
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::media::image_files;
use crate::recording::folder::Recording;
use crate::robot::hand_eye::HandEye;
use crate::robot::kinematics::{Arm, JointSample};
use crate::robot::pose_buffer::PoseBuffer;
use crate::time::{Span, Timestamp};

/// Corners that a view must show.
const LEAST_CORNERS: usize = 6;

/// Measure how the camera sits on the arm's hand.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  endofield calibrate hand-eye stations/ --camera camera.yaml --board checkerboard:9x6 --square-mm 4
  endofield calibrate hand-eye --images left_*.png --poses hand_*.txt --board-poses board_*.txt \\
      --camera camera.yaml --board checkerboard:13x8 --square-mm 3 -o hand_eye.yaml

Rest the arm at ten to thirty stations before a board that lies still; tilt the scope by 20° and more to all sides and roll it.
Beside hand_eye.yaml is written hand_eye_report.json.")]
pub struct Args {
    /// A recording: pictures, frames.csv, and poses.tum or joints.csv.
    #[arg(required_unless_present = "images", conflicts_with = "images")]
    recording: Option<PathBuf>,
    /// Pictures, one a station, in place of a recording.
    #[arg(long, num_args = 1.., value_name = "FILE", requires = "poses")]
    images: Vec<PathBuf>,
    /// Poses base_from_hand of the pictures in their order: a text file with a 4×4 matrix (mm) each, or one .tum file.
    #[arg(long, num_args = 1.., value_name = "FILE")]
    poses: Vec<PathBuf>,
    /// Where the tracker sees the board at each picture, likewise; base_from_hand is then taken in the board marker's space.
    #[arg(long, num_args = 1.., value_name = "FILE", requires = "images")]
    board_poses: Vec<PathBuf>,
    /// The camera; a recording's own if left out.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// The board, such as checkerboard:9x6 (as in calibrate camera).
    #[arg(long)]
    board: String,
    /// Side of a square or distance of dots, mm.
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// Frames looked at, of a recording.
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(3..=200))]
    frames: u32,
    /// The arm's kinematics, to read joints.csv with; with it constant joint offsets can be found.
    #[arg(long, value_name = "FILE")]
    arm: Option<PathBuf>,
    /// How far joints may be off constantly, degrees (mm for a slide at ten times the number); 0 does not look for offsets.
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    joint_offsets_deg: f64,
    /// Hand-eye file to write.
    #[arg(short, long, default_value = "hand_eye.yaml", value_name = "FILE")]
    output: PathBuf,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let layout = BoardLayout::new(&args.board, args.square_mm).map_err(|error| UsageError(error.to_string()))?;
    let [report_path, plot_path] = ["_report.json", "_report.png"].map(|ending| super::beside(&args.output, ending));
    for path in [&args.output, &report_path, &plot_path] {
        context.refuse_overwriting(path)?;
    }
    let recorded = args.recording.as_deref().map(Recording::open).transpose()?;
    let camera = camera_of(args, recorded.as_ref())?;
    let inputs = args.recording.iter().chain(&args.images).cloned().collect::<Vec<_>>();
    let seen = look_at_all(&inputs, args.frames as usize, &context.console, &|image| {
        detect(image, &layout)
    })?;
    if let Some(other) = seen.iter().find(|seen| seen.size != (camera.width, camera.height)) {
        anyhow::bail!(
            "{} is {}×{}, the camera file is for {}×{}: calibrate the camera at this size",
            other.name,
            other.size.0,
            other.size.1,
            camera.width,
            camera.height
        );
    }
    let arm = match &recorded {
        Some(recording) => of_recording(args, recording, &seen, context)?,
        None => of_files(args, seen.len())?,
    };
    let (views, hands, names, without) = matched(&seen, &camera, arm);
    if !without.is_empty() {
        tracing::warn!(
            "{} of {} pictures are left out: {}",
            without.len(),
            seen.len(),
            listed(&without)
        );
    }
    let settings = Settings {
        time_offset: matches!(hands, Hands::Timed { .. } | Hands::Jointed { .. }),
        joint_sigma: joint_sigmas(&hands, args.joint_offsets_deg),
        ..Settings::default()
    };
    let refined = calibrate(&views, &hands, &camera, &settings)?;
    let report = Report::new(&refined, &views, &hands, &camera, &settings, &names, without);
    let hand_eye = HandEye {
        time_offset: settings.time_offset.then(|| Span::from_seconds(refined.time_offset_s[0])),
        covariance: Some(refined.covariance),
        ..HandEye::new(refined.hand_from_camera)
    };
    hand_eye.write(&args.output)?;
    super::write_json(&report_path, &serde_json::to_value(&report)?)?;
    let drawn = drawn(&refined, &views, &hands, &camera, &report);
    image_files::write(&plot_path, &plot::drawn((camera.width, camera.height), &drawn))?;
    console::print(&report.table())?;
    console::print(&format!(
        "\nwrote {}, {} and {}\n",
        args.output.display(),
        report_path.display(),
        plot_path.display()
    ))?;
    Ok(Ended::Complete)
}

fn camera_of(args: &Args, recording: Option<&Recording>) -> anyhow::Result<CameraModel> {
    match (&args.camera, recording.and_then(|recording| recording.camera.clone())) {
        (Some(path), _) => Ok(file::read(path)?),
        (None, Some(camera)) => Ok(camera),
        (None, None) => Err(UsageError(
            "expected --camera FILE or a recording with camera.yaml; `endofield calibrate camera` makes it".into(),
        )
        .into()),
    }
}

/// Where the hand was at each picture.
#[derive(Debug)]
enum Hands {
    /// As told, one a picture.
    Told(Vec<Transform<RobotBase, Hand>>),
    /// Read from the arm's path when the picture was exposed.
    Timed { arm: PoseBuffer, instants: Vec<Timestamp> },
    /// Read from joint values.
    Jointed {
        arm: Arm,
        samples: Vec<JointSample>,
        instants: Vec<Timestamp>,
    },
}

impl Hands {
    /// Only these pictures.
    fn kept(self, pictures: &[usize]) -> Self {
        let of = |instants: Vec<Timestamp>| pictures.iter().map(|&picture| instants[picture]).collect();
        match self {
            Self::Told(poses) => Self::Told(pictures.iter().map(|&picture| poses[picture]).collect()),
            Self::Timed { arm, instants } => Self::Timed {
                arm,
                instants: of(instants),
            },
            Self::Jointed { arm, samples, instants } => Self::Jointed {
                arm,
                samples,
                instants: of(instants),
            },
        }
    }
}

impl HandPoses for Hands {
    fn base_from_hand(&self, view: usize, offset_s: f64, offsets: &[f64]) -> Option<Transform<RobotBase, Hand>> {
        let offset = Span::from_seconds(offset_s);
        match self {
            Self::Told(poses) => poses.get(view).copied(),
            Self::Timed { arm, instants } => arm
                .pose_at(*instants.get(view)? - offset)
                .ok()
                .map(|found| found.base_from_hand),
            Self::Jointed { arm, samples, instants } => {
                let mut values = joints_at(samples, *instants.get(view)? - offset)?;
                for (value, offset) in values.iter_mut().zip(offsets) {
                    *value += offset;
                }
                arm.base_from_hand(&values).ok()
            }
        }
    }

    fn joints(&self) -> usize {
        match self {
            Self::Jointed { arm, .. } => arm.joints().len(),
            _ => 0,
        }
    }
}

/// Joint values between two samples.
fn joints_at(samples: &[JointSample], at: Timestamp) -> Option<Vec<f64>> {
    let after = samples.partition_point(|sample| sample.stamp <= at);
    let before = samples.get(after.checked_sub(1)?)?;
    let Some(next) = samples.get(after) else {
        return (before.stamp == at).then(|| before.values.clone());
    };
    let t = (at - before.stamp).seconds() / (next.stamp - before.stamp).seconds();
    Some(
        (before.values.iter().zip(&next.values))
            .map(|(a, b)| a + t * (b - a))
            .collect(),
    )
}

/// Standard deviations of joint offsets: none if they are not looked for.
fn joint_sigmas(hands: &Hands, degrees: f64) -> Vec<f64> {
    use crate::robot::kinematics::JointKind;
    match hands {
        Hands::Jointed { arm, .. } if degrees > 0.0 => (arm.joints().iter())
            .map(|joint| match joint.kind {
                JointKind::Prismatic => 10.0 * degrees,
                JointKind::Revolute => degrees.to_radians(),
            })
            .collect(),
        _ => Vec::new(),
    }
}

fn of_recording(
    args: &Args,
    recording: &Recording,
    seen: &[Seen<Option<Detection>>],
    context: &Context,
) -> anyhow::Result<Hands> {
    let folder = args.recording.as_deref().unwrap_or(std::path::Path::new("."));
    let times = recording.frame_times.as_ref().with_context(|| {
        format!(
            "{}: expected frames.csv with each frame's exposure time on the arm's clock, found none",
            folder.display()
        )
    })?;
    let instants = seen
        .iter()
        .map(|seen| {
            let number = usize::try_from(seen.frame).unwrap_or(usize::MAX);
            times
                .get(number)
                .copied()
                .with_context(|| format!("frames.csv: no line for frame {}", seen.frame))
        })
        .collect::<anyhow::Result<Vec<Timestamp>>>()?;
    let joints = folder.join("joints.csv");
    if let Some(path) = &args.arm {
        let arm = Arm::read(path)?;
        let samples = arm.read_joint_samples(&joints)?;
        return Ok(Hands::Jointed { arm, samples, instants });
    }
    let trajectory = recording
        .trajectory
        .as_ref()
        .with_context(|| format!("{}: expected poses.tum or joints.csv, found none", folder.display()))?;
    Ok(Hands::Timed {
        arm: PoseBuffer::from_trajectory(trajectory, &context.config.poses)?,
        instants,
    })
}

fn of_files(args: &Args, pictures: usize) -> anyhow::Result<Hands> {
    let hands: Vec<Transform<RobotBase, Hand>> = poses(&args.poses, pictures, "--poses")?;
    if args.board_poses.is_empty() {
        return Ok(Hands::Told(hands));
    }
    let boards: Vec<Transform<RobotBase, RobotBase>> = poses(&args.board_poses, pictures, "--board-poses")?;
    Ok(Hands::Told(
        boards
            .iter()
            .zip(&hands)
            .map(|(board, hand)| board.inverse() * *hand)
            .collect(),
    ))
}

/// One pose a picture.
fn poses<To, From>(files: &[PathBuf], pictures: usize, option: &str) -> anyhow::Result<Vec<Transform<To, From>>> {
    let found: Vec<_> = pose_files::read(files)?.into_iter().map(|(_, pose)| pose).collect();
    if found.len() != pictures {
        return Err(UsageError(format!(
            "{option}: expected a pose for each of {pictures} pictures, found {}",
            found.len()
        ))
        .into());
    }
    Ok(found)
}

/// Pictures with a board and a hand, their names, and the rest with the reason.
fn matched(
    seen: &[Seen<Option<Detection>>],
    camera: &CameraModel,
    hands: Hands,
) -> (Vec<StationView>, Hands, Vec<String>, Vec<String>) {
    let (mut views, mut kept, mut names, mut without) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let offsets = vec![0.0; hands.joints()];
    for (picture, seen) in seen.iter().enumerate() {
        let Some(detection) = seen
            .found
            .as_ref()
            .filter(|detection| detection.corners.len() >= LEAST_CORNERS)
        else {
            without.push(format!("{} (no board)", seen.name));
            continue;
        };
        let Some(pose) = board_pose(camera, &detection.corners) else {
            without.push(format!("{} (the board's pose cannot be told)", seen.name));
            continue;
        };
        if hands.base_from_hand(picture, 0.0, &offsets).is_none() {
            without.push(format!("{} (no pose of the arm)", seen.name));
            continue;
        }
        let sightings = detection.corners.iter().map(|corner| Sighting {
            corner: corner.board,
            pixel: corner.pixel,
        });
        views.push(StationView {
            camera_from_board: pose.camera_from_board,
            sightings: sightings.collect(),
        });
        kept.push(picture);
        names.push(seen.name.clone());
    }
    (views, hands.kept(&kept), names, without)
}

/// What each view saw, and where the arm alone puts it.
fn drawn(refined: &Refined, views: &[StationView], hands: &Hands, camera: &CameraModel, report: &Report) -> Vec<Drawn> {
    let offsets: Vec<f64> = refined.joint_offsets.iter().map(|offset| offset[0]).collect();
    let offsets = if offsets.is_empty() {
        vec![0.0; hands.joints()]
    } else {
        offsets
    };
    (views.iter().zip(&report.views).enumerate())
        .map(|(view, (seen, told))| {
            let hand = hands.base_from_hand(view, refined.time_offset_s[0], &offsets);
            let camera_from_board = hand.map(|hand| (hand * refined.hand_from_camera).inverse() * refined.base_from_board);
            let corners = seen.sightings.iter().map(|sighting| {
                let predicted = camera_from_board.and_then(|pose| camera.project(pose * sighting.corner));
                (sighting.pixel, predicted)
            });
            Drawn {
                corners: corners.collect(),
                predicted_px: told.predicted_px,
                left_out_px: told.left_out_px,
                outlier: told.wrong,
            }
        })
        .collect()
}
