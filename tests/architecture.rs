//! The floors of the house: a room imports only from floors below its own.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Rooms by floor, bottom first. A room that is not here fails the test.
const FLOORS: &[&[&str]] = &[
    &["geometry", "image", "solver", "time", "progress", "yaml"],
    &["camera", "media", "quality", "robot"],
    &["calibration", "frame", "light_field", "recording", "synthetic", "video4linux"],
    &["pipeline", "localization"],
    &["sources", "stages", "sinks"],
    &["config", "viewer"],
    &["compose"],
    &["cli"],
];

fn floor_of(room: &str) -> Option<usize> {
    FLOORS.iter().position(|rooms| rooms.contains(&room))
}

fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

fn room_of(source: &Path, file: &Path) -> String {
    let first = file.strip_prefix(source).unwrap().components().next().unwrap();
    Path::new(first.as_os_str())
        .file_stem()
        .unwrap()
        .to_string_lossy()
        .into_owned()
}

#[test]
fn rooms_import_only_downward() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&source, &mut files);
    assert!(
        files.len() > 10,
        "found only {} files under {}",
        files.len(),
        source.display()
    );
    let mut faults = BTreeMap::new();
    for file in files {
        let room = room_of(&source, &file);
        if room == "main" || room == "lib" {
            continue;
        }
        let Some(floor) = floor_of(&room) else {
            faults.insert(format!("{}", file.display()), format!("the room `{room}` has no floor"));
            continue;
        };
        for (number, line) in fs::read_to_string(&file).unwrap().lines().enumerate() {
            let code = line.split("//").next().unwrap_or("");
            for part in code.split("crate::").skip(1) {
                let target: String = part.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                if target == room {
                    continue;
                }
                if floor_of(&target).is_none_or(|below| below >= floor) {
                    faults.insert(
                        format!("{}:{}", file.display(), number + 1),
                        format!("`{room}` (floor {floor}) imports `{target}`"),
                    );
                }
            }
        }
    }
    assert!(faults.is_empty(), "imports must point downward:\n{faults:#?}");
}
