//! `color.yaml`: reference statistics and correction of one instrument's colors.
//!
//! ```yaml
//! # 8-bit sRGB levels
//! reference:
//!   mean: [150.2, 88.1, 76.4]
//!   covariance: [[900, 640, 520], [640, 560, 430], [520, 430, 410]]   # optional
//! correction:                        # optional; values 0 to 1
//!   encoding: linear                 # or srgb (default)
//!   gamma: [1, 1, 1]                 # optional: exponents of the encoded values, before all else
//!   matrix: [[0.93, 0.05, 0.02], [0.01, 0.97, 0.02], [0.0, 0.08, 0.92]]
//!   offset: [0, 0, 0]                # optional
//!   # or, instead of matrix and offset, one row each for red, green, blue:
//!   # polynomial: [[…10 numbers: 1 r g b r² g² b² rg gb br…], […], […]]
//!   # root_polynomial: [[…6 numbers: r g b √rg √gb √br…], […], […]]
//! ```

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use crate::image::color_correction::{Correction, Encoding, Formula, ROOT_TERMS, TERMS};
use crate::yaml::Node;

/// Why a file gives no colors.
#[derive(Debug, thiserror::Error)]
pub enum ColorFileError {
    /// The disk said no.
    #[error("cannot read the color file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The disk said no.
    #[error("cannot write the color file {}: {source}", path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content.
    #[error("{}: {what}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What was found and expected.
        what: String,
    },
}

/// Reference colors; without a covariance only the mean is aimed at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    /// Mean color, 8-bit sRGB levels.
    pub mean: Vector3<f64>,
    /// Covariance, levels².
    pub covariance: Option<Matrix3<f64>>,
}

/// What `color.yaml` holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColorFile {
    /// The tissue's right colors.
    pub reference: Option<Reference>,
    /// The camera's correction.
    pub correction: Option<Correction>,
}

impl ColorFile {
    /// Read a file.
    pub fn read(path: &Path) -> Result<Self, ColorFileError> {
        let text = std::fs::read_to_string(path).map_err(|source| ColorFileError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text).map_err(|what| ColorFileError::Content {
            path: path.to_owned(),
            what,
        })
    }

    /// Write a file that [`ColorFile::read`] reads back.
    pub fn write(&self, path: &Path) -> Result<(), ColorFileError> {
        std::fs::write(path, self.text()).map_err(|source| ColorFileError::Unwritable {
            path: path.to_owned(),
            source,
        })
    }

    /// From the text of a file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let node = Node::parse(text).map_err(|e| e.to_string())?;
        if !matches!(node, Node::Map(_)) {
            return Err("expected the keys `reference` and/or `correction`, found none".to_owned());
        }
        let reference = node.get("reference").map(reference).transpose()?;
        let correction = node.get("correction").map(correction).transpose()?;
        if reference.is_none() && correction.is_none() {
            return Err("expected the keys `reference` and/or `correction`, found neither".to_owned());
        }
        Ok(Self { reference, correction })
    }

    /// As the text of a file.
    pub fn text(&self) -> String {
        let mut text = "# Colors of one instrument. reference: 8-bit sRGB levels; correction: values 0 to 1.\n".to_owned();
        if let Some(reference) = &self.reference {
            let mut pairs = vec![("mean".to_owned(), list(reference.mean.as_slice()))];
            if let Some(covariance) = &reference.covariance {
                let rows = (0..3).map(|r| list(&[covariance[(r, 0)], covariance[(r, 1)], covariance[(r, 2)]]));
                pairs.push(("covariance".to_owned(), Node::List(rows.collect())));
            }
            Node::Map(pairs).write(&mut text, "reference", 0);
        }
        if let Some(correction) = &self.correction {
            let encoding = match correction.encoding {
                Encoding::Srgb => "srgb",
                Encoding::Linear => "linear",
            };
            let mut pairs = vec![("encoding".to_owned(), Node::Text(encoding.to_owned()))];
            if correction.gamma != [1.0; 3] {
                pairs.push(("gamma".to_owned(), list(&correction.gamma)));
            }
            match &correction.formula {
                Formula::Matrix { matrix, offset } => {
                    pairs.push(("matrix".to_owned(), Node::List(matrix.iter().map(|row| list(row)).collect())));
                    pairs.push(("offset".to_owned(), list(offset)));
                }
                Formula::Polynomial { coefficients } => {
                    let rows = coefficients.iter().map(|row| list(row)).collect();
                    pairs.push(("polynomial".to_owned(), Node::List(rows)));
                }
                Formula::RootPolynomial { coefficients } => {
                    let rows = coefficients.iter().map(|row| list(row)).collect();
                    pairs.push(("root_polynomial".to_owned(), Node::List(rows)));
                }
            }
            Node::Map(pairs).write(&mut text, "correction", 0);
        }
        text
    }
}

fn list(values: &[f64]) -> Node {
    Node::List(values.iter().map(|v| Node::Number(*v)).collect())
}

fn numbers<const N: usize>(node: &Node, key: &str) -> Result<Option<[f64; N]>, String> {
    let Some(value) = node.get(key) else { return Ok(None) };
    let found = value.numbers().and_then(|values| <[f64; N]>::try_from(values).ok());
    match found.filter(|values| values.iter().all(|v| v.is_finite())) {
        Some(values) => Ok(Some(values)),
        None => Err(format!("`{key}` must be {N} finite numbers")),
    }
}

fn rows<const N: usize, const ALL: usize>(values: [f64; ALL]) -> [[f64; N]; 3] {
    std::array::from_fn(|r| std::array::from_fn(|c| values[r * N + c]))
}

fn reference(node: &Node) -> Result<Reference, String> {
    let Some(mean) = numbers::<3>(node, "mean")? else {
        return Err("`reference` lacks `mean`: three levels from 0 to 255".to_owned());
    };
    if mean.iter().any(|v| !(0.0..=255.0).contains(v)) {
        return Err(format!("`mean` is {mean:?}, expected three levels from 0 to 255"));
    }
    let covariance = numbers::<9>(node, "covariance")?.map(|values| Matrix3::from_row_slice(&values));
    if let Some(covariance) = &covariance {
        let lowest = covariance.symmetric_eigenvalues().min();
        let skew = (covariance - covariance.transpose()).amax();
        if skew > 1e-3 * covariance.amax().max(1.0) || lowest < -1e-3 * covariance.amax().max(1.0) {
            return Err("`covariance` must be symmetric with no negative eigenvalue".to_owned());
        }
    }
    Ok(Reference {
        mean: Vector3::from(mean),
        covariance,
    })
}

fn correction(node: &Node) -> Result<Correction, String> {
    let encoding = match node.get("encoding").map(Node::text) {
        None | Some(Some("srgb")) => Encoding::Srgb,
        Some(Some("linear")) => Encoding::Linear,
        Some(other) => {
            return Err(format!(
                "`encoding` is `{}`, expected srgb or linear",
                other.unwrap_or("no word")
            ));
        }
    };
    let gamma = numbers::<3>(node, "gamma")?.unwrap_or([1.0; 3]);
    if gamma.iter().any(|v| !(0.1..=10.0).contains(v)) {
        return Err(format!("`gamma` is {gamma:?}, expected three exponents from 0.1 to 10"));
    }
    let matrix = numbers::<9>(node, "matrix")?;
    let polynomial = numbers::<{ 3 * TERMS }>(node, "polynomial")?;
    let root_polynomial = numbers::<{ 3 * ROOT_TERMS }>(node, "root_polynomial")?;
    let formula = match (matrix, polynomial, root_polynomial) {
        (Some(matrix), None, None) => Formula::Matrix {
            matrix: rows(matrix),
            offset: numbers::<3>(node, "offset")?.unwrap_or_default(),
        },
        (None, Some(polynomial), None) => Formula::Polynomial {
            coefficients: rows(polynomial),
        },
        (None, None, Some(root_polynomial)) => Formula::RootPolynomial {
            coefficients: rows(root_polynomial),
        },
        _ => return Err("`correction` must hold either `matrix`, `polynomial` or `root_polynomial`".to_owned()),
    };
    Ok(Correction {
        gamma,
        encoding,
        formula,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let reference = Reference {
            mean: Vector3::new(150.25, 88.5, 76.125),
            covariance: Some(Matrix3::new(900.0, 640.0, 520.0, 640.0, 560.0, 430.0, 520.0, 430.0, 410.0)),
        };
        let matrix = Formula::Matrix {
            matrix: [[0.9, 0.1, 0.0], [0.0, 1.0, 0.0], [1e-7, 0.0, 0.8]],
            offset: [0.0, 0.1, 0.0],
        };
        let polynomial = Formula::Polynomial {
            coefficients: std::array::from_fn(|r| std::array::from_fn(|c| (r * 10 + c) as f64 / 7.0)),
        };
        let root_polynomial = Formula::RootPolynomial {
            coefficients: std::array::from_fn(|r| std::array::from_fn(|c| (r * 6 + c) as f64 / 7.0)),
        };
        for (formula, gamma) in [(matrix, 1.0), (polynomial, 0.9), (root_polynomial, 1.1)] {
            let correction = Some(Correction {
                gamma: [gamma; 3],
                encoding: Encoding::Linear,
                formula,
            });
            let file = ColorFile {
                reference: Some(reference),
                correction,
            };
            assert_eq!(ColorFile::parse(&file.text()).unwrap(), file);
        }
    }

    #[test]
    fn faults_are_named() {
        for (text, word) in [
            ("", "reference"),
            ("reference: {mean: [1, 2]}", "3 finite numbers"),
            ("reference: {mean: [1, 2, 300]}", "0 to 255"),
            (
                "reference: {mean: [1, 2, 3], covariance: [1,0,0, 0,-5,0, 0,0,1]}",
                "eigenvalue",
            ),
            ("correction: {encoding: rec709, matrix: [1,0,0,0,1,0,0,0,1]}", "encoding"),
            ("correction: {offset: [0,0,0]}", "either"),
            ("correction: {gamma: [0,1,1], matrix: [1,0,0,0,1,0,0,0,1]}", "0.1 to 10"),
            ("reference: [", "line"),
        ] {
            let error = ColorFile::parse(text).unwrap_err();
            assert!(error.contains(word), "`{text}` gives `{error}`");
        }
    }
}
