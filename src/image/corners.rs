//! Places in a picture that can be found again: corners, spread over the picture.
//!
//! Shi and Tomasi, "Good features to track", 1994 (doi:10.1109/CVPR.1994.323794): a window can be located in both directions
//! if the smaller eigenvalue of its summed gradient products is large. To keep strong texture from taking all the corners, the
//! picture is divided into cells and each gives at most a few.

use crate::image::buffer::{Image, Mask};
use crate::image::gradient::gradient;

/// Half the side of the window that is summed, px.
const WINDOW_RADIUS_PX: usize = 4;

/// A place that can be found again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Column, px.
    pub x: f32,
    /// Row, px.
    pub y: f32,
    /// Smaller eigenvalue of the mean gradient products, (levels/px)².
    pub strength: f32,
}

/// How corners are chosen.
#[derive(Clone, Copy, Debug)]
pub struct CornerChoice {
    /// Cells along the picture's longer side.
    pub cells: usize,
    /// Corners a cell gives at most.
    pub per_cell: usize,
    /// Weakest corner taken, (levels/px)².
    pub min_strength: f32,
    /// Kept free at the border, px.
    pub margin: usize,
}

/// The strongest corners of every cell, on valid pixels, cell by cell.
pub fn corners(image: &Image<f32>, valid: &Mask, choice: &CornerChoice) -> Vec<Corner> {
    let strength = corner_strength(image, valid);
    let (width, height) = image.size();
    let margin = choice.margin.max(1);
    if width <= 2 * margin || height <= 2 * margin {
        return Vec::new();
    }
    let cell = (width.max(height) / choice.cells.max(1)).max(8);
    let mut found = Vec::new();
    let mut in_cell: Vec<Corner> = Vec::new();
    for top in (margin..height - margin).step_by(cell) {
        for left in (margin..width - margin).step_by(cell) {
            in_cell.clear();
            for y in top..(top + cell).min(height - margin) {
                for x in left..(left + cell).min(width - margin) {
                    let s = strength.at(x, y);
                    if s >= choice.min_strength && valid.at(x, y) != 0 && is_peak(&strength, x, y) {
                        in_cell.push(Corner {
                            x: x as f32,
                            y: y as f32,
                            strength: s,
                        });
                    }
                }
            }
            in_cell.sort_by(|a, b| b.strength.total_cmp(&a.strength));
            found.extend(in_cell.iter().take(choice.per_cell));
        }
    }
    found
}

fn is_peak(strength: &Image<f32>, x: usize, y: usize) -> bool {
    let s = strength.at(x, y);
    for (v, before) in [(y - 1, true), (y, true), (y, false), (y + 1, false)] {
        let columns = if v == y {
            if before { x - 1..x } else { x + 1..x + 2 }
        } else {
            x - 1..x + 2
        };
        for u in columns {
            let other = strength.at(u, v);
            // Ties go to the first in reading order, so that a plateau gives one corner.
            if other > s || (before && other == s) {
                return false;
            }
        }
    }
    true
}

/// The smaller eigenvalue for every pixel; gradients at invalid pixels count as none.
pub fn corner_strength(image: &Image<f32>, valid: &Mask) -> Image<f32> {
    let (width, height) = image.size();
    let (gx, gy) = gradient(image);
    let mut products = vec![[0.0f32; 3]; width * height];
    for (((p, x), y), valid) in products.iter_mut().zip(gx.pixels()).zip(gy.pixels()).zip(valid.pixels()) {
        if *valid != 0 {
            *p = [x * x, x * y, y * y];
        }
    }
    let summed = box_sums(&products, width, height);
    let mut out = Image::filled(width, height, 0.0);
    let area = ((2 * WINDOW_RADIUS_PX + 1) * (2 * WINDOW_RADIUS_PX + 1)) as f32;
    for (out, [xx, xy, yy]) in out.pixels_mut().iter_mut().zip(summed) {
        let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        *out = ((mean - (half * half + xy * xy).sqrt()) / area).max(0.0);
    }
    out
}

fn box_sums(values: &[[f32; 3]], width: usize, height: usize) -> Vec<[f32; 3]> {
    let r = WINDOW_RADIUS_PX;
    let mut across = vec![[0.0f32; 3]; values.len()];
    for (row, out) in values.chunks(width).zip(across.chunks_mut(width)) {
        let mut sum = [0.0f64; 3];
        for x in 0..width + r {
            for c in 0..3 {
                sum[c] += row.get(x).map_or(0.0, |v| f64::from(v[c]));
                sum[c] -= x
                    .checked_sub(2 * r + 1)
                    .and_then(|left| row.get(left))
                    .map_or(0.0, |v| f64::from(v[c]));
            }
            if let Some(out) = x.checked_sub(r).and_then(|x| out.get_mut(x)) {
                *out = sum.map(|s| s as f32);
            }
        }
    }
    let mut out = vec![[0.0f32; 3]; values.len()];
    let mut sum = vec![[0.0f64; 3]; width];
    for y in 0..height + r {
        for (x, sum) in sum.iter_mut().enumerate() {
            for c in 0..3 {
                if y < height {
                    sum[c] += f64::from(across[y * width + x][c]);
                }
                if let Some(top) = y.checked_sub(2 * r + 1) {
                    sum[c] -= f64::from(across[top * width + x][c]);
                }
            }
            if let Some(row) = y.checked_sub(r) {
                out[row * width + x] = sum.map(|s| s as f32);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn box_sums_agree_with_the_plain_double_loop() {
        let (width, height) = (23, 17);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let values: Vec<[f32; 3]> = (0..width * height)
            .map(|_| [0; 3].map(|_: i32| rng.random_range(0.0..9.0)))
            .collect();
        let fast = box_sums(&values, width, height);
        let r = WINDOW_RADIUS_PX as isize;
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0f32;
                for v in y as isize - r..=y as isize + r {
                    for u in x as isize - r..=x as isize + r {
                        if u >= 0 && v >= 0 && u < width as isize && v < height as isize {
                            sum += values[v as usize * width + u as usize][1];
                        }
                    }
                }
                assert!((sum - fast[y * width + x][1]).abs() < 1e-2);
            }
        }
    }

    #[test]
    fn squares_give_their_corners_and_a_masked_square_none() {
        let mut image = Image::filled(120, 80, 20.0f32);
        for (left, top) in [(20, 20), (80, 40)] {
            for y in top..top + 16 {
                for x in left..left + 16 {
                    image.set(x, y, 120.0);
                }
            }
        }
        let mut valid = Image::filled(120, 80, 255u8);
        for y in 30..66 {
            for x in 70..106 {
                valid.set(x, y, 0);
            }
        }
        let choice = CornerChoice {
            cells: 12,
            per_cell: 1,
            min_strength: 10.0,
            margin: 6,
        };
        let found = corners(&image, &valid, &choice);
        assert!(found.len() >= 4);
        for corner in found {
            let x = (corner.x - 19.5).abs().min((corner.x - 35.5).abs());
            let y = (corner.y - 19.5).abs().min((corner.y - 35.5).abs());
            assert!(x < 5.0 && y < 5.0, "{corner:?}");
        }
    }
}
