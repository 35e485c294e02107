//! What a recording says about itself when it is complete, lacks something, or is wrong.

use std::path::Path;

use endofield::recording::folder::{Part, Recording};

fn put(folder: &Path, name: &str, text: &str) {
    std::fs::write(folder.join(name), text).unwrap();
}

const CAMERA: &str = "image_width: 1920\nimage_height: 1080\ncamera_name: scope\n\
                      camera_matrix: {rows: 3, cols: 3, data: [1500, 0, 960, 0, 1500, 540, 0, 0, 1]}\n\
                      distortion_model: equidistant\ndistortion_coefficients: {rows: 1, cols: 4, data: [0.01, 0, 0, 0]}\n";

#[test]
fn every_wrong_file_is_named() {
    for (name, text, word) in [
        ("camera.yaml", "image_width: 10\n", "image_height"),
        ("camera.yaml", "{{{", "camera.yaml"),
        (
            "hand_eye.yaml",
            "unit: mm\ntransformation: {x: 0, y: 0, z: 0, qx: 0, qy: 0, qz: 0, qw: 0}\n",
            "length 0",
        ),
        (
            "poses.tum",
            "# T_base_hand, mm\n1 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1\n",
            "line 3: time runs backwards",
        ),
        ("poses.tum", "# T_base_hand, mm\n1 nan 0 0 0 0 0 1\n", "line 2"),
        ("poses.tum", "", "found none"),
        ("joints.csv", "timestamp_s,q1\n0,1\n", "line 2"),
        ("frames.csv", "frame,timestamp_s\n0,x\n", "line 2"),
        ("arm.toml", "name = 1", "the arm's table"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        put(folder.path(), "video.mp4", "");
        if name == "arm.toml" {
            put(folder.path(), "joints.csv", "0,0\n");
        }
        put(folder.path(), name, text);
        let message = Recording::open(folder.path()).unwrap_err().to_string();
        assert!(message.contains(word), "{name}: `{message}` should say `{word}`");
    }
}

#[test]
fn a_partial_recording_tells_what_it_lacks() {
    let folder = tempfile::tempdir().unwrap();
    put(folder.path(), "video.avi", "");
    put(folder.path(), "camera.yaml", CAMERA);
    put(
        folder.path(),
        "joints.csv",
        "timestamp_s,q1,q2,q3,q4,q5,q6,q7\n0,0,0,0,0,0,0,0\n0.02,1,0,0,0,0,0,0\n",
    );
    let recording = Recording::open(folder.path()).unwrap();
    let missing = recording.missing();
    assert_eq!(missing.iter().map(|m| m.what).collect::<Vec<_>>(), [Part::HandEye]);
    assert!(missing[0].to_string().starts_with("no hand_eye.yaml: "));
    assert_eq!(recording.trajectory.as_ref().map(|t| t.poses().len()), Some(2));
    assert!(recording.check_video_size(1920, 1080).is_ok());
    assert!(recording.check_video_size(1280, 720).is_err());
}
