//! The program, as a user types it.

use std::path::Path;
use std::process::{Command, Output};

/// Run `endofield` in a folder.
pub fn endofield(arguments: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_endofield"))
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

/// What it said.
pub fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}
