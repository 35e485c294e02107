//! Cameras from pictures of boards: synthetic truth, and real pictures.

use std::path::{Path, PathBuf};

use endofield::calibration::board::detection::{BoardCorner, Detection, detect};
use endofield::calibration::board::pattern::BoardLayout;
use endofield::calibration::board::placement::Naming;
use endofield::calibration::camera::cross_validation::cross_validated;
use endofield::calibration::camera::lens::{self, LensModel};
use endofield::calibration::camera::refine::{View, calibrate};
use endofield::camera::distortion::Distortion;
use endofield::camera::file;
use endofield::camera::intrinsics::{Intrinsics, Pixel};
use endofield::camera::model::CameraModel;
use endofield::geometry::point::Point;
use endofield::geometry::space::{Board, Camera};
use endofield::geometry::transform::Transform;
use endofield::media::image_files;
use nalgebra::{DVector, UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::support::command::{endofield, told};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/boards").join(name)
}

fn camera(model: LensModel) -> CameraModel {
    let mut camera = model.camera(
        960,
        540,
        Intrinsics {
            fx: 720.0,
            fy: 724.0,
            cx: 471.0,
            cy: 281.0,
        },
    );
    camera.distortion = match model {
        LensModel::PlumbBob => Distortion::BrownConrady {
            k: [-0.28, 0.09, -0.01, 0.0, 0.0, 0.0],
            p: [0.0008, -0.0012],
        },
        LensModel::RationalPolynomial => Distortion::BrownConrady {
            k: [0.2, -0.05, 0.01, 0.5, 0.02, 0.0],
            p: [0.0008, -0.0012],
        },
        LensModel::Equidistant => Distortion::KannalaBrandt {
            k: [-0.03, 0.012, -0.005, 0.001],
        },
    };
    camera
}

/// Boards waved before the camera, their corners off by `noise_px`; those outside the picture are not seen.
fn views(camera: &CameraModel, count: usize, noise_px: f64, seed: u64) -> Vec<View> {
    let sites = BoardLayout::new("checkerboard:12x9", 5.0).unwrap().sites();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    (0..count)
        .map(|_| {
            let mut draw = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
            let turn = UnitQuaternion::from_euler_angles(draw(0.6), draw(0.6), draw(1.0));
            let middle = Vector3::new(draw(22.0), draw(12.0), 85.0 + draw(20.0));
            let pose: Transform<Camera, Board> = Transform::new(turn, middle - turn * Vector3::new(27.5, 20.0, 0.0));
            let corners = (sites.iter().enumerate())
                .filter_map(|(site, place)| {
                    let board = Point::new(place.board_mm[0], place.board_mm[1], 0.0);
                    let at = camera.project(pose * board).filter(|at| camera.contains(*at, 2.0))?;
                    let mut noise = || noise_px * random.sample::<f64, _>(StandardNormal);
                    let pixel = Pixel {
                        x: at.x + noise(),
                        y: at.y + noise(),
                    };
                    Some(BoardCorner {
                        site,
                        board,
                        pixel,
                        sigma_px: noise_px,
                    })
                })
                .collect();
            View {
                corners,
                dot_radius_mm: None,
            }
        })
        .collect()
}

#[test]
fn every_model_is_found_within_its_covariance() {
    const NOISE_PX: f64 = 0.1;
    for model in [LensModel::PlumbBob, LensModel::Equidistant] {
        let truth = camera(model);
        let count = model.names().len();
        let runs = 24;
        let mut mean = 0.0;
        for seed in 0..runs {
            let found = calibrate(&views(&truth, 14, NOISE_PX, seed), (960, 540), model).unwrap();
            let error = DVector::from_fn(count, |place, _| {
                lens::parameter(&found.camera, model, place) - lens::parameter(&truth, model, place)
            });
            let information = found.covariance.unwrap().try_inverse().unwrap();
            mean += error.dot(&(information * &error)) / runs as f64;
            assert!(
                (0.9..1.1).contains(&(found.sigma_px / NOISE_PX)),
                "{model:?} {}",
                found.sigma_px
            );
        }
        // The mean of `runs` χ² of `count` degrees: count ± 4·√(2·count/runs).
        let bound = 4.0 * (2.0 * count as f64 / runs as f64).sqrt();
        assert!((mean - count as f64).abs() < bound, "{model:?}: {mean} of {count}");
    }
}

#[test]
fn a_rational_lens_is_explained_to_the_noise() {
    // Its coefficients stand in for one another; what counts is where points are seen.
    let model = LensModel::RationalPolynomial;
    let truth = camera(model);
    let views = views(&truth, 20, 0.1, 5);
    let found = calibrate(&views, (960, 540), model).unwrap();
    assert!((0.9..1.1).contains(&(found.sigma_px / 0.1)), "{}", found.sigma_px);
    let difference = cross_validated(&views, (960, 540), model, &found).unwrap();
    assert!(difference.median_px < 0.1, "{difference:?}");
}

#[test]
fn wrong_corners_are_named_and_do_no_harm() {
    let truth = camera(LensModel::PlumbBob);
    let mut views = views(&truth, 12, 0.1, 3);
    for view in &mut views {
        view.corners[5].pixel.x += 4.0;
    }
    // One board mistaken by a whole row at one end.
    for corner in views[4].corners.iter_mut().skip(20).step_by(2) {
        corner.pixel.y += 15.0;
    }
    let found = calibrate(&views, (960, 540), LensModel::PlumbBob).unwrap();
    assert!(
        (found.camera.intrinsics.fx - truth.intrinsics.fx).abs() < 1.5,
        "{:?}",
        found.camera
    );
    assert!(found.views.iter().all(|view| !view.residuals[5].used));
    let left_out = found
        .views
        .iter()
        .flat_map(|view| &view.residuals)
        .filter(|residual| !residual.used)
        .count();
    assert!(left_out > 40 && left_out < 140, "{left_out}");
}

#[test]
fn a_mirrored_board_fits_no_camera() {
    let truth = camera(LensModel::PlumbBob);
    let mut views = views(&truth, 12, 0.1, 3);
    for view in &mut views {
        for corner in &mut view.corners {
            corner.board = Point::new(corner.board.coords.y, corner.board.coords.x * 1.1, 0.0);
        }
    }
    let found = calibrate(&views, (960, 540), LensModel::PlumbBob);
    assert!(found.is_err() || found.is_ok_and(|found| found.rms_px > 1.0));
}

#[test]
fn the_simulated_scope_is_calibrated_from_its_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let made = endofield(
        &[
            "simulate",
            "out",
            "--scene",
            "calibration",
            "--size",
            "640x360",
            "--survey-frames",
            "120",
            "--frames",
            "0",
            "--seed",
            "4",
        ],
        folder.path(),
    );
    assert!(made.status.success(), "{}", told(&made));
    let ran = endofield(
        &[
            "calibrate",
            "camera",
            "out/survey",
            "--board",
            "checkerboard:9x6",
            "--square-mm",
            "4",
            "--frames",
            "24",
            "-o",
            "camera.yaml",
            "--corners-out",
            "corners.json",
        ],
        folder.path(),
    );
    assert!(ran.status.success(), "{}", told(&ran));
    let truth = file::read(&folder.path().join("out/truth/survey/camera.yaml")).unwrap();
    let found = file::read(&folder.path().join("camera.yaml")).unwrap();
    // 24 views of 54 corners at 0.05 px each: fx to about f·σ/(size·√n) ≈ 600·0.05/(200·√1300) ≈ 0.005 if all else were known; the other
    // parameters cost a factor of some tens.
    assert!((found.intrinsics.fx - truth.intrinsics.fx).abs() < 0.5, "{found:?}");
    assert!((found.intrinsics.cx - truth.intrinsics.cx).abs() < 0.5, "{found:?}");
    let mut checked = 0;
    let corners: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.path().join("corners.json")).unwrap()).unwrap();
    let known = std::fs::read_to_string(folder.path().join("out/truth/survey/corners.csv")).unwrap();
    let mut squares = 0.0;
    for view in corners["views"].as_array().unwrap() {
        let frame: u64 = view["name"].as_str().unwrap().trim_end_matches(".png").parse().unwrap();
        for corner in view["corners"].as_array().unwrap() {
            let prefix = format!("{frame},{},", corner["site"]);
            let Some(line) = known.lines().find(|line| line.starts_with(&prefix)) else {
                continue;
            };
            let numbers: Vec<f64> = line.split(',').map(|number| number.parse().unwrap()).collect();
            let (dx, dy) = (
                corner["pixel"][0].as_f64().unwrap() - numbers[2],
                corner["pixel"][1].as_f64().unwrap() - numbers[3],
            );
            assert!(dx.hypot(dy) < 0.3, "{line}: off by ({dx}, {dy})");
            squares += dx * dx + dy * dy;
            checked += 1;
        }
    }
    let rms = (squares / f64::from(checked)).sqrt();
    assert!(checked > 800 && rms < 0.06, "{checked} corners, {rms} px");
    let report: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.path().join("camera_report.json")).unwrap()).unwrap();
    assert!(report["rms_px"].as_f64().unwrap() < 0.06 && report["covariance"].is_array());
    let plot = image_files::read(&folder.path().join("camera_report.png")).unwrap();
    assert!(plot.width() > 1600);
    // What is there is not overwritten.
    let again = endofield(
        &[
            "calibrate",
            "camera",
            "out/survey",
            "--board",
            "checkerboard:9x6",
            "--square-mm",
            "4",
            "-o",
            "camera.yaml",
        ],
        folder.path(),
    );
    assert_eq!(again.status.code(), Some(1));
    assert!(told(&again).contains("--force"));
}

fn found(name: &str, board: &str, square_mm: f64) -> Detection {
    let image = image_files::read(&fixture(name)).unwrap();
    detect(&image, &BoardLayout::new(board, square_mm).unwrap()).unwrap()
}

#[test]
fn real_laparoscope_pictures_show_their_boards() {
    let mut charuco = Vec::new();
    // OpenCV 5.0 finds 140, 87 and 97 ChArUco corners.
    for (name, fewest) in [
        ("laparoscope_1.jpg", 250),
        ("laparoscope_2.jpg", 180),
        ("laparoscope_3.jpg", 110),
    ] {
        let detection = found(name, "charuco:19x26:4:4x4_250:legacy", 5.0);
        assert!(detection.corners.len() >= fewest, "{name}: {}", detection.corners.len());
        charuco.push(View {
            corners: detection.corners,
            dot_radius_mm: None,
        });
        let inset = found(name, "checkerboard:13x8", 3.0);
        assert!(inset.corners.len() >= 100, "{name}: {}", inset.corners.len());
        assert_eq!(inset.naming, Naming::Unique);
    }
    let calibration = calibrate(&charuco, (720, 576), LensModel::PlumbBob).unwrap();
    assert!(calibration.rms_px < 0.25, "{}", calibration.rms_px);
    // All 15 pictures of that camera give 834.1 ± 0.2 and 909.0 ± 0.2; PAL pixels are 1.09 times as wide as high.
    let k = &calibration.camera.intrinsics;
    assert!((k.fx - 834.1).abs() < 4.0 && (k.fy / k.fx - 1.09).abs() < 0.003, "{k:?}");
}

#[test]
fn real_dots_in_a_round_field_are_all_found() {
    for name in ["immersed_1.jpg", "immersed_2.jpg"] {
        let detection = found(name, "acircles:3x11", 1.0);
        assert_eq!((detection.corners.len(), detection.naming), (33, Naming::Unique), "{name}");
        let radius = detection.dot_radius_mm.unwrap();
        assert!((0.4..0.7).contains(&radius), "{radius}");
    }
}

#[test]
fn faults_are_told_in_sentences() {
    let folder = tempfile::tempdir().unwrap();
    let (lap, dots) = (fixture("laparoscope_1.jpg"), fixture("immersed_1.jpg"));
    let (lap, dots) = (lap.to_str().unwrap(), dots.to_str().unwrap());
    let board = ["--square-mm", "3", "-o", "x.yaml"];
    let run = |arguments: &[&str]| endofield(&[&["calibrate", "camera"], arguments, &board].concat(), folder.path());
    let wrong_board = run(&[lap, "--board", "chess:1x1"]);
    assert_eq!(wrong_board.status.code(), Some(2));
    assert!(told(&wrong_board).contains("charuco:19x26"), "{}", told(&wrong_board));
    let none = run(&[dots, "--board", "checkerboard:9x6"]);
    assert_eq!(none.status.code(), Some(1));
    assert!(told(&none).contains("found it in 0 of 1"), "{}", told(&none));
    let sizes = run(&[lap, dots, "--board", "checkerboard:13x8"]);
    assert!(
        told(&sizes).contains("720×576") && told(&sizes).contains("768×710"),
        "{}",
        told(&sizes)
    );
    assert!(!folder.path().join("x.yaml").exists());
}
