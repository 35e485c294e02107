//! `calibrate hand-eye`: how the camera sits on the arm, from a board seen from many stations.

use std::path::{Path, PathBuf};

use crate::calibration::board::detection::{Detection, detect};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::camera::pose::board_pose;
use crate::calibration::hand_eye::calibrate::{StationView, calibrate};
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::plot::{self, Drawn};
use crate::calibration::hand_eye::refinement::{Refined, Settings};
use crate::calibration::hand_eye::reprojection::Sighting;
use crate::camera::file;
use crate::camera::model::CameraModel;
use crate::cli::calibrate::hand_eye_camera::{self, CameraChange, Known};
use crate::cli::calibrate::hand_eye_report::{Report, listed};
use crate::cli::calibrate::hand_eye_scene;
use crate::cli::calibrate::hands::{Hands, joint_sigmas};
use crate::cli::calibrate::pictures::{Seen, look_at_all};
use crate::cli::calibrate::pose_files;
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::media::image_files;
use crate::recording::folder::Recording;
use crate::robot::hand_eye::HandEye;
use crate::time::Span;

/// Corners that a view must show.
const LEAST_CORNERS: usize = 6;

/// Measure how the camera sits on the arm's hand.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  endofield calibrate hand-eye stations/ --camera camera.yaml --board checkerboard:9x6 --square-mm 4
  endofield calibrate hand-eye survey/
  endofield calibrate hand-eye --images left_*.png --poses hand_*.txt --board-poses board_*.txt \\
      --camera camera.yaml --board checkerboard:13x8 --square-mm 3 -o hand_eye.yaml

Rest the arm at ten to thirty stations before a board that lies still; tilt the scope by 20° and more to all sides and roll it.
Without a board, a survey of any still scene with texture will do; the answer is less sure.
Beside hand_eye.yaml are written hand_eye_report.json and hand_eye_report.png, with --refine-camera also hand_eye_camera.yaml.")]
pub struct Args {
    /// A recording: pictures, frames.csv, and poses.tum or joints.csv.
    #[arg(required_unless_present = "images", conflicts_with = "images")]
    pub(super) recording: Option<PathBuf>,
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
    pub(super) camera: Option<PathBuf>,
    /// The board, such as checkerboard:9x6 (as in calibrate camera); without it, the recording's own scene must do, and be still.
    #[arg(long, requires = "square_mm", required_unless_present = "recording")]
    board: Option<String>,
    /// Side of a square or distance of dots, mm.
    #[arg(long, value_name = "MM", requires = "board")]
    square_mm: Option<f64>,
    /// Frames looked at, of a recording.
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u32).range(3..=200))]
    pub(super) frames: u32,
    /// The arm's kinematics, to read joints.csv with; with it constant joint offsets can be found.
    #[arg(long, value_name = "FILE")]
    pub(super) arm: Option<PathBuf>,
    /// How far joints may be off constantly, degrees (mm for a slide at ten times the number); 0 does not look for offsets.
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    joint_offsets_deg: f64,
    /// Adjust the camera too, within what camera_report.json beside its file says of it (else 1 %), and let the answer's deviations allow
    /// for its doubt; needs a board.
    #[arg(long)]
    pub(super) refine_camera: bool,
    /// Hand-eye file to write.
    #[arg(short, long, default_value = "hand_eye.yaml", value_name = "FILE")]
    pub(super) output: PathBuf,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let (Some(board), Some(square_mm)) = (&args.board, args.square_mm) else {
        return hand_eye_scene::run(args, context);
    };
    let layout = BoardLayout::new(board, square_mm).map_err(|error| UsageError(error.to_string()))?;
    let [report_path, plot_path] = ["_report.json", "_report.png"].map(|ending| super::beside(&args.output, ending));
    let refined_path = super::beside(&args.output, "_camera.yaml");
    for path in [&args.output, &report_path, &plot_path]
        .into_iter()
        .chain(args.refine_camera.then_some(&refined_path))
    {
        context.refuse_overwriting(path)?;
    }
    let recorded = args.recording.as_deref().map(Recording::open).transpose()?;
    let camera = camera_of(args, recorded.as_ref())?;
    let camera_file = (args.camera.clone())
        .or_else(|| Some(args.recording.as_ref()?.join("camera.yaml")))
        .unwrap_or_default();
    let known = (args.refine_camera).then(|| Known::of(&camera, &camera_file)).transpose()?;
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
        Some(recording) => {
            let folder = args.recording.as_deref().unwrap_or(Path::new("."));
            let frames: Vec<u64> = seen.iter().map(|seen| seen.frame).collect();
            Hands::of_recording((folder, recording), args.arm.as_deref(), &frames, context)?
        }
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
        camera_prior: known.as_ref().map(|known| known.prior.clone()),
        ..Settings::default()
    };
    let refined = calibrate(&views, &hands, &camera, &settings)?;
    let change = known.and_then(|known| CameraChange::new(&refined, &camera, &known));
    let report = Report::new(&refined, &views, &hands, &camera, &settings, &names, without, change);
    let hand_eye = HandEye {
        time_offset: settings.time_offset.then(|| Span::from_seconds(refined.time_offset_s[0])),
        covariance: Some(refined.covariance),
        ..HandEye::new(refined.hand_from_camera)
    };
    hand_eye.write(&args.output)?;
    super::write_json(&report_path, &serde_json::to_value(&report)?)?;
    let drawn = drawn(&refined, &views, &hands, &report);
    image_files::write(&plot_path, &plot::drawn((camera.width, camera.height), &drawn))?;
    let mut written: Vec<&Path> = vec![&args.output, &report_path, &plot_path];
    if args.refine_camera {
        hand_eye_camera::write(&refined_path, &refined.camera, &camera_file)?;
        written.push(&refined_path);
    }
    console::print(&report.table())?;
    super::say_written(&written)?;
    Ok(Ended::Complete)
}

pub(super) fn camera_of(args: &Args, recording: Option<&Recording>) -> anyhow::Result<CameraModel> {
    match (&args.camera, recording.and_then(|recording| recording.camera.clone())) {
        (Some(path), _) => Ok(file::read(path)?),
        (None, Some(camera)) => Ok(camera),
        (None, None) => Err(UsageError(
            "expected --camera FILE or a recording with camera.yaml; `endofield calibrate camera` makes it".into(),
        )
        .into()),
    }
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
        if hands.as_told(picture, 0.0).is_none() {
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
fn drawn(refined: &Refined, views: &[StationView], hands: &Hands, report: &Report) -> Vec<Drawn> {
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
                let predicted = camera_from_board.and_then(|pose| refined.camera.project(pose * sighting.corner));
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
