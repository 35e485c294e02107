//! Unknown values of a smooth map filled from the known ones around: pull–push (Gortler et al. 1996, "The Lumigraph").
//!
//! Pull: known values are averaged into ever coarser levels. Push: an unknown value is taken, bilinearly, from the coarser level. What is
//! known stays exactly as it is.

use crate::image::buffer::Image;

/// Fills holes; owns its working memory.
#[derive(Debug, Default)]
pub struct HoleFiller {
    values: Vec<Image<f32>>,
    weights: Vec<Image<f32>>,
}

impl HoleFiller {
    /// Fill the zeros of `map` from values at most about 2^`levels` px away; farther ones stay zero.
    pub fn fill(&mut self, map: &mut Image<f32>, levels: usize) {
        while self.values.len() < levels {
            self.values.push(Image::filled(0, 0, 0.0));
            self.weights.push(Image::filled(0, 0, 0.0));
        }
        for level in 0..levels {
            let (finer, rest) = self.values.split_at_mut(level);
            let (finer_weights, rest_weights) = self.weights.split_at_mut(level);
            match (finer.last(), finer_weights.last()) {
                (Some(values), Some(weights)) => pull(values, |i| weights.pixels()[i], &mut rest[0], &mut rest_weights[0]),
                _ => pull(
                    map,
                    |i| if map.pixels()[i] > 0.0 { 1.0 } else { 0.0 },
                    &mut rest[0],
                    &mut rest_weights[0],
                ),
            }
        }
        for level in (1..levels).rev() {
            let (finer, coarser) = self.values.split_at_mut(level);
            let (finer_weights, coarser_weights) = self.weights.split_at_mut(level);
            push(
                &coarser[0],
                &coarser_weights[0],
                &mut finer[level - 1],
                Some(&mut finer_weights[level - 1]),
            );
        }
        if levels > 0 {
            push(&self.values[0], &self.weights[0], map, None);
        }
    }
}

fn pull(values: &Image<f32>, weight: impl Fn(usize) -> f32, out: &mut Image<f32>, out_weights: &mut Image<f32>) {
    let (width, height) = (values.width().div_ceil(2), values.height().div_ceil(2));
    for image in [&mut *out, &mut *out_weights] {
        if image.size() != (width, height) {
            image.resize(width, height, 0.0);
        }
    }
    for y in 0..height {
        for x in 0..width {
            let (mut sum, mut total) = (0.0, 0.0);
            for v in 2 * y..(2 * y + 2).min(values.height()) {
                for u in 2 * x..(2 * x + 2).min(values.width()) {
                    let index = v * values.width() + u;
                    let w = weight(index);
                    sum += w * values.pixels()[index];
                    total += w;
                }
            }
            out.set(x, y, if total > 0.0 { sum / total } else { 0.0 });
            out_weights.set(x, y, total.min(1.0));
        }
    }
}

/// Values of weight 0 (or zeros, without weights) from the coarser level; they then count as known.
fn push(coarse: &Image<f32>, coarse_weights: &Image<f32>, out: &mut Image<f32>, mut weights: Option<&mut Image<f32>>) {
    let (width, height) = out.size();
    for y in 0..height {
        for x in 0..width {
            let known = weights.as_ref().map_or(out.at(x, y) > 0.0, |w| w.at(x, y) > 0.0);
            if known {
                continue;
            }
            let (place_x, place_y) = ((x as f32 - 0.5).max(0.0) / 2.0, (y as f32 - 0.5).max(0.0) / 2.0);
            let (left, top) = (place_x as usize, place_y as usize);
            let (fx, fy) = (place_x - left as f32, place_y - top as f32);
            let (mut sum, mut total) = (0.0, 0.0);
            for (u, v, w) in [
                (0, 0, (1.0 - fx) * (1.0 - fy)),
                (1, 0, fx * (1.0 - fy)),
                (0, 1, (1.0 - fx) * fy),
                (1, 1, fx * fy),
            ] {
                let (u, v) = ((left + u).min(coarse.width() - 1), (top + v).min(coarse.height() - 1));
                if coarse_weights.at(u, v) > 0.0 {
                    sum += w * coarse.at(u, v);
                    total += w;
                }
            }
            if total > 1e-6 {
                out.set(x, y, sum / total);
                if let Some(weights) = &mut weights {
                    weights.set(x, y, 1.0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_of_a_slope_are_filled_near_the_slope_and_the_rest_stays() {
        let slope = |x: usize, y: usize| 50.0 + 0.2 * x as f32 + 0.1 * y as f32;
        let mut map = Image::filled(101, 77, 0.0);
        for y in 0..77 {
            for x in 0..101 {
                let hole = (40..52).contains(&x) && (30..45).contains(&y);
                map.set(x, y, if hole { 0.0 } else { slope(x, y) });
            }
        }
        HoleFiller::default().fill(&mut map, 6);
        for y in 0..77 {
            for x in 0..101 {
                let hole = (40..52).contains(&x) && (30..45).contains(&y);
                let bound = if hole { 1.0 } else { 0.0 };
                assert!(
                    (map.at(x, y) - slope(x, y)).abs() <= bound,
                    "({x}, {y}): {} for {}",
                    map.at(x, y),
                    slope(x, y)
                );
            }
        }
    }

    #[test]
    fn what_is_far_stays_unknown() {
        let mut map = Image::filled(200, 4, 0.0);
        map.set(0, 0, 7.0);
        HoleFiller::default().fill(&mut map, 3);
        assert_eq!(map.at(3, 3), 7.0);
        assert_eq!(map.at(60, 2), 0.0);
    }
}
