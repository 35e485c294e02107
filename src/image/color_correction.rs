//! A camera's fixed color correction, as calibration against a chart gives it.
//!
//! A camera's encoded value is first raised to `gamma`, so that it is what sRGB would have encoded; then follows a 3 × 3 matrix with an
//! offset, a polynomial of second degree, or a root polynomial (Finlayson, Mackiewicz, Hurlbert 2015, Color correction using
//! root-polynomial regression, doi:10.1109/TIP.2015.2405336), whose terms all grow with the light as the light does, so that a color is
//! corrected alike in shade and in glare. All in encoded sRGB or in linear light, on values from 0 to 1.

use crate::image::color::{linear_from_srgb, srgb_from_linear};

/// In which values the correction computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Encoding {
    /// Encoded sRGB.
    #[default]
    Srgb,
    /// Linear light.
    Linear,
}

/// Number of terms of the polynomial: 1 r g b r² g² b² rg gb br.
pub const TERMS: usize = 10;

/// Number of terms of the root polynomial: r g b √(rg) √(gb) √(br).
pub const ROOT_TERMS: usize = 6;

/// r g b √(rg) √(gb) √(br).
pub fn root_terms([r, g, b]: [f64; 3]) -> [f64; ROOT_TERMS] {
    let root = |v: f64| v.max(0.0).sqrt();
    [r, g, b, root(r * g), root(g * b), root(b * r)]
}

/// 1 r g b r² g² b² rg gb br.
pub fn polynomial_terms([r, g, b]: [f64; 3]) -> [f64; TERMS] {
    [1.0, r, g, b, r * r, g * g, b * b, r * g, g * b, b * r]
}

/// What the correction computes.
#[derive(Clone, Debug, PartialEq)]
pub enum Formula {
    /// out = matrix · in + offset.
    Matrix {
        /// Row by row.
        matrix: [[f64; 3]; 3],
        /// Added last.
        offset: [f64; 3],
    },
    /// out = coefficients · (1 r g b r² g² b² rg gb br).
    Polynomial {
        /// One row each for red, green and blue.
        coefficients: [[f64; TERMS]; 3],
    },
    /// out = coefficients · (r g b √(rg) √(gb) √(br)).
    RootPolynomial {
        /// One row each for red, green and blue.
        coefficients: [[f64; ROOT_TERMS]; 3],
    },
}

impl Formula {
    /// The formula on three values.
    pub fn apply(&self, [r, g, b]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::Matrix { matrix, offset } => {
                std::array::from_fn(|i| matrix[i][0] * r + matrix[i][1] * g + matrix[i][2] * b + offset[i])
            }
            Self::Polynomial { coefficients } => summed(coefficients, polynomial_terms([r, g, b])),
            Self::RootPolynomial { coefficients } => summed(coefficients, root_terms([r, g, b])),
        }
    }
}

fn summed<const N: usize>(coefficients: &[[f64; N]; 3], terms: [f64; N]) -> [f64; 3] {
    std::array::from_fn(|i| coefficients[i].iter().zip(terms).map(|(c, t)| c * t).sum())
}

/// A camera's correction.
#[derive(Clone, Debug, PartialEq)]
pub struct Correction {
    /// Exponent of each channel's encoded value, before all else; 1 if the camera encodes as sRGB does.
    pub gamma: [f64; 3],
    /// In which values.
    pub encoding: Encoding,
    /// How.
    pub formula: Formula,
}

impl Correction {
    /// Correct a color in 8-bit sRGB levels; the result is within 0 to 255.
    pub fn apply(&self, color: [f32; 3]) -> [f32; 3] {
        let mut unit = color.map(|v| f64::from(v) / 255.0);
        for (value, gamma) in unit.iter_mut().zip(self.gamma) {
            *value = value.max(0.0).powf(gamma);
        }
        let result = self.formula.apply(match self.encoding {
            Encoding::Srgb => unit,
            Encoding::Linear => unit.map(linear_from_srgb),
        });
        let encoded = match self.encoding {
            Encoding::Srgb => result,
            Encoding::Linear => result.map(|v| srgb_from_linear(v.max(0.0))),
        };
        encoded.map(|v| (v.clamp(0.0, 1.0) * 255.0) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_with_linear_terms_is_its_matrix() {
        let matrix = [[0.9, 0.1, 0.0], [0.05, 0.9, 0.0], [0.0, 0.1, 0.8]];
        let mut coefficients = [[0.0; TERMS]; 3];
        for i in 0..3 {
            coefficients[i][1..4].copy_from_slice(&matrix[i]);
            coefficients[i][0] = 0.01;
        }
        for encoding in [Encoding::Srgb, Encoding::Linear] {
            let a = Correction {
                gamma: [1.0; 3],
                encoding,
                formula: Formula::Matrix {
                    matrix,
                    offset: [0.01; 3],
                },
            };
            let b = Correction {
                gamma: [1.0; 3],
                encoding,
                formula: Formula::Polynomial { coefficients },
            };
            let color = [200.0, 90.0, 30.0];
            for (x, y) in a.apply(color).iter().zip(b.apply(color)) {
                assert!((x - y).abs() < 1e-4);
            }
        }
    }
    #[test]
    fn a_root_polynomial_follows_the_light_and_gamma_comes_first() {
        let correction = Correction {
            gamma: [1.0; 3],
            encoding: Encoding::Linear,
            formula: Formula::RootPolynomial {
                coefficients: [
                    [0.6, 0.1, 0.0, 0.2, 0.1, 0.0],
                    [0.0, 0.7, 0.0, 0.1, 0.1, 0.1],
                    [0.1, 0.0, 0.5, 0.0, 0.2, 0.1],
                ],
            },
        };
        let bright = [0.5, 0.3, 0.2];
        let dim = bright.map(|v| v / 4.0);
        for (a, b) in correction.formula.apply(bright).iter().zip(correction.formula.apply(dim)) {
            assert!((a / 4.0 - b).abs() < 1e-12);
        }
        let twisted = Correction {
            gamma: [2.0, 1.0, 0.5],
            ..correction.clone()
        };
        let color: [f32; 3] = [100.0, 120.0, 140.0];
        let bent = [
            255.0 * (color[0] / 255.0).powi(2),
            color[1],
            255.0 * (color[2] / 255.0).sqrt(),
        ];
        for (a, b) in twisted.apply(color).iter().zip(correction.apply(bent)) {
            assert!((a - b).abs() < 1e-3);
        }
    }
}
