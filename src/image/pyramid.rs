//! The same picture at half, quarter, … size.
//!
//! Burt and Adelson, "The Laplacian pyramid as a compact image code", 1983 (doi:10.1109/TCOM.1983.1095851): smooth with the binomial
//! (1 4 6 4 1)/16, keep every second pixel. Pixel (x, y) of level n lies on pixel (2ⁿ x, 2ⁿ y) of the picture, so positions
//! divide by 2ⁿ and need no half-pixel bookkeeping. A mask goes along: a coarse pixel is valid only if all it was made of was.

use crate::image::buffer::{Image, Mask};

/// A gray picture and its mask, in halving sizes; level 0 is the picture itself.
#[derive(Clone, Debug)]
pub struct Pyramid {
    /// Gray, finest first.
    pub levels: Vec<Image<f32>>,
    /// Not 0 where the gray of the same level is to be trusted.
    pub valid: Vec<Mask>,
}

impl Pyramid {
    /// At most `count` levels, ending early at pictures smaller than 24 px.
    pub fn new(image: Image<f32>, valid: Mask, count: usize) -> Self {
        let (mut levels, mut masks) = (vec![image], vec![valid]);
        while levels.len() < count {
            let (Some(image), Some(mask)) = (levels.last(), masks.last()) else {
                break;
            };
            if image.width().min(image.height()) < 48 {
                break;
            }
            let (smaller, smaller_mask) = (halved(image), halved_mask(mask));
            levels.push(smaller);
            masks.push(smaller_mask);
        }
        Self { levels, valid: masks }
    }
}

/// Smoothed with the binomial of five taps, size kept.
pub fn smoothed(image: &Image<f32>) -> Image<f32> {
    let (width, height) = image.size();
    let mut across = Image::filled(width, height, 0.0);
    for y in 0..height {
        let row = image.row(y);
        let at = |x: isize| row[x.clamp(0, width as isize - 1) as usize];
        for (x, out) in across.row_mut(y).iter_mut().enumerate() {
            let x = x as isize;
            *out = (at(x - 2) + at(x + 2) + 4.0 * (at(x - 1) + at(x + 1)) + 6.0 * at(x)) / 16.0;
        }
    }
    let mut out = Image::filled(width, height, 0.0);
    for y in 0..height {
        let row = |d: isize| across.row((y as isize + d).clamp(0, height as isize - 1) as usize);
        let (a, b, c, d, e) = (row(-2), row(-1), row(0), row(1), row(2));
        for (x, value) in out.row_mut(y).iter_mut().enumerate() {
            *value = (a[x] + e[x] + 4.0 * (b[x] + d[x]) + 6.0 * c[x]) / 16.0;
        }
    }
    out
}

/// Smoothed and every second pixel kept.
pub fn halved(image: &Image<f32>) -> Image<f32> {
    let full = smoothed(image);
    let (width, height) = (image.width().div_ceil(2), image.height().div_ceil(2));
    let mut out = Image::filled(width, height, 0.0);
    for y in 0..height {
        for (value, source) in out.row_mut(y).iter_mut().zip(full.row(2 * y).iter().step_by(2)) {
            *value = *source;
        }
    }
    out
}

/// Valid (255) only where the whole neighbourhood of `radius` px is.
pub fn eroded(mask: &Mask, radius: usize) -> Mask {
    let (width, height) = mask.size();
    let mut across = Image::filled(width, height, 0);
    for y in 0..height {
        let row = mask.row(y);
        for (x, out) in across.row_mut(y).iter_mut().enumerate() {
            if row[x.saturating_sub(radius)..(x + radius + 1).min(width)]
                .iter()
                .all(|m| *m != 0)
            {
                *out = 255;
            }
        }
    }
    let mut out = Image::filled(width, height, 255);
    for y in 0..height {
        for v in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            for (out, m) in out.row_mut(y).iter_mut().zip(across.row(v)) {
                *out &= *m;
            }
        }
    }
    out
}

/// Every second pixel, valid (255) only where its 3×3 neighbourhood is.
pub fn halved_mask(mask: &Mask) -> Mask {
    let (width, height) = (mask.width().div_ceil(2), mask.height().div_ceil(2));
    let mut out = Image::filled(width, height, 0);
    for y in 0..height {
        let rows = (2 * y).saturating_sub(1)..(2 * y + 2).min(mask.height());
        for x in 0..width {
            let columns = (2 * x).saturating_sub(1)..(2 * x + 2).min(mask.width());
            if rows.clone().all(|v| mask.row(v)[columns.clone()].iter().all(|m| *m != 0)) {
                out.set(x, y, 255);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_stays_a_ramp_of_twice_the_slope_away_from_the_border() {
        let mut image = Image::filled(64, 60, 0.0f32);
        for y in 0..60 {
            for x in 0..64 {
                image.set(x, y, x as f32 + 10.0 * y as f32);
            }
        }
        let pyramid = Pyramid::new(image, Image::filled(64, 60, 255), 2);
        for y in 2..28 {
            for x in 2..30 {
                assert!((pyramid.levels[1].at(x, y) - (2 * x + 20 * y) as f32).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn an_invalid_pixel_spoils_its_coarse_neighbours_only() {
        let mut mask = Image::filled(16, 16, 255u8);
        mask.set(7, 6, 0);
        let worn = eroded(&mask, 2);
        assert_eq!(worn.pixels().iter().filter(|m| **m == 0).count(), 25);
        assert!((5..=9).all(|x| (4..=8).all(|y| worn.at(x, y) == 0)));
        let half = halved_mask(&mask);
        let spoilt: Vec<_> = (0..8)
            .flat_map(|y| (0..8).map(move |x| (x, y)))
            .filter(|p| half.at(p.0, p.1) == 0)
            .collect();
        assert_eq!(spoilt, [(3, 3), (4, 3)]);
    }
}
