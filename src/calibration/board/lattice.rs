//! From loose features to a lattice: starting at one feature, its neighbours are looked for where the lattice would go on.
//!
//! Each empty cell next to filled ones is predicted from them, by going on straight and by comparing with the next row, so that the
//! steps may change slowly: perspective and a strong lens bend the lattice, but never by much from one cell to the next. The best
//! prediction is filled first.

use std::collections::{BTreeMap, BTreeSet};

use crate::camera::intrinsics::Pixel;

/// A cell of a lattice.
pub type Cell = [i32; 2];

/// A found feature may be this share of a step beside its prediction.
const MOST_DEVIATION: f64 = 0.28;
/// A lattice larger than this is no board.
const MOST_CELLS: usize = 4000;

/// Where a lattice starts.
#[derive(Clone, Copy, Debug)]
pub struct Seed {
    /// Feature of the cell (0, 0).
    pub feature: usize,
    /// Steps to the cells (1, 0) and (0, 1), px.
    pub steps: [[f64; 2]; 2],
}

/// Features by cell.
pub type Lattice = BTreeMap<Cell, usize>;

#[derive(Clone, Copy, Debug)]
struct Member {
    at: Pixel,
    steps: [[f64; 2]; 2],
}

/// All features that a lattice from `seed` reaches; `fits` says whether a feature may stand in a cell.
pub fn grown(features: &[Pixel], seed: Seed, fits: &dyn Fn(usize, Cell) -> bool) -> Lattice {
    let mut lattice = Lattice::new();
    let Some(at) = features.get(seed.feature) else {
        return lattice;
    };
    let longest = seed.steps.iter().map(|step| step[0].hypot(step[1])).fold(1.0, f64::max);
    let buckets = Buckets::new(features, longest);
    let mut members = BTreeMap::from([(
        [0, 0],
        Member {
            at: *at,
            steps: seed.steps,
        },
    )]);
    let mut used = BTreeSet::from([seed.feature]);
    lattice.insert([0, 0], seed.feature);
    loop {
        let mut wanted: Vec<(f64, Cell, usize, Member)> = Vec::new();
        for cell in empty_neighbours(&members) {
            let Some(prediction) = predicted(&members, cell) else {
                continue;
            };
            let shorter = prediction
                .steps
                .iter()
                .map(|step| step[0].hypot(step[1]))
                .fold(f64::INFINITY, f64::min);
            let reach = MOST_DEVIATION * shorter;
            if !(reach.is_finite() && reach > 0.5) {
                continue;
            }
            let nearest = buckets
                .near(prediction.at, reach)
                .filter(|feature| !used.contains(feature) && fits(*feature, cell))
                .map(|feature| (distance(features[feature], prediction.at), feature))
                .filter(|(far, _)| *far <= reach)
                .min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((far, feature)) = nearest {
                wanted.push((far / shorter, cell, feature, prediction));
            }
        }
        wanted.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut grew = false;
        for (_, cell, feature, prediction) in wanted {
            if used.insert(feature) {
                lattice.insert(cell, feature);
                members.insert(
                    cell,
                    Member {
                        at: features[feature],
                        ..prediction
                    },
                );
                grew = true;
            }
        }
        renew_steps(&mut members);
        if !grew || lattice.len() > MOST_CELLS {
            return lattice;
        }
    }
}

fn distance(a: Pixel, b: Pixel) -> f64 {
    (a.x - b.x).hypot(a.y - b.y)
}

fn moved(cell: Cell, axis: usize, by: i32) -> Cell {
    let mut to = cell;
    to[axis] += by;
    to
}

fn empty_neighbours(members: &BTreeMap<Cell, Member>) -> BTreeSet<Cell> {
    let mut empty = BTreeSet::new();
    for cell in members.keys() {
        for axis in 0..2 {
            for by in [-1, 1] {
                let to = moved(*cell, axis, by);
                if !members.contains_key(&to) {
                    empty.insert(to);
                }
            }
        }
    }
    empty
}

/// Where `cell` should lie, by the mean of what its neighbours say.
fn predicted(members: &BTreeMap<Cell, Member>, cell: Cell) -> Option<Member> {
    let (mut sum, mut weight) = ([0.0; 2], 0.0);
    let mut steps = [[0.0; 2]; 2];
    let mut voters = 0.0;
    for axis in 0..2 {
        for by in [-1, 1] {
            let Some(near) = members.get(&moved(cell, axis, by)) else {
                continue;
            };
            let mut say = |x: f64, y: f64, w: f64| {
                sum[0] += w * x;
                sum[1] += w * y;
                weight += w;
            };
            let toward = f64::from(-by);
            let step = near.steps[axis];
            if let Some(far) = members.get(&moved(cell, axis, 2 * by)) {
                say(2.0 * near.at.x - far.at.x, 2.0 * near.at.y - far.at.y, 1.0);
            } else {
                say(near.at.x + toward * step[0], near.at.y + toward * step[1], 0.2);
            }
            for side in [-1, 1] {
                let beside = moved(cell, 1 - axis, side);
                if let (Some(a), Some(b)) = (members.get(&beside), members.get(&moved(beside, axis, by))) {
                    say(near.at.x + a.at.x - b.at.x, near.at.y + a.at.y - b.at.y, 1.0);
                }
            }
            voters += 1.0;
            for (sum, step) in steps.iter_mut().flatten().zip(near.steps.iter().flatten()) {
                *sum += step;
            }
        }
    }
    if weight == 0.0 {
        return None;
    }
    for step in steps.iter_mut().flatten() {
        *step /= voters;
    }
    Some(Member {
        at: Pixel {
            x: sum[0] / weight,
            y: sum[1] / weight,
        },
        steps,
    })
}

/// Steps as they are found to be, where neighbours are known.
fn renew_steps(members: &mut BTreeMap<Cell, Member>) {
    let before = members.clone();
    for (cell, member) in members.iter_mut() {
        for axis in 0..2 {
            let ahead = before.get(&moved(*cell, axis, 1));
            let behind = before.get(&moved(*cell, axis, -1));
            let (a, b, cells) = match (ahead, behind) {
                (Some(a), Some(b)) => (a.at, b.at, 2.0),
                (Some(a), None) => (a.at, member.at, 1.0),
                (None, Some(b)) => (member.at, b.at, 1.0),
                (None, None) => continue,
            };
            member.steps[axis] = [(a.x - b.x) / cells, (a.y - b.y) / cells];
        }
    }
}

/// Features by place, to find near ones quickly.
#[derive(Debug)]
pub struct Buckets {
    side: f64,
    by_place: BTreeMap<(i64, i64), Vec<usize>>,
}

impl Buckets {
    /// Buckets of `side` px.
    pub fn new(features: &[Pixel], side: f64) -> Self {
        let mut by_place: BTreeMap<(i64, i64), Vec<usize>> = BTreeMap::new();
        for (index, at) in features.iter().enumerate() {
            by_place.entry(Self::place(side, at.x, at.y)).or_default().push(index);
        }
        Self { side, by_place }
    }

    fn place(side: f64, x: f64, y: f64) -> (i64, i64) {
        ((x / side).floor() as i64, (y / side).floor() as i64)
    }

    /// Features in the buckets that a circle of radius `reach` around `at` touches.
    pub fn near(&self, at: Pixel, reach: f64) -> impl Iterator<Item = usize> + '_ {
        let (left, top) = Self::place(self.side, at.x - reach, at.y - reach);
        let (right, bottom) = Self::place(self.side, at.x + reach, at.y + reach);
        (left..=right)
            .flat_map(move |u| (top..=bottom).map(move |v| (u, v)))
            .filter_map(|place| self.by_place.get(&place))
            .flatten()
            .copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_lattice_is_followed_to_its_end_and_not_beyond() {
        // A barrel lens: r' = r (1 − 0.25 r²), half the diagonal at r = 1.
        let mut features = Vec::new();
        for j in -6..=6 {
            for i in -8..=8 {
                let (x, y) = (f64::from(i) * 0.1, f64::from(j) * 0.1);
                let shrink = 1.0 - 0.25 * (x * x + y * y);
                features.push(Pixel {
                    x: 320.0 + 300.0 * x * shrink,
                    y: 240.0 + 300.0 * y * shrink,
                });
            }
        }
        // Clutter between the rows.
        let count = features.len();
        features.push(Pixel { x: 335.0, y: 255.0 });
        features.push(Pixel { x: 20.0, y: 20.0 });
        let seed = Seed {
            feature: 6 * 17 + 8,
            steps: [[30.0, 0.0], [0.0, 30.0]],
        };
        let lattice = grown(&features, seed, &|_, _| true);
        assert_eq!(lattice.len(), count);
        for (cell, feature) in lattice {
            assert_eq!(feature as i32, (cell[1] + 6) * 17 + cell[0] + 8);
        }
    }
}
