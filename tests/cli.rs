//! What a user meets at the command line: exit codes and messages.

use std::path::Path;

use crate::support::command::{endofield, told};
use endofield::image::buffer::Image;

/// A folder of small pictures with a bright square that wanders.
fn pictures(folder: &Path, count: usize) {
    std::fs::create_dir_all(folder).unwrap();
    for number in 0..count {
        let mut image = Image::filled(96, 64, [120_u8, 60, 50]);
        for y in 20..40 {
            for x in 10 + number..30 + number {
                image.set(x, y, [170, 120, 90]);
            }
        }
        image::save_buffer(
            folder.join(format!("{number:06}.png")),
            image.as_bytes(),
            96,
            64,
            image::ColorType::Rgb8,
        )
        .unwrap();
    }
}

#[test]
fn help_has_an_example_and_succeeds() {
    let folder = tempfile::tempdir().unwrap();
    for command in [vec!["--help"], vec!["process", "--help"], vec!["demo", "--help"]] {
        let output = endofield(&command, folder.path());
        let text = String::from_utf8_lossy(&output.stdout);
        assert_eq!(output.status.code(), Some(0), "{command:?}");
        assert!(
            text.contains("endofield process") || text.contains("endofield demo"),
            "{command:?}: {text}"
        );
    }
    assert_eq!(endofield(&["--version"], folder.path()).status.code(), Some(0));
}

#[test]
fn bad_usage_is_2() {
    let folder = tempfile::tempdir().unwrap();
    pictures(&folder.path().join("in"), 2);
    let wrong: [&[&str]; 8] = [
        &[],
        &["improve"],
        &["process", "in"],
        &["process", "in", "-o", "out.mp3"],
        &["process", "in", "-o", "out/", "--stages", "median,colour"],
        &["process", "in", "-o", "out/", "--set", "output.crf"],
        &["process", "in", "-o", "out/", "--set", "output.crf=99"],
        &["process", "in", "-o", "out/", "--start", "2", "--end", "1"],
    ];
    for arguments in wrong {
        let output = endofield(arguments, folder.path());
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", told(&output));
    }
    assert!(!folder.path().join("out").exists());
}

#[test]
fn the_settings_are_printed_without_an_input() {
    let folder = tempfile::tempdir().unwrap();
    let output = endofield(&["process", "--set", "output.crf=33", "--print-config"], folder.path());
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("crf = 33"));
}

#[test]
fn pictures_go_through_the_line_and_the_report_tells() {
    let folder = tempfile::tempdir().unwrap();
    pictures(&folder.path().join("in"), 7);
    let arguments = [
        "process",
        "in",
        "-o",
        "out/",
        "--mask-out",
        "mask/",
        "--side-by-side",
        "both/",
        "--report",
        "report.json",
    ];
    let output = endofield(&arguments, folder.path());
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    let count = |name: &str| std::fs::read_dir(folder.path().join(name)).unwrap().count();
    assert_eq!((count("out"), count("mask"), count("both")), (7, 7, 7));
    let said = told(&output);
    assert_eq!(said.lines().filter(|line| line.contains("undistort:")).count(), 1, "{said}");
    assert_eq!(said.lines().filter(|line| line.contains("specular:")).count(), 1, "{said}");
    let text = std::fs::read_to_string(folder.path().join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(
        (report["frames"]["in"].as_u64(), report["frames"]["out"].as_u64()),
        (Some(7), Some(7))
    );
    assert_eq!(report["frames"]["dropped"].as_u64(), Some(0));
    assert_eq!(report["per_frame"].as_array().unwrap().len(), 7);
    assert_eq!(report["per_frame"][0]["pose"], "missing");
    assert!(report["stages"].as_array().unwrap().iter().all(|stage| stage["count"] == 7));
    assert!(report["end_to_end"]["p99_ms"].as_f64().unwrap() > 0.0);

    let again = endofield(&arguments, folder.path());
    assert_eq!(again.status.code(), Some(1));
    assert!(told(&again).contains("--force"), "{}", told(&again));
    let forced: Vec<&str> = arguments.iter().copied().chain(["--force"]).collect();
    assert_eq!(endofield(&forced, folder.path()).status.code(), Some(0));
}

#[test]
fn the_input_is_never_the_output() {
    let folder = tempfile::tempdir().unwrap();
    pictures(&folder.path().join("in"), 2);
    let output = endofield(&["process", "in", "-o", "in/", "--force"], folder.path());
    assert_eq!(output.status.code(), Some(1));
    assert!(told(&output).contains("input"), "{}", told(&output));
    let twice = endofield(&["process", "in", "-o", "out.mkv", "--mask-out", "out.mkv"], folder.path());
    assert_eq!(twice.status.code(), Some(2), "{}", told(&twice));
}

#[test]
fn what_is_no_video_is_refused_with_a_message() {
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    put("empty.mp4", "");
    put("text.mp4", "this is no video\n");
    for input in ["empty.mp4", "text.mp4", "absent.mp4"] {
        let output = endofield(&["process", input, "-o", "out.mkv"], folder.path());
        assert_eq!(output.status.code(), Some(1), "{input}: {}", told(&output));
        assert!(
            told(&output).starts_with("error: ") && told(&output).contains(input),
            "{}",
            told(&output)
        );
        assert!(!told(&output).contains("panicked"));
    }
    assert!(!folder.path().join("out.mkv").exists());
}

#[test]
fn progress_for_machines_is_json() {
    let folder = tempfile::tempdir().unwrap();
    pictures(&folder.path().join("in"), 3);
    let output = endofield(
        &["process", "in", "-o", "out/", "--progress", "json", "--log-format", "json"],
        folder.path(),
    );
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    let told = told(&output);
    for line in told.lines() {
        assert!(serde_json::from_str::<serde_json::Value>(line).is_ok(), "not JSON: {line}");
    }
    assert!(told.contains("\"event\":\"end\""), "{told}");
}
