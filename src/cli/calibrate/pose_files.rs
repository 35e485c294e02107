//! Poses from files: 4×4 matrices, one a file, or a TUM file.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use nalgebra::Matrix4;

use crate::geometry::transform::Transform;
use crate::robot::trajectory::TumFile;

/// Poses with their names: of as many matrices, or of the lines of one TUM file.
pub fn read<To, From>(files: &[PathBuf]) -> anyhow::Result<Vec<(String, Transform<To, From>)>> {
    match files {
        [one] if one.extension().is_some_and(|ending| ending == "tum") => {
            let lines = TumFile::read(one)?.poses;
            let named = lines.iter().enumerate();
            Ok(named
                .map(|(i, (_, pose))| (format!("pose {}", i + 1), Transform::from_isometry(*pose)))
                .collect())
        }
        files => (files.iter())
            .map(|path| {
                let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
                Ok((name, matrix(path)?))
            })
            .collect(),
    }
}

/// A pose as sixteen numbers, row by row.
fn matrix<To, From>(path: &Path) -> anyhow::Result<Transform<To, From>> {
    anyhow::ensure!(
        !path.is_dir(),
        "{}: expected a pose file (TUM, or 4×4 matrices, one a file), found a folder; name the files in it",
        path.display()
    );
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let numbers: Vec<f64> = (text.split(|c: char| c.is_whitespace() || c == ',' || c == ';'))
        .filter_map(|word| word.parse().ok())
        .collect();
    anyhow::ensure!(
        numbers.len() == 16 && numbers.iter().all(|n| n.is_finite()),
        "{}: expected a 4×4 matrix (16 numbers), found {} numbers",
        path.display(),
        numbers.len()
    );
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    anyhow::ensure!(
        (rotation * rotation.transpose() - nalgebra::Matrix3::identity()).norm() < 0.01 && rotation.determinant() > 0.0,
        "{}: expected a rotation in the matrix's upper left, found none (determinant {:.3})",
        path.display(),
        rotation.determinant()
    );
    Ok(Transform::from_matrix(
        &rotation,
        matrix.fixed_view::<3, 1>(0, 3).into_owned(),
    ))
}
