//! `calibrate color`, as a user types it: a tinted picture of a chart becomes a color file, and `process` puts the colors right.

use std::path::Path;

use endofield::calibration::color::chart::{Edition, PATCHES, place, references};
use endofield::calibration::color::example::{Example, Setting, Tint, taken};
use endofield::calibration::homography::mapped;
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::color::{delta_e_2000, lab_from_linear, linear_from_srgb};
use endofield::media::image_files;
use serde_json::Value;

use crate::support::command::{endofield, told};

fn chart_picture(fall_off: f64) -> Example {
    let setting = Setting {
        seed: 21,
        fall_off,
        exposure: 0.85,
        ..Setting::default()
    };
    taken(960, 540, &setting)
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// Mean ΔE2000 of the patches' middles to the chart.
fn error(image: &Image<Rgb8>, example: &Example) -> f64 {
    let references = references(Edition::Since2014);
    let of_patch = |patch: usize| {
        let [u, v] = place(patch);
        let mut sum = [0.0; 3];
        for i in 0..100 {
            let at = [u + 0.05 * f64::from(i % 10) - 0.22, v + 0.05 * f64::from(i / 10) - 0.22];
            let [x, y] = mapped(&example.pixel_from_chart, at).unwrap();
            let pixel = image.at(x.round() as usize, y.round() as usize);
            for (sum, level) in sum.iter_mut().zip(pixel) {
                *sum += linear_from_srgb(f64::from(level) / 255.0) / 100.0;
            }
        }
        delta_e_2000(lab_from_linear(sum), references[patch].lab)
    };
    (0..PATCHES).map(of_patch).sum::<f64>() / PATCHES as f64
}

#[test]
fn a_chart_calibrates_the_camera_and_process_shows_right_colors() {
    let folder = tempfile::tempdir().unwrap();
    let uneven = chart_picture(0.45);
    image_files::write(&folder.path().join("chart.png"), &uneven.image).unwrap();
    let output = endofield(&["calibrate", "color", "chart.png", "-o", "color.yaml"], folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(table.contains("mean ΔE2000") && table.contains("bluish green"), "{table}");
    let report = json(&folder.path().join("color_report.json"));
    let mean = |key: &str| report[key]["mean"].as_f64().unwrap();
    assert!(mean("before") > 6.0 && mean("after") < 1.5, "{table}");
    assert!(report["cross_validated"].as_f64().unwrap() < 1.5, "{table}");
    assert!(folder.path().join("color_report.png").exists());
    let again = endofield(&["calibrate", "color", "chart.png", "-o", "color.yaml"], folder.path());
    assert!(
        !again.status.success() && told(&again).contains("--force"),
        "{}",
        told(&again)
    );

    // The same camera, the same chart under even light: what process makes of it.
    let even = chart_picture(0.0);
    let recording = folder.path().join("recording");
    std::fs::create_dir_all(recording.join("frames")).unwrap();
    image_files::write(&recording.join("frames/000000.png"), &even.image).unwrap();
    std::fs::copy(folder.path().join("color.yaml"), recording.join("color.yaml")).unwrap();
    let output = endofield(&["process", "recording", "-o", "out/", "--stages", "color"], folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let written = std::fs::read_dir(folder.path().join("out"))
        .unwrap()
        .flatten()
        .map(|e| e.path());
    let picture = written.into_iter().find(|path| image_files::is_picture(path)).unwrap();
    let (before, after) = (error(&even.image, &even), error(&image_files::read(&picture).unwrap(), &even));
    // Light at the chart's middle was not 1 under the uneven light: a few per cent of brightness stay, ΔE about one.
    assert!(before > 8.0 && after < 2.5, "{before} {after}");
}

#[test]
fn corners_help_where_no_chart_is_found_and_faults_say_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let example = chart_picture(0.3);
    image_files::write(&folder.path().join("chart.png"), &example.image).unwrap();
    let corners = [[0.0, 0.0], [5.0, 0.0], [5.0, 3.0], [0.0, 3.0]].map(|at| {
        let [x, y] = mapped(&example.pixel_from_chart, at).unwrap();
        format!("{x:.0},{y:.0}")
    });
    let mut command = vec!["calibrate", "color", "chart.png", "-o", "given.yaml", "--corners"];
    command.extend(corners.iter().map(String::as_str));
    let output = endofield(&command, folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let after = json(&folder.path().join("given_report.json"))["after"]["mean"]
        .as_f64()
        .unwrap();
    assert!(after < 1.5, "{after}");

    for (name, color) in [("gray.png", [120, 120, 120]), ("black.png", [0, 0, 0])] {
        image_files::write(&folder.path().join(name), &Image::filled(320, 240, color)).unwrap();
    }
    let output = endofield(&["calibrate", "color", "gray.png"], folder.path());
    assert!(
        !output.status.success() && told(&output).contains("--corners"),
        "{}",
        told(&output)
    );
    let output = endofield(&["calibrate", "color", "black.png", "--white"], folder.path());
    assert!(
        !output.status.success() && told(&output).contains("white or gray"),
        "{}",
        told(&output)
    );
}

#[test]
fn a_white_target_gives_the_white_balance() {
    let folder = tempfile::tempdir().unwrap();
    let tint = Tint {
        gains: [1.15, 1.0, 0.8],
        ..Tint::NONE
    };
    let level = tint.seen([0.4; 3]).map(|v| (255.0 * v).round() as u8);
    image_files::write(&folder.path().join("white.png"), &Image::filled(320, 240, level)).unwrap();
    let output = endofield(
        &["calibrate", "color", "white.png", "--white", "-o", "color.yaml"],
        folder.path(),
    );
    assert!(output.status.success(), "{}", told(&output));
    let report = json(&folder.path().join("color_report.json"));
    let gains: Vec<f64> = report["gains"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect();
    // A level is 0.6 % of linear light here.
    assert!((gains[0] / gains[1] * 1.15 - 1.0).abs() < 0.01 && (gains[2] / gains[1] * 0.8 - 1.0).abs() < 0.01);
    assert!(report["delta_e_2000_to_gray"]["after"].as_f64().unwrap() < 0.3);
    assert_eq!(report["after_tenths"].as_array().unwrap().len(), 100);
    let plot = image_files::read(&folder.path().join("color_report.png")).unwrap();
    // The target as seen, and corrected beside it: gray.
    let middle = plot.height() / 2;
    assert_eq!(plot.at(200, middle), level);
    let [red, green, blue] = plot.at(700, middle);
    assert!(red.abs_diff(green) <= 1 && blue.abs_diff(green) <= 1, "{red} {green} {blue}");
}
