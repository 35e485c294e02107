//! `calibrate hand-eye`: how the camera sits on the arm, from a board seen from many stations.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use nalgebra::Matrix4;
use serde::Serialize;

use crate::calibration::board::detection::{Detection, detect};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::camera::pose::board_pose;
use crate::calibration::hand_eye::calibrate::{Held, StationView, calibrate, leave_out, stations};
use crate::calibration::hand_eye::method::METHODS;
use crate::calibration::hand_eye::refinement::{HandPoses, Refined, Settings, Sighting};
use crate::camera::file;
use crate::camera::model::CameraModel;
use crate::cli::calibrate::pictures::{Seen, look_at_all};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::recording::folder::Recording;
use crate::robot::hand_eye::HandEye;
use crate::robot::kinematics::{Arm, JointSample};
use crate::robot::pose_buffer::PoseBuffer;
use crate::robot::trajectory::TumFile;
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
    let report_path = super::beside(&args.output, "_report.json");
    for path in [&args.output, &report_path] {
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
    console::print(&report.table())?;
    console::print(&format!("\nwrote {} and {}\n", args.output.display(), report_path.display()))?;
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
    let folder = args.recording.as_deref().unwrap_or(Path::new("."));
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

/// One pose a picture, from as many matrices or from one TUM file.
fn poses<To, From>(files: &[PathBuf], pictures: usize, option: &str) -> anyhow::Result<Vec<Transform<To, From>>> {
    let of_tum = |path: &Path| -> anyhow::Result<Vec<Transform<To, From>>> {
        let file = TumFile::read(path)?;
        Ok(file.poses.iter().map(|(_, pose)| Transform::from_isometry(*pose)).collect())
    };
    let found = match files {
        [one] if one.extension().is_some_and(|ending| ending == "tum") => of_tum(one)?,
        files => files.iter().map(|path| matrix(path)).collect::<anyhow::Result<_>>()?,
    };
    if found.len() != pictures {
        return Err(UsageError(format!(
            "{option}: expected a pose for each of {pictures} pictures, found {}",
            found.len()
        ))
        .into());
    }
    Ok(found)
}

/// A pose as sixteen numbers, row by row.
fn matrix<To, From>(path: &Path) -> anyhow::Result<Transform<To, From>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let numbers: Vec<f64> = (text.split(|c: char| c.is_whitespace() || c == ',' || c == ';'))
        .filter_map(|word| word.parse().ok())
        .collect();
    anyhow::ensure!(
        numbers.len() == 16 && numbers.iter().all(|n| n.is_finite()),
        "{}: expected a 4×4 matrix (16 numbers), found {} numbers",
        path.display(),
        numbers.len()
    );
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    anyhow::ensure!(
        (rotation * rotation.transpose() - nalgebra::Matrix3::identity()).norm() < 0.01 && rotation.determinant() > 0.0,
        "{}: expected a rotation in the matrix's upper left, found none (determinant {:.3})",
        path.display(),
        rotation.determinant()
    );
    Ok(Transform::from_matrix(
        &rotation,
        matrix.fixed_view::<3, 1>(0, 3).into_owned(),
    ))
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

fn listed(names: &[String]) -> String {
    const MOST: usize = 4;
    let shown = names.iter().take(MOST).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > MOST {
        format!("{shown} and {} more", names.len() - MOST)
    } else {
        shown
    }
}

#[derive(Debug, Serialize)]
struct View {
    name: String,
    corners: usize,
    /// What the arm alone predicts, RMS px.
    predicted_px: f64,
    /// Correction of the hand: shift mm, turn degrees.
    correction_mm: f64,
    correction_deg: f64,
    /// Square of the correction in deviations that the middle station tells: about 6 for one like the others.
    distance: f64,
    /// Not heard: the arm was not where it said.
    wrong: bool,
    /// Predicted from a calibration on the others.
    left_out_px: Option<f64>,
    left_out_mm: Option<f64>,
}

#[derive(Debug, Serialize)]
struct Compared {
    method: &'static str,
    /// Difference to the joint refinement.
    off_mm: Option<f64>,
    off_deg: Option<f64>,
    /// Mean and median over views left out.
    left_out_px: Option<[f64; 2]>,
    left_out_mm: Option<[f64; 2]>,
}

#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    translation_mm: [f64; 3],
    rotation_xyzw: [f64; 4],
    sigma_mm: [f64; 3],
    sigma_deg: [f64; 3],
    base_from_board_mm: [f64; 3],
    rms_px: f64,
    arm_sigma_mm: f64,
    arm_sigma_deg: f64,
    corner_sigma_px: f64,
    time_offset_ms: Option<[f64; 2]>,
    joint_offsets: Vec<[f64; 2]>,
    views: Vec<View>,
    methods: Vec<Compared>,
    left_out_pictures: Vec<String>,
    warnings: Vec<String>,
}

impl Report {
    fn new(
        refined: &Refined,
        views: &[StationView],
        hands: &Hands,
        camera: &CameraModel,
        settings: &Settings,
        names: &[String],
        left_out_pictures: Vec<String>,
    ) -> Self {
        let held = leave_out(views, hands, camera, settings, None);
        let x = refined.hand_from_camera;
        let q = x.rotation();
        let deviation = |i: usize| refined.covariance[(i, i)].max(0.0).sqrt();
        let reports: Vec<View> = (names.iter().enumerate())
            .map(|(view, name)| View {
                name: name.clone(),
                corners: views[view].sightings.len(),
                predicted_px: refined.predicted_px[view],
                correction_mm: refined.corrections[view].fixed_rows::<3>(0).norm(),
                correction_deg: refined.corrections[view].fixed_rows::<3>(3).norm().to_degrees(),
                distance: refined.distance[view],
                wrong: refined.outlier[view],
                left_out_px: held[view].map(|held| held.rms_px),
                left_out_mm: held[view].map(|held| held.board_mm),
            })
            .collect();
        let stations = stations(views, hands);
        let mut methods: Vec<Compared> = vec![compared("joint refinement", Some(x), &x, &held)];
        methods.extend(METHODS.iter().map(|&method| {
            let held = leave_out(views, hands, camera, settings, Some(method));
            compared(method.name(), method.solve(&stations), &x, &held)
        }));
        let mut warnings = Vec::new();
        let wrong: Vec<String> = reports
            .iter()
            .filter(|view| view.wrong)
            .map(|view| view.name.clone())
            .collect();
        if !wrong.is_empty() {
            warnings.push(format!("the arm was not where it said at {}: not used", listed(&wrong)));
        }
        if views.len() < 8 {
            warnings.push(format!("only {} stations: ten to thirty make the answer sure", views.len()));
        }
        if (0..3).any(|axis| deviation(axis) > 1.0) {
            warnings
                .push("the camera's place is unsure by more than 1 mm: add stations, tilted farther and about other axes".into());
        }
        Self {
            version: env!("CARGO_PKG_VERSION"),
            translation_mm: x.translation().into(),
            rotation_xyzw: [q.i, q.j, q.k, q.w],
            sigma_mm: std::array::from_fn(deviation),
            sigma_deg: std::array::from_fn(|axis| deviation(axis + 3).to_degrees()),
            base_from_board_mm: refined.base_from_board.translation().into(),
            rms_px: refined.rms_px,
            arm_sigma_mm: refined.sigmas[0],
            arm_sigma_deg: refined.sigmas[1].to_degrees(),
            corner_sigma_px: refined.sigmas[2],
            time_offset_ms: settings.time_offset.then(|| refined.time_offset_s.map(|s| 1000.0 * s)),
            joint_offsets: refined.joint_offsets.clone(),
            views: reports,
            methods,
            left_out_pictures,
            warnings,
        }
    }

    fn table(&self) -> String {
        let mut text = String::new();
        let [x, y, z] = self.translation_mm;
        let [sx, sy, sz] = self.sigma_mm;
        let [rx, ry, rz] = self.sigma_deg;
        // Writing to a String cannot fail.
        let _ = writeln!(text, "hand_from_camera, {} stations", self.views.len());
        let _ = writeln!(text, "  translation   {x:.3} {y:.3} {z:.3} mm  (± {sx:.3} {sy:.3} {sz:.3})");
        let [qx, qy, qz, qw] = self.rotation_xyzw;
        let _ = writeln!(
            text,
            "  rotation      {qx:.5} {qy:.5} {qz:.5} {qw:.5} xyzw  (± {rx:.3} {ry:.3} {rz:.3}°)"
        );
        if let Some([offset, sigma]) = self.time_offset_ms {
            let _ = writeln!(
                text,
                "  time offset   {offset:.1} ms  (± {sigma:.1}), added to the arm's stamps"
            );
        }
        for (joint, [offset, sigma]) in self.joint_offsets.iter().enumerate() {
            let _ = writeln!(text, "  joint {}       {offset:.5} (± {sigma:.5}) mm or rad", joint + 1);
        }
        let _ = writeln!(
            text,
            "  arm's noise   {:.3} mm, {:.4}° a station; corners {:.3} px; RMS {:.3} px with the stations corrected",
            self.arm_sigma_mm, self.arm_sigma_deg, self.corner_sigma_px, self.rms_px
        );
        let _ = writeln!(
            text,
            "\n  station                        corners  arm alone  correction     distance  left out"
        );
        for view in &self.views {
            let held = match (view.left_out_px, view.left_out_mm) {
                (Some(px), Some(mm)) => format!("{px:.2} px {mm:.2} mm"),
                _ => "–".to_owned(),
            };
            let _ = writeln!(
                text,
                "  {:<30} {:>7}  {:>6.2} px  {:.2} mm {:>6.3}° {:>7.1}  {held}{}",
                view.name,
                view.corners,
                view.predicted_px,
                view.correction_mm,
                view.correction_deg,
                view.distance.sqrt(),
                if view.wrong { "  WRONG" } else { "" }
            );
        }
        let _ = writeln!(
            text,
            "\n  method             differs by           stations left out, mean (median)"
        );
        for method in &self.methods {
            let off = match (method.off_mm, method.off_deg) {
                (Some(mm), Some(deg)) => format!("{mm:.3} mm {deg:.3}°"),
                _ => "no answer".to_owned(),
            };
            let held = match (method.left_out_px, method.left_out_mm) {
                (Some([px, middle_px]), Some([mm, middle_mm])) => {
                    format!("{px:.3} ({middle_px:.3}) px {mm:.3} ({middle_mm:.3}) mm")
                }
                _ => "–".to_owned(),
            };
            let _ = writeln!(text, "  {:<18} {off:<20} {held}", method.method);
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  ! {warning}");
        }
        text
    }
}

fn compared(
    method: &'static str,
    found: Option<Transform<Hand, crate::geometry::space::Camera>>,
    reference: &Transform<Hand, crate::geometry::space::Camera>,
    held: &[Option<Held>],
) -> Compared {
    let summed = |of: &dyn Fn(&Held) -> f64| {
        let values: Option<Vec<f64>> = held.iter().map(|held| held.as_ref().map(of)).collect();
        let mut values = values.filter(|values| !values.is_empty())?;
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        let median = 0.5 * (values[middle] + values[(values.len() - 1) / 2]);
        Some([values.iter().sum::<f64>() / values.len() as f64, median])
    };
    Compared {
        method,
        off_mm: found.map(|found| (found.translation() - reference.translation()).norm()),
        off_deg: found.map(|found| found.rotation().angle_to(&reference.rotation()).to_degrees()),
        left_out_px: summed(&|held| held.rms_px),
        left_out_mm: summed(&|held| held.board_mm),
    }
}
