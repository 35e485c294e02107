//! Finding a ChArUco board: a checkerboard whose white squares bear markers, so that any part of it tells which part it is.
//!
//! A few markers are enough. Their ids say where on the board they are, their corners give a first map from board to picture, and from
//! there on everything is known: how the picture must look around each corner of the board, markers and all. Each corner is found by
//! fitting that look to the pixels ([`crate::calibration::board::pattern_fit`]), from the markers outward, corner by corner, as far as the
//! board is seen.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix2, Matrix3};

use crate::calibration::board::detection::{BoardCorner, Detection};
use crate::calibration::board::marker::Dictionary;
use crate::calibration::board::marker_search::{FoundMarker, markers};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::board::pattern_fit::{FittedSite, fitted, typical_blur_px};
use crate::calibration::board::placement::Naming;
use crate::calibration::board::stray::without_strays;
use crate::calibration::homography::{from_pairs, mapped};
use crate::camera::intrinsics::Pixel;
use crate::geometry::point::Point;
use crate::image::buffer::Image;

/// Markers this many squares apart check each other.
const CHECKED_WITHIN: i32 = 4;
/// A neighbour may lie this share of the way beside where a marker's own corners say.
const MOST_STRAY: f64 = 0.3;
/// Sites within so many squares say where the next one is.
const KNOWN_WITHIN: i32 = 3;
/// A corner may lie this share of a square beside its prediction.
const MOST_SURPRISE: f64 = 0.3;
/// Fewer corners than this are no find.
const FEWEST_CORNERS: usize = 6;

/// What is printed where.
#[derive(Clone, Debug)]
pub struct Print {
    columns: i32,
    rows: i32,
    square_mm: f64,
    marker_mm: f64,
    dictionary: Dictionary,
    /// 0 if the first square bears a marker, else 1.
    parity: i32,
}

impl Print {
    /// The print of a board.
    pub fn new(layout: &BoardLayout, marker_mm: f64, dictionary: Dictionary, legacy: bool) -> Self {
        Self {
            columns: layout.columns as i32,
            rows: layout.rows as i32,
            square_mm: layout.square_mm,
            marker_mm,
            dictionary,
            parity: i32::from(!(legacy && layout.rows.is_multiple_of(2))),
        }
    }

    /// The square (column, row) that marker `id` is printed in.
    fn square_of(&self, id: usize) -> Option<[i32; 2]> {
        let (columns, id) = (self.columns, id as i32);
        // Two rows together bear as many markers as there are columns.
        let even = (columns + 1 - self.parity) / 2;
        let (pair, rest) = (id / columns, id % columns);
        let (row, place) = if rest < even {
            (2 * pair, rest)
        } else {
            (2 * pair + 1, rest - even)
        };
        let column = 2 * place + (row + self.parity) % 2;
        (row < self.rows && column < columns).then_some([column, row])
    }

    /// The marker in a square, `None` for a black one.
    fn marker_in(&self, column: i32, row: i32) -> Option<usize> {
        if (column + row + self.parity) % 2 != 0 {
            return None;
        }
        let even = (self.columns + 1 - self.parity) / 2;
        let before = row / 2 * self.columns + if row % 2 == 1 { even } else { 0 };
        Some((before + (column - (row + self.parity) % 2) / 2) as usize)
    }

    /// True where the print is white; board space.
    pub fn is_white(&self, x: f64, y: f64) -> bool {
        let (column, row) = (
            (x / self.square_mm).floor() as i32 + 1,
            (y / self.square_mm).floor() as i32 + 1,
        );
        if column < 0 || row < 0 || column >= self.columns || row >= self.rows {
            return true;
        }
        let Some(id) = self.marker_in(column, row) else {
            return false;
        };
        let cells = self.dictionary.cells();
        let margin = (self.square_mm - self.marker_mm) / 2.0;
        let cell = |at: f64, square: i32| {
            let within = at - f64::from(square - 1) * self.square_mm - margin;
            (within / self.marker_mm * (cells + 2) as f64).floor() as i32
        };
        let (u, v) = (cell(x, column), cell(y, row));
        let last = cells as i32 + 1;
        if u < 0 || v < 0 || u > last || v > last {
            return true;
        }
        let framed = u == 0 || v == 0 || u == last || v == last;
        !framed && self.dictionary.is_white(id, u as usize - 1, v as usize - 1)
    }

    /// Corners of a marker in its square, clockwise from the first as the board is read, mm.
    fn corners_of(&self, [column, row]: [i32; 2]) -> [[f64; 2]; 4] {
        let margin = (self.square_mm - self.marker_mm) / 2.0;
        let (left, top) = (
            f64::from(column - 1) * self.square_mm + margin,
            f64::from(row - 1) * self.square_mm + margin,
        );
        let (right, bottom) = (left + self.marker_mm, top + self.marker_mm);
        [[left, top], [right, top], [right, bottom], [left, bottom]]
    }
}

/// The board in a gray picture (0–255), if it is seen.
pub fn detect(gray: &Image<f32>, print: &Print, layout: &BoardLayout) -> Option<Detection> {
    let agreed = agreeing(&markers(gray, print.dictionary), print);
    let sites = followed(gray, print, &agreed, layout);
    (sites.len() >= FEWEST_CORNERS)
        .then(|| Detection {
            corners: sites
                .iter()
                .map(|([column, row], site)| BoardCorner {
                    site: *row as usize * (layout.columns - 1) + *column as usize,
                    board: Point::new(f64::from(*column) * layout.square_mm, f64::from(*row) * layout.square_mm, 0.0),
                    pixel: site.pixel,
                    sigma_px: site.sigma_px,
                })
                .collect(),
            naming: Naming::Unique,
            dot_radius_mm: None,
        })
        .map(|mut detection| {
            detection.corners.sort_by_key(|corner| corner.site);
            detection
        })
}

/// A marker at its place on the board.
#[derive(Clone, Debug)]
struct Anchor {
    square: [i32; 2],
    /// Board, mm, and picture.
    pairs: [([f64; 2], [f64; 2]); 4],
}

/// Markers that lie where their neighbours' corners say.
fn agreeing(found: &[FoundMarker], print: &Print) -> Vec<Anchor> {
    let anchors: Vec<Anchor> = found
        .iter()
        .filter_map(|marker| {
            let square = print.square_of(marker.id)?;
            let board = print.corners_of(square);
            let pairs = [0, 1, 2, 3].map(|k| (board[k], marker.corners[k]));
            Some(Anchor { square, pairs })
        })
        .collect();
    let middle = |corners: [[f64; 2]; 4]| {
        let sum = corners.iter().fold([0.0; 2], |sum, c| [sum[0] + c[0], sum[1] + c[1]]);
        [sum[0] / 4.0, sum[1] / 4.0]
    };
    let maps: Vec<Option<Matrix3<f64>>> = anchors.iter().map(|anchor| from_pairs(&anchor.pairs)).collect();
    let votes: Vec<usize> = (0..anchors.len())
        .map(|i| {
            let Some(map) = &maps[i] else { return 0 };
            let a = &anchors[i];
            let own = middle(a.pairs.map(|(_, pixel)| pixel));
            let agreeing: BTreeSet<[i32; 2]> = anchors
                .iter()
                .filter(|b| {
                    let far = (a.square[0] - b.square[0]).abs().max((a.square[1] - b.square[1]).abs());
                    if far == 0 || far > CHECKED_WITHIN {
                        return false;
                    }
                    let there = middle(b.pairs.map(|(_, pixel)| pixel));
                    let way = (there[0] - own[0]).hypot(there[1] - own[1]);
                    mapped(map, middle(b.pairs.map(|(board, _)| board)))
                        .is_some_and(|p| (p[0] - there[0]).hypot(p[1] - there[1]) < MOST_STRAY * way)
                })
                .map(|b| b.square)
                .collect();
            agreeing.len()
        })
        .collect();
    let mut best: BTreeMap<[i32; 2], usize> = BTreeMap::new();
    for (i, anchor) in anchors.iter().enumerate() {
        if votes[i] > 0 && best.get(&anchor.square).is_none_or(|known| votes[*known] < votes[i]) {
            best.insert(anchor.square, i);
        }
    }
    best.values().map(|i| anchors[*i].clone()).collect()
}

/// All corners that can be fitted, from the markers outward.
fn followed(gray: &Image<f32>, print: &Print, anchors: &[Anchor], layout: &BoardLayout) -> BTreeMap<[i32; 2], FittedSite> {
    let (columns, rows) = (layout.columns as i32 - 1, layout.rows as i32 - 1);
    let s = layout.square_mm;
    let mut waiting: BTreeMap<[i32; 2], Matrix3<f64>> = BTreeMap::new();
    for row in 0..rows {
        for column in 0..columns {
            // The corner is shared by the squares (column, row) to (column + 1, row + 1).
            let near: Vec<_> = anchors
                .iter()
                .filter(|a| (column - 1..=column + 2).contains(&a.square[0]) && (row - 1..=row + 2).contains(&a.square[1]))
                .flat_map(|a| a.pairs)
                .collect();
            let touching = anchors
                .iter()
                .any(|a| (column..=column + 1).contains(&a.square[0]) && (row..=row + 1).contains(&a.square[1]));
            if let Some(map) = from_pairs(&near).filter(|_| touching) {
                waiting.insert([column, row], map);
            }
        }
    }
    let place = |[column, row]: [i32; 2]| [f64::from(column) * s, f64::from(row) * s];
    let local = |map: &Matrix3<f64>, site: [i32; 2]| -> Option<(Pixel, Matrix2<f64>)> {
        let at = place(site);
        let here = mapped(map, at)?;
        let right = mapped(map, [at[0] + 0.1 * s, at[1]])?;
        let below = mapped(map, [at[0], at[1] + 0.1 * s])?;
        let per_mm = 10.0 / s;
        let frame = Matrix2::new(right[0] - here[0], below[0] - here[0], right[1] - here[1], below[1] - here[1]) * per_mm;
        Some((Pixel { x: here[0], y: here[1] }, frame))
    };
    let starts: Vec<(Pixel, Matrix2<f64>, [f64; 2])> = waiting
        .iter()
        .filter_map(|(site, map)| local(map, *site).map(|(pixel, frame)| (pixel, frame, place(*site))))
        .collect();
    let Some(blur_px) = typical_blur_px(gray, print, s, &starts) else {
        return BTreeMap::new();
    };
    let mut sites: BTreeMap<[i32; 2], FittedSite> = BTreeMap::new();
    let mut refused: BTreeMap<[i32; 2], usize> = BTreeMap::new();
    while !waiting.is_empty() {
        let mut grew = false;
        for (site, map) in std::mem::take(&mut waiting) {
            let fit = local(&map, site).and_then(|(pixel, frame)| {
                let square_px = frame.determinant().abs().sqrt() * s;
                fitted(gray, print, s, place(site), pixel, &frame, blur_px)
                    .filter(|fit| (fit.pixel.x - pixel.x).hypot(fit.pixel.y - pixel.y) < MOST_SURPRISE * square_px)
            });
            match fit {
                Some(fit) => {
                    sites.insert(site, fit);
                    grew = true;
                }
                None => *refused.entry(site).or_default() += 1,
            }
        }
        if !grew {
            break;
        }
        for row in 0..rows {
            for column in 0..columns {
                let site = [column, row];
                if sites.contains_key(&site) || refused.get(&site).is_some_and(|times| *times > 1) {
                    continue;
                }
                let beside = [[-1, 0], [1, 0], [0, -1], [0, 1]];
                if !beside.iter().any(|by| sites.contains_key(&[column + by[0], row + by[1]])) {
                    continue;
                }
                let near: Vec<_> = (-KNOWN_WITHIN..=KNOWN_WITHIN)
                    .flat_map(|v| (-KNOWN_WITHIN..=KNOWN_WITHIN).map(move |u| [column + u, row + v]))
                    .filter_map(|at| sites.get(&at).map(|fit| (place(at), [fit.pixel.x, fit.pixel.y])))
                    .collect();
                if near.len() >= 5
                    && let Some(map) = from_pairs(&near)
                {
                    waiting.insert(site, map);
                }
            }
        }
    }
    let kept = without_strays(sites.iter().map(|(site, fit)| (*site, fit.pixel)).collect());
    sites.retain(|site, _| kept.contains_key(site));
    sites
}

#[cfg(test)]
mod tests {
    use std::str::FromStr as _;

    use super::*;

    fn print(columns: i32, rows: i32, parity: i32) -> Print {
        Print {
            columns,
            rows,
            square_mm: 5.0,
            marker_mm: 4.0,
            dictionary: Dictionary::from_str("4x4_250").unwrap(),
            parity,
        }
    }

    #[test]
    fn markers_are_numbered_as_opencv_does() {
        for (columns, rows) in [(19, 26), (18, 25), (5, 7), (6, 8)] {
            for parity in [0, 1] {
                let print = print(columns, rows, parity);
                let mut id = 0;
                for row in 0..rows {
                    for column in 0..columns {
                        if (column + row + parity) % 2 == 0 {
                            assert_eq!(print.marker_in(column, row), Some(id), "{columns}x{rows} {parity}");
                            assert_eq!(print.square_of(id), Some([column, row]));
                            id += 1;
                        } else {
                            assert_eq!(print.marker_in(column, row), None);
                        }
                    }
                }
            }
        }
    }

    /// A picture of a board through a tilted view of a bent lens: 16 points a pixel.
    fn picture(print: &Print, see: &dyn Fn(f64, f64) -> [f64; 2]) -> Image<f32> {
        let mut image = Image::filled(480, 400, 0.0_f32);
        for y in 0..400 {
            for x in 0..480 {
                let mut sum = 0.0;
                for k in 0..16 {
                    let at = see(
                        x as f64 + (f64::from(k % 4) - 1.5) / 4.0,
                        y as f64 + (f64::from(k / 4) - 1.5) / 4.0,
                    );
                    sum += if print.is_white(at[0], at[1]) { 180.0 } else { 30.0 };
                }
                image.set(x, y, sum / 16.0);
            }
        }
        crate::image::pyramid::smoothed(&image)
    }

    #[test]
    fn a_part_of_a_board_is_read_and_its_corners_are_exact() {
        use rand::{RngExt as _, SeedableRng as _};
        use rand_distr::StandardNormal;
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        for (degrees, parity) in [(10.0_f64, 0), (200.0, 1)] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            // From picture to board: centre, turn, perspective, and a barrel lens.
            let see = |x: f64, y: f64| {
                let (u, v) = ((x - 240.0) / 240.0, (y - 200.0) / 240.0);
                let bend = 1.0 + 0.12 * (u * u + v * v);
                let (u, v) = (u * bend, v * bend);
                let depth = 1.0 + 0.15 * u - 0.1 * v;
                let (u, v) = (60.0 * u / depth, 60.0 * v / depth);
                [42.0 + cos * u - sin * v, 60.0 + sin * u + cos * v]
            };
            let print = print(19, 26, parity);
            let mut image = picture(&print, &see);
            for pixel in image.pixels_mut() {
                *pixel += 3.0 * random.sample::<f32, _>(StandardNormal);
            }
            let layout = BoardLayout::new("charuco:19x26:4:4x4_250", 5.0).unwrap();
            let detection = detect(&image, &print, &layout).unwrap();
            assert!(detection.corners.len() > 250, "{}", detection.corners.len());
            let mut squares = 0.0;
            let mut bad = Vec::new();
            for corner in &detection.corners {
                // How far the pixel's own place on the board is from the corner's, turned into px by the local scale.
                let at = see(corner.pixel.x, corner.pixel.y);
                let beside = see(corner.pixel.x + 1.0, corner.pixel.y);
                let mm_per_px = (beside[0] - at[0]).hypot(beside[1] - at[1]);
                let error = (at[0] - corner.board.coords.x).hypot(at[1] - corner.board.coords.y) / mm_per_px;
                if error > 0.4 {
                    bad.push((error, corner.board.coords.xy() / 5.0, corner.pixel));
                }
                squares += error * error;
            }
            assert!(bad.is_empty(), "{degrees}° of {}: {bad:?}", detection.corners.len());
            let rms = (squares / detection.corners.len() as f64).sqrt();
            assert!(rms < 0.08, "{rms} px");
        }
    }
}
