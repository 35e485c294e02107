//! The camera's path through stretches of a recording, as the pictures tell it: structure from motion, in which the arm has hardly a say.

use anyhow::Context as _;
use rayon::prelude::*;

use crate::calibration::time_offset::camera_path::{CameraPath, PosedPicture};
use crate::camera::model::CameraModel;
use crate::cli::context::Context;
use crate::geometry::space::{Camera, Hand, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Rgb8};
use crate::image::pool::Pool;
use crate::image::reduction::{mean_of_squares, reduction_to};
use crate::light_field::build;
use crate::light_field::survey::{self, PosePrior, SurveyError, SurveyFrame};
use crate::media::reader::{Input, VideoReader};
use crate::progress::{Progress as _, Silent};
use crate::recording::folder::Recording;
use crate::robot::pose_buffer::PoseBuffer;
use crate::time::{Span, Timestamp};

/// Pictures are looked at about this wide: corners are found to a tenth of a px, and some hundreds of them tell a turn a hundred times
/// better than an arm does, px.
const WIDTH_PX: f32 = 960.0;
/// Between two views, ms: a scope's path is smooth over that.
const STEP_MS: f64 = 58.0;
const MOST_STEP_MS: f64 = 90.0;
/// Views of a stretch at most.
const MOST_VIEWS: usize = 90;
/// Stretches of a long recording.
const MOST_STRETCHES: usize = 3;
/// Fewer views make no path.
const FEWEST_VIEWS: usize = 12;
/// At first the arm only keeps the whole from floating: were it trusted, the path would be its own, at whatever offset was assumed.
pub const HARDLY: Trust = Trust {
    mm: 6.0,
    rad: 0.04,
    offset_doubt_ms: 60.0,
    offset_range_ms: 150.0,
};

/// How far the arm has a say in the camera's path.
#[derive(Clone, Copy, Debug)]
pub struct Trust {
    /// Deviation of its place per axis, mm.
    pub mm: f64,
    /// Of its turn per axis, rad.
    pub rad: f64,
    /// Doubt about the offset, ms: along the path, the arm is trusted less by as far as it moves in that time.
    pub offset_doubt_ms: f64,
    /// How far around the offset given another may be better, ms.
    pub offset_range_ms: f64,
}

impl Trust {
    /// As far as it errs, but along the path not at all: it straightens what the pictures leave loose, and has no say in the offset.
    pub fn across([mm, rad]: [f64; 2]) -> Self {
        Self {
            mm: mm.clamp(0.02, HARDLY.mm),
            rad: rad.clamp(1e-4, HARDLY.rad),
            offset_doubt_ms: 300.0,
            offset_range_ms: 0.0,
        }
    }
}

/// Which corners are followed: with others, the errors of the path are others.
#[derive(Clone, Copy, Debug)]
pub struct Corners {
    /// Views whose corners are taken.
    pub anchors: usize,
    /// Cells along the picture, each with one corner.
    pub cells: usize,
}

/// Two choices that have little in common.
pub const CORNERS: [Corners; 2] = [Corners { anchors: 14, cells: 16 }, Corners { anchors: 9, cells: 21 }];

/// The arm, as far as it is trusted.
struct TrustedArm<'a> {
    arm: &'a PoseBuffer,
    hand_from_camera: Transform<Hand, Camera>,
    trust: Trust,
}

impl PosePrior for TrustedArm<'_> {
    fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>> {
        let hand = self.arm.pose_at(at).ok()?.base_from_hand;
        Some(Transform::from_isometry(*(hand * self.hand_from_camera).isometry()))
    }

    fn sigma_mm(&self) -> f64 {
        self.trust.mm
    }

    fn sigma_rad(&self) -> f64 {
        self.trust.rad
    }
}

/// Pictures of stretches, undistorted and small, and the camera that explains them.
#[derive(Debug)]
pub struct Stretches {
    camera: CameraModel,
    /// In the order of time.
    pub views: Vec<Vec<SurveyFrame>>,
}

/// A camera's path and how well it fits its pictures.
#[derive(Debug)]
pub struct FoundPath {
    /// The path.
    pub path: CameraPath,
    /// Reprojection error, px of the pictures as they were looked at.
    pub error_px: f64,
}

impl Stretches {
    /// Of the stretches in which the arm moved most; `times` are the frames' exposures, `about` is the offset as far as it is known.
    pub fn fetched(
        recording: &Recording,
        camera: &CameraModel,
        arm: &PoseBuffer,
        times: &[Timestamp],
        about: Span,
        context: &Context,
    ) -> anyhow::Result<Self> {
        let chosen = chosen_frames(times, arm, about);
        let mut rest = fetched(recording, camera, &chosen, times, context)?;
        let mut views = Vec::new();
        for stretch in &chosen {
            let later = rest.split_off(stretch.len().min(rest.len()));
            views.push(std::mem::replace(&mut rest, later));
        }
        views.retain(|views| !views.is_empty());
        Ok(Self {
            camera: camera.reduced(reduction_to(camera.width, WIDTH_PX)).pinhole(),
            views,
        })
    }

    /// The camera's path through a stretch's views, beginning at where the arm was at `offset`.
    pub fn path(
        &self,
        views: &[SurveyFrame],
        arm: &PoseBuffer,
        hand_from_camera: Transform<Hand, Camera>,
        offset: Span,
        trust: Trust,
        corners: Corners,
    ) -> Result<FoundPath, SurveyError> {
        let prior = TrustedArm {
            arm,
            hand_from_camera,
            trust,
        };
        let settings = survey::Settings {
            known_time_offset_ms: Some(offset.milliseconds()),
            time_offset_range_ms: trust.offset_range_ms,
            time_offset_doubt_ms: trust.offset_doubt_ms,
            prior_smoothing_ms: 0.0,
            max_points: 800,
            anchors: corners.anchors,
            corner_cells: corners.cells,
            ..Default::default()
        };
        let refined = survey::refine(views, &self.camera, &prior, &settings, &Silent)?;
        let poses = views.iter().zip(&refined.world_from_camera);
        let posed = poses.filter_map(|(view, pose)| {
            Some(PosedPicture {
                at: view.exposed_at,
                world_from_camera: (*pose)?,
            })
        });
        Ok(FoundPath {
            path: CameraPath::new(posed.collect(), Span::from_milliseconds(2.5 * MOST_STEP_MS)),
            error_px: refined.report.refined_reprojection_px,
        })
    }
}

/// Numbers of the frames of each stretch, in the order of time.
fn chosen_frames(times: &[Timestamp], arm: &PoseBuffer, about: Span) -> Vec<Vec<usize>> {
    let (Some(first), Some(last)) = (times.first(), times.last()) else {
        return Vec::new();
    };
    let interval_ms = (*last - *first).milliseconds() / (times.len().max(2) - 1) as f64;
    let stride_for = |ms: f64| ((ms / interval_ms.max(0.1)).floor() as usize).max(1);
    // What fits into one stretch at a wider step is taken whole.
    let stride = (stride_for(STEP_MS)..=stride_for(MOST_STEP_MS))
        .find(|stride| times.len().div_ceil(*stride) <= MOST_VIEWS)
        .unwrap_or(stride_for(MOST_STEP_MS));
    let frames: Vec<usize> = (0..times.len()).step_by(stride).collect();
    let count = (frames.len() / MOST_VIEWS).clamp(1, MOST_STRETCHES);
    let length = frames.len().min(MOST_VIEWS);
    // How unevenly the hand moves over a stretch: what of its speed is not the mean.
    let speeds: Vec<Option<[f64; 6]>> = (frames.iter())
        .map(|&frame| {
            let pose = arm.pose_at(*times.get(frame)? - about).ok()?;
            let (v, w) = (pose.velocity_mm_s / HARDLY.mm, pose.angular_velocity_rad_s / HARDLY.rad);
            Some([v.x, v.y, v.z, w.x, w.y, w.z])
        })
        .collect();
    let telling = |start: usize| -> f64 {
        let known: Vec<&[f64; 6]> = speeds.iter().skip(start).take(length).flatten().collect();
        let mean: [f64; 6] =
            std::array::from_fn(|axis| known.iter().map(|speed| speed[axis]).sum::<f64>() / known.len().max(1) as f64);
        known
            .iter()
            .map(|speed| (0..6).map(|axis| (speed[axis] - mean[axis]).powi(2)).sum::<f64>())
            .sum()
    };
    let mut starts: Vec<(usize, f64)> = (0..=frames.len() - length)
        .step_by((length / 6).max(1))
        .map(|start| (start, telling(start)))
        .collect();
    starts.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut taken: Vec<usize> = Vec::new();
    for (start, _) in starts {
        if taken.len() < count && taken.iter().all(|other| other.abs_diff(start) >= length) {
            taken.push(start);
        }
    }
    taken.sort_unstable();
    (taken.into_iter())
        .map(|start| frames.iter().skip(start).take(length).copied().collect::<Vec<_>>())
        .filter(|stretch| stretch.len() >= FEWEST_VIEWS)
        .collect()
}

fn fetched(
    recording: &Recording,
    camera: &CameraModel,
    chosen: &[Vec<usize>],
    times: &[Timestamp],
    context: &Context,
) -> anyhow::Result<Vec<SurveyFrame>> {
    let wanted: Vec<usize> = chosen.iter().flatten().copied().collect();
    let step = reduction_to(camera.width, WIDTH_PX);
    let small = camera.reduced(step);
    let mut reader = VideoReader::open(&Input::from_argument(recording.video.path()))?;
    recording.check_video_size(reader.info().width, reader.info().height)?;
    let pool = Pool::<Rgb8>::new(4);
    let mut pictures: Vec<(usize, Timestamp, Image<Rgb8>)> = Vec::with_capacity(wanted.len());
    context.console.begin("fetch the pictures", wanted.len() as u64);
    while pictures.len() < wanted.len() {
        anyhow::ensure!(!context.console.stopping(), "stopped before all pictures were fetched");
        let Some(frame) = reader.next_frame(&pool)? else { break };
        let number = usize::try_from(frame.number)?;
        if number == wanted[pictures.len()] {
            let at = *times
                .get(number)
                .with_context(|| format!("expected the exposure of frame {number}, found none"))?;
            let mut picture = Image::filled(small.width, small.height, [0; 3]);
            mean_of_squares(&frame.image, step, &mut picture);
            pictures.push((number, at, picture));
            context.console.advance(1);
        }
    }
    context.console.end();
    let frames = pictures.par_iter().map(|(number, exposed_at, picture)| {
        let view = build::view_of(*number as u32, *exposed_at, picture, &small, Transform::identity());
        SurveyFrame {
            frame_number: view.frame_number,
            image: view.image,
            confidence: view.confidence,
            exposed_at: view.exposed_at,
        }
    });
    Ok(frames.collect())
}
