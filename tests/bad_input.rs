//! Wrong input as a user types it, through `process` and `light-field build`: a message that names the file, exit code 1, no panic.

use std::fs;
use std::path::Path;
use std::process::Command;

use endofield::image::buffer::Image;
use endofield::media::image_files;

use crate::support::command::{endofield, told};

/// Fails with 1 and says every one of `words`.
fn refused(arguments: &[&str], folder: &Path, words: &[&str]) {
    let output = endofield(arguments, folder);
    let told = told(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {told}");
    assert!(!told.contains("panicked"), "{arguments:?}: {told}");
    for word in words {
        assert!(told.contains(word), "{arguments:?}: expected `{word}` in: {told}");
    }
}

/// A simulated operation in `sim`: 12 frames of 160×90.
fn simulated(folder: &Path) {
    let arguments = [
        "simulate",
        "sim",
        "--size",
        "160x90",
        "--frames",
        "12",
        "--survey-frames",
        "12",
    ];
    let output = endofield(&arguments, folder);
    assert_eq!(output.status.code(), Some(0), "{}", told(&output));
}

fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
    }
}

/// The text with line `number` (from 1) changed.
fn with_line(text: &str, number: usize, change: impl Fn(&str) -> String) -> String {
    let lines = (1..).zip(text.lines());
    lines
        .map(|(n, line)| if n == number { change(line) } else { line.to_owned() } + "\n")
        .collect()
}

fn with_word(line: &str, index: usize, word: &str) -> String {
    let words = line.split(' ').enumerate();
    words
        .map(|(i, old)| if i == index { word } else { old })
        .collect::<Vec<_>>()
        .join(" ")
}

#[test]
fn a_recording_whose_files_are_wrong() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    simulated(folder);
    type Change = fn(&str) -> String;
    let cases: [(&str, Change, &[&str]); 6] = [
        (
            "poses.tum",
            |text| with_line(text, 8, |line| with_word(line, 1, "nan")),
            &["poses.tum, line 8", "finite", "`nan`"],
        ),
        (
            "poses.tum",
            |text| with_line(text, 8, |line| with_word(line, 0, "-100.0")),
            &["poses.tum, line 8", "backwards"],
        ),
        (
            "poses.tum",
            |text| {
                with_line(text, 8, |line| {
                    (4..8).fold(line.to_owned(), |line, i| with_word(&line, i, "0"))
                })
            },
            &["poses.tum, line 8", "length 0"],
        ),
        (
            "camera.yaml",
            |text| text.replace("image_width: 160", "image_width: 320"),
            &["320x90", "160x90"],
        ),
        (
            "frames.csv",
            |text| text.lines().take(6).map(|line| format!("{line}\n")).collect(),
            &["frames.csv: expected a line for each frame"],
        ),
        (
            "hand_eye.yaml",
            |text| text.replace("rotation:", "turning:"),
            &["hand_eye.yaml", "expected"],
        ),
    ];
    for (index, (file, change, words)) in cases.into_iter().enumerate() {
        let name = format!("bad{index}");
        copied(&folder.join("sim/survey"), &folder.join(&name));
        let path = folder.join(&name).join(file);
        let text = fs::read_to_string(&path).unwrap();
        let changed = change(&text);
        assert_ne!(changed, text, "{file}");
        fs::write(&path, changed).unwrap();
        refused(&["process", &name, "-o", &format!("{name}.mkv")], folder, words);
        refused(&["light-field", "build", &name, "-o", &format!("{name}.lf")], folder, words);
    }
}

#[test]
fn a_video_that_ends_too_early_or_changes_its_size() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    simulated(folder);
    let whole = fs::read(folder.join("sim/survey/video.mp4")).unwrap();
    copied(&folder.join("sim/survey"), &folder.join("cut"));
    fs::write(folder.join("cut/video.mp4"), &whole[..whole.len() * 2 / 3]).unwrap();
    refused(
        &["process", "cut", "-o", "cut.mp4"],
        folder,
        &["video.mp4", "copy the file again"],
    );
    refused(&["light-field", "build", "cut", "-o", "cut.lf"], folder, &["video.mp4"]);
    assert!(!folder.join("cut.lf").exists());
    // What came before the end was used, and told once.
    let again = endofield(&["process", "cut/video.mp4", "-o", "again.mp4"], folder);
    assert!(told(&again).matches("damaged data").count() <= 1, "{}", told(&again));
    assert!(fs::metadata(folder.join("again.mp4")).unwrap().len() > 1000);

    let mut stream = Vec::new();
    for size in ["160x90", "320x180"] {
        let part = Command::new("ffmpeg")
            .args(["-v", "error", "-f", "lavfi", "-i", &format!("testsrc=s={size}:d=0.4:r=25")])
            .args(["-c:v", "libx264", "-f", "mpegts", "-"])
            .output()
            .unwrap();
        stream.extend(part.stdout);
    }
    fs::write(folder.join("change.ts"), stream).unwrap();
    refused(
        &["process", "change.ts", "-o", "change.mp4"],
        folder,
        &["160×90", "320×180", "split the recording"],
    );
}

#[test]
fn a_light_field_that_is_not_whole() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    simulated(folder);
    let sparse = folder.join("site.lf/sparse");
    fs::create_dir_all(&sparse).unwrap();
    fs::write(sparse.join("cameras.txt"), "1 PINHOLE 160 90 140 140 80 45\n").unwrap();
    fs::write(
        sparse.join("images.txt"),
        "1 1 0 0 0 0 0 0 1 000000.png\n\n2 1 0 0 0 5 0 0 1 000001.png\n\n",
    )
    .unwrap();
    let process = ["process", "sim/live", "-o", "out.mkv", "--light-field", "site.lf"];
    refused(&process, folder, &["000000.png", "not there"]);
    refused(&["light-field", "info", "site.lf"], folder, &["000000.png", "not there"]);
    fs::write(folder.join("site.lf/light_field.toml"), "format = 1\nnonsense\n").unwrap();
    refused(&process, folder, &["light_field.toml: line 2", "build the light field again"]);
    fs::write(sparse.join("images.txt"), "1 nan 0 0 0 0 0 0 1 000000.png\n\n").unwrap();
    refused(&process, folder, &["images.txt", "finite"]);
    assert!(!folder.join("out.mkv").exists());
}

#[test]
fn a_disk_that_is_full_before_the_end() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    simulated(folder);
    // `ulimit -f` bounds the size of a file as a full disk would, in blocks of 512 or 1024 bytes.
    let limited = |output: &str, blocks: &str| {
        let script = "trap '' XFSZ; ulimit -f \"$1\"; exec \"$0\" process sim/live -o \"$2\"";
        Command::new("sh")
            .args(["-c", script, env!("CARGO_BIN_EXE_endofield"), blocks, output])
            .current_dir(folder)
            .output()
            .unwrap()
    };
    for output in ["full.mp4", "full.mkv"] {
        let ended = limited(output, "8");
        assert_eq!(ended.status.code(), Some(1), "{output}: {}", told(&ended));
        assert!(told(&ended).contains("stays playable"), "{output}: {}", told(&ended));
    }
    let ended = limited("enough.mp4", "100000");
    assert_eq!(ended.status.code(), Some(0), "{}", told(&ended));
}

#[test]
fn calibrations_of_what_cannot_be_calibrated_from() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    for name in ["empty", "gray", "sizes"] {
        fs::create_dir(folder.join(name)).unwrap();
    }
    let gray = |name: &str, width| image_files::write(&folder.join(name), &Image::filled(width, 120, [128; 3])).unwrap();
    gray("gray/0.png", 160);
    gray("gray/1.png", 160);
    gray("sizes/0.png", 160);
    gray("sizes/1.png", 200);
    fs::write(folder.join("text.png"), "no picture at all\n").unwrap();
    fs::write(
        folder.join("nan.tum"),
        "# T_base_hand, mm\n0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n",
    )
    .unwrap();
    for (list, pictures) in [
        ("gray.csv", ["gray/0.png", "gray/1.png"]),
        ("sizes.csv", ["sizes/0.png", "sizes/1.png"]),
    ] {
        let [first, second] = pictures;
        fs::write(
            folder.join(list),
            format!("picture,station,rotation\n{first},a,x\n{second},a,y\n"),
        )
        .unwrap();
    }
    let board = ["--board", "checkerboard:9x6", "--square-mm", "4"];
    for (subject, input, words) in [
        ("camera", "empty", "found none"),
        ("camera", "gray", "0 of 2"),
        ("camera", "sizes", "one size"),
        ("camera", "text.png", "expected a picture"),
        ("oblique", "empty", "expected a list"),
        ("oblique", "gray.csv", "none of 2"),
        ("oblique", "sizes.csv", "one size"),
    ] {
        refused(&[&["calibrate", subject, input][..], &board].concat(), folder, &[words]);
    }
    for (subject, input, words) in [
        ("color", "empty", "found none"),
        ("color", "gray", "0.png and 1 more"),
        ("color", "text.png", "expected a picture"),
        ("pivot", "empty", "found a folder"),
        ("pivot", "nan.tum", "line 3"),
        ("pivot", "text.png", "16 numbers"),
        ("time-offset", "empty", "found none"),
        ("time-offset", "gray", "poses.tum"),
    ] {
        refused(&["calibrate", subject, input], folder, &[words]);
    }
}
