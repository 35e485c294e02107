//! A checkerboard before the scope, for calibration: exact corners beside every picture.
//!
//! Two ways to use it: the board is waved before a camera that stands still (intrinsics), or it lies still and the arm goes
//! from station to station (hand-eye); at a station it rests, so that late stamps do no harm there.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use crate::camera::intrinsics::Pixel;
use crate::geometry::point::Point;
use crate::geometry::space::{Board, Camera};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Rgb8};
use crate::synthetic::light::arriving;
use crate::synthetic::noise::hash_u64;
use crate::synthetic::renderer::{Renderer, soften};

/// Inner corners along x and y.
pub const CORNERS: [usize; 2] = [9, 6];
/// Side of a square, mm.
pub const SQUARE_MM: f64 = 4.0;
/// White paper around the squares, mm.
const MARGIN_MM: f64 = 3.0;

/// A place on the board and where it is seen.
#[derive(Clone, Copy, Debug)]
pub struct Corner {
    /// On the board, mm.
    pub board: [f64; 2],
    /// In the picture, with the lens.
    pub pixel: Pixel,
}

/// Pose of the board before a still camera at `seconds`: tilted, turned, near and far, all over the picture.
pub fn waved(seconds: f64) -> Transform<Camera, Board> {
    let s = seconds * 1.9;
    let tilt = UnitQuaternion::from_euler_angles(0.52 * (1.13 * s).sin(), 0.55 * (0.87 * s + 1.0).sin(), 0.5 * (0.41 * s).sin());
    let centre = Vector3::new(
        13.0 * (0.71 * s + 0.5).sin(),
        7.0 * (0.93 * s).cos(),
        76.0 + 16.0 * (0.53 * s + 2.0).sin(),
    );
    Transform::new(tilt, centre - tilt * middle())
}

/// Pose of the camera over a still board at `seconds`: twenty stations, 0.8 s each, half of it at rest.
pub fn station(seconds: f64) -> Transform<Board, Camera> {
    const STATION_S: f64 = 0.8;
    let number = (seconds / STATION_S).floor();
    let share = ((seconds / STATION_S - number) * 2.0 - 1.0).clamp(0.0, 1.0);
    let eased = share * share * (3.0 - 2.0 * share);
    station_pose(number).interpolated(&station_pose(number + 1.0), eased)
}

fn station_pose(number: f64) -> Transform<Board, Camera> {
    let draw = |salt: u64| {
        let bits = hash_u64((number as i64 as u64).wrapping_mul(31).wrapping_add(salt));
        (bits >> 11) as f64 / (1_u64 << 53) as f64 * 2.0 - 1.0
    };
    let turn = UnitQuaternion::from_euler_angles(0.42 * draw(1), 0.42 * draw(2), 0.7 * draw(3));
    let centre = Vector3::new(8.0 * draw(4), 5.0 * draw(5), 78.0 + 12.0 * draw(6));
    let camera_from_board: Transform<Camera, Board> = Transform::new(turn, centre - turn * middle());
    camera_from_board.inverse()
}

fn middle() -> Vector3<f64> {
    Vector3::new(
        (CORNERS[0] - 1) as f64 * SQUARE_MM / 2.0,
        (CORNERS[1] - 1) as f64 * SQUARE_MM / 2.0,
        0.0,
    )
}

/// All inner corners, row by row, as the camera sees them; `None` if one of them is not in the picture.
pub fn corners(renderer: &Renderer, camera_from_board: &Transform<Camera, Board>) -> Option<Vec<Corner>> {
    (0..CORNERS[0] * CORNERS[1])
        .map(|i| {
            let board = [(i % CORNERS[0]) as f64 * SQUARE_MM, (i / CORNERS[0]) as f64 * SQUARE_MM];
            let pixel = renderer
                .camera()
                .project(*camera_from_board * Point::<Board>::new(board[0], board[1], 0.0))?;
            renderer.in_field(pixel).then_some(Corner { board, pixel })
        })
        .collect()
}

/// The picture of the board; `key` is the seed of its noise.
pub fn picture(renderer: &Renderer, camera_from_board: &Transform<Camera, Board>, exposure: f64, key: u64) -> Image<Rgb8> {
    let (width, height) = (renderer.camera().width, renderer.camera().height);
    let rotation: Matrix3<f64> = camera_from_board.rotation().to_rotation_matrix().into_inner();
    let origin = camera_from_board.translation();
    let normal: Vector3<f64> = rotation.column(2).into();
    let distance = normal.dot(&origin);
    let pixel_mm = distance.abs() / renderer.camera().intrinsics.fx;
    let mut light = vec![[0.0_f32; 3]; width * height];
    for (i, light) in light.iter_mut().enumerate() {
        let Some((slope, through)) = renderer.lens_ray(i) else {
            continue;
        };
        let ray = Vector3::new(slope[0], slope[1], 1.0);
        let depth = distance / normal.dot(&ray);
        let mut albedo = TABLE;
        if depth > 0.0 && depth < 400.0 {
            let on_board = rotation.tr_mul(&(ray * depth - origin));
            albedo = board_albedo(on_board.x, on_board.y, pixel_mm);
        }
        let at = ray * if depth > 0.0 && depth < 400.0 { depth } else { 120.0 };
        let facing = normal * normal.dot(&at).signum();
        let lit: f64 = renderer
            .world()
            .lamps
            .iter()
            .map(|lamp| {
                let (to_lamp, strength) = arriving(lamp, at);
                strength * (-facing.dot(&to_lamp)).max(0.0)
            })
            .sum();
        *light = [(albedo * lit * exposure) as f32 * through; 3];
    }
    soften(&mut light, width);
    let mut picture = Image::filled(width, height, [0_u8; 3]);
    for (i, (pixel, light)) in picture.pixels_mut().iter_mut().zip(&light).enumerate() {
        *pixel = renderer.sensor().noisy(*light, key.wrapping_add(i as u64));
    }
    picture
}

/// Albedo beside the board, of black and of white squares.
const TABLE: f64 = 0.10;
const BLACK: f64 = 0.03;
const WHITE: f64 = 0.65;

/// Edges are as soft as a pixel is wide, so that corners keep their place to a small part of a pixel.
fn board_albedo(x: f64, y: f64, pixel_mm: f64) -> f64 {
    let columns = CORNERS[0] as f64 * SQUARE_MM;
    let rows = CORNERS[1] as f64 * SQUARE_MM;
    let within = |margin: f64| {
        let beyond = (-SQUARE_MM - margin - x)
            .max(x - columns - margin)
            .max(-SQUARE_MM - margin - y)
            .max(y - rows - margin);
        (0.5 - beyond / pixel_mm).clamp(0.0, 1.0)
    };
    // A square wave, −1…1, with ramps one pixel wide, but none at the outer border, where the paper begins.
    let wave = |v: f64, end: f64| {
        let v = v.clamp(0.5 * pixel_mm - SQUARE_MM, end - 0.5 * pixel_mm);
        let phase = (v / SQUARE_MM).rem_euclid(2.0);
        let nearest = (phase - phase.round()) * SQUARE_MM;
        let sign = if phase.round() as i64 % 2 == 0 { 1.0 } else { -1.0 };
        sign * (2.0 * nearest / pixel_mm).clamp(-1.0, 1.0)
    };
    let checks = BLACK + (WHITE - BLACK) * (0.5 - 0.5 * wave(x, columns) * wave(y, rows));
    let paper = WHITE + (checks - WHITE) * within(0.0);
    TABLE + (paper - TABLE) * within(MARGIN_MM)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_four_squares_round_a_corner_alternate() {
        let at = |x: f64, y: f64| board_albedo(x, y, 0.1);
        let (a, b, c, d) = (at(-1.0, -1.0), at(1.0, -1.0), at(-1.0, 1.0), at(1.0, 1.0));
        assert!(
            (a - d).abs() < 1e-9 && (b - c).abs() < 1e-9 && (a - b).abs() > 0.5,
            "{a} {b} {c} {d}"
        );
        assert!((at(0.0, 0.0) - (BLACK + WHITE) / 2.0).abs() < 1e-9);
        assert_eq!(at(100.0, 0.0), TABLE);
        assert_eq!(at(-6.0, 3.0), WHITE);
    }

    #[test]
    fn stations_rest_and_then_move() {
        let moved = |a: f64, b: f64| (station(a).translation() - station(b).translation()).norm();
        assert!(moved(0.05, 0.35) < 1e-9);
        assert!(moved(0.45, 0.75) > 0.1);
        assert!(moved(0.79999, 0.80001) < 0.1);
    }
}
