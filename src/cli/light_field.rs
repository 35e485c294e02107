//! `light-field`: build from a survey, import, info, render, evaluate.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Subcommand;
use rayon::prelude::*;
use serde::Serialize;

use crate::camera::file as camera_file;
use crate::cli::import;
use crate::cli::telescope;
use crate::config::Config;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Rgb8};
use crate::image::pool::Pool;
use crate::light_field::build::{self, BuildSettings, CompletionReport};
use crate::light_field::colmap::model_folder;
use crate::light_field::evaluate::{Evaluation, leave_one_out};
use crate::light_field::file;
use crate::light_field::prior::PriorSettings;
use crate::light_field::renderer::Renderer;
use crate::light_field::selection::{SelectionSettings, ViewCandidate, select_views, sharpness};
use crate::light_field::survey::{self, PosePrior};
use crate::light_field::survey_report::SurveyReport;
use crate::light_field::view::{LightField, View};
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress;
use crate::recording::folder::{Recording, Video};
use crate::robot::hand_eye::HandEye;
use crate::robot::trajectory::{Trajectory, TumFile};
use crate::time::{Clock as _, MonotonicClock, Span, Timestamp};

/// Light fields: build from a survey, look at, render from, evaluate.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  endofield light-field build survey -o lf\n  endofield light-field evaluate lf\n  \
    endofield light-field render lf --poses camera_poses.tum --camera camera.yaml -o pictures"
)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make a light field from a survey (a recording with camera.yaml, poses and hand_eye.yaml) or from a COLMAP model.
    Build(BuildArgs),
    Import(import::Args),
    /// Say what a light field holds.
    Info {
        /// The light field's folder.
        light_field: PathBuf,
    },
    /// What virtual cameras would see.
    Render(RenderArgs),
    /// Render each view from the others and compare: PSNR, SSIM.
    Evaluate {
        /// The light field's folder.
        light_field: PathBuf,
        /// Also write the figures as JSON.
        #[arg(long, value_name = "FILE")]
        json: Option<PathBuf>,
    },
}

#[derive(Debug, clap::Args)]
struct BuildArgs {
    /// The survey: a recording's folder; or the folder of a COLMAP model with its pictures.
    recording: PathBuf,
    /// Where the light field goes.
    #[arg(short, long, value_name = "LF")]
    output: PathBuf,
    /// Views wanted.
    #[arg(long, value_name = "N", default_value_t = 96)]
    views: usize,
    /// Trust the poses as they are: no refinement by the pictures.
    #[arg(long)]
    no_refinement: bool,
    /// How far an oblique telescope is turned against the camera head in this recording, degrees (`calibrate oblique` tells what turns).
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    telescope_angle_deg: Option<f64>,
}

#[derive(Debug, clap::Args)]
struct RenderArgs {
    /// The light field's folder.
    light_field: PathBuf,
    /// Camera poses, TUM layout (`# T_world_camera, mm`).
    #[arg(long, value_name = "FILE")]
    poses: PathBuf,
    /// The virtual camera (its lens is ignored: pictures are a pinhole's).
    #[arg(long, value_name = "FILE")]
    camera: PathBuf,
    /// Where the pictures go: 000000.png …, and a mask of what could be rendered in mask/.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// Seconds spent per phase.
#[derive(Debug, Default, Serialize)]
struct Phases {
    decode_and_select_s: f64,
    undistort_and_detect_s: f64,
    refine_s: f64,
    depth_and_surface_s: f64,
    write_s: f64,
}

#[derive(Debug, Serialize)]
struct BuildReport {
    source: String,
    views: usize,
    points: usize,
    survey: Option<SurveyReport>,
    surface: CompletionReport,
    lamp_falloff: f32,
    seconds: Phases,
}

/// Runs one of the subcommands; with `force`, what is there is overwritten.
pub fn run(args: &Args, config: &Config, force: bool, progress: &dyn Progress) -> anyhow::Result<()> {
    match &args.command {
        Command::Build(args) => build_command(args, config, force, progress),
        Command::Import(args) => import::run(args, force, progress),
        Command::Info { light_field } => info(light_field, progress),
        Command::Render(args) => render(args, force, progress),
        Command::Evaluate { light_field, json } => evaluate(light_field, json.as_deref(), progress),
    }
}

/// The arm's word on where the camera was.
struct Arm {
    poses: Trajectory,
    hand_eye: HandEye,
    /// Samples farther apart are not bridged.
    max_gap: Span,
    trust: PriorSettings,
}

impl PosePrior for Arm {
    fn world_from_camera(&self, at: Timestamp) -> Option<Transform<World, Camera>> {
        let poses = self.poses.poses();
        let next = poses.partition_point(|pose| pose.stamp <= at);
        let (before, after) = (poses.get(next.checked_sub(1)?)?, poses.get(next));
        let hand = match after {
            Some(after) if (after.stamp - before.stamp) <= self.max_gap => {
                let t = (at - before.stamp).0 as f64 / (after.stamp - before.stamp).0 as f64;
                before.base_from_hand.interpolated(&after.base_from_hand, t)
            }
            _ if before.stamp == at => before.base_from_hand,
            _ => return None,
        };
        Some(Transform::from_isometry(*(hand * self.hand_eye.hand_from_camera).isometry()))
    }

    fn sigma_mm(&self) -> f64 {
        self.trust.arm_sigma_mm
    }

    fn sigma_rad(&self) -> f64 {
        self.trust.arm_sigma_rad
    }
}

/// What is asked of a light field that is built from a survey.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Views.
    pub views: usize,
    /// Whether the pictures refine the arm's poses.
    pub refine: bool,
    /// How far an oblique telescope is turned.
    pub telescope_angle_deg: Option<f64>,
}

/// Builds a light field from a survey recording or a COLMAP model in `source`, without writing it.
pub fn built(
    source: &Path,
    wanted: Wanted,
    config: &Config,
    progress: &dyn Progress,
) -> anyhow::Result<(LightField, serde_json::Value)> {
    let (light_field, report) = if model_folder(source).is_some() && !source.join("poses.tum").is_file() {
        if wanted.telescope_angle_deg.is_some() {
            bail!("--telescope-angle-deg is of recordings: the cameras of a COLMAP model are as they were turned");
        }
        from_model(source, progress)?
    } else {
        from_recording(source, wanted, config, progress)?
    };
    Ok((light_field, serde_json::to_value(report)?))
}

fn build_command(args: &BuildArgs, config: &Config, force: bool, progress: &dyn Progress) -> anyhow::Result<()> {
    refuse_overwriting(&args.output, force)?;
    let wanted = Wanted {
        views: args.views,
        refine: !args.no_refinement,
        telescope_angle_deg: args.telescope_angle_deg,
    };
    let (light_field, mut report) = built(&args.recording, wanted, config, progress)?;
    let began = MonotonicClock.now();
    file::save(&light_field, &args.output, progress)?;
    report["seconds"]["write_s"] = since(began).into();
    let path = args.output.join("build_report.json");
    fs::write(&path, serde_json::to_string_pretty(&report)?).with_context(|| format!("cannot write {}", path.display()))?;
    print_report(&report);
    say(&format!("light field in {}", args.output.display()));
    Ok(())
}

fn from_model(source: &Path, progress: &dyn Progress) -> anyhow::Result<(LightField, BuildReport)> {
    let began = MonotonicClock.now();
    let mut light_field = file::read(source, progress)?.light_field;
    let read_s = since(began);
    let began = MonotonicClock.now();
    build::make_confidence(&mut light_field);
    let detect_s = since(began);
    let began = MonotonicClock.now();
    let surface = build::complete(&mut light_field, &BuildSettings::default(), progress)?;
    let seconds = Phases {
        decode_and_select_s: read_s,
        undistort_and_detect_s: detect_s,
        depth_and_surface_s: since(began),
        ..Phases::default()
    };
    light_field.recipe = format!("COLMAP model {}", source.display());
    let report = BuildReport {
        source: source.display().to_string(),
        views: light_field.views.len(),
        points: light_field.points.len(),
        survey: None,
        surface,
        lamp_falloff: light_field.shading.falloff,
        seconds,
    };
    Ok((light_field, report))
}

fn from_recording(
    source: &Path,
    wanted: Wanted,
    config: &Config,
    progress: &dyn Progress,
) -> anyhow::Result<(LightField, BuildReport)> {
    let Wanted { views, refine, .. } = wanted;
    let recording = telescope::turned(Recording::open(source)?, wanted.telescope_angle_deg)?;
    let what = "a light field needs camera.yaml, poses.tum (or joints.csv) and hand_eye.yaml beside the video";
    let (Some(camera), Some(trajectory), Some(hand_eye)) = (&recording.camera, &recording.trajectory, &recording.hand_eye) else {
        let missing: Vec<String> = recording.missing().iter().map(ToString::to_string).collect();
        bail!("{}: {what}; {}", source.display(), missing.join("; "));
    };
    let known_offset = hand_eye.time_offset;
    let arm = Arm {
        poses: trajectory.clone(),
        hand_eye: hand_eye.clone(),
        max_gap: Span::from_milliseconds(config.poses.max_gap_ms),
        trust: config.survey.clone(),
    };
    let mut seconds = Phases::default();

    let began = MonotonicClock.now();
    let pictures = selected_pictures(&recording, &arm, views, progress)?;
    seconds.decode_and_select_s = since(began);

    let began = MonotonicClock.now();
    progress.begin("undistort, find specularities", pictures.len() as u64);
    let prepared: Vec<View> = (pictures.par_iter())
        .map(|(number, exposed_at, image)| {
            let stamp = *exposed_at - known_offset.unwrap_or_default();
            let pose = arm.world_from_camera(stamp).unwrap_or_else(Transform::identity);
            progress.advance(1);
            build::view_of(*number, *exposed_at, image, camera, pose)
        })
        .collect();
    progress.end();
    drop(pictures);
    seconds.undistort_and_detect_s = since(began);

    let began = MonotonicClock.now();
    let (mut light_field, report) = if refine {
        let settings = survey::Settings {
            known_time_offset_ms: known_offset.map(|o| o.milliseconds()),
            ..Default::default()
        };
        let (refined, report) = build::refined(prepared, &camera.pinhole(), &arm, &settings, progress)?;
        (refined, Some(report))
    } else {
        let unrefined = LightField {
            views: prepared,
            time_offset: known_offset.unwrap_or_default(),
            ..LightField::default()
        };
        (unrefined, None)
    };
    seconds.refine_s = since(began);

    let began = MonotonicClock.now();
    light_field.recipe = format!(
        "survey {}, {}",
        source.display(),
        if refine {
            "poses refined by the pictures"
        } else {
            "the arm's poses"
        }
    );
    let surface = build::complete(&mut light_field, &BuildSettings::default(), progress)?;
    seconds.depth_and_surface_s = since(began);
    let report = BuildReport {
        source: source.display().to_string(),
        views: light_field.views.len(),
        points: light_field.points.len(),
        survey: report,
        surface,
        lamp_falloff: light_field.shading.falloff,
        seconds,
    };
    Ok((light_field, report))
}

type Picture = (u32, Timestamp, Image<Rgb8>);

/// Two passes over the video, so that only the chosen frames are ever held: one to judge all, one to fetch the chosen.
fn selected_pictures(recording: &Recording, arm: &Arm, views: usize, progress: &dyn Progress) -> anyhow::Result<Vec<Picture>> {
    let input = match &recording.video {
        Video::File(path) => Input::File(path.clone()),
        Video::Frames(path) => Input::ImageFolder(path.clone()),
    };
    let pool = Pool::<Rgb8>::new(4);
    let exposed = |number: u64, stamp: Timestamp| {
        match &recording.frame_times {
        Some(times) => times.get(number as usize).copied().with_context(|| {
            format!(
                "frames.csv: expected a line for each frame of the video, found {} lines and a frame {number}; add the missing lines, \
                 or remove the file to go by the container's time stamps",
                times.len()
            )
        }),
        None => Ok(stamp),
    }
    };
    let offset = arm.hand_eye.time_offset.unwrap_or_default();
    let mut reader = VideoReader::open(&input)?;
    recording.check_video_size(reader.info().width, reader.info().height)?;
    let mut candidates = Vec::new();
    progress.begin("look through the survey", reader.info().frame_count.unwrap_or(0));
    while let Some(frame) = reader.next_frame(&pool)? {
        if progress.stopping() {
            bail!("stopped before it was done");
        }
        let exposed_at = exposed(frame.number, frame.timestamp)?;
        candidates.push(ViewCandidate {
            frame_number: frame.number as u32,
            exposed_at,
            sharpness: sharpness(&frame.image),
            world_from_camera: arm.world_from_camera(exposed_at - offset),
        });
        progress.advance(1);
    }
    progress.end();
    let chosen = select_views(
        &candidates,
        &SelectionSettings {
            target_views: views,
            ..SelectionSettings::default()
        },
    );
    let wanted: Vec<(u32, Timestamp)> = chosen
        .iter()
        .map(|&i| (candidates[i].frame_number, candidates[i].exposed_at))
        .collect();
    let mut pictures = Vec::with_capacity(wanted.len());
    let mut reader = VideoReader::open(&input)?;
    progress.begin("fetch the chosen views", wanted.len() as u64);
    while pictures.len() < wanted.len() {
        let Some(frame) = reader.next_frame(&pool)? else { break };
        let (number, exposed_at) = wanted[pictures.len()];
        if frame.number == u64::from(number) {
            pictures.push((number, exposed_at, frame.image.clone()));
            progress.advance(1);
        }
    }
    progress.end();
    Ok(pictures)
}

fn info(folder: &Path, progress: &dyn Progress) -> anyhow::Result<()> {
    let light_field = build::open(folder, &BuildSettings::default(), progress)?;
    let views = &light_field.views;
    let Some(first) = views.first() else {
        bail!("{}: no views", folder.display())
    };
    let centers: Vec<_> = views.iter().map(|v| v.world_from_camera.translation()).collect();
    let path: f64 = centers.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    let mut depths: Vec<f32> = views
        .iter()
        .flat_map(|v| v.depth.pixels().iter().step_by(97))
        .copied()
        .filter(|z| *z > 0.0)
        .collect();
    depths.sort_by(f32::total_cmp);
    let depth = |share: f64| {
        depths
            .get(((depths.len().max(1) - 1) as f64 * share) as usize)
            .copied()
            .unwrap_or(0.0)
    };
    let confident = views.iter().flat_map(|v| v.confidence.pixels()).filter(|&&c| c > 127).count() as f64;
    let all = views.iter().map(|v| v.confidence.pixels().len()).sum::<usize>() as f64;
    let (low, high) = views.iter().fold((f32::MAX, 0.0_f32), |(low, high), v| {
        (low.min(v.gain[1]), high.max(v.gain[1]))
    });
    say(&format!("{}\n  made by        {}", folder.display(), light_field.recipe));
    say(&format!(
        "  views          {} of {}×{}, frames {}–{}",
        views.len(),
        first.camera.width,
        first.camera.height,
        first.frame_number,
        views[views.len() - 1].frame_number
    ));
    say(&format!(
        "  focal length   {:.1} × {:.1} px",
        first.camera.intrinsics.fx, first.camera.intrinsics.fy
    ));
    say(&format!("  path           {path:.1} mm"));
    say(&format!(
        "  depth          {:.1} / {:.1} / {:.1} mm (5 %, median, 95 %)",
        depth(0.05),
        depth(0.5),
        depth(0.95)
    ));
    say(&format!(
        "  surface        {} vertices, {} triangles",
        light_field.surface.vertices.len(),
        light_field.surface.triangles.len()
    ));
    say(&format!("  scene points   {}", light_field.points.len()));
    say(&format!("  confident      {:.1} % of all pixels", 100.0 * confident / all));
    say(&format!("  gains          {low:.2}–{high:.2} (green)"));
    let lamp = light_field.shading;
    say(&format!(
        "  lamp           distance^-{:.2}, vignetting {:.2} ρ² {:+.2} ρ⁴",
        lamp.falloff, lamp.vignetting[0], lamp.vignetting[1]
    ));
    say(&format!("  time offset    {:.1} ms", light_field.time_offset.milliseconds()));
    Ok(())
}

fn render(args: &RenderArgs, force: bool, progress: &dyn Progress) -> anyhow::Result<()> {
    refuse_overwriting(&args.output, force)?;
    let light_field = build::open(&args.light_field, &BuildSettings::default(), progress)?;
    let camera = camera_file::read(&args.camera)?.pinhole();
    let poses = TumFile::read(&args.poses)?;
    let inverted = match poses.transform.as_deref() {
        None | Some("T_world_camera" | "T_base_camera") => false,
        Some("T_camera_world" | "T_camera_base") => true,
        Some(other) => bail!(
            "{}: expected camera poses (`# T_world_camera, mm`), found {other}",
            args.poses.display()
        ),
    };
    let masks = args.output.join("mask");
    fs::create_dir_all(&masks).with_context(|| format!("cannot make {}", masks.display()))?;
    progress.begin("render", poses.poses.len() as u64);
    poses.poses.par_iter().enumerate().try_for_each_init(
        || {
            (
                Renderer::new(&light_field),
                Image::filled(0, 0, [0_u8; 3]),
                Image::filled(0, 0, 0_u8),
            )
        },
        |(renderer, picture, mask), (index, (_, pose))| {
            if progress.stopping() {
                bail!("stopped before it was done");
            }
            let pose = Transform::from_isometry(if inverted { pose.inverse() } else { *pose });
            renderer.render(&light_field, &camera, &pose, picture, mask);
            let name = format!("{index:06}.png");
            file::write_rgb(&args.output.join(&name), picture)?;
            file::write_mask(&masks.join(&name), mask)?;
            progress.advance(1);
            Ok(())
        },
    )?;
    progress.end();
    say(&format!("{} pictures in {}", poses.poses.len(), args.output.display()));
    Ok(())
}

fn evaluate(folder: &Path, json: Option<&Path>, progress: &dyn Progress) -> anyhow::Result<()> {
    let light_field = build::open(folder, &BuildSettings::default(), progress)?;
    let evaluation: Evaluation = leave_one_out(&light_field, progress);
    say("each view rendered from the others");
    say("   frame     PSNR    SSIM | without specular pixels: PSNR    SSIM  texture | rendered");
    let line = |name: &str, v: &crate::light_field::evaluate::ViewScore| {
        say(&format!(
            "{name:>8}  {:6.2}  {:6.4} | {:30.2}  {:6.4}   {:6.2} | {:5.1} %",
            v.psnr,
            v.ssim,
            v.psnr_without_specular,
            v.ssim_without_specular,
            v.texture_psnr,
            100.0 * v.covered
        ));
    };
    for view in &evaluation.views {
        line(&view.frame.to_string(), view);
    }
    line("mean", &evaluation.mean);
    if let Some(path) = json {
        fs::write(path, serde_json::to_string_pretty(&evaluation)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(())
}

fn print_report(report: &serde_json::Value) {
    let number = |pointer: &str| report.pointer(pointer).and_then(serde_json::Value::as_f64);
    let count = |pointer: &str| number(pointer).unwrap_or(0.0) as u64;
    say(&format!(
        "views            {}, scene points {}",
        count("/views"),
        count("/points")
    ));
    if let (Some(before), Some(after)) = (
        number("/survey/prior_reprojection_px"),
        number("/survey/refined_reprojection_px"),
    ) {
        say(&format!(
            "reprojection     {before:.2} px with the arm's poses, {after:.2} px refined"
        ));
        say(&format!(
            "time offset      {:.1} ms",
            number("/survey/time_offset_ms").unwrap_or(0.0)
        ));
    }
    say(&format!(
        "surface          {} triangles from {} depth maps, under {:.1} % of the confident pixels",
        count("/surface/triangles"),
        count("/surface/depth_maps"),
        100.0 * number("/surface/coverage").unwrap_or(0.0)
    ));
    say(&format!(
        "brightness       views of one point differ by {:.1} % before gains and lamp model, {:.1} % after",
        100.0 * number("/surface/brightness_spread_before").unwrap_or(0.0),
        100.0 * number("/surface/brightness_spread_after").unwrap_or(0.0)
    ));
    let phases = [
        "decode_and_select_s",
        "undistort_and_detect_s",
        "refine_s",
        "depth_and_surface_s",
        "write_s",
    ];
    let parts: Vec<String> = phases
        .iter()
        .map(|p| {
            format!(
                "{} {:.1}",
                p.trim_end_matches("_s").replace('_', " "),
                number(&format!("/seconds/{p}")).unwrap_or(0.0)
            )
        })
        .collect();
    say(&format!("seconds          {}", parts.join(", ")));
}

/// Refuse to write over `path` unless told to.
pub(super) fn refuse_overwriting(path: &Path, force: bool) -> anyhow::Result<()> {
    let occupied = path.is_file() || path.read_dir().is_ok_and(|mut entries| entries.next().is_some());
    if occupied && !force {
        bail!(
            "{}: exists already and is not overwritten; remove it, choose another name or pass --force",
            path.display()
        );
    }
    Ok(())
}

fn since(began: Timestamp) -> f64 {
    (MonotonicClock.now() - began).seconds()
}

#[expect(clippy::print_stdout, reason = "a command's result goes to stdout")]
fn say(text: &str) {
    println!("{text}");
}
