//! Remapping: every output pixel fetched from its own place in the source, by a precomputed table.
//!
//! OpenCV's convention: the table says for each output pixel where in the source it comes from, to 1/32 px; bilinear weights are
//! then multiples of 1/1024 and the result is the same integer everywhere. Outside the source is black.
//!
//! The table is read once per pixel and frame, so it is small: 32 bits a pixel, 22 of them the source pixel counted from a base
//! that each block of 64 output pixels has to itself, 10 of them the fractions. A pixel whose four neighbours are not all in the
//! source stands in a short list of its own, so that the loop over the others need not look at borders. A second table says the same
//! for eight output pixels at once in 24 bytes: see [`crate::image::remap_octets`].

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::remap_octets::{EIGHT, Octet};
use crate::image::{remap_bicubic, remap_bilinear};

/// Fractions of a pixel that positions are rounded to, as in OpenCV.
pub const STEPS_PER_PX: i64 = 32;
/// Output pixels that share a base.
pub(crate) const BLOCK: usize = 64;
/// This output pixel has no four neighbours in the source.
pub(crate) const OUTSIDE: u32 = u32::MAX;
pub(crate) const FRACTION_BITS: u32 = 10;
const LARGEST_INDEX: u32 = (1 << (32 - FRACTION_BITS)) - 2;
/// Rows that one task of the thread pool treats.
const ROWS_PER_BAND: usize = 32;

/// How values between pixels are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// From the nearest pixel.
    Nearest,
    /// From four pixels.
    #[default]
    Bilinear,
    /// From sixteen pixels (Keys 1981, a = −0.75 as in OpenCV).
    Bicubic,
}

/// Why there is no table, or why it does not fit a picture.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RemapError {
    /// No pixels at all.
    #[error("expected a picture, found one of {0}x{1} px")]
    Empty(usize, usize),
    /// Neighbouring output pixels come from source pixels too far apart for the table.
    #[error("near output pixel ({x}, {y}) the map jumps about the source: it is no lens")]
    Rugged {
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
    /// The picture is not of the size that the table was made for.
    #[error("expected a picture of {expected:?} px, found {found:?}")]
    SourceSize {
        /// Of the table.
        expected: (usize, usize),
        /// Of the picture.
        found: (usize, usize),
    },
}

/// Fills one output row from its entries, its blocks' bases and the source.
pub(crate) type RowKernel = fn(&[u32], &[u32], &Image<Rgb8>, &mut [Rgb8]);

/// A place in the source: the pixel to the upper left and 1/32 px from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub x: i32,
    pub y: i32,
    pub fx: u8,
    pub fy: u8,
}

/// Where every output pixel comes from.
#[derive(Clone, Debug)]
pub struct RemapTable {
    width: usize,
    height: usize,
    source_width: usize,
    source_height: usize,
    /// (source pixel − base) · 1024 + fy · 32 + fx, or [`OUTSIDE`].
    entries: Vec<u32>,
    /// Smallest source pixel of each block, row by row.
    bases: Vec<u32>,
    /// The same for every eight output pixels of a row that are together, row by row: all that [`Interpolation::Bilinear`] reads where
    /// the map is smooth.
    octets: Vec<Octet>,
    /// Output pixels at the source's border, in order.
    edges: Vec<(u32, Place)>,
}

impl RemapTable {
    /// For an output of `size` and a source of `source_size`; `source_of(x, y)` says where output pixel (x, y) comes from.
    pub fn new(
        (width, height): (usize, usize),
        (source_width, source_height): (usize, usize),
        source_of: impl Fn(usize, usize) -> Option<(f64, f64)> + Sync,
    ) -> Result<Self, RemapError> {
        for (w, h) in [(width, height), (source_width, source_height)] {
            if w == 0 || h == 0 || w * h >= u32::MAX as usize {
                return Err(RemapError::Empty(w, h));
            }
        }
        let rows: Result<Vec<_>, RemapError> = (0..height)
            .into_par_iter()
            .map(|y| {
                let places: Vec<Option<Place>> = (0..width).map(|x| place_of(source_of(x, y)?)).collect();
                RowOfTable::new(&places, y, source_width, source_height)
            })
            .collect();
        let mut table = Self {
            width,
            height,
            source_width,
            source_height,
            entries: Vec::new(),
            bases: Vec::new(),
            octets: Vec::new(),
            edges: Vec::new(),
        };
        for (y, row) in rows?.into_iter().enumerate() {
            table.entries.extend(row.entries);
            table.bases.extend(row.bases);
            table.octets.extend(row.octets);
            table
                .edges
                .extend(row.edges.into_iter().map(|(x, place)| ((y * width + x) as u32, place)));
        }
        Ok(table)
    }

    /// (columns, rows) of the output.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// (columns, rows) of the source.
    pub fn source_size(&self) -> (usize, usize) {
        (self.source_width, self.source_height)
    }

    /// Where in the source output pixel (x, y) comes from, px, as the table has it; `None` outside.
    pub fn position(&self, x: usize, y: usize) -> Option<(f64, f64)> {
        let place = self.place(x, y)?;
        let step = STEPS_PER_PX as f64;
        Some((
            f64::from(place.x) + f64::from(place.fx) / step,
            f64::from(place.y) + f64::from(place.fy) / step,
        ))
    }

    pub(crate) fn place(&self, x: usize, y: usize) -> Option<Place> {
        let index = y * self.width + x;
        let entry = *self.entries.get(index)?;
        if entry == OUTSIDE {
            let at = self.edges.binary_search_by_key(&(index as u32), |(pixel, _)| *pixel).ok()?;
            return self.edges.get(at).map(|(_, place)| *place);
        }
        let base = *self.bases.get(y * self.width.div_ceil(BLOCK) + x / BLOCK)? as usize;
        let pixel = base + (entry >> FRACTION_BITS) as usize;
        let (x, y) = ((pixel % self.source_width) as i32, (pixel / self.source_width) as i32);
        Some(Place {
            x,
            y,
            fx: (entry & 31) as u8,
            fy: (entry >> 5 & 31) as u8,
        })
    }

    fn check_source(&self, found: (usize, usize)) -> Result<(), RemapError> {
        let expected = self.source_size();
        if expected == found {
            Ok(())
        } else {
            Err(RemapError::SourceSize { expected, found })
        }
    }

    /// Remap a color picture; `out` takes the table's size. Allocates only when `out` must grow.
    pub fn remap_rgb(&self, source: &Image<Rgb8>, out: &mut Image<Rgb8>, interpolation: Interpolation) -> Result<(), RemapError> {
        self.check_source(source.size())?;
        if out.size() != self.size() {
            out.resize(self.width, self.height, [0; 3]);
        }
        match interpolation {
            Interpolation::Nearest => self.each_row(out.pixels_mut(), |row, out| {
                nearest_row(row.entries, row.bases, source, out);
            }),
            Interpolation::Bilinear => {
                let kernel = remap_bilinear::row_kernel();
                self.each_row(out.pixels_mut(), |row, out| kernel(&row, source, out));
            }
            Interpolation::Bicubic => {
                let kernel = remap_bicubic::row_kernel();
                self.each_row(out.pixels_mut(), |row, out| kernel(row.entries, row.bases, source, out));
            }
        }
        let edge_kernel: fn(&Image<Rgb8>, Place) -> Rgb8 = match interpolation {
            Interpolation::Nearest => |image, place| nearest_at(image, place).unwrap_or([0; 3]),
            Interpolation::Bilinear => bilinear_at,
            Interpolation::Bicubic => remap_bicubic::at,
        };
        let pixels = out.pixels_mut();
        for (pixel, place) in &self.edges {
            pixels[*pixel as usize] = edge_kernel(source, *place);
        }
        Ok(())
    }

    /// Remap a mask (bicubic is taken as bilinear); `out` takes the table's size. Allocates only when `out` must grow.
    pub fn remap_mask(&self, source: &Mask, out: &mut Mask, interpolation: Interpolation) -> Result<(), RemapError> {
        self.check_source(source.size())?;
        if out.size() != self.size() {
            out.resize(self.width, self.height, 0);
        }
        let nearest = interpolation == Interpolation::Nearest;
        self.each_row(out.pixels_mut(), |row, out| {
            if nearest {
                nearest_row(row.entries, row.bases, source, out)
            } else {
                mask_bilinear_row(row.entries, row.bases, source, out)
            }
        });
        let pixels = out.pixels_mut();
        for (pixel, place) in &self.edges {
            pixels[*pixel as usize] = if nearest {
                nearest_at(source, *place).unwrap_or(0)
            } else {
                let four = four_of(source, *place);
                blended(four.map(|value| value.unwrap_or(0)), *place)
            };
        }
        Ok(())
    }

    fn each_row<P: Send>(&self, out: &mut [P], kernel: impl Fn(Row<'_>, &mut [P]) + Sync) {
        out.par_chunks_mut(self.width * ROWS_PER_BAND)
            .enumerate()
            .for_each(|(band, out)| {
                for (y, out) in out.chunks_mut(self.width).enumerate() {
                    kernel(self.row(band * ROWS_PER_BAND + y), out);
                }
            });
    }

    pub(crate) fn row(&self, y: usize) -> Row<'_> {
        let (blocks, octets) = (self.width.div_ceil(BLOCK), self.width / EIGHT);
        Row {
            entries: &self.entries[y * self.width..(y + 1) * self.width],
            bases: &self.bases[y * blocks..(y + 1) * blocks],
            octets: &self.octets[y * octets..(y + 1) * octets],
        }
    }
}

/// What a table says about one output row.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row<'a> {
    /// One a pixel.
    pub entries: &'a [u32],
    /// One a block.
    pub bases: &'a [u32],
    /// One for every eight pixels; none for the rest.
    pub octets: &'a [Octet],
}

fn place_of((x, y): (f64, f64)) -> Option<Place> {
    let step = STEPS_PER_PX as f64;
    // OpenCV rounds halves to even (`cvRound`).
    let (sx, sy) = ((x * step).round_ties_even(), (y * step).round_ties_even());
    if !(sx.abs() < 1e9 && sy.abs() < 1e9) {
        return None;
    }
    let (sx, sy) = (sx as i64, sy as i64);
    let part = |s: i64| (s.div_euclid(STEPS_PER_PX) as i32, s.rem_euclid(STEPS_PER_PX) as u8);
    let ((x, fx), (y, fy)) = (part(sx), part(sy));
    Some(Place { x, y, fx, fy })
}

struct RowOfTable {
    entries: Vec<u32>,
    bases: Vec<u32>,
    octets: Vec<Octet>,
    edges: Vec<(usize, Place)>,
}

impl RowOfTable {
    fn new(places: &[Option<Place>], y: usize, source_width: usize, source_height: usize) -> Result<Self, RemapError> {
        let mut row = Self {
            entries: Vec::with_capacity(places.len()),
            bases: Vec::new(),
            octets: Vec::new(),
            edges: Vec::new(),
        };
        let (last_x, last_y) = (source_width as i32 - 1, source_height as i32 - 1);
        // Eight bytes are read at each of two rows for two pixels of three bytes: the last such pair has no room for that.
        let inner = |p: &Place| {
            let inside = p.x >= 0 && p.y >= 0 && p.x < last_x && p.y < last_y;
            inside && (p.x + 1 < last_x || p.y + 1 < last_y)
        };
        let eights = places.as_chunks::<EIGHT>().0.iter();
        row.octets
            .extend(eights.map(|eight| Octet::new(eight, (source_width, source_height), inner)));
        for (block_number, block) in places.chunks(BLOCK).enumerate() {
            let pixel = |place: &Place| (place.y as usize * source_width + place.x as usize) as u32;
            let base = block
                .iter()
                .flatten()
                .filter(|place| inner(place))
                .map(pixel)
                .min()
                .unwrap_or(0);
            row.bases.push(base);
            for (i, place) in block.iter().enumerate() {
                let x = block_number * BLOCK + i;
                row.entries.push(match place {
                    Some(place) if inner(place) => {
                        let index = pixel(place) - base;
                        if index > LARGEST_INDEX {
                            return Err(RemapError::Rugged { x, y });
                        }
                        index << FRACTION_BITS | u32::from(place.fy) << 5 | u32::from(place.fx)
                    }
                    Some(place) if place.x >= -1 && place.y >= -1 && place.x <= last_x && place.y <= last_y => {
                        row.edges.push((x, *place));
                        OUTSIDE
                    }
                    _ => OUTSIDE,
                });
            }
        }
        Ok(row)
    }
}

/// Source pixel and fractions of an entry that is not [`OUTSIDE`].
#[inline(always)]
pub(crate) fn unpacked(entry: u32, base: u32) -> (usize, u32, u32) {
    ((base + (entry >> FRACTION_BITS)) as usize, entry & 31, entry >> 5 & 31)
}

/// The weighted mean of four neighbours, in 1/1024, rounded half up as OpenCV does.
#[inline(always)]
pub(crate) fn blend(four: [u8; 4], fx: u32, fy: u32) -> u8 {
    let [a, b, c, d] = four.map(u32::from);
    let top = a * (32 - fx) + b * fx;
    let bottom = c * (32 - fx) + d * fx;
    ((top * (32 - fy) + bottom * fy + 512) >> 10) as u8
}

fn blended(four: [u8; 4], place: Place) -> u8 {
    blend(four, u32::from(place.fx), u32::from(place.fy))
}

fn four_of<P: Copy>(image: &Image<P>, place: Place) -> [Option<P>; 4] {
    [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| pixel_at(image, place.x + dx, place.y + dy))
}

pub(crate) fn pixel_at<P: Copy>(image: &Image<P>, x: i32, y: i32) -> Option<P> {
    let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
    (x < image.width() && y < image.height()).then(|| image.at(x, y))
}

fn bilinear_at(image: &Image<Rgb8>, place: Place) -> Rgb8 {
    let four = four_of(image, place).map(|pixel| pixel.unwrap_or([0; 3]));
    [0, 1, 2].map(|c| blended(four.map(|pixel| pixel[c]), place))
}

fn nearest_at<P: Copy>(image: &Image<P>, place: Place) -> Option<P> {
    pixel_at(
        image,
        place.x + i32::from(place.fx >= 16),
        place.y + i32::from(place.fy >= 16),
    )
}

fn nearest_row<P: Copy + Default>(entries: &[u32], bases: &[u32], source: &Image<P>, out: &mut [P]) {
    let (width, pixels) = (source.width(), source.pixels());
    for ((entries, out), base) in entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(bases) {
        for (entry, out) in entries.iter().zip(out) {
            *out = if *entry == OUTSIDE {
                P::default()
            } else {
                let (pixel, fx, fy) = unpacked(*entry, *base);
                let near = pixel + usize::from(fx >= 16) + if fy >= 16 { width } else { 0 };
                pixels.get(near).copied().unwrap_or_default()
            };
        }
    }
}

fn mask_bilinear_row(entries: &[u32], bases: &[u32], source: &Mask, out: &mut [u8]) {
    let (width, pixels) = (source.width(), source.pixels());
    for ((entries, out), base) in entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(bases) {
        for (entry, out) in entries.iter().zip(out) {
            *out = 0;
            if *entry != OUTSIDE {
                let (pixel, fx, fy) = unpacked(*entry, *base);
                if let (Some(&[a, b]), Some(&[c, d])) = (pair(pixels, pixel), pair(pixels, pixel + width)) {
                    *out = blend([a, b, c, d], fx, fy);
                }
            }
        }
    }
}

/// Two neighbours in a row.
#[inline(always)]
pub(crate) fn pair<P>(pixels: &[P], at: usize) -> Option<&[P; 2]> {
    pixels.get(at..)?.first_chunk::<2>()
}
