//! What a command is about to write: nothing that is there is overwritten unasked, and never what it reads.

use std::path::{Path, PathBuf};

use anyhow::bail;

use crate::cli::context::{Context, UsageError};

/// Every path that a command will write.
#[derive(Debug, Default)]
pub struct Outputs {
    paths: Vec<(&'static str, PathBuf)>,
}

impl Outputs {
    /// One more; `option` is how the user named it.
    pub fn add(&mut self, option: &'static str, path: Option<&Path>) {
        if let Some(path) = path.filter(|path| *path != Path::new("-")) {
            self.paths.push((option, path.to_owned()));
        }
    }

    /// Refuse what would overwrite, before any work is done.
    pub fn check(&self, inputs: &[&Path], context: &Context) -> anyhow::Result<()> {
        for (index, (option, path)) in self.paths.iter().enumerate() {
            if let Some((other, _)) = self.paths.iter().take(index).find(|(_, other)| same_place(other, path)) {
                bail!(UsageError(format!(
                    "{option}: expected another path than {other}'s, found {} twice",
                    path.display()
                )));
            }
            if inputs.iter().any(|input| same_place(input, path)) {
                bail!(
                    "{option} {}: is the input as well and is never overwritten; choose another output",
                    path.display()
                );
            }
            context.refuse_overwriting(path)?;
            let folder = if is_folder(path) {
                path.as_path()
            } else {
                path.parent().unwrap_or(Path::new(""))
            };
            if !is_folder(path) && !folder.as_os_str().is_empty() && !folder.is_dir() {
                bail!(
                    "{option} {}: expected the folder {} to be there; make it first",
                    path.display(),
                    folder.display()
                );
            }
        }
        Ok(())
    }
}

/// True for a path that means a folder of numbered pictures.
pub fn is_folder(path: &Path) -> bool {
    let text = path.to_string_lossy();
    text.ends_with('/') || text.contains('%')
}

/// Where the file `name` lies beside `output`; nowhere beside a stream.
pub fn beside(output: &Path, name: &str) -> Option<PathBuf> {
    if output == Path::new("-") {
        return None;
    }
    let folder = if output.to_string_lossy().ends_with('/') {
        Some(output)
    } else {
        output.parent()
    };
    folder.map(|folder| folder.join(name))
}

fn same_place(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => a == b,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beside_an_output() {
        assert_eq!(beside(Path::new("a/b.mp4"), "camera.yaml"), Some("a/camera.yaml".into()));
        assert_eq!(beside(Path::new("b.mp4"), "camera.yaml"), Some("camera.yaml".into()));
        assert_eq!(beside(Path::new("a/out/"), "camera.yaml"), Some("a/out/camera.yaml".into()));
        assert_eq!(beside(Path::new("-"), "camera.yaml"), None);
    }

    #[test]
    fn one_place_has_many_names() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.mp4");
        std::fs::write(&file, "x").unwrap();
        assert!(same_place(&file, &folder.path().join(".").join("a.mp4")));
        assert!(!same_place(&file, &folder.path().join("b.mp4")));
    }
}
