//! Color spaces and color differences: sRGB, CIE XYZ and L*a*b* under D65, and the difference ΔE2000.
//!
//! sRGB is IEC 61966-2-1; L*a*b* is CIE 15. ΔE2000 follows Sharma, Wu, Dalal, The CIEDE2000 color-difference formula,
//! Color Res. Appl. 30(1), 2005, doi:10.1002/col.20070, and is tested with their published pairs. One unit is about what
//! a trained eye just notices.

use crate::image::buffer::Rgb8;

/// A color in CIE L*a*b*.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lab {
    /// Lightness, 0 to 100.
    pub l: f64,
    /// Green to red.
    pub a: f64,
    /// Blue to yellow.
    pub b: f64,
}

/// White of sRGB, D65, Y = 1.
const WHITE: [f64; 3] = [0.950_470, 1.0, 1.088_830];

/// Rec. 601 luma, in the unit of the channels.
#[inline]
pub fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// Linear light 0 to 1 from an encoded value 0 to 1.
pub fn linear_from_srgb(encoded: f64) -> f64 {
    if encoded <= 0.040_45 {
        encoded / 12.92
    } else {
        ((encoded + 0.055) / 1.055).powf(2.4)
    }
}

/// Encoded value 0 to 1 from linear light 0 to 1.
pub fn srgb_from_linear(linear: f64) -> f64 {
    if linear <= 0.003_130_8 {
        linear * 12.92
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    }
}

/// [`linear_from_srgb`] within 0.002: a cubic, for pixels by the thousand.
#[inline(always)]
pub fn fast_linear(encoded: f32) -> f32 {
    encoded * (0.012_522_878 + encoded * (0.682_171_1 + encoded * 0.305_306_02))
}

/// [`srgb_from_linear`] within 0.005: square roots of square roots.
#[inline(always)]
pub fn fast_srgb(linear: f32) -> f32 {
    let half = linear.sqrt();
    let fourth = half.sqrt();
    (0.662_002_7 * half + 0.684_122_1 * fourth - 0.323_583_6 * fourth.sqrt() - 0.022_541_147 * linear).max(0.0)
}

/// CIE XYZ (Y = 1 for white) from 8-bit sRGB.
pub fn xyz_from_srgb8(color: Rgb8) -> [f64; 3] {
    xyz_from_linear(color.map(|v| linear_from_srgb(f64::from(v) / 255.0)))
}

/// CIE XYZ (Y = 1 for white) from linear light 0 to 1 in sRGB's primaries; beyond its gamut components are negative.
pub fn xyz_from_linear([r, g, b]: [f64; 3]) -> [f64; 3] {
    [
        0.412_456_4 * r + 0.357_576_1 * g + 0.180_437_5 * b,
        0.212_672_9 * r + 0.715_152_2 * g + 0.072_175_0 * b,
        0.019_333_9 * r + 0.119_192_0 * g + 0.950_304_1 * b,
    ]
}

/// Linear light in sRGB's primaries from CIE XYZ; negative beyond the gamut.
pub fn linear_from_xyz([x, y, z]: [f64; 3]) -> [f64; 3] {
    [
        3.240_454_2 * x - 1.537_138_5 * y - 0.498_531_4 * z,
        -0.969_266_0 * x + 1.876_010_8 * y + 0.041_556_0 * z,
        0.055_643_4 * x - 0.204_025_9 * y + 1.057_225_2 * z,
    ]
}

/// L*a*b* from linear light in sRGB's primaries.
pub fn lab_from_linear(linear: [f64; 3]) -> Lab {
    lab_from_xyz(xyz_from_linear(linear))
}

/// XYZ relative to its white (all 1) from L*a*b*.
pub fn relative_xyz_from_lab(lab: Lab) -> [f64; 3] {
    let y = (lab.l + 16.0) / 116.0;
    [y + lab.a / 500.0, y, y - lab.b / 200.0].map(|f: f64| {
        if f > 6.0 / 29.0 {
            f.powi(3)
        } else {
            (116.0 * f - 16.0) * 27.0 / 24_389.0
        }
    })
}

/// L*a*b* from XYZ.
pub fn lab_from_xyz(xyz: [f64; 3]) -> Lab {
    let f = |t: f64| {
        if t > 216.0 / 24_389.0 {
            t.cbrt()
        } else {
            (24_389.0 / 27.0 * t + 16.0) / 116.0
        }
    };
    let [x, y, z] = [0, 1, 2].map(|i| f(xyz[i] / WHITE[i]));
    Lab {
        l: 116.0 * y - 16.0,
        a: 500.0 * (x - y),
        b: 200.0 * (y - z),
    }
}

/// L*a*b* from 8-bit sRGB.
pub fn lab_from_srgb8(color: Rgb8) -> Lab {
    lab_from_xyz(xyz_from_srgb8(color))
}

/// The difference ΔE2000 of two colors.
pub fn delta_e_2000(first: Lab, second: Lab) -> f64 {
    let seventh = |c: f64| (c.powi(7) / (c.powi(7) + 25.0_f64.powi(7))).sqrt();
    let mean_chroma = (first.a.hypot(first.b) + second.a.hypot(second.b)) / 2.0;
    let stretch = 1.0 + 0.5 * (1.0 - seventh(mean_chroma)); // eq. 4
    let chroma_hue = |lab: Lab| {
        let a = stretch * lab.a; // eq. 5
        let hue = lab.b.atan2(a).to_degrees();
        (a.hypot(lab.b), if hue < 0.0 { hue + 360.0 } else { hue }) // eqs. 6, 7
    };
    let ((c1, h1), (c2, h2)) = (chroma_hue(first), chroma_hue(second));
    let gray = c1 * c2 == 0.0;

    let dl = second.l - first.l;
    let dc = c2 - c1;
    let dh_degrees = match h2 - h1 {
        _ if gray => 0.0,
        d if d > 180.0 => d - 360.0,
        d if d < -180.0 => d + 360.0,
        d => d,
    }; // eq. 10
    let dh = 2.0 * (c1 * c2).sqrt() * (dh_degrees / 2.0).to_radians().sin(); // eq. 11

    let l = (first.l + second.l) / 2.0;
    let c = (c1 + c2) / 2.0;
    let h = match h1 + h2 {
        sum if gray => sum,
        sum if (h1 - h2).abs() <= 180.0 => sum / 2.0,
        sum if sum < 360.0 => (sum + 360.0) / 2.0,
        sum => (sum - 360.0) / 2.0,
    }; // eq. 14
    let cos = |degrees: f64| degrees.to_radians().cos();
    let t = 1.0 - 0.17 * cos(h - 30.0) + 0.24 * cos(2.0 * h) + 0.32 * cos(3.0 * h + 6.0) - 0.20 * cos(4.0 * h - 63.0);
    let bend = 30.0 * (-((h - 275.0) / 25.0).powi(2)).exp();
    let rotation = -(2.0 * bend).to_radians().sin() * 2.0 * seventh(c); // eqs. 17, 21
    let sl = 1.0 + 0.015 * (l - 50.0).powi(2) / (20.0 + (l - 50.0).powi(2)).sqrt();
    let sc = 1.0 + 0.045 * c;
    let sh = 1.0 + 0.015 * c * t;
    let (l, c, h) = (dl / sl, dc / sc, dh / sh);
    (l * l + c * c + h * h + rotation * c * h).sqrt() // eq. 22
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sharma, Wu, Dalal 2005, table 1.
    const PAIRS: &[([f64; 3], [f64; 3], f64)] = &[
        ([50.0, 2.6772, -79.7751], [50.0, 0.0, -82.7485], 2.0425),
        ([50.0, 3.1571, -77.2803], [50.0, 0.0, -82.7485], 2.8615),
        ([50.0, 2.8361, -74.0200], [50.0, 0.0, -82.7485], 3.4412),
        ([50.0, -1.3802, -84.2814], [50.0, 0.0, -82.7485], 1.0000),
        ([50.0, -1.1848, -84.8006], [50.0, 0.0, -82.7485], 1.0000),
        ([50.0, -0.9009, -85.5211], [50.0, 0.0, -82.7485], 1.0000),
        ([50.0, 0.0, 0.0], [50.0, -1.0, 2.0], 2.3669),
        ([50.0, -1.0, 2.0], [50.0, 0.0, 0.0], 2.3669),
        ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0009], 7.1792),
        ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0010], 7.1792),
        ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0011], 7.2195),
        ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0012], 7.2195),
        ([50.0, -0.0010, 2.4900], [50.0, 0.0009, -2.4900], 4.8045),
        ([50.0, -0.0010, 2.4900], [50.0, 0.0010, -2.4900], 4.8045),
        ([50.0, -0.0010, 2.4900], [50.0, 0.0011, -2.4900], 4.7461),
        ([50.0, 2.5, 0.0], [50.0, 0.0, -2.5], 4.3065),
        ([50.0, 2.5, 0.0], [73.0, 25.0, -18.0], 27.1492),
        ([50.0, 2.5, 0.0], [61.0, -5.0, 29.0], 22.8977),
        ([50.0, 2.5, 0.0], [56.0, -27.0, -3.0], 31.9030),
        ([50.0, 2.5, 0.0], [58.0, 24.0, 15.0], 19.4535),
        ([50.0, 2.5, 0.0], [50.0, 3.1736, 0.5854], 1.0000),
        ([50.0, 2.5, 0.0], [50.0, 3.2972, 0.0], 1.0000),
        ([50.0, 2.5, 0.0], [50.0, 1.8634, 0.5757], 1.0000),
        ([50.0, 2.5, 0.0], [50.0, 3.2592, 0.3350], 1.0000),
        ([60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644),
        ([63.0109, -31.0961, -5.8663], [62.8187, -29.7946, -4.0864], 1.2630),
        ([61.2901, 3.7196, -5.3901], [61.4292, 2.2480, -4.9620], 1.8731),
        ([35.0831, -44.1164, 3.7933], [35.0232, -40.0716, 1.5901], 1.8645),
        ([22.7233, 20.0904, -46.6940], [23.0331, 14.9730, -42.5619], 2.0373),
        ([36.4612, 47.8580, 18.3852], [36.2715, 50.5065, 21.2231], 1.4146),
        ([90.8027, -2.0831, 1.4410], [91.1528, -1.6435, 0.0447], 1.4441),
        ([90.9257, -0.5406, -0.9208], [88.6381, -0.8985, -0.7239], 1.5381),
        ([6.7747, -0.2908, -2.4247], [5.8714, -0.0985, -2.2286], 0.6377),
        ([2.0776, 0.0795, -1.1350], [0.9033, -0.0636, -0.5514], 0.9082),
    ];

    #[test]
    fn ciede2000_gives_the_published_differences() {
        for (index, (first, second, expected)) in PAIRS.iter().enumerate() {
            let lab = |v: &[f64; 3]| Lab {
                l: v[0],
                a: v[1],
                b: v[2],
            };
            let found = delta_e_2000(lab(first), lab(second));
            assert!(
                (found - expected).abs() < 1e-4,
                "pair {}: {found}, published {expected}",
                index + 1
            );
        }
    }

    #[test]
    fn xyz_and_lab_are_inverted() {
        for color in [[255, 255, 255], [12, 200, 90], [200, 3, 40], [5, 5, 9]] {
            let xyz = xyz_from_srgb8(color);
            let relative = relative_xyz_from_lab(lab_from_xyz(xyz));
            for i in 0..3 {
                assert!((relative[i] * WHITE[i] - xyz[i]).abs() < 1e-9);
                let linear = linear_from_xyz(xyz)[i];
                assert!((linear - linear_from_srgb(f64::from(color[i]) / 255.0)).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn the_fast_curves_keep_to_the_exact_ones() {
        for level in 0..=255 {
            let exact = f64::from(level) / 255.0;
            assert!(
                (f64::from(fast_linear(exact as f32)) - linear_from_srgb(exact)).abs() < 0.002,
                "{level}"
            );
            assert!(
                (f64::from(fast_srgb(exact as f32)) - srgb_from_linear(exact)).abs() < 0.005,
                "{level}"
            );
        }
    }

    #[test]
    fn white_is_white_and_srgb_inverts() {
        let white = lab_from_srgb8([255; 3]);
        assert!(
            (white.l - 100.0).abs() < 1e-3 && white.a.abs() < 0.02 && white.b.abs() < 0.02,
            "{white:?}"
        );
        for v in 0..=255 {
            let encoded = f64::from(v) / 255.0;
            assert!((srgb_from_linear(linear_from_srgb(encoded)) - encoded).abs() < 1e-6);
        }
    }
}
