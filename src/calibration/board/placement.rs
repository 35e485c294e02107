//! Which corner of the board a lattice's cell is: the turn and shift that put most cells on the board.

use std::collections::{BTreeMap, BTreeSet};

use crate::calibration::board::lattice::{Cell, Lattice};
use crate::calibration::board::pattern::{BoardLayout, Pattern, Site};
use crate::camera::intrinsics::Pixel;

/// How sure it is which corner is which.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Naming {
    /// Each corner is known.
    Unique,
    /// The whole board is seen, but it looks the same upside down: the end nearer to upright was taken.
    UpsideDown,
    /// Only a part is seen, and it could be another part: good for the camera, of no use where the board's place matters.
    Shifted,
}

/// Cells put on the board.
#[derive(Clone, Debug)]
pub struct Placed {
    /// Site (index into the layout's sites) and feature.
    pub pairs: Vec<(usize, usize)>,
    /// How sure that is.
    pub naming: Naming,
}

/// Integer change of basis, rows first.
type Basis = [[i32; 2]; 2];

const TURNS: [Basis; 4] = [[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]];

/// A lattice of dots may have been grown along a diagonal.
const SHEARS: [Basis; 5] = [
    [[1, 0], [0, 1]],
    [[1, 1], [0, 1]],
    [[1, -1], [0, 1]],
    [[1, 0], [1, 1]],
    [[1, 0], [-1, 1]],
];

fn changed(basis: &Basis, cell: Cell) -> Cell {
    [
        basis[0][0] * cell[0] + basis[0][1] * cell[1],
        basis[1][0] * cell[0] + basis[1][1] * cell[1],
    ]
}

fn product(a: &Basis, b: &Basis) -> Basis {
    let first = changed(a, [b[0][0], b[1][0]]);
    let second = changed(a, [b[0][1], b[1][1]]);
    [[first[0], second[0]], [first[1], second[1]]]
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    basis: Basis,
    shift: Cell,
    on_board: usize,
    colors_agree: bool,
    sheared: bool,
}

/// Put `lattice` on the board; for a checkerboard the square between the steps (1, 0) and (0, 1) of cell (0, 0) is bright.
pub fn placed(lattice: &Lattice, features: &[Pixel], layout: &BoardLayout) -> Option<Placed> {
    let sites = layout.sites();
    let by_cell: BTreeMap<Cell, usize> = sites.iter().enumerate().map(|(index, site)| (site.lattice, index)).collect();
    let colored = matches!(layout.pattern, Pattern::Checkerboard);
    let shears = if colored { &SHEARS[..1] } else { &SHEARS[..] };
    let mut candidates = Vec::new();
    for (place, shear) in shears.iter().enumerate() {
        for (quarters, turn) in TURNS.iter().enumerate() {
            let basis = product(turn, shear);
            let known = candidates.len();
            collect(lattice, &sites, &basis, colored.then_some(quarters), &mut candidates);
            candidates
                .iter_mut()
                .skip(known)
                .for_each(|candidate| candidate.sheared = place > 0);
        }
    }
    let most = candidates.iter().map(|candidate| candidate.on_board).max()?;
    candidates.retain(|candidate| candidate.on_board == most);
    if candidates.iter().any(|candidate| candidate.colors_agree) {
        candidates.retain(|candidate| candidate.colors_agree);
    }
    // A small piece fits in many ways; steps along the nearest neighbours are the likeliest.
    if candidates.iter().any(|candidate| !candidate.sheared) {
        candidates.retain(|candidate| !candidate.sheared);
    }
    let whole = most == sites.len();
    let naming = match candidates.len() {
        1 => Naming::Unique,
        2 if layout.looks_the_same_upside_down() && are_half_turns(&candidates) => Naming::UpsideDown,
        _ if whole && layout.looks_the_same_upside_down() => Naming::UpsideDown,
        _ => Naming::Shifted,
    };
    let upright = |candidate: &Candidate| {
        let pairs = pairs(lattice, &by_cell, candidate);
        // Covariance of board x and picture x: how far the board's x points to the right.
        let mean = |value: &dyn Fn(&(usize, usize)) -> f64| pairs.iter().map(value).sum::<f64>() / pairs.len().max(1) as f64;
        let mean_board = mean(&|(site, _)| sites[*site].board_mm[0]);
        let mean_picture = mean(&|(_, feature)| features[*feature].x);
        mean(&|(site, feature)| (sites[*site].board_mm[0] - mean_board) * (features[*feature].x - mean_picture))
    };
    let best = candidates.iter().max_by(|a, b| upright(a).total_cmp(&upright(b)))?;
    Some(Placed {
        pairs: pairs(lattice, &by_cell, best),
        naming,
    })
}

fn are_half_turns(candidates: &[Candidate]) -> bool {
    let [a, b] = candidates else { return false };
    a.basis.iter().flatten().zip(b.basis.iter().flatten()).all(|(a, b)| *a == -*b)
}

fn pairs(lattice: &Lattice, by_cell: &BTreeMap<Cell, usize>, candidate: &Candidate) -> Vec<(usize, usize)> {
    let mut pairs: Vec<(usize, usize)> = lattice
        .iter()
        .filter_map(|(cell, feature)| {
            let at = changed(&candidate.basis, *cell);
            let site = by_cell.get(&[at[0] + candidate.shift[0], at[1] + candidate.shift[1]])?;
            Some((*site, *feature))
        })
        .collect();
    pairs.sort_unstable();
    pairs
}

/// All shifts under which a lattice in `basis` meets the board, with how many cells do.
fn collect(lattice: &Lattice, sites: &[Site], basis: &Basis, quarters: Option<usize>, candidates: &mut Vec<Candidate>) {
    let cells: Vec<Cell> = lattice.keys().map(|cell| changed(basis, *cell)).collect();
    let mut counts: BTreeMap<Cell, usize> = BTreeMap::new();
    let (low, high) = extent(sites.iter().map(|site| site.lattice));
    let (width, height) = (high[0] - low[0] + 1, high[1] - low[1] + 1);
    if width <= 0 || height <= 0 {
        return;
    }
    let mut on_board = vec![false; (width * height) as usize];
    for site in sites {
        on_board[((site.lattice[1] - low[1]) * width + site.lattice[0] - low[0]) as usize] = true;
    }
    let (first, last) = extent(cells.iter().copied());
    for down in low[1] - last[1]..=high[1] - first[1] {
        for across in low[0] - last[0]..=high[0] - first[0] {
            let met = cells
                .iter()
                .filter(|cell| {
                    let (u, v) = (cell[0] + across - low[0], cell[1] + down - low[1]);
                    u >= 0 && v >= 0 && u < width && v < height && on_board[(v * width + u) as usize]
                })
                .count();
            counts.insert([across, down], met);
        }
    }
    let Some(most) = counts.values().copied().max() else { return };
    let distinct: BTreeSet<Cell> = counts
        .iter()
        .filter(|(_, met)| **met == most)
        .map(|(shift, _)| *shift)
        .collect();
    for shift in distinct {
        // Bright lies between the steps of even cells; on the board, of odd ones. A quarter turn swaps the colors.
        let colors_agree = quarters.is_none_or(|quarters| (shift[0] + shift[1] + quarters as i32).rem_euclid(2) == 1);
        candidates.push(Candidate {
            basis: *basis,
            shift,
            on_board: most,
            colors_agree,
            sheared: false,
        });
    }
}

fn extent(cells: impl Iterator<Item = Cell>) -> (Cell, Cell) {
    cells.fold(([i32::MAX; 2], [i32::MIN; 2]), |(low, high), cell| {
        (
            [low[0].min(cell[0]), low[1].min(cell[1])],
            [high[0].max(cell[0]), high[1].max(cell[1])],
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Features of all sites, seen turned by `degrees`, in a lattice with another origin and basis.
    fn seen(layout: &BoardLayout, degrees: f64, basis: &Basis, skip: usize) -> (Lattice, Vec<Pixel>) {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let mut features = Vec::new();
        let mut lattice = Lattice::new();
        for (index, site) in layout.sites().iter().enumerate() {
            let [x, y] = site.board_mm;
            features.push(Pixel {
                x: cos * x - sin * y,
                y: sin * x + cos * y,
            });
            if index >= skip {
                lattice.insert(changed(basis, [site.lattice[0] - 3, site.lattice[1] - 2]), index);
            }
        }
        (lattice, features)
    }

    #[test]
    fn every_turn_of_an_asymmetric_board_is_undone() {
        for text in ["checkerboard:9x6", "acircles:4x11"] {
            let layout = BoardLayout::new(text, 10.0).unwrap();
            for (quarters, basis) in TURNS.iter().enumerate() {
                for degrees in [0.0, 80.0, 170.0, 260.0] {
                    let (lattice, features) = seen(&layout, degrees, basis, 0);
                    // The first cell (3, 2) is odd: its bright square lies between its steps. A quarter turn of the lattice swaps that,
                    // and what a grower calls cell (0, 0) is always one with bright between.
                    let lattice: Lattice = if layout.pattern == Pattern::Checkerboard && quarters % 2 == 1 {
                        lattice.into_iter().map(|([u, v], feature)| ([u + 1, v], feature)).collect()
                    } else {
                        lattice
                    };
                    let placed = placed(&lattice, &features, &layout).unwrap();
                    assert_eq!(placed.naming, Naming::Unique, "{text}");
                    assert!(
                        placed.pairs.iter().all(|(site, feature)| site == feature),
                        "{text} {quarters} {degrees}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_symmetric_board_is_taken_the_way_up() {
        let layout = BoardLayout::new("circles:7x5", 10.0).unwrap();
        for (degrees, same) in [(20.0, true), (200.0, false)] {
            let (lattice, features) = seen(&layout, degrees, &SHEARS[2], 0);
            let placed = placed(&lattice, &features, &layout).unwrap();
            assert_eq!(placed.naming, Naming::UpsideDown);
            assert_eq!(placed.pairs.iter().all(|(site, feature)| site == feature), same);
            assert_eq!(placed.pairs.len(), 35);
        }
    }

    #[test]
    fn a_part_of_a_board_is_said_to_be_one() {
        let layout = BoardLayout::new("checkerboard:9x6", 10.0).unwrap();
        let (lattice, features) = seen(&layout, 0.0, &TURNS[0], 18);
        let placed = placed(&lattice, &features, &layout).unwrap();
        assert_eq!((placed.naming, placed.pairs.len()), (Naming::Shifted, 36));
    }
}
