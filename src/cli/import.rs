//! `light-field import`: a recording from a video and the camera poses that structure from motion found for some of its frames.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};

use crate::camera::file as camera_file;
use crate::camera::model::CameraModel;
use crate::cli::context::UsageError;
use crate::geometry::transform::Transform;
use crate::image::pool::Pool;
use crate::light_field::colmap::{ColmapModel, model_folder};
use crate::light_field::error::LightFieldError;
use crate::light_field::{file, pose_list};
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress;
use crate::robot::densify::densified;
use crate::robot::hand_eye::HandEye;
use crate::robot::trajectory::{TimedPose, Trajectory};
use crate::time::{Span, Timestamp};

/// Over a longer step a scope moved by hand may have been anywhere.
const LONGEST_STEP: Span = Span(600_000_000);

/// Make a recording of a video and the camera poses that structure from motion (COLMAP) found for some of its frames.
///
/// The poses are carried to the frames between two posed ones up to 0.6 s apart. The recording is then used as any other.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  endofield light-field import poses_colmap.json --video endo.mp4 -o clip\n  \
    endofield light-field build clip -o clip.lf\n  endofield process clip -o enhanced.mp4 --light-field clip.lf\n\n\
    A COLMAP model's folder (sparse/, with pictures named by their frame's number) does as well as a list in JSON."
)]
pub struct Args {
    /// Poses: a JSON list (camera, and world_to_cam per video_frame), or the folder of a COLMAP model.
    poses: PathBuf,
    /// The video that the poses belong to.
    #[arg(long, value_name = "FILE")]
    video: PathBuf,
    /// The recording to make: a folder.
    #[arg(short, long, value_name = "RECORDING")]
    output: PathBuf,
    /// Structure from motion knows no lengths: the poses are scaled so that the scene's points lie so far away in the median.
    #[arg(long, value_name = "MM", default_value_t = 80.0)]
    scene_depth_mm: f64,
    /// Length of the poses' unit, where it is known; wins over --scene-depth-mm.
    #[arg(long, value_name = "MM")]
    unit_mm: Option<f64>,
    /// The number that the poses give to the video's first frame.
    #[arg(long, value_name = "N", default_value_t = 0)]
    first_frame: u32,
}

/// Run it; with `force`, what is there is overwritten.
pub fn run(args: &Args, force: bool, progress: &dyn Progress) -> anyhow::Result<()> {
    for (option, value) in [("--scene-depth-mm", Some(args.scene_depth_mm)), ("--unit-mm", args.unit_mm)] {
        if let Some(value) = value.filter(|value| !value.is_finite() || *value <= 0.0) {
            bail!(UsageError(format!("{option}: expected a length above 0 mm, found {value}")));
        }
    }
    super::light_field::refuse_overwriting(&args.output, force)?;
    let model = read_model(&args.poses)?;
    let camera = only_camera(&model, &args.poses)?;
    let unit_mm = match args.unit_mm {
        Some(unit_mm) => unit_mm,
        None => args.scene_depth_mm / median_depth(&model, &args.poses)?,
    };
    let stamps = frame_stamps(&args.video, &camera, progress)?;
    let known = timed_poses(&model, args, unit_mm, &stamps)?;
    let poses = densified(&known, &stamps, LONGEST_STEP);
    let without = stamps.len() - poses.len();
    let said = format!(
        "{} of {} frames have a pose from structure from motion, {} one between two of those, {without} none",
        known.len(),
        stamps.len(),
        poses.len() - known.len(),
    );
    let Some(trajectory) = Trajectory::new(poses) else {
        bail!("{}: expected poses of the video's frames, found none", args.poses.display());
    };

    fs::create_dir_all(&args.output).with_context(|| format!("cannot make {}", args.output.display()))?;
    place_video(&args.video, &args.output)?;
    trajectory.write(&args.output.join("poses.tum"))?;
    camera_file::write(&args.output.join("camera.yaml"), &camera, "structure_from_motion")?;
    // The poses are the camera's own, so that the hand is the camera; and one clock stamps both.
    let mut hand_eye = HandEye::new(Transform::identity());
    hand_eye.time_offset = Some(Span(0));
    hand_eye.write(&args.output.join("hand_eye.yaml"))?;
    tracing::info!("{said}");
    if args.unit_mm.is_none() {
        tracing::warn!(
            "the true scale is unknown: the poses' unit is taken as {unit_mm:.4} mm, so that the scene lies {} mm away in the median \
             (--unit-mm if you know better); lengths in mm mean no more than that",
            args.scene_depth_mm
        );
    }
    tracing::info!("recording in {}", args.output.display());
    Ok(())
}

fn read_model(path: &Path) -> anyhow::Result<ColmapModel> {
    let model = if path.is_dir() {
        let folder = model_folder(path).ok_or_else(|| LightFieldError::NotALightField(path.to_path_buf()))?;
        ColmapModel::read(&folder)?
    } else {
        pose_list::read(path)?
    };
    if model.images.len() < 2 {
        bail!(
            "{}: expected poses of at least 2 frames, found {}",
            path.display(),
            model.images.len()
        );
    }
    Ok(model)
}

/// One video has one camera.
fn only_camera(model: &ColmapModel, path: &Path) -> anyhow::Result<CameraModel> {
    let mut used = model.images.iter().map(|image| image.camera_id);
    let first = used.next().unwrap_or_default();
    match model.cameras.get(&first) {
        Some(camera) if used.all(|id| id == first) => Ok(camera.clone()),
        _ => bail!(
            "{}: expected one camera for all frames, found several; run COLMAP's feature_extractor with --ImageReader.single_camera 1",
            path.display()
        ),
    }
}

/// Of all points in front of all cameras, in the model's unit.
fn median_depth(model: &ColmapModel, path: &Path) -> anyhow::Result<f64> {
    let mut depths: Vec<f64> = (model.images.iter())
        .flat_map(|image| {
            let camera_from_world = image.world_from_camera.inverse();
            let every = model.points.iter().step_by(1 + model.points.len() / 2000);
            every.map(move |point| (camera_from_world * point.position).coords.z)
        })
        .filter(|depth| depth.is_finite() && *depth > 0.0)
        .collect();
    depths.sort_by(f64::total_cmp);
    depths.get(depths.len() / 2).copied().ok_or_else(|| {
        anyhow::anyhow!(
            "{}: expected scene points to tell the scale by (points3D.txt or .bin in a model, sparse_points.csv beside a list), \
             found none; give --unit-mm",
            path.display()
        )
    })
}

/// When each frame of the video is shown; the frames are counted by decoding, since containers lie.
fn frame_stamps(video: &Path, camera: &CameraModel, progress: &dyn Progress) -> anyhow::Result<Vec<Timestamp>> {
    let mut reader = VideoReader::open(&Input::from_argument(video))?;
    let info = reader.info();
    if (info.width, info.height) != (camera.width, camera.height) {
        bail!(
            "{}: expected {}x{} as the poses' camera says, found {}x{}; give the video that the poses were made from",
            video.display(),
            camera.width,
            camera.height,
            info.width,
            info.height
        );
    }
    progress.begin("count the frames", info.frame_count.unwrap_or(0));
    let pool = Pool::new(2);
    let mut stamps = Vec::new();
    while let Some(frame) = reader.next_frame(&pool)? {
        if progress.stopping() {
            bail!("stopped before it was done");
        }
        stamps.push(frame.timestamp);
        progress.advance(1);
    }
    progress.end();
    Ok(stamps)
}

fn timed_poses(model: &ColmapModel, args: &Args, unit_mm: f64, stamps: &[Timestamp]) -> anyhow::Result<Vec<TimedPose>> {
    let mut by_frame = BTreeMap::new();
    for image in &model.images {
        let number = file::number_in(&image.name)
            .with_context(|| format!("{}: expected a name with the frame's number, such as 000123.png", image.name))?;
        let stamp = (number.checked_sub(args.first_frame)).and_then(|index| stamps.get(index as usize));
        let Some(&stamp) = stamp else {
            bail!(
                "{}: expected frames {} to {} as in {}, found frame {number}; is it the right video, and is --first-frame right?",
                args.poses.display(),
                args.first_frame,
                args.first_frame as usize + stamps.len().saturating_sub(1),
                args.video.display()
            );
        };
        let pose = &image.world_from_camera;
        let base_from_hand = Transform::new(pose.rotation(), pose.translation() * unit_mm);
        if by_frame.insert(number, TimedPose { stamp, base_from_hand }).is_some() {
            bail!(
                "{}: expected one pose for each frame, found two for frame {number}",
                args.poses.display()
            );
        }
    }
    Ok(by_frame.into_values().collect())
}

/// The video under the name that a recording gives it: a second name for the same file where the disk allows, else a copy.
fn place_video(video: &Path, folder: &Path) -> anyhow::Result<()> {
    let from = video
        .canonicalize()
        .with_context(|| format!("cannot read {}", video.display()))?;
    if from.is_dir() {
        bail!("{}: expected a video file, found a folder", video.display());
    }
    let extension = from
        .extension()
        .map(|e| e.to_string_lossy().into_owned())
        .unwrap_or_else(|| "mp4".into());
    let to = folder.join(format!("video.{extension}"));
    if to.canonicalize().is_ok_and(|there| there == from) {
        return Ok(());
    }
    if to.exists() {
        fs::remove_file(&to).with_context(|| format!("cannot replace {}", to.display()))?;
    }
    if fs::hard_link(&from, &to).is_err() {
        fs::copy(&from, &to).with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))?;
    }
    Ok(())
}
