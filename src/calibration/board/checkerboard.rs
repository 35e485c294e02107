//! Finding a checkerboard: saddles, grown to a lattice, put on the board, each corner fitted.
//!
//! Neighbouring corners see bright and dark swapped; that tells a checkerboard from other patterns and its rows from one another. The
//! search runs on the picture reduced to about a thousand columns first (little noise, no comb of an interlaced picture), then on finer
//! and coarser ones until the whole board is found. The fit is always made on the full picture.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use crate::calibration::board::corner_fit::{FittedCorner, Start, fitted};
use crate::calibration::board::detection::{BoardCorner, Detection};
use crate::calibration::board::lattice::{Cell, Lattice, Seed, grown};
use crate::calibration::board::pattern::{BoardLayout, Site};
use crate::calibration::board::placement::{Placed, placed};
use crate::calibration::board::saddle::{Saddle, saddles};
use crate::calibration::board::stray::without_strays;
use crate::camera::intrinsics::Pixel;
use crate::geometry::point::Point;
use crate::image::buffer::Image;
use crate::image::pyramid::halved;

/// The width that the first search reduces pictures to, px, at least.
const FIRST_WIDTH: usize = 700;
/// Lattices tried per picture.
const MOST_SEEDS: usize = 60;
/// Edges of neighbours may turn by this much, rad.
const MOST_TURN_RAD: f64 = 0.4;
/// Edges may turn by this much over the whole board, rad.
const MOST_TURN_OVERALL_RAD: f64 = 0.9;
/// A corner's window reaches this share of the way to the next edges.
const WINDOW_SHARE: f64 = 0.45;
/// A piece of fewer corners is no board.
pub const FEWEST_CORNERS: usize = 12;

/// The board in a gray picture (0–255), if it is seen.
pub fn detect(gray: &Image<f32>, layout: &BoardLayout) -> Option<Detection> {
    let sites = layout.sites();
    let mut best: Option<(Placed, Vec<Saddle>)> = None;
    for (image, scale) in levels(gray) {
        let mut found = saddles(&image);
        for saddle in &mut found {
            saddle.pixel.x *= scale;
            saddle.pixel.y *= scale;
        }
        let placed = largest(&found, layout);
        let count = |placed: &Placed| placed.pairs.len();
        if let Some(placed) = placed
            && best.as_ref().is_none_or(|(best, _)| count(&placed) > count(best))
        {
            best = Some((placed, found));
        }
        if best.as_ref().is_some_and(|(best, _)| count(best) == sites.len()) {
            break;
        }
    }
    let (placed, found) = best?;
    let starts: BTreeMap<usize, Rough> = placed
        .pairs
        .iter()
        .map(|(site, feature)| {
            let saddle = &found[*feature];
            (
                *site,
                Rough {
                    pixel: saddle.pixel,
                    edges: saddle.edges,
                },
            )
        })
        .collect();
    let mut corners = refined(gray, &sites, &starts);
    drop_strays(&sites, &mut corners);
    complete(gray, &sites, &mut corners);
    drop_strays(&sites, &mut corners);
    if corners.len() < FEWEST_CORNERS.min(sites.len()) {
        return None;
    }
    Some(Detection {
        corners: corners
            .iter()
            .map(|(site, corner)| {
                let [x, y] = sites[*site].board_mm;
                BoardCorner {
                    site: *site,
                    board: Point::new(x, y, 0.0),
                    pixel: corner.pixel,
                    sigma_px: corner.sigma_px,
                }
            })
            .collect(),
        naming: placed.naming,
        dot_radius_mm: None,
    })
}

/// The picture at several sizes, likeliest first, each with the size of its pixels.
fn levels(gray: &Image<f32>) -> Vec<(Image<f32>, f64)> {
    let mut pyramid = vec![(gray.clone(), 1.0)];
    while let Some((last, scale)) = pyramid.last()
        && last.width() > 360
        && pyramid.len() < 4
    {
        let next = (halved(last), scale * 2.0);
        pyramid.push(next);
    }
    let first = pyramid
        .iter()
        .rposition(|(image, _)| image.width() >= FIRST_WIDTH)
        .unwrap_or(0);
    // First, finer, coarser, and so on outward.
    let mut numbered: Vec<(usize, (Image<f32>, f64))> = pyramid.into_iter().enumerate().collect();
    numbered.sort_by_key(|(level, _)| 2 * level.abs_diff(first) + usize::from(*level > first));
    numbered.into_iter().map(|(_, level)| level).collect()
}

/// The smaller angle between two lines.
fn turn(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(PI);
    d.min(PI - d)
}

/// The lattice that covers most of the board.
fn largest(found: &[Saddle], layout: &BoardLayout) -> Option<Placed> {
    let pixels: Vec<Pixel> = found.iter().map(|saddle| saddle.pixel).collect();
    let whole = layout.sites().len();
    let mut best: Option<Placed> = None;
    let mut in_a_lattice = vec![false; found.len()];
    let mut seeds = 0;
    for first in 0..found.len() {
        if in_a_lattice[first] {
            continue;
        }
        let Some(seed) = seed(found, first) else { continue };
        seeds += 1;
        if seeds > MOST_SEEDS {
            break;
        }
        let edges = found[first].edges;
        let fits = |feature: usize, cell: Cell| {
            let at = found[feature].edges;
            let same = turn(at[0], edges[0]).max(turn(at[1], edges[1]));
            let swapped = turn(at[0], edges[1]).max(turn(at[1], edges[0]));
            let (right, wrong) = if (cell[0] + cell[1]).rem_euclid(2) == 0 {
                (same, swapped)
            } else {
                (swapped, same)
            };
            right < wrong && right < MOST_TURN_OVERALL_RAD
        };
        let lattice: Lattice = grown(&pixels, seed, &fits);
        for feature in lattice.values() {
            in_a_lattice[*feature] = true;
        }
        if lattice.len() < FEWEST_CORNERS.min(whole) || best.as_ref().is_some_and(|best| best.pairs.len() >= lattice.len()) {
            continue;
        }
        if let Some(placed) = placed(&lattice, &pixels, layout)
            && best.as_ref().is_none_or(|best| placed.pairs.len() > best.pairs.len())
        {
            best = Some(placed);
        }
        if best.as_ref().is_some_and(|best| best.pairs.len() == whole) {
            break;
        }
    }
    best
}

/// A start at `first`, if it has neighbours with swapped colors along both of its edges.
fn seed(found: &[Saddle], first: usize) -> Option<Seed> {
    let start = &found[first];
    let mut steps = [[0.0; 2]; 2];
    for (axis, step) in steps.iter_mut().enumerate() {
        let along = start.edges[axis];
        let nearest = found
            .iter()
            .enumerate()
            .filter(|(index, other)| {
                let (dx, dy) = (other.pixel.x - start.pixel.x, other.pixel.y - start.pixel.y);
                *index != first
                    && turn(dy.atan2(dx), along) < 0.3
                    && turn(other.edges[0], start.edges[1]) < MOST_TURN_RAD
                    && turn(other.edges[1], start.edges[0]) < MOST_TURN_RAD
            })
            .map(|(_, other)| [other.pixel.x - start.pixel.x, other.pixel.y - start.pixel.y])
            .min_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1])))?;
        // Along the edge's own sense, so that bright lies between the two steps.
        let along = if axis == 1 && along < start.edges[0] {
            along + PI
        } else {
            along
        };
        let sense = (nearest[0] * along.cos() + nearest[1] * along.sin()).signum();
        *step = [nearest[0] * sense, nearest[1] * sense];
    }
    let (a, b) = (steps[0][0].hypot(steps[0][1]), steps[1][0].hypot(steps[1][1]));
    (a < 6.0 * b && b < 6.0 * a).then_some(Seed { feature: first, steps })
}

#[derive(Clone, Copy, Debug)]
struct Rough {
    pixel: Pixel,
    edges: [f64; 2],
}

/// How far from a corner the next edges are, from its neighbours on the lattice.
fn window(at: Pixel, cell: Cell, places: &BTreeMap<Cell, Pixel>) -> Option<f64> {
    let steps = |axis: usize| {
        [-1, 1].into_iter().filter_map(move |by| {
            let mut to = cell;
            to[axis] += by;
            places.get(&to).map(|p| [p.x - at.x, p.y - at.y])
        })
    };
    let mut nearest = f64::INFINITY;
    for a in steps(0) {
        for b in steps(1) {
            let area = (a[0] * b[1] - a[1] * b[0]).abs();
            nearest = nearest.min(area / a[0].hypot(a[1]).max(b[0].hypot(b[1])));
        }
    }
    nearest.is_finite().then_some(WINDOW_SHARE * nearest)
}

fn refined(gray: &Image<f32>, sites: &[Site], starts: &BTreeMap<usize, Rough>) -> BTreeMap<usize, FittedCorner> {
    let places: BTreeMap<Cell, Pixel> = starts
        .iter()
        .map(|(site, rough)| (sites[*site].lattice, rough.pixel))
        .collect();
    starts
        .iter()
        .filter_map(|(site, rough)| {
            let radius_px = window(rough.pixel, sites[*site].lattice, &places)?;
            let start = Start {
                pixel: rough.pixel,
                edges: rough.edges,
                radius_px,
            };
            Some((*site, fitted(gray, &start)?))
        })
        .collect()
}

fn drop_strays(sites: &[Site], corners: &mut BTreeMap<usize, FittedCorner>) {
    let kept = without_strays(
        corners
            .iter()
            .map(|(site, corner)| (sites[*site].lattice, corner.pixel))
            .collect(),
    );
    corners.retain(|site, _| kept.contains_key(&sites[*site].lattice));
}

/// Corners that the search missed (a specularity, a shadow) are fitted where their neighbours say.
fn complete(gray: &Image<f32>, sites: &[Site], corners: &mut BTreeMap<usize, FittedCorner>) {
    let by_cell: BTreeMap<Cell, usize> = sites.iter().enumerate().map(|(index, site)| (site.lattice, index)).collect();
    loop {
        let mut added = Vec::new();
        let places: BTreeMap<Cell, Pixel> = corners
            .iter()
            .map(|(site, corner)| (sites[*site].lattice, corner.pixel))
            .collect();
        for (index, site) in sites.iter().enumerate() {
            if corners.contains_key(&index) {
                continue;
            }
            let at = |by: [i32; 2]| {
                let cell = [site.lattice[0] + by[0], site.lattice[1] + by[1]];
                by_cell.get(&cell).and_then(|index| corners.get(index))
            };
            let mut guesses = Vec::new();
            for axis in 0..2 {
                let by = |steps: i32| if axis == 0 { [steps, 0] } else { [0, steps] };
                if let (Some(a), Some(b)) = (at(by(-1)), at(by(1))) {
                    guesses.push(([(a.pixel.x + b.pixel.x) / 2.0, (a.pixel.y + b.pixel.y) / 2.0], a));
                }
                for sense in [-1, 1] {
                    if let (Some(a), Some(b), Some(c)) = (at(by(sense)), at(by(2 * sense)), at(by(3 * sense))) {
                        let on = |a: f64, b: f64, c: f64| 3.0 * a - 3.0 * b + c;
                        let guess = [on(a.pixel.x, b.pixel.x, c.pixel.x), on(a.pixel.y, b.pixel.y, c.pixel.y)];
                        guesses.push((guess, a));
                    }
                }
            }
            if guesses.len() < 2 {
                continue;
            }
            let n = guesses.len() as f64;
            let pixel = Pixel {
                x: guesses.iter().map(|(at, _)| at[0]).sum::<f64>() / n,
                y: guesses.iter().map(|(at, _)| at[1]).sum::<f64>() / n,
            };
            let neighbour = guesses[0].1;
            let Some(radius_px) = window(pixel, site.lattice, &places) else {
                continue;
            };
            let start = Start {
                pixel,
                // The neighbour's bright is our dark.
                edges: [neighbour.edges[1], neighbour.edges[0]],
                radius_px,
            };
            if let Some(corner) = fitted(gray, &start)
                && (corner.pixel.x - pixel.x).hypot(corner.pixel.y - pixel.y) < 0.3 * radius_px.max(3.0)
                && corner.contrast > 0.3 * neighbour.contrast
            {
                added.push((index, corner));
            }
        }
        if added.is_empty() {
            return;
        }
        corners.extend(added);
    }
}
