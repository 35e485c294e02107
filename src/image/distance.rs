//! How far each pixel is from a mask, as the 3–4 chamfer distance (Borgefors 1986): two passes, within 8 % of Euclid.

use crate::image::buffer::{Image, Mask};

/// Chamfer units a pixel: a horizontal step costs 3, a diagonal one 4.
pub const UNITS_PER_PX: u16 = 3;

/// For each pixel the distance to the nearest non-zero pixel of `mask`, in thirds of a pixel, at most `limit`.
pub fn chamfer_distance(mask: &Mask, limit: u16, out: &mut Image<u16>) {
    let (width, height) = mask.size();
    if out.size() != mask.size() {
        out.resize(width, height, limit);
    }
    for (distance, &set) in out.pixels_mut().iter_mut().zip(mask.pixels()) {
        *distance = if set != 0 { 0 } else { limit };
    }
    for y in 0..height {
        sweep(out, y, y.checked_sub(1), false);
    }
    for y in (0..height).rev() {
        sweep(out, y, (y + 1 < height).then_some(y + 1), true);
    }
}

fn sweep(out: &mut Image<u16>, y: usize, neighbour: Option<usize>, backward: bool) {
    let width = out.width();
    if let Some(other) = neighbour {
        for x in 0..width {
            let mut best = out.at(x, y).min(out.at(x, other).saturating_add(3));
            if x > 0 {
                best = best.min(out.at(x - 1, other).saturating_add(4));
            }
            if x + 1 < width {
                best = best.min(out.at(x + 1, other).saturating_add(4));
            }
            out.set(x, y, best);
        }
    }
    let row = out.row_mut(y);
    if backward {
        for x in (0..width.saturating_sub(1)).rev() {
            row[x] = row[x].min(row[x + 1].saturating_add(3));
        }
    } else {
        for x in 1..width {
            row[x] = row[x].min(row[x - 1].saturating_add(3));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_near_the_euclidean_distance() {
        let mut mask = Image::filled(41, 31, 0);
        mask.set(20, 15, 255);
        mask.set(3, 28, 255);
        let mut out = Image::filled(0, 0, 0);
        chamfer_distance(&mask, 3000, &mut out);
        for y in 0..31 {
            for x in 0..41 {
                let euclid = [(20.0, 15.0), (3.0, 28.0)]
                    .iter()
                    .map(|&(u, v): &(f64, f64)| (x as f64 - u).hypot(y as f64 - v))
                    .fold(f64::MAX, f64::min);
                let found = f64::from(out.at(x, y)) / f64::from(UNITS_PER_PX);
                assert!(
                    (found - euclid).abs() <= 0.081 * euclid + 1e-9,
                    "({x}, {y}): {found} against {euclid}"
                );
            }
        }
    }
}
