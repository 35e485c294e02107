//! A video with the poses that structure from motion found: imported, made into a light field, enhanced with it, as a user types it.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use crate::support::command::{endofield, told};
use endofield::robot::trajectory::TumFile;

/// Length of a unit of the model, mm.
const UNIT_MM: f64 = 2.5;
/// Every so many frames have a pose.
const STEP: usize = 4;

fn succeeded(arguments: &[&str], folder: &Path) -> String {
    let output = endofield(arguments, folder);
    let told = told(&output);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {told}");
    told
}

/// A simulated sweep of 25 frames, and a list of the true poses of every fourth as structure from motion would give them.
fn clip(folder: &Path) {
    succeeded(
        &[
            "simulate",
            "sim",
            "--size",
            "320x180",
            "--frames",
            "1",
            "--survey-frames",
            "25",
        ],
        folder,
    );
    let truth = TumFile::read(&folder.join("sim/truth/survey/camera_poses.tum")).unwrap();
    let mut frames = String::new();
    for (number, (_, pose)) in truth.poses.iter().enumerate().step_by(STEP) {
        let m = pose.inverse().to_homogeneous();
        let row = |i: usize| {
            let t = if i < 3 { m[(i, 3)] / UNIT_MM } else { 1.0 };
            format!("[{}, {}, {}, {t}]", m[(i, 0)], m[(i, 1)], m[(i, 2)])
        };
        let comma = if number > 0 { "," } else { "" };
        let rows: Vec<String> = (0..4).map(row).collect();
        write!(
            frames,
            "{comma}\n{{\"video_frame\": {number}, \"world_to_cam\": [{}]}}",
            rows.join(", ")
        )
        .unwrap();
    }
    // The simulated lens at this size; COLMAP puts (0.5, 0.5) at the centre of the first pixel.
    let camera = "\"model\": \"FULL_OPENCV\", \"width\": 320, \"height\": 180, \"fx\": 294.4, \"fy\": 294.88, \"cx\": 161.824, \
                  \"cy\": 88.688, \"k1\": -0.24, \"k2\": 0.085, \"p1\": 0.0006, \"p2\": -0.0004, \"k3\": -0.012, \"k4\": 0, \"k5\": 0, \"k6\": 0";
    fs::write(folder.join("poses.json"), format!("{{{camera}, \"frames\": [{frames}\n]}}")).unwrap();
}

#[test]
fn a_clip_is_enhanced_by_its_own_light_field() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    clip(folder);
    let import = [
        "light-field",
        "import",
        "poses.json",
        "--video",
        "sim/survey/video.mp4",
        "-o",
        "clip",
    ];

    // Without scene points nothing tells the scale.
    let refused = endofield(&import, folder);
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--unit-mm"));
    let told = succeeded(&[&import[..], &["--unit-mm", "2.5"]].concat(), folder);
    assert!(told.contains("7 of 25 frames have a pose"), "{told}");

    // Between the posed frames the camera is where it was in truth; lens and pictures fit each other.
    let truth = TumFile::read(&folder.join("sim/truth/survey/camera_poses.tum")).unwrap();
    let found = TumFile::read(&folder.join("clip/poses.tum")).unwrap();
    assert_eq!((found.poses.len(), found.transform.as_deref()), (25, Some("T_base_hand")));
    for (number, ((_, found), (_, truth))) in found.poses.iter().zip(&truth.poses).enumerate() {
        let away = found.inv_mul(truth);
        // The simulated sweep is faster than any hand: it goes all the way in a second.
        let (mm, rad) = if number % STEP == 0 { (1e-3, 1e-6) } else { (1.5, 0.02) };
        assert!(away.translation.vector.norm() < mm, "frame {number}: {away}");
        assert!(away.rotation.angle() < rad, "frame {number}: {away}");
    }

    succeeded(&["light-field", "build", "clip", "-o", "clip.lf", "--views", "25"], folder);
    let process = [
        "process",
        "clip",
        "-o",
        "out.mkv",
        "--light-field",
        "clip.lf",
        "--stages",
        "undistort,specular",
    ];
    succeeded(&[&process[..], &["--report", "report.json"]].concat(), folder);
    let report: serde_json::Value = serde_json::from_str(&fs::read_to_string(folder.join("report.json")).unwrap()).unwrap();
    let frames = report["per_frame"].as_array().unwrap();
    let share = |code: &str| frames.iter().map(|f| f["mask"][code].as_f64().unwrap()).sum::<f64>();
    assert!(frames.iter().all(|frame| frame["pose"] == "measured"));
    assert!(
        share("255") > 0.3 * (share("64") + share("255")),
        "{} {}",
        share("64"),
        share("255")
    );
}

#[test]
fn poses_that_do_not_fit_the_video_are_refused() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    clip(folder);
    let list = fs::read_to_string(folder.join("poses.json")).unwrap();
    for (from, to, word) in [
        ("\"width\": 320", "\"width\": 640", "expected 640x180"),
        ("\"video_frame\": 24", "\"video_frame\": 25", "found frame 25"),
        ("\"video_frame\": 4,", "\"video_frame\": 0,", "two for frame 0"),
        (
            "\"world_to_cam\": [[",
            "\"world_to_cam\": [[0, ",
            "frame 0: expected world_to_cam",
        ),
        ("FULL_OPENCV", "FISH", "`FISH`"),
    ] {
        fs::write(folder.join("bad.json"), list.replacen(from, to, 1)).unwrap();
        let arguments = [
            "light-field",
            "import",
            "bad.json",
            "--video",
            "sim/survey/video.mp4",
            "-o",
            "bad",
            "--unit-mm",
            "1",
        ];
        let output = endofield(&arguments, folder);
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{to}: {told}");
        assert!(told.starts_with("error: ") && told.contains(word), "{to}: {told}");
        assert!(!folder.join("bad").exists());
    }
}
