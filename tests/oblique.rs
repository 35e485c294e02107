//! `calibrate oblique`, as a user types it: pictures of a board at three rotations of a 30° telescope, angles not told.

use std::fs;

use endofield::calibration::plot::style::{FIELD, MARGIN, PANEL_WIDTH};
use endofield::camera::distortion::Distortion;
use endofield::camera::file;
use endofield::camera::intrinsics::{Intrinsics, Pixel};
use endofield::camera::model::CameraModel;
use endofield::camera::oblique::Oblique;
use endofield::geometry::space::{Board, Camera};
use endofield::geometry::transform::Transform;
use endofield::image::buffer::{Image, Rgb8};
use endofield::media::image_files;
use nalgebra::{Unit, UnitQuaternion, Vector3};
use serde_json::Value;

use crate::support::command::{endofield, told};

const SQUARE_MM: f64 = 4.0;

/// A checkerboard of 10 × 7 squares with a white rim before a gray ground, each pixel of nine samples.
fn picture(camera: &CameraModel, camera_from_board: &Transform<Camera, Board>) -> Image<Rgb8> {
    let board_from_camera = camera_from_board.inverse();
    let eye = board_from_camera.translation();
    let mut image = Image::filled(camera.width, camera.height, [0; 3]);
    for y in 0..camera.height {
        for x in 0..camera.width {
            let mut sum = 0.0;
            for sample in 0..9 {
                let at = Pixel {
                    x: x as f64 + f64::from(sample % 3 - 1) / 3.0,
                    y: y as f64 + f64::from(sample / 3 - 1) / 3.0,
                };
                let direction = board_from_camera.rotation() * camera.unproject(at).unwrap().coords;
                let on_board = eye - direction * (eye.z / direction.z);
                let (u, v) = (on_board.x / SQUARE_MM, on_board.y / SQUARE_MM);
                sum += if !(-2.0..10.0).contains(&u) || !(-2.0..7.0).contains(&v) {
                    70.0
                } else if (-1.0..9.0).contains(&u) && (-1.0..6.0).contains(&v) && (u.floor() + v.floor()) as i32 % 2 == 0 {
                    25.0
                } else {
                    220.0
                };
            }
            image.set(x, y, [(sum / 9.0_f64).round() as u8; 3]);
        }
    }
    image
}

#[test]
fn a_telescope_turned_by_unknown_angles_is_calibrated() {
    let camera = CameraModel {
        width: 640,
        height: 480,
        intrinsics: Intrinsics {
            fx: 500.0,
            fy: 500.0,
            cx: 322.0,
            cy: 236.0,
        },
        distortion: Distortion::None,
    };
    let tilt = 30.0_f64.to_radians();
    let truth = Oblique {
        axis: Unit::new_normalize(Vector3::new(0.0, tilt.sin(), tilt.cos())),
        point_mm: Vector3::new(0.5, 0.0, 0.0),
        center: Pixel { x: 318.0, y: 241.0 },
    };
    let folder = tempfile::tempdir().unwrap();
    let angles = [("start", 0.0), ("left", -25.0_f64), ("right", 25.0)];
    let mut list = "picture,station,rotation\n".to_owned();
    for station in 0..6 {
        let i = f64::from(station);
        let turn = UnitQuaternion::from_euler_angles(0.5 * (1.9 * i).sin(), 0.5 * (1.9 * i + 1.0).cos(), 0.4 * (i - 2.5));
        let place = Vector3::new(4.0 * (2.0 * i).cos(), 2.0 * (3.0 * i).sin(), 95.0);
        let board = Transform::new(turn, place - turn * Vector3::new(16.0, 10.0, 0.0));
        for (name, degrees) in &angles {
            if station > 3 && *name != "start" {
                continue;
            }
            let angle = degrees.to_radians();
            let seen = picture(&truth.camera_at(&camera, angle), &(truth.turned_from_zero(angle) * board));
            let file = format!("{station}{name}.png");
            image_files::write(&folder.path().join(&file), &seen).unwrap();
            list += &format!("{file},{station},{name}\n");
        }
    }
    fs::write(folder.path().join("views.csv"), list).unwrap();
    let command = [
        "calibrate",
        "oblique",
        "views.csv",
        "--board",
        "checkerboard:9x6",
        "--square-mm",
        "4",
    ];
    let output = endofield(&command, folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let report: Value = serde_json::from_str(&fs::read_to_string(folder.path().join("camera_report.json")).unwrap()).unwrap();
    let number = |key: &str| report[key].as_f64().unwrap();
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    // Rendered corners are good to some hundredths of a pixel, and no worse than five deviations.
    assert!(number("rms_px") < 0.15 && number("rms_without_turning_px") > 20.0, "{table}");
    let sure = |found: f64, truth: f64, sigma: f64, least: f64| (found - truth).abs() < (5.0 * sigma).max(least);
    assert!(
        sure(number("obliqueness_deg"), 30.0, number("obliqueness_sigma_deg"), 0.1),
        "{table}"
    );
    for (rotation, (_, degrees)) in report["rotations"].as_array().unwrap().iter().zip(angles) {
        let of = |key: &str| rotation[key].as_f64().unwrap();
        assert!(sure(of("angle_deg"), degrees, of("sigma_deg"), 0.1), "{table}");
    }
    let path = folder.path().join("camera.yaml");
    let joint = file::read_oblique(&path).unwrap().unwrap();
    assert!(joint.axis.angle(&truth.axis) < 0.02, "{table}");
    assert!((file::read(&path).unwrap().intrinsics.fx - 500.0).abs() < 5.0, "{table}");

    let plot = image_files::read(&folder.path().join("camera_report.png")).unwrap();
    assert_eq!(plot.width(), 2 * PANEL_WIDTH + 3 * MARGIN);
    // Each picture has a bar, however well it fits: none of their feet is empty ground.
    let foot = plot.height() - MARGIN - 3;
    let pictures = report["pictures"].as_array().unwrap().len() as u32;
    let step = PANEL_WIDTH as f64 / f64::from(pictures);
    for place in 0..pictures {
        let x = 2 * MARGIN + PANEL_WIDTH + ((f64::from(place) + 0.5) * step) as usize;
        assert_ne!(plot.at(x, foot), FIELD, "picture {place}: {table}");
    }

    // What was taken with the telescope turned is processed by the camera at that angle.
    let recording = folder.path().join("recording");
    fs::create_dir_all(recording.join("frames")).unwrap();
    fs::copy(folder.path().join("0right.png"), recording.join("frames/000000.png")).unwrap();
    fs::copy(&path, recording.join("camera.yaml")).unwrap();
    let command = [
        "process",
        "recording",
        "-o",
        "out/",
        "--stages",
        "undistort",
        "--telescope-angle-deg",
    ];
    let output = endofield(&[&command[..], &["25"]].concat(), folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let processed = file::read(&folder.path().join("out/camera.yaml")).unwrap().intrinsics;
    let at_zero = file::read(&path).unwrap();
    let turned = joint.camera_at(&at_zero, 25.0_f64.to_radians()).intrinsics;
    assert!(
        (processed.cx - turned.cx).hypot(processed.cy - turned.cy) < 1e-6,
        "{processed:?} {turned:?}"
    );
    assert!((turned.cx - at_zero.intrinsics.cx).hypot(turned.cy - at_zero.intrinsics.cy) > 0.5);
    // Where nothing is known to turn, an angle is refused.
    file::write(&recording.join("camera.yaml"), &at_zero, "straight").unwrap();
    let output = endofield(&[&command[..], &["25", "--force"]].concat(), folder.path());
    assert!(
        output.status.code() == Some(1) && told(&output).contains("calibrate oblique"),
        "{}",
        told(&output)
    );

    // Without turning there is no joint to be found.
    let straight = fs::read_to_string(folder.path().join("views.csv")).unwrap();
    let first_only: String = straight
        .lines()
        .filter(|line| !line.ends_with("left"))
        .map(|line| format!("{line}\n"))
        .collect();
    fs::write(folder.path().join("few.csv"), first_only).unwrap();
    let command = [
        "calibrate",
        "oblique",
        "few.csv",
        "--board",
        "checkerboard:9x6",
        "--square-mm",
        "4",
        "--force",
    ];
    let output = endofield(&command, folder.path());
    assert!(
        !output.status.success() && told(&output).contains("rotations"),
        "{}",
        told(&output)
    );
}
