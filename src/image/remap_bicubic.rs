//! The bicubic kernel of [`crate::image::remap`]: Keys 1981 (DOI 10.1109/TASSP.1981.1163711), a = −0.75 as in OpenCV.

use crate::image::buffer::{Image, Rgb8};
use crate::image::remap::{BLOCK, OUTSIDE, Place, pixel_at, unpacked};

/// Weights are multiples of 1/2048: two passes then stay within 32 bits.
const WEIGHT_BITS: u32 = 11;
const A: f64 = -0.75;

/// The weights of the four pixels around a place, by the fraction in 1/32 px.
static WEIGHTS: [[i32; 4]; 32] = weights();

const fn weights() -> [[i32; 4]; 32] {
    let mut table = [[0; 4]; 32];
    let mut step = 0;
    while step < 32 {
        let t = step as f64 / 32.0;
        // Keys 1981, eq. 4, for the distances 1+t, t, 1−t, 2−t.
        let far = ((A * (t + 1.0) - 5.0 * A) * (t + 1.0) + 8.0 * A) * (t + 1.0) - 4.0 * A;
        let near = ((A + 2.0) * t - (A + 3.0)) * t * t + 1.0;
        let u = 1.0 - t;
        let other = ((A + 2.0) * u - (A + 3.0)) * u * u + 1.0;
        let one = (1 << WEIGHT_BITS) as f64;
        let w0 = rounded(far * one);
        let w1 = rounded(near * one);
        let w2 = rounded(other * one);
        // What is left, so that a constant stays constant.
        table[step] = [w0, w1, w2, (1 << WEIGHT_BITS) - w0 - w1 - w2];
        step += 1;
    }
    table
}

const fn rounded(value: f64) -> i32 {
    if value < 0.0 {
        (value - 0.5) as i32
    } else {
        (value + 0.5) as i32
    }
}

/// One output row.
pub(crate) fn row(entries: &[u32], bases: &[u32], source: &Image<Rgb8>, out: &mut [Rgb8]) {
    let width = source.width();
    for ((entries, out), base) in entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(bases) {
        for (entry, out) in entries.iter().zip(out) {
            if *entry == OUTSIDE {
                *out = [0; 3];
                continue;
            }
            let (at, fx, fy) = unpacked(*entry, *base);
            let (x, y) = (at % width, at / width);
            *out = inner(source, x, y, fx as usize, fy as usize).unwrap_or_else(|| {
                at_border(
                    source,
                    Place {
                        x: x as i32,
                        y: y as i32,
                        fx: fx as u8,
                        fy: fy as u8,
                    },
                )
            });
        }
    }
}

/// Where all sixteen pixels are in the picture.
#[inline(always)]
fn inner(source: &Image<Rgb8>, x: usize, y: usize, fx: usize, fy: usize) -> Option<Rgb8> {
    let (wx, wy) = (&WEIGHTS[fx & 31], &WEIGHTS[fy & 31]);
    if x < 1 || y < 1 || x + 2 >= source.width() {
        return None;
    }
    let mut sums = [0_i32; 3];
    for (k, weight) in wy.iter().enumerate() {
        let start = (y + k - 1) * source.width() + x - 1;
        let four = source.pixels().get(start..)?.first_chunk::<4>()?;
        for c in 0..3 {
            let across: i32 = (0..4).map(|i| i32::from(four[i][c]) * wx[i]).sum();
            sums[c] += across * weight;
        }
    }
    Some(sums.map(to_byte))
}

fn to_byte(sum: i32) -> u8 {
    let half = 1 << (2 * WEIGHT_BITS - 1);
    ((sum + half) >> (2 * WEIGHT_BITS)).clamp(0, 255) as u8
}

/// Anywhere; outside the picture is black.
pub(crate) fn at(source: &Image<Rgb8>, place: Place) -> Rgb8 {
    at_border(source, place)
}

fn at_border(source: &Image<Rgb8>, place: Place) -> Rgb8 {
    let (wx, wy) = (&WEIGHTS[usize::from(place.fx & 31)], &WEIGHTS[usize::from(place.fy & 31)]);
    let mut sums = [0_i32; 3];
    for (dy, weight_y) in (-1..).zip(wy) {
        for (dx, weight_x) in (-1..).zip(wx) {
            let pixel = pixel_at(source, place.x + dx, place.y + dy).unwrap_or([0; 3]);
            for c in 0..3 {
                sums[c] += i32::from(pixel[c]) * weight_x * weight_y;
            }
        }
    }
    sums.map(to_byte)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::remap::{Interpolation, RemapTable};

    #[test]
    fn a_constant_stays_and_a_line_stays() {
        let source = Image::from_vec(
            40,
            40,
            (0..1600).map(|i| [77, (i % 40 * 6) as u8, (i / 40 * 5) as u8]).collect(),
        )
        .unwrap();
        let table = RemapTable::new((30, 30), (40, 40), |x, y| Some((x as f64 + 4.41, y as f64 + 5.23))).unwrap();
        let mut out = Image::filled(0, 0, [0; 3]);
        table.remap_rgb(&source, &mut out, Interpolation::Bicubic).unwrap();
        for y in 0..30 {
            for x in 0..30 {
                let (sx, sy) = table.position(x, y).unwrap();
                let [r, g, b] = out.at(x, y).map(f64::from);
                assert_eq!(r, 77.0);
                // With a = −0.75 a slope is reproduced to a few hundredths of itself only (a = −0.5 would be exact).
                assert!((g - 6.0 * sx).abs() < 1.0 && (b - 5.0 * sy).abs() < 1.0);
            }
        }
    }

    #[test]
    fn row_and_border_kernels_agree() {
        let source = Image::from_vec(
            24,
            16,
            (0..384_u32)
                .map(|i| [(i * 7 % 251) as u8, (i * 13 % 241) as u8, (i * 29 % 239) as u8])
                .collect(),
        )
        .unwrap();
        let table = RemapTable::new((24, 16), (24, 16), |x, y| {
            Some((x as f64 * 1.02 - 0.6, y as f64 * 0.97 + 0.3))
        })
        .unwrap();
        let mut out = Image::filled(0, 0, [0; 3]);
        table.remap_rgb(&source, &mut out, Interpolation::Bicubic).unwrap();
        for y in 0..16 {
            for x in 0..24 {
                let expected = table.place(x, y).map_or([0; 3], |place| at(&source, place));
                assert_eq!(out.at(x, y), expected, "({x}, {y})");
            }
        }
    }
}
