//! The forms that a correction may take, and the light that may lie on a chart.
//!
//! Corrections compute in linear light. From one gain a channel over a matrix to root polynomial and polynomial they grow more flexible;
//! each may come with an exponent for a tone curve that is not sRGB's. The light is the exponential of a polynomial in the place on the
//! chart, zero in its middle: always positive, and smooth.

use crate::image::color::{linear_from_srgb, srgb_from_linear};
use crate::image::color_correction::{Correction, Encoding, Formula, ROOT_TERMS, TERMS, polynomial_terms, root_terms};

/// A form of correction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// One gain a channel.
    Gains,
    /// 3 × 3.
    Matrix,
    /// 3 × 3 and an offset: light scattered in the lens.
    MatrixOffset,
    /// Finlayson 2015, second degree.
    RootPolynomial,
    /// Second degree, with all products.
    Polynomial,
}

/// A form with or without an exponent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// The form.
    pub form: Form,
    /// With an exponent.
    pub gamma: bool,
}

/// All shapes, the simpler before the more flexible.
pub const SHAPES: [Shape; 8] = {
    const fn shape(form: Form, gamma: bool) -> Shape {
        Shape { form, gamma }
    }
    [
        shape(Form::Gains, false),
        shape(Form::Gains, true),
        shape(Form::Matrix, false),
        shape(Form::Matrix, true),
        shape(Form::MatrixOffset, true),
        shape(Form::RootPolynomial, false),
        shape(Form::RootPolynomial, true),
        shape(Form::Polynomial, false),
    ]
};

impl Shape {
    /// In a few words.
    pub fn name(self) -> &'static str {
        match (self.form, self.gamma) {
            (Form::Gains, false) => "gains",
            (Form::Gains, true) => "gains, exponent",
            (Form::Matrix, false) => "matrix",
            (Form::Matrix, true) => "matrix, exponent",
            (Form::MatrixOffset, false) => "matrix, offset",
            (Form::MatrixOffset, true) => "matrix, offset, exponent",
            (Form::RootPolynomial, false) => "root polynomial",
            (Form::RootPolynomial, true) => "root polynomial, exponent",
            (Form::Polynomial, false) => "polynomial",
            (Form::Polynomial, true) => "polynomial, exponent",
        }
    }

    /// Numbers for the form, without the exponent.
    pub fn form_numbers(self) -> usize {
        match self.form {
            Form::Gains => 3,
            Form::Matrix => 9,
            Form::MatrixOffset => 12,
            Form::RootPolynomial => 3 * ROOT_TERMS,
            Form::Polynomial => 3 * TERMS,
        }
    }

    /// All its numbers.
    pub fn numbers(self) -> usize {
        self.form_numbers() + usize::from(self.gamma)
    }

    /// Terms that a channel of the result is the weighted sum of.
    pub fn terms(self, linear: [f64; 3], channel: usize) -> Vec<f64> {
        match self.form {
            Form::Gains => vec![linear[channel]],
            Form::Matrix => linear.to_vec(),
            Form::MatrixOffset => vec![linear[0], linear[1], linear[2], 1.0],
            Form::RootPolynomial => root_terms(linear).to_vec(),
            Form::Polynomial => polynomial_terms(linear).to_vec(),
        }
    }

    /// The correction that these numbers mean.
    pub fn correction(self, numbers: &[f64]) -> Correction {
        let at = |place: usize| numbers.get(place).copied().unwrap_or(0.0);
        let formula = match self.form {
            Form::Gains => Formula::Matrix {
                matrix: std::array::from_fn(|r| std::array::from_fn(|c| if r == c { at(r) } else { 0.0 })),
                offset: [0.0; 3],
            },
            Form::Matrix => Formula::Matrix {
                matrix: std::array::from_fn(|r| std::array::from_fn(|c| at(3 * r + c))),
                offset: [0.0; 3],
            },
            Form::MatrixOffset => Formula::Matrix {
                matrix: std::array::from_fn(|r| std::array::from_fn(|c| at(4 * r + c))),
                offset: std::array::from_fn(|r| at(4 * r + 3)),
            },
            Form::RootPolynomial => Formula::RootPolynomial {
                coefficients: std::array::from_fn(|r| std::array::from_fn(|c| at(ROOT_TERMS * r + c))),
            },
            Form::Polynomial => Formula::Polynomial {
                coefficients: std::array::from_fn(|r| std::array::from_fn(|c| at(TERMS * r + c))),
            },
        };
        let gamma = if self.gamma { at(self.form_numbers()) } else { 1.0 };
        Correction {
            gamma: [gamma; 3],
            encoding: Encoding::Linear,
            formula,
        }
    }
}

/// Linear light as a camera meant it that encodes by sRGB's curve and a power: `linear` is by sRGB's curve alone.
pub fn linear_by_gamma(linear: [f64; 3], gamma: f64) -> [f64; 3] {
    if gamma == 1.0 {
        return linear;
    }
    linear.map(|v| linear_from_srgb(srgb_from_linear(v.max(0.0)).powf(gamma)))
}

/// Numbers of a light of this degree.
pub fn light_numbers(degree: usize) -> usize {
    (degree + 1) * (degree + 2) / 2 - 1
}

/// Place on the chart from −1 to 1.
fn centered([column, row]: [f64; 2]) -> [f64; 2] {
    [column / 2.5 - 1.0, row / 1.5 - 1.0]
}

/// The light's terms at a place: x, y, x², xy, y² …
pub fn light_terms(degree: usize, at: [f64; 2]) -> impl Iterator<Item = f64> {
    let [x, y] = centered(at);
    (1..=degree as i32).flat_map(move |d| (0..=d).map(move |j| x.powi(d - j) * y.powi(j)))
}

/// How the light's terms change per column and per row.
pub fn light_slopes(degree: usize, at: [f64; 2]) -> impl Iterator<Item = [f64; 2]> {
    let [x, y] = centered(at);
    let slope = |v: f64, power: i32| {
        if power == 0 {
            0.0
        } else {
            f64::from(power) * v.powi(power - 1)
        }
    };
    (1..=degree as i32)
        .flat_map(move |d| (0..=d).map(move |j| [slope(x, d - j) * y.powi(j) / 2.5, x.powi(d - j) * slope(y, j) / 1.5]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shape_is_the_sum_of_its_terms() {
        let linear = [0.3, 0.2, 0.1];
        for shape in SHAPES {
            let mut numbers: Vec<f64> = (0..shape.form_numbers()).map(|i| 0.1 + i as f64 / 50.0).collect();
            let each = shape.form_numbers() / 3;
            if shape.gamma {
                numbers.push(1.0);
            }
            let found = shape.correction(&numbers).formula.apply(linear);
            for channel in 0..3 {
                let terms = shape.terms(linear, channel);
                assert_eq!(terms.len(), each);
                let sum: f64 = terms.iter().zip(&numbers[channel * each..]).map(|(t, n)| t * n).sum();
                assert!((sum - found[channel]).abs() < 1e-12, "{}", shape.name());
            }
        }
    }

    #[test]
    fn slopes_of_the_light_are_its_derivatives() {
        let at = [1.3, 2.6];
        let h = 1e-6;
        for degree in 0..=4 {
            assert_eq!(light_terms(degree, at).count(), light_numbers(degree));
            for (place, [a, b]) in light_slopes(degree, at).enumerate() {
                let term = |u: f64, v: f64| light_terms(degree, [u, v]).nth(place).unwrap();
                assert!(((term(at[0] + h, at[1]) - term(at[0] - h, at[1])) / (2.0 * h) - a).abs() < 1e-6);
                assert!(((term(at[0], at[1] + h) - term(at[0], at[1] - h)) / (2.0 * h) - b).abs() < 1e-6);
            }
        }
    }
}
