//! Blood vessels: trees of bending branches that fork and thin out.
//!
//! At a fork the children's radii follow Murray's law, r³ = r₁³ + r₂³ (Murray 1926, DOI 10.1073/pnas.12.3.207).

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::synthetic::material::MaterialGrid;

/// Where a tree is rooted and how it grows.
#[derive(Clone, Copy, Debug)]
pub struct Root {
    /// Place, mm.
    pub at: [f64; 2],
    /// Direction of growth, rad.
    pub heading: f64,
    /// Radius, mm.
    pub radius_mm: f64,
    /// Length of the first branch, mm.
    pub length_mm: f64,
}

/// Below this a vessel is no longer seen, mm.
const THINNEST_MM: f64 = 0.07;
/// A branch is drawn in steps of this length, mm.
const STEP_MM: f64 = 0.15;

/// How much of each texel of `grid` is vessel, 0–1.
pub fn vessel_coverage(grid: &MaterialGrid, roots: &[Root], seed: u64) -> Vec<f32> {
    let mut coverage = vec![0.0_f32; grid.columns * grid.rows];
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut growing = roots.to_vec();
    while let Some(branch) = growing.pop() {
        let (mut at, mut heading, mut bend) = (branch.at, branch.heading, 0.0);
        let length = branch.length_mm * random.random_range(0.7..1.3);
        let mut gone = 0.0;
        while gone < length {
            bend = 0.93 * bend + random.random_range(-0.009..0.009);
            heading += bend;
            at = [at[0] + STEP_MM * heading.cos(), at[1] + STEP_MM * heading.sin()];
            gone += STEP_MM;
            let radius = branch.radius_mm * (1.0 - 0.2 * gone / length);
            stamp(&mut coverage, grid, at, radius);
        }
        let share: f64 = random.random_range(0.35..0.65);
        for (side, part) in [(1.0, share), (-1.0, 1.0 - share)] {
            let radius_mm = branch.radius_mm * 0.92 * part.cbrt();
            if radius_mm > THINNEST_MM {
                let turn = side * random.random_range(0.25..0.8);
                growing.push(Root {
                    at,
                    heading: heading + turn,
                    radius_mm,
                    length_mm: branch.length_mm * 0.85,
                });
            }
        }
    }
    coverage
}

/// A disc with a soft rim.
fn stamp(coverage: &mut [f32], grid: &MaterialGrid, at: [f64; 2], radius_mm: f64) {
    let reach = radius_mm + 0.12;
    let first = |axis: usize| ((at[axis] - reach - grid.origin[axis]) / grid.pitch_mm).floor().max(0.0) as usize;
    let last = |axis: usize, count: usize| {
        (((at[axis] + reach - grid.origin[axis]) / grid.pitch_mm).ceil().max(0.0) as usize).min(count - 1)
    };
    for row in first(1)..=last(1, grid.rows) {
        for column in first(0)..=last(0, grid.columns) {
            let (x, y) = grid.place(column, row);
            let distance = (x - at[0]).hypot(y - at[1]);
            let inside = ((reach - distance) / 0.2).clamp(0.0, 1.0);
            // Thin vessels lie deeper and are paler.
            let strength = (inside * inside * (3.0 - 2.0 * inside) * (radius_mm / 0.3).clamp(0.35, 1.0)) as f32;
            let texel = &mut coverage[row * grid.columns + column];
            *texel = texel.max(strength);
        }
    }
}
