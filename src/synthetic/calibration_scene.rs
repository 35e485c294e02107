//! Recordings of the checkerboard: `survey` waves it before a still scope, `live` carries the scope over a still board.

use std::fmt::Write as _;
use std::path::Path;

use rayon::prelude::*;
use serde_json::json;

use crate::geometry::space::{Board, Camera, World};
use crate::geometry::transform::Transform;
use crate::progress::Progress;
use crate::synthetic::arm::arm_readings;
use crate::synthetic::board::{CORNERS, SQUARE_MM, corners, picture, station, waved};
use crate::synthetic::export::{make_folder, write_arm, write_camera, write_hand_eye, write_poses, write_rgb, write_text};
use crate::synthetic::noise::hash_u64;
use crate::synthetic::renderer::Renderer;
use crate::synthetic::simulation::{POSE_MARGIN_S, Settings, SimulationError, Summary, renderer_of};
use crate::synthetic::trajectory::{Course, Trajectory};

/// A white sheet 75 mm away is then well exposed.
const EXPOSURE: f64 = 0.9;

/// Write both recordings and their truth into `out`.
pub fn simulate_boards(out: &Path, settings: &Settings, progress: &dyn Progress) -> Result<Summary, SimulationError> {
    settings.checked()?;
    let renderer = &renderer_of(settings)?;
    let at_rest = Trajectory::new(Course::Still, 1.0, renderer.world().world_from_organs).world_from_camera(0.0);
    let world_from_board: Transform<World, Board> = at_rest * station(0.0).inverse();
    let still = move |_: f64| at_rest;
    let carried = move |seconds: f64| world_from_board * station(seconds);
    let mut summary = Summary::default();
    summary.frames += write_board_recording(
        out,
        "survey",
        settings.survey_frames,
        settings,
        renderer,
        progress,
        &still,
        &waved,
    )?;
    let seen = move |seconds: f64| station(seconds).inverse();
    summary.frames += write_board_recording(
        out,
        "live",
        settings.live_frames,
        settings,
        renderer,
        progress,
        &carried,
        &seen,
    )?;
    let truth = json!({
        "unit": "mm",
        "seed": settings.seed,
        "recordings": ["survey", "live"],
        "board": { "kind": "checkerboard", "corners": CORNERS, "square_mm": SQUARE_MM },
        "files": {
            "<recording>/corners.csv": "frame,corner,x_px,y_px,board_x_mm,board_y_mm: inner corners in the video's own geometry, frames that show all of them",
            "<recording>/board_poses.tum": "T_camera_board at each frame's exposure",
            "<recording>/camera_poses.tum": "T_world_camera at each frame's exposure",
        },
        "time_offset_s": -settings.arm.late_s,
    });
    write_text(&out.join("truth/truth.json"), &format!("{truth:#}\n"))?;
    Ok(summary)
}

fn write_board_recording(
    out: &Path,
    name: &str,
    frames: usize,
    settings: &Settings,
    renderer: &Renderer,
    progress: &dyn Progress,
    world_from_camera: &(dyn Fn(f64) -> Transform<World, Camera> + Sync),
    camera_from_board: &(dyn Fn(f64) -> Transform<Camera, Board> + Sync),
) -> Result<usize, SimulationError> {
    if frames == 0 {
        return Ok(0);
    }
    let (folder, truth) = (out.join(name), out.join("truth").join(name));
    make_folder(&folder.join("frames"))?;
    make_folder(&truth)?;
    let seconds = |frame: usize| frame as f64 / settings.frame_rate_hz;
    let seed = hash_u64(settings.seed ^ hash_u64(name.len() as u64));
    let readings = arm_readings(
        &settings.arm,
        seed,
        -POSE_MARGIN_S,
        seconds(frames) + POSE_MARGIN_S,
        world_from_camera,
    )?;
    let mut stamps = String::from("frame,timestamp_s\n");
    let mut found = String::from("frame,corner,x_px,y_px,board_x_mm,board_y_mm\n");
    for frame in 0..frames {
        // Writing to a String cannot fail.
        let _infallible = writeln!(stamps, "{frame},{:.6}", seconds(frame));
        for (number, corner) in corners(renderer, &camera_from_board(seconds(frame)))
            .unwrap_or_default()
            .iter()
            .enumerate()
        {
            let _infallible = writeln!(
                found,
                "{frame},{number},{:.5},{:.5},{},{}",
                corner.pixel.x, corner.pixel.y, corner.board[0], corner.board[1]
            );
        }
    }
    write_text(&folder.join("frames.csv"), &stamps)?;
    write_text(&truth.join("corners.csv"), &found)?;
    write_arm(&folder, &readings)?;
    let exact = (0..frames).map(|frame| (seconds(frame), world_from_camera(seconds(frame))));
    write_poses(&truth.join("camera_poses.tum"), "T_world_camera", exact)?;
    let boards = (0..frames).map(|frame| (seconds(frame), camera_from_board(seconds(frame))));
    write_poses(&truth.join("board_poses.tum"), "T_camera_board", boards)?;
    // Calibration is what these recordings are for: its results are the truth, not part of the recording.
    write_camera(&truth.join("camera.yaml"), renderer.camera())?;
    write_hand_eye(&truth.join("hand_eye.yaml"), settings.arm.scope_mm)?;
    progress.begin(&format!("rendering {name}"), frames as u64);
    let outcome = (0..frames).into_par_iter().try_for_each(|frame| {
        if progress.stopping() {
            return Err(SimulationError::Stopped);
        }
        let key = hash_u64(seed ^ hash_u64(frame as u64));
        let picture = picture(renderer, &camera_from_board(seconds(frame)), EXPOSURE, key);
        write_rgb(&folder.join("frames").join(format!("{frame:06}.png")), &picture)?;
        progress.advance(1);
        Ok(())
    });
    progress.end();
    outcome.map(|()| frames)
}
