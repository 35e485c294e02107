//! `calibrate hand-eye RECORDING` without a board: how the camera sits on the arm, from tracks of a still scene.

use std::fmt::Write as _;

use anyhow::Context as _;
use nalgebra::Vector3;
use serde::Serialize;

use crate::calibration::hand_eye::epipolar::{FromScene, Settings, refine};
use crate::calibration::hand_eye::epipolar_search::search;
use crate::calibration::hand_eye::feature_tracks::{FeatureTrack, FeatureTracker};
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::motion::{Demands, Station, check};
use crate::calibration::hand_eye::plot::{self, Drawn};
use crate::calibration::hand_eye::view_pairs::{ViewPair, essential, pairs};
use crate::camera::model::CameraModel;
use crate::cli::calibrate::hand_eye::{Args, camera_of};
use crate::cli::calibrate::hand_eye_report::Placement;
use crate::cli::calibrate::hands::Hands;
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;
use crate::image::pool::Pool;
use crate::media::image_files;
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress as _;
use crate::recording::folder::Recording;
use crate::robot::hand_eye::HandEye;
use crate::time::Span;

/// Pairs of views without which nothing is begun.
const FEWEST_PAIRS: usize = 8;
/// Arms are not off by so much from view to view: an answer that needs it is wrong.
const WRONG_MM: f64 = 2.0;
const WRONG_DEG: f64 = 0.5;
/// A turn or shift less sure than this is said to be so.
const UNSURE_MM: f64 = 1.0;
const UNSURE_DEG: f64 = 0.3;

#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    #[serde(flatten)]
    placement: Placement,
    time_offset_ms: [f64; 2],
    arm_sigma_mm: f64,
    arm_sigma_deg: f64,
    track_sigma_px: f64,
    rms_px: f64,
    tracks: usize,
    pairs: usize,
    views: Vec<View>,
    warnings: Vec<String>,
}

#[derive(Debug, Serialize)]
struct View {
    frame: u64,
    /// RMS distance of its tracks from fitting the arm's motion alone, px.
    predicted_px: Option<f64>,
    correction_mm: f64,
    correction_deg: f64,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let path = args
        .recording
        .as_deref()
        .ok_or_else(|| UsageError("expected a recording to calibrate from, or --board with --square-mm and --images".into()))?;
    if args.refine_camera {
        return Err(UsageError(
            "--refine-camera needs a board: tracks of a scene do not tell the camera from the arm's errors; add --board and --square-mm, or \
             leave it out"
                .into(),
        )
        .into());
    }
    let [report_path, plot_path] = ["_report.json", "_report.png"].map(|ending| super::beside(&args.output, ending));
    for path in [&args.output, &report_path, &plot_path] {
        context.refuse_overwriting(path)?;
    }
    let recording = Recording::open(path)?;
    let camera = camera_of(args, Some(&recording))?;
    let (tracks, frames) = followed(&recording, &camera, args.frames as usize, context)?;
    let hands = Hands::of_recording((path, &recording), args.arm.as_deref(), &frames, context)?;
    check(&stations(&hands, frames.len()), &Demands::default())?;
    let told = |view: usize| hands.as_told(view, 0.0).is_some();
    let mut pairs = pairs(&tracks, &camera);
    pairs.retain(|pair| told(pair.first) && told(pair.second));
    anyhow::ensure!(
        pairs.len() >= FEWEST_PAIRS,
        "only {} pairs of views share enough places that could be followed, at least {FEWEST_PAIRS} are needed: the scene is without texture, \
         the pictures are blurred, or the scope moved too fast",
        pairs.len()
    );
    let settings = Settings {
        time_offset: true,
        ..Settings::default()
    };
    let starts = search(&pairs, &hands);
    let found = refine(&pairs, frames.len(), &hands, &camera, &starts, &settings).context(
        "the tracks do not determine how the camera sits on the hand: tilt the scope farther, to all sides, and roll it",
    )?;
    let [place_mm, turn_rad, _] = found.sigmas;
    anyhow::ensure!(
        place_mm < WRONG_MM && turn_rad.to_degrees() < WRONG_DEG,
        "the tracks fit only if the arm's poses are off by {place_mm:.1} mm and {:.2}° a view: that is no answer. The scene may move, or the \
         scope was not tilted enough for one; survey a still scene with tilts of 20° and more to all sides, or use a board",
        turn_rad.to_degrees()
    );
    let report = Report::new(&found, &frames, tracks.len(), &pairs);
    let hand_eye = HandEye {
        time_offset: Some(Span::from_seconds(found.time_offset_s[0])),
        covariance: Some(found.covariance),
        ..HandEye::new(found.hand_from_camera)
    };
    hand_eye.write(&args.output)?;
    super::write_json(&report_path, &serde_json::to_value(&report)?)?;
    let drawn = drawn(&found, &pairs, &hands, &camera, frames.len());
    image_files::write(&plot_path, &plot::drawn((camera.width, camera.height), &drawn))?;
    console::print(&report.table())?;
    super::say_written(&[&args.output, &report_path, &plot_path])?;
    Ok(Ended::Complete)
}

/// Tracks through the recording, with `views` frames of it as views.
fn followed(
    recording: &Recording,
    camera: &CameraModel,
    views: usize,
    context: &Context,
) -> anyhow::Result<(Vec<FeatureTrack>, Vec<u64>)> {
    let mut reader = VideoReader::open(&Input::from_argument(recording.video.path()))?;
    let count = reader.info().frame_count.unwrap_or(0);
    let every = if count == 0 {
        6
    } else {
        count.div_ceil(views.max(1) as u64).max(1)
    };
    let pool = Pool::new(4);
    let mut tracker = FeatureTracker::default();
    let mut frames = Vec::new();
    context.console.begin("following the scene", count);
    while let Some(frame) = reader.next_frame(&pool)? {
        anyhow::ensure!(!context.console.stopping(), "stopped before all pictures were looked at");
        anyhow::ensure!(
            frame.image.size() == (camera.width, camera.height),
            "the pictures are {}×{}, the camera file is for {}×{}: calibrate the camera at this size",
            frame.image.width(),
            frame.image.height(),
            camera.width,
            camera.height
        );
        let view = (frame.number % every == 0).then(|| {
            frames.push(frame.number);
            frames.len() - 1
        });
        tracker.next(&frame.image, view);
        context.console.advance(1);
    }
    context.console.end();
    Ok((tracker.tracks(), frames))
}

/// Hand and camera at every view, to see whether they moved enough. For that, any place of the camera on the hand and of a board in the
/// base will do.
fn stations(hands: &Hands, views: usize) -> Vec<Station> {
    let hand_from_camera = Transform::<Hand, Camera>::identity();
    (0..views)
        .filter_map(|view| {
            let base_from_hand = hands.as_told(view, 0.0)?;
            Some(Station {
                base_from_hand,
                camera_from_board: (base_from_hand * hand_from_camera).inverse() * Transform::identity(),
            })
        })
        .collect()
}

/// Places of each view's first pair, with the nearest place at which the arm's motion alone would let them be.
fn drawn(found: &FromScene, pairs: &[ViewPair], hands: &Hands, camera: &CameraModel, views: usize) -> Vec<Drawn> {
    let eye = |view: usize| {
        let hand = hands.as_told(view, found.time_offset_s[0])?;
        Some(hand * found.hand_from_camera)
    };
    let pixel = |ray: &Vector3<f64>| camera.project(Point::from_coords(*ray));
    (0..views)
        .map(|view| {
            let pair = pairs.iter().find(|pair| pair.second == view);
            let motion = pair.and_then(|pair| Some(eye(pair.second)?.inverse() * eye(pair.first)?));
            let corners = pair.zip(motion).into_iter().flat_map(|(pair, motion)| {
                let essential = essential(&motion);
                pair.rays.iter().filter_map(move |[from, to]| {
                    let line = essential * from;
                    let away = to.dot(&line) / (line.x * line.x + line.y * line.y).max(1e-24);
                    let foot = Vector3::new(to.x - away * line.x, to.y - away * line.y, 1.0);
                    Some((pixel(to)?, pixel(&foot)))
                })
            });
            Drawn {
                corners: corners.collect(),
                predicted_px: found.predicted_px[view],
                left_out_px: None,
                outlier: false,
            }
        })
        .collect()
}

impl Report {
    fn new(found: &FromScene, frames: &[u64], tracks: usize, pairs: &[ViewPair]) -> Self {
        let placement = Placement::new(&found.hand_from_camera, &found.covariance);
        let mut warnings = Vec::new();
        if placement.sigma_mm.iter().any(|sigma| *sigma > UNSURE_MM) {
            warnings.push(format!(
                "the camera's place is unsure by more than {UNSURE_MM} mm: tilt the scope farther and to all sides, or use a board"
            ));
        }
        if placement.sigma_deg.iter().any(|sigma| *sigma > UNSURE_DEG) {
            warnings.push(format!(
                "the camera's rotation is unsure by more than {UNSURE_DEG}°: move and tilt farther, or use a board"
            ));
        }
        let views = frames.iter().zip(&found.predicted_px).zip(&found.corrections);
        Self {
            version: env!("CARGO_PKG_VERSION"),
            placement,
            time_offset_ms: found.time_offset_s.map(|s| 1000.0 * s),
            arm_sigma_mm: found.sigmas[0],
            arm_sigma_deg: found.sigmas[1].to_degrees(),
            track_sigma_px: found.sigmas[2],
            rms_px: found.rms_px,
            tracks,
            pairs: pairs.len(),
            views: views
                .map(|((&frame, &px), correction)| View {
                    frame,
                    predicted_px: px.is_finite().then_some(px),
                    correction_mm: correction.fixed_rows::<3>(0).norm(),
                    correction_deg: correction.fixed_rows::<3>(3).norm().to_degrees(),
                })
                .collect(),
            warnings,
        }
    }

    fn table(&self) -> String {
        let [offset, sigma] = self.time_offset_ms;
        let mut text = format!(
            "hand_from_camera, {} views of a scene without a board: {} tracks, {} pairs of views
{}  time offset   {offset:.1} ms  (± {sigma:.1}), added to the arm's stamps
  arm's noise   {:.3} mm, {:.4}° a view; tracks {:.3} px; RMS {:.3} px with the views corrected

  frame   arm alone  correction
",
            self.views.len(),
            self.tracks,
            self.pairs,
            self.placement.lines(),
            self.arm_sigma_mm,
            self.arm_sigma_deg,
            self.track_sigma_px,
            self.rms_px
        );
        for view in &self.views {
            let px = view.predicted_px.map_or_else(|| "–".to_owned(), |px| format!("{px:.2} px"));
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "  {:>5}  {px:>10}  {:.2} mm {:.3}°",
                view.frame, view.correction_mm, view.correction_deg
            );
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  ! {warning}");
        }
        text
    }
}
