//! The arm's clock against the camera's, as a user measures it.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use crate::support::command::{endofield, told};

fn report(path: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

/// Three seconds at 12 fps and 320×180, stamps 30 ms early. The hand errs by 0.25 mm and 0.08° a reading at some 70 mm/s and 0.25 rad/s:
/// 3 ms a reading, 0.3 ms from 150; what the path's freedom takes and the small pictures' errors leave it within the 3 ms that are asked.
#[test]
fn a_simulated_survey_tells_its_offset() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let simulate = "simulate sim --size 320x180 --frames 0 --survey-frames 36 --fps 12 --pose-late-ms -30 --seed 41";
    let output = endofield(&simulate.split(' ').collect::<Vec<_>>(), folder);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    let output = endofield(&["calibrate", "time-offset", "sim/survey", "--write"], folder);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        table.contains("to be added to the arm's stamps") && table.contains("log-likelihood"),
        "{table}"
    );
    let report = report(&folder.join("sim/survey/time_offset_report.json"));
    assert_eq!(
        (report["method"].as_str(), report["sure"].as_bool()),
        (Some("camera path"), Some(true)),
        "{report:#}"
    );
    let (offset, sigma) = (
        report["time_offset_ms"].as_f64().unwrap(),
        report["sigma_ms"].as_f64().unwrap(),
    );
    assert!(
        (offset - 30.0).abs() < 3.0 && (offset - 30.0).abs() < 4.0 * sigma,
        "{offset} ± {sigma}"
    );
    assert!(folder.join("sim/survey/time_offset_report.png").is_file());
    let hand_eye = fs::read_to_string(folder.join("sim/survey/hand_eye.yaml")).unwrap();
    assert!(hand_eye.contains("time_offset_s: 0.0"), "{hand_eye}");
    // A second time only with --force: the report is there.
    let again = endofield(&["calibrate", "time-offset", "sim/survey", "--write"], folder);
    assert_eq!(again.status.code(), Some(1), "{}", told(&again));
}

/// A line that bobs as ultrasound shows the bottom of a tank, 12 pictures a second for 20 s, and a probe that bobs likewise; the
/// tracker's stamps are 60 ms early. A picture in which the line is found to half a px, at 40 px/s on average, tells the time to about
/// 12 ms, 240 of them to 1 ms; 20 ms is what is asked of a real tank.
#[test]
fn ultrasound_and_tracker_are_imported_and_tell_their_offset() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let depth = |t: f64| 50.0 + 22.0 * (1.9 * t).sin() + 9.0 * (3.7 * t + 1.0).sin() + 5.0 * (0.8 * t).cos();
    let (width, height, frames) = (160, 120, 240);
    let mut header = format!(
        "ObjectType = Image\nNDims = 3\nCompressedData = False\nDimSize = {width} {height} {frames}\nElementType = MET_UCHAR\n"
    );
    let mut pixels = Vec::new();
    for frame in 0..frames {
        let t = f64::from(frame) / 12.0;
        writeln!(
            header,
            "Seq_Frame{frame:04}_Timestamp = {:.6}\nSeq_Frame{frame:04}_ImageStatus = OK",
            100.0 + t
        )
        .unwrap();
        for y in 0..height {
            for x in 0..width {
                let away = f64::from(y) - depth(t) - 0.06 * (f64::from(x) - 80.0);
                let lit = (20..140).contains(&x);
                pixels.push(if lit {
                    (140.0 * (-0.5 * (away / 1.5).powi(2)).exp()) as u8
                } else {
                    0
                });
            }
        }
    }
    header.push_str("ElementDataFile = LOCAL\n");
    fs::write(folder.join("video.mha"), [header.into_bytes(), pixels].concat()).unwrap();
    let mut header = "ObjectType = Image\nNDims = 3\nDimSize = 0 0 1100\n".to_owned();
    for reading in 0..1100 {
        let t = f64::from(reading) / 50.0 - 1.0;
        let status = if reading % 97 == 5 { "INVALID" } else { "OK" };
        write!(
            header,
            "Seq_Frame{reading:04}_Timestamp = {:.6}\nSeq_Frame{reading:04}_ProbeToTrackerTransform = 1 0 0 {:.4} 0 1 0 2 0 0 1 {:.4} 0 0 0 1\n\
             Seq_Frame{reading:04}_ProbeToTrackerTransformStatus = {status}\n",
            100.0 + t - 0.06,
            0.5 * (2.3 * t).sin(),
            -0.4 * depth(t)
        )
        .unwrap();
    }
    header.push_str("ElementDataFile = LOCAL\n");
    fs::write(folder.join("tracker.mha"), header).unwrap();
    let output = endofield(&["import", "video.mha", "tracker.mha", "-o", "tank"], folder);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
    assert!(told(&output).contains("240 pictures, 1088 poses"), "{}", told(&output));
    let output = endofield(
        &[
            "calibrate",
            "time-offset",
            "tank",
            "--json",
            "tank.json",
            "--plot",
            "tank.png",
        ],
        folder,
    );
    let report = report(&folder.join("tank.json"));
    assert_eq!(output.status.code(), Some(0), "{}: {report:#}", told(&output));
    assert_eq!(report["method"].as_str(), Some("image motion"));
    let offset = report["time_offset_ms"].as_f64().unwrap();
    assert!((offset - 60.0).abs() < 20.0, "{report:#}");
}
