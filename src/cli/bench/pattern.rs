//! A number as a picture that a camera can read off a screen, askew and at any size: a bright frame on black, and in it cells for the
//! number's bits and, for the check, their opposites.
//!
//! A camera that exposes while a screen goes from one picture to the next sees both; then bits and opposites do not agree, and nothing is
//! read. Numbers are Gray-coded, so that of two neighbours only one bit differs.

use crate::calibration::homography;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::Components;

/// Bits of a number.
const BITS: usize = 16;
/// Cells along a side of the square inside the frame; they hold the bits and their opposites.
const ACROSS: usize = 6;
/// Black around the frame, the frame, black in it: in shares of the picture.
const MARGIN: f64 = 0.06;
const FRAME: f64 = 0.05;
const GAP: f64 = 0.04;
/// Where cells begin and end, in shares of the frame's outer size.
const FIRST_CELL: f64 = (FRAME + GAP) / (1.0 - 2.0 * MARGIN);
/// Dark and bright must be so far apart, levels.
const LEAST_CONTRAST: u8 = 40;
/// The frame's bounding box covers at least this share of the camera's picture.
const LEAST_SHARE: f64 = 0.01;

const BRIGHT: Rgb8 = [235; 3];
const DARK: Rgb8 = [16; 3];

/// Whether each cell is bright, row by row.
fn cells_of(number: u16) -> [bool; 2 * BITS] {
    let gray = number ^ (number >> 1);
    std::array::from_fn(|cell| (gray >> (cell % BITS) & 1 == 1) == (cell < BITS))
}

fn number_of(cells: &[bool; 2 * BITS]) -> Option<u16> {
    let (bits, opposites) = cells.split_at(BITS);
    if bits.iter().zip(opposites).any(|(bit, opposite)| bit == opposite) {
        return None;
    }
    let gray = (0..BITS).fold(0_u16, |gray, bit| gray | u16::from(bits[bit]) << bit);
    Some((0..4).fold(gray, |number, step| number ^ (number >> (1 << step))))
}

/// Draw the number over the whole picture.
pub fn draw(number: u16, picture: &mut Image<Rgb8>) {
    let cells = cells_of(number);
    let (width, height) = picture.size();
    let share = |at: usize, of: usize| (at as f64 + 0.5) / of as f64;
    for y in 0..height {
        let v = share(y, height);
        for (x, pixel) in picture.row_mut(y).iter_mut().enumerate() {
            let u = share(x, width);
            let inward = u.min(1.0 - u).min(v).min(1.0 - v);
            let in_frame = (MARGIN..MARGIN + FRAME).contains(&inward);
            let inside = MARGIN + FRAME + GAP;
            let lit = inward >= inside && {
                let cell = |at: f64| (((at - inside) / (1.0 - 2.0 * inside) * ACROSS as f64) as usize).min(ACROSS - 1);
                cells.get(cell(v) * ACROSS + cell(u)).copied().unwrap_or(false)
            };
            *pixel = if in_frame || lit { BRIGHT } else { DARK };
        }
    }
}

/// The number that a camera sees, if it sees one whole.
#[derive(Debug, Default)]
pub struct PatternReader {
    components: Components,
}

impl PatternReader {
    /// Read a picture.
    pub fn read(&mut self, picture: &Image<Rgb8>) -> Option<u16> {
        let (width, height) = picture.size();
        let mut levels = [0_u32; 256];
        picture.pixels().iter().for_each(|pixel| levels[usize::from(pixel[1])] += 1);
        let count: u32 = levels.iter().sum();
        // The level that so many in a hundred do not exceed.
        let level_of = |share: u32| {
            let mut seen = 0;
            levels.iter().position(|&number| {
                seen += number;
                u64::from(seen) * 100 >= u64::from(count) * u64::from(share)
            })
        };
        let (dark, bright) = (level_of(3)? as u8, level_of(97)? as u8);
        if bright.saturating_sub(dark) < LEAST_CONTRAST {
            return None;
        }
        let middle = dark + (bright - dark) / 2;
        let mut mask: Mask = Image::filled(width, height, 0);
        for (lit, pixel) in mask.pixels_mut().iter_mut().zip(picture.pixels()) {
            *lit = if pixel[1] > middle { 255 } else { 0 };
        }
        self.components.label(&mask);
        let (label, region) = (self.components.regions().iter().enumerate())
            .max_by_key(|(_, region)| (region.right - region.left) as u64 * (region.bottom - region.top) as u64)?;
        let box_area = f64::from(region.right - region.left) * f64::from(region.bottom - region.top);
        if box_area < LEAST_SHARE * (width * height) as f64 {
            return None;
        }
        let corners = self.corners_of(label as u32)?;
        let unit = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let pairs: Vec<([f64; 2], [f64; 2])> = unit.into_iter().zip(corners).collect();
        let picture_from_frame = homography::from_pairs(&pairs)?;
        let mut cells = [false; 2 * BITS];
        for (index, cell) in cells.iter_mut().enumerate() {
            let place = |at: usize| FIRST_CELL + (1.0 - 2.0 * FIRST_CELL) * (at as f64 + 0.5) / ACROSS as f64;
            let [x, y] = homography::mapped(&picture_from_frame, [place(index % ACROSS), place(index / ACROSS)])?;
            let mut sum = 0_u32;
            for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
                let (column, row) = ((x + f64::from(dx)).round(), (y + f64::from(dy)).round());
                if column < 0.0 || row < 0.0 || column >= width as f64 || row >= height as f64 {
                    return None;
                }
                sum += u32::from(picture.at(column as usize, row as usize)[1]);
            }
            *cell = sum / 9 > u32::from(middle);
        }
        number_of(&cells)
    }

    /// The outermost pixels of a component towards the four corners, first the upper left, then clockwise.
    fn corners_of(&self, label: u32) -> Option<[[f64; 2]; 4]> {
        let ends = (self.components.runs().iter().filter(|run| run.label == label)).flat_map(|run| {
            [
                [f64::from(run.begin), f64::from(run.y)],
                [f64::from(run.end - 1), f64::from(run.y)],
            ]
        });
        let mut corners: Option<[[f64; 2]; 4]> = None;
        for end in ends {
            let best = corners.get_or_insert([end; 4]);
            for (corner, [right, down]) in best.iter_mut().zip([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) {
                let reach = |at: [f64; 2]| right * at[0] + down * at[1];
                if reach(end) > reach(*corner) {
                    *corner = end;
                }
            }
        }
        corners
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(number: u16) -> Image<Rgb8> {
        let mut picture = Image::filled(320, 180, [0; 3]);
        draw(number, &mut picture);
        picture
    }

    /// Filmed askew, dimmer, unsharp and noisy.
    fn filmed(screen: &Image<Rgb8>, seed: u32) -> Image<Rgb8> {
        let (width, height) = (400, 300);
        let seen = [[62.0, 40.0], [341.0, 66.0], [322.0, 251.0], [48.0, 228.0]];
        let (w, h) = (screen.width() as f64 - 1.0, screen.height() as f64 - 1.0);
        let corners = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]];
        let pairs: Vec<_> = seen.into_iter().zip(corners).collect();
        let screen_from_seen = homography::from_pairs(&pairs).unwrap();
        let mut state = seed;
        let mut out = Image::filled(width, height, [0; 3]);
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for (dx, dy) in [(-0.6, 0.0), (0.6, 0.0), (0.0, -0.6), (0.0, 0.6)] {
                    let at = homography::mapped(&screen_from_seen, [x as f64 + dx, y as f64 + dy]).unwrap();
                    let inside = at[0] >= 0.0 && at[1] >= 0.0 && at[0] <= w && at[1] <= h;
                    sum += if inside {
                        f64::from(screen.at(at[0].round() as usize, at[1].round() as usize)[1])
                    } else {
                        45.0
                    };
                }
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let noise = f64::from(state >> 24) / 16.0 - 8.0;
                let level = (30.0 + 0.6 * sum / 4.0 + noise) as u8;
                out.set(x, y, [level; 3]);
            }
        }
        out
    }

    #[test]
    fn every_number_is_read_as_it_was_drawn() {
        let mut reader = PatternReader::default();
        for number in (0..=u16::MAX).step_by(997).chain([1, 2, u16::MAX]) {
            assert_eq!(reader.read(&drawn(number)), Some(number));
        }
    }

    #[test]
    fn a_screen_filmed_askew_is_read() {
        let mut reader = PatternReader::default();
        for number in [0, 5, 300, 12_345, 54_321, u16::MAX] {
            assert_eq!(reader.read(&filmed(&drawn(number), u32::from(number))), Some(number));
        }
    }

    #[test]
    fn two_numbers_at_once_and_other_pictures_are_not_read() {
        let mut reader = PatternReader::default();
        // The upper half shows the next one already.
        let (mut both, next) = (drawn(0x0fff), drawn(0x1000));
        for y in 0..90 {
            both.row_mut(y).copy_from_slice(next.row(y));
        }
        let read = reader.read(&both);
        assert!(read.is_none() || read == Some(0x0fff) || read == Some(0x1000), "{read:?}");
        let mixed = {
            let (one, other) = (drawn(0x00ff), drawn(0x5a00));
            let mut mixed = one.clone();
            for (to, from) in mixed.pixels_mut().iter_mut().zip(other.pixels()) {
                *to = [to[0].max(from[0]); 3];
            }
            mixed
        };
        assert_eq!(reader.read(&mixed), None);
        assert_eq!(reader.read(&Image::filled(64, 64, [90; 3])), None);
        let mut spot = Image::filled(64, 64, [10; 3]);
        spot.set(3, 3, [250; 3]);
        assert_eq!(reader.read(&spot), None);
    }
}
