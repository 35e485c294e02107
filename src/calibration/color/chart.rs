//! The ColorChecker Classic: 24 patches in four rows of six, and what their colors are.
//!
//! McCamy, Marcus, Davidson 1976 (A color-rendition chart, J. Appl. Photogr. Eng. 2(3)) made it; the maker's published L*a*b* values
//! under D50 for charts made since November 2014 ("New color specifications for ColorChecker SG and Classic charts", X-Rite 2015) and
//! those of before (GretagMacbeth 2005) are used here. The line's white is D65: they are adapted by the Bradford transform
//! (Lindbloom; Lam 1985), so that a white that is white under D50 is white under D65.

use nalgebra::{Matrix3, Vector3};

use crate::image::color::{Lab, lab_from_xyz, linear_from_xyz, relative_xyz_from_lab};

/// Columns of the chart as it is held: dark skin at the upper left, black at the lower right.
pub const COLUMNS: usize = 6;
/// Rows.
pub const ROWS: usize = 4;
/// All patches.
pub const PATCHES: usize = COLUMNS * ROWS;

/// Row by row.
pub const NAMES: [&str; PATCHES] = [
    "dark skin",
    "light skin",
    "blue sky",
    "foliage",
    "blue flower",
    "bluish green",
    "orange",
    "purplish blue",
    "moderate red",
    "purple",
    "yellow green",
    "orange yellow",
    "blue",
    "green",
    "red",
    "yellow",
    "magenta",
    "cyan",
    "white",
    "neutral 8",
    "neutral 6.5",
    "neutral 5",
    "neutral 3.5",
    "black",
];

/// Which colors a chart has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Edition {
    /// Made since November 2014.
    #[default]
    Since2014,
    /// Made before.
    Before2014,
}

/// L*a*b* under D50, charts made since November 2014.
const SINCE_2014: [[f64; 3]; PATCHES] = [
    [37.54, 14.37, 14.92],
    [64.66, 19.27, 17.50],
    [49.32, -3.82, -22.54],
    [43.46, -12.74, 22.72],
    [54.94, 9.61, -24.79],
    [70.48, -32.26, -0.37],
    [62.73, 35.83, 56.50],
    [39.43, 10.75, -45.17],
    [50.57, 48.64, 16.67],
    [30.10, 22.54, -20.87],
    [71.77, -24.13, 58.19],
    [71.51, 18.24, 67.37],
    [28.37, 15.42, -49.80],
    [54.38, -39.72, 32.27],
    [42.43, 51.05, 28.62],
    [81.80, 2.67, 80.41],
    [50.63, 51.28, -14.12],
    [49.57, -29.71, -28.32],
    [95.19, -1.03, 2.93],
    [81.29, -0.57, 0.44],
    [66.89, -0.75, -0.06],
    [50.76, -0.13, 0.14],
    [35.63, -0.46, -0.48],
    [20.64, 0.07, -0.46],
];

/// L*a*b* under D50, charts made before November 2014.
const BEFORE_2014: [[f64; 3]; PATCHES] = [
    [37.986, 13.555, 14.059],
    [65.711, 18.130, 17.810],
    [49.927, -4.880, -21.925],
    [43.139, -13.095, 21.905],
    [55.112, 8.844, -25.399],
    [70.719, -33.397, -0.199],
    [62.661, 36.067, 57.096],
    [40.020, 10.410, -45.964],
    [51.124, 48.239, 16.248],
    [30.325, 22.976, -21.587],
    [72.532, -23.709, 57.255],
    [71.941, 19.363, 67.857],
    [28.778, 14.179, -50.297],
    [55.261, -38.342, 31.370],
    [42.101, 53.378, 28.190],
    [81.733, 4.039, 79.819],
    [51.935, 49.986, -14.574],
    [51.038, -28.631, -28.638],
    [96.539, -0.425, 1.186],
    [81.257, -0.638, -0.335],
    [66.766, -0.734, -0.504],
    [50.867, -0.153, -0.270],
    [35.656, -0.421, -1.231],
    [20.461, -0.079, -0.973],
];

/// White of D50 (ICC), Y = 1.
const D50: [f64; 3] = [0.964_22, 1.0, 0.825_21];
/// White of D65, Y = 1.
const D65: [f64; 3] = [0.950_47, 1.0, 1.088_83];

/// A patch's right color.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    /// L*a*b* under D65.
    pub lab: Lab,
    /// Linear light in sRGB's primaries; cyan lies a little beyond them and has a negative red.
    pub linear: [f64; 3],
}

/// The right colors of a chart, row by row.
pub fn references(edition: Edition) -> [Reference; PATCHES] {
    let table = match edition {
        Edition::Since2014 => &SINCE_2014,
        Edition::Before2014 => &BEFORE_2014,
    };
    let adapt = bradford();
    table.map(|[l, a, b]| {
        let relative = relative_xyz_from_lab(Lab { l, a, b });
        let xyz = adapt * Vector3::from_fn(|i, _| relative[i] * D50[i]);
        Reference {
            lab: lab_from_xyz(xyz.into()),
            linear: linear_from_xyz(xyz.into()),
        }
    })
}

/// XYZ under D65 from XYZ under D50.
fn bradford() -> Matrix3<f64> {
    let cones = Matrix3::new(0.8951, 0.2664, -0.1614, -0.7502, 1.7135, 0.0367, 0.0389, -0.0685, 1.0296);
    let (from, to) = (cones * Vector3::from(D50), cones * Vector3::from(D65));
    let back = cones.try_inverse().unwrap_or_else(Matrix3::identity);
    back * Matrix3::from_diagonal(&to.component_div(&from)) * cones
}

/// Column and row of a patch.
pub fn place(patch: usize) -> [f64; 2] {
    [(patch % COLUMNS) as f64, (patch / COLUMNS) as f64]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::color::srgb_from_linear;

    #[test]
    fn references_are_the_well_known_srgb_colors() {
        // 8-bit sRGB by Lindbloom's published matrix from D50 to D65, worked out apart from this code.
        let known = [
            (0, [115.5, 80.92, 67.36]),
            (1, [198.56, 147.21, 128.68]),
            (6, [224.26, 123.73, 46.69]),
            (12, [35.36, 63.33, 147.1]),
            (14, [179.9, 48.68, 56.96]),
            (15, [238.29, 198.45, 19.71]),
            (18, [244.94, 245.22, 242.69]),
            (23, [48.66, 49.36, 50.71]),
        ];
        let found = references(Edition::Before2014);
        for (patch, levels) in known {
            for (linear, level) in found[patch].linear.iter().zip(levels) {
                let encoded = 255.0 * srgb_from_linear(*linear);
                assert!((encoded - level).abs() < 0.3, "{}: {encoded} {level}", NAMES[patch]);
            }
        }
    }

    #[test]
    fn neutral_stays_neutral_and_cyan_lies_beyond_the_gamut() {
        let found = references(Edition::Since2014);
        for reference in &found[19..] {
            assert!(reference.lab.a.hypot(reference.lab.b) < 1.5);
        }
        let beyond: Vec<usize> = (0..PATCHES).filter(|i| found[*i].linear.iter().any(|v| *v < 0.0)).collect();
        assert_eq!(beyond, [17]);
    }
}
