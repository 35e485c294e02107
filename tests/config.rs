//! The configuration: `config/default.toml` tells the truth, and what is wrong is named.

use std::fs;
use std::path::Path;

use endofield::config::{Assignment, Config};
use toml::{Table, Value};

fn default_toml() -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("config/default.toml")).unwrap()
}

fn set(text: &str) -> Result<Config, String> {
    let assignment: Assignment = text.parse().unwrap();
    Config::load(None, &[assignment]).map_err(|error| error.to_string())
}

/// Every `group.key` of a tree.
fn keys(table: &Table, prefix: &str, found: &mut Vec<String>) {
    for (key, value) in table {
        match value {
            Value::Table(inner) => keys(inner, &format!("{prefix}{key}."), found),
            _ => found.push(format!("{prefix}{key}")),
        }
    }
}

#[test]
fn default_toml_is_the_default() {
    let text = default_toml();
    let config: Config = toml::from_str(&text).unwrap();
    assert_eq!(config.to_toml(), Config::default().to_toml());
    let (mut written, mut real) = (Vec::new(), Vec::new());
    keys(&text.parse::<Table>().unwrap(), "", &mut written);
    keys(&Config::default().to_toml().parse::<Table>().unwrap(), "", &mut real);
    written.sort();
    real.sort();
    assert_eq!(written, real, "every key, and no other, stands in config/default.toml");
}

#[test]
fn every_default_is_explained() {
    let text = default_toml();
    let lines: Vec<&str> = text.lines().collect();
    for (number, line) in lines.iter().enumerate() {
        if line.contains(" = ") && !line.starts_with('#') {
            let above = number.checked_sub(1).map_or("", |n| lines[n]);
            assert!(
                above.starts_with("# "),
                "config/default.toml:{}: `{line}` has no line above that says why",
                number + 1
            );
        }
    }
}

#[test]
fn a_setting_takes_the_kind_of_its_default() {
    assert_eq!(set("output.crf=18").unwrap().output.crf, 18);
    assert_eq!(set("output.preset=fast").unwrap().output.preset, "fast");
    assert_eq!(set("output.preset=\"fast\"").unwrap().output.preset, "fast");
    let message = set("output.crf=fast").unwrap_err();
    assert!(
        message.contains("output.crf=fast") && message.contains("whole number"),
        "{message}"
    );
}

#[test]
fn what_is_wrong_is_named() {
    let message = set("output.crf=99").unwrap_err();
    assert!(
        message.contains("output.crf") && message.contains("99") && message.contains("0 to 51"),
        "{message}"
    );
    let message = set("output.crt=9").unwrap_err();
    assert!(message.contains("crt") && message.contains("crf"), "{message}");
    let message = set("outputs.crf=9").unwrap_err();
    assert!(message.contains("outputs") && message.contains("output"), "{message}");
    let message = set("substitution.reach_px=-1").unwrap_err();
    assert!(
        message.contains("substitution.reach_px") && message.contains("-1"),
        "{message}"
    );
    assert!(set("substitution.reach_px=nan").unwrap_err().contains("finite"));
    assert!(set("output=9").unwrap_err().contains("group"));
    assert!("output.crf".parse::<Assignment>().is_err());
}

#[test]
fn a_file_is_named_with_line_key_and_bound() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my.toml");
    let load = |text: &str| {
        fs::write(&path, text).unwrap();
        Config::load(Some(&path), &[]).map_err(|error| error.to_string())
    };
    assert_eq!(load("[output]\ncrf = 20\n").unwrap().output.crf, 20);
    let message = load("[output]\n\ncrt = 20\n").unwrap_err();
    assert!(
        message.contains("my.toml") && message.contains("line 3") && message.contains("crt"),
        "{message}"
    );
    let message = load("[output]\ncrf = 60\n").unwrap_err();
    assert!(
        message.contains("my.toml") && message.contains("output.crf") && message.contains("60"),
        "{message}"
    );
    let message = Config::load(Some(&folder.path().join("none.toml")), &[])
        .unwrap_err()
        .to_string();
    assert!(message.contains("none.toml"), "{message}");
}

#[test]
fn later_assignments_win_over_earlier_and_over_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("my.toml");
    fs::write(&path, "[output]\ncrf = 20\n").unwrap();
    let sets: Vec<Assignment> = ["output.crf=21", "output.crf=22"]
        .iter()
        .map(|text| text.parse().unwrap())
        .collect();
    assert_eq!(Config::load(Some(&path), &sets).unwrap().output.crf, 22);
}
