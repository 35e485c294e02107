//! Corners that do not lie where their neighbours say: a homography through the corners within two steps predicts each to a small part
//! of a step, whatever the lens. Where the field of the scope ends, or a reflex lies on an edge, a fit may settle elsewhere.

use std::collections::BTreeMap;

use crate::calibration::board::lattice::Cell;
use crate::calibration::homography::{from_pairs, mapped};
use crate::camera::intrinsics::Pixel;

/// A corner may lie this share of a step beside its prediction.
const MOST_STRAY: f64 = 0.07;
/// But so much is always allowed, px.
const ALLOWED_PX: f64 = 0.8;
/// Neighbours that a prediction needs.
const LEAST_NEIGHBOURS: usize = 5;

/// Without strays: the worst is taken away first, because it misleads its neighbours, until all agree. A corner with too few neighbours
/// to tell is taken away too.
pub fn without_strays(mut corners: BTreeMap<Cell, Pixel>) -> BTreeMap<Cell, Pixel> {
    let mut strays: BTreeMap<Cell, f64> = corners.keys().map(|cell| (*cell, stray(&corners, *cell))).collect();
    while let Some((worst, _)) = strays
        .iter()
        .filter(|(_, stray)| **stray > 1.0)
        .max_by(|a, b| a.1.total_cmp(b.1))
        .map(|(cell, stray)| (*cell, *stray))
    {
        corners.remove(&worst);
        strays.remove(&worst);
        for (cell, value) in &mut strays {
            if (cell[0] - worst[0]).abs() <= 2 && (cell[1] - worst[1]).abs() <= 2 {
                *value = stray(&corners, *cell);
            }
        }
    }
    corners
}

/// How far a corner strays, in units of what is allowed.
fn stray(corners: &BTreeMap<Cell, Pixel>, cell: Cell) -> f64 {
    let Some(at) = corners.get(&cell) else { return 0.0 };
    let mut near = Vec::new();
    let mut step_px = f64::INFINITY;
    for v in -2..=2 {
        for u in -2..=2 {
            let Some(other) = corners.get(&[cell[0] + u, cell[1] + v]).filter(|_| (u, v) != (0, 0)) else {
                continue;
            };
            near.push(([f64::from(u), f64::from(v)], [other.x, other.y]));
            step_px = step_px.min((other.x - at.x).hypot(other.y - at.y) / f64::from(u).hypot(f64::from(v)));
        }
    }
    let predicted = (near.len() >= LEAST_NEIGHBOURS).then(|| from_pairs(&near)).flatten();
    match predicted.and_then(|map| mapped(&map, [0.0, 0.0])) {
        Some(p) => (p[0] - at.x).hypot(p[1] - at.y) / (MOST_STRAY * step_px).max(ALLOWED_PX),
        None => f64::INFINITY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_strays_go() {
        let mut corners = BTreeMap::new();
        for v in 0..7 {
            for u in 0..9 {
                let (x, y) = (f64::from(u) / 9.0 - 0.5, f64::from(v) / 9.0 - 0.4);
                let bend = 1.0 - 0.3 * (x * x + y * y);
                let pixel = Pixel {
                    x: 400.0 + 300.0 * x * bend,
                    y: 300.0 + 280.0 * y * bend,
                };
                corners.insert([u, v], pixel);
            }
        }
        let whole = corners.clone();
        assert_eq!(without_strays(corners.clone()), whole);
        for cell in [[0, 0], [4, 3], [5, 3]] {
            corners.get_mut(&cell).unwrap().x += 6.0;
        }
        corners.insert([20, 20], Pixel { x: 700.0, y: 500.0 });
        let kept = without_strays(corners);
        assert_eq!(kept.len(), whole.len() - 3);
        assert!(kept.iter().all(|(cell, pixel)| whole.get(cell) == Some(pixel)));
    }
}
