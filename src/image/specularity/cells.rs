//! The picture averaged over square cells, and the darkest and the brightest channel of every pixel.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::wide::{self, Kernel};

/// Pixels that are split into channels at a time, within the first-level cache. Also the largest cell: sums of so many levels fit into
/// 16 bits.
pub(super) const CHUNK: usize = 192;
/// A cell whose brightest channel is darker tells nothing about tissue (surround, shadow), levels.
const MIN_MOST_LEVELS: f32 = 12.0;

/// Averages over each cell.
#[derive(Debug)]
pub(super) struct Cells {
    /// Of min(R, G, B).
    pub least: Image<f32>,
    /// Of max(R, G, B).
    pub most: Image<f32>,
    /// Of the channels.
    pub rgb: Image<[f32; 3]>,
    /// 255 where the cell lies inside the image field and is not all but black.
    pub valid: Mask,
}

/// One value per pixel of the picture.
#[derive(Debug, Default)]
pub(super) struct Extremes {
    /// min(R, G, B).
    pub least: Vec<u8>,
    /// max(R, G, B).
    pub most: Vec<u8>,
}

impl Cells {
    pub fn new() -> Self {
        Self {
            least: Image::filled(0, 0, 0.0),
            most: Image::filled(0, 0, 0.0),
            rgb: Image::filled(0, 0, [0.0; 3]),
            valid: Image::filled(0, 0, 0),
        }
    }

    pub fn size(&self) -> (usize, usize) {
        self.valid.size()
    }

    /// Average over cells of `step` px, at most [`CHUNK`]; what is left over at the right and at the bottom is in no cell.
    pub fn average(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, step: usize, extremes: &mut Extremes) {
        let (width, pixels) = (image.width(), image.pixels().len());
        let (across, down) = (width / step, image.height() / step);
        if self.size() != (across, down) {
            self.least.resize(across, down, 0.0);
            self.most.resize(across, down, 0.0);
            self.rgb.resize(across, down, [0.0; 3]);
            self.valid.resize(across, down, 0);
        }
        extremes.least.resize(pixels, 0);
        extremes.most.resize(pixels, 0);
        let band = step * width;
        let planes = extremes.least.par_chunks_mut(band).zip(extremes.most.par_chunks_mut(band));
        let (whole, rest) = image.pixels().split_at(down * band);
        let cells = self.least.pixels_mut().par_chunks_mut(across);
        let cells = cells.zip(self.most.pixels_mut().par_chunks_mut(across));
        let cells = cells.zip(self.rgb.pixels_mut().par_chunks_mut(across));
        let cells = cells.zip(self.valid.pixels_mut().par_chunks_mut(across));
        let rows = cells.zip(planes).zip(whole.par_chunks(band)).enumerate();
        rows.for_each(|(row, (((((least, most), rgb), valid), extremes), source))| {
            wide::run(CellRow {
                source,
                width,
                step,
                extremes,
                least,
                most,
                rgb,
            });
            for (valid, most) in valid.iter_mut().zip(most.iter()) {
                *valid = if *most > MIN_MOST_LEVELS { 255 } else { 0 };
            }
            if let Some(field) = field {
                for inside in field.pixels()[row * band..(row + 1) * band].chunks_exact(width) {
                    for (valid, inside) in valid.iter_mut().zip(inside.chunks_exact(step)) {
                        *valid = if inside.contains(&0) { 0 } else { *valid };
                    }
                }
            }
        });
        let (least, most) = (&mut extremes.least[down * band..], &mut extremes.most[down * band..]);
        for ((least, most), [r, g, b]) in least.iter_mut().zip(most).zip(rest) {
            *least = *r.min(g).min(b);
            *most = *r.max(g).max(b);
        }
    }
}

/// One row of cells.
struct CellRow<'a> {
    /// `step` rows.
    source: &'a [Rgb8],
    width: usize,
    step: usize,
    extremes: (&'a mut [u8], &'a mut [u8]),
    least: &'a mut [f32],
    most: &'a mut [f32],
    rgb: &'a mut [[f32; 3]],
}

impl Kernel for CellRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            source,
            width,
            step,
            extremes,
            least,
            most,
            rgb,
        } = self;
        let scale = 1.0 / (step * step) as f32;
        let chunk = CHUNK / step * step;
        for left in (0..width).step_by(chunk) {
            let n = chunk.min(width - left);
            // Sums down the columns, of: least, most, red, green, blue.
            let mut sums = [[0_u16; CHUNK]; 5];
            for v in 0..step {
                let at = v * width + left;
                let planes = match source[at..].first_chunk::<CHUNK>() {
                    // What lies beyond the row's end is computed along and not used: a fixed length is faster.
                    Some(source) => split(source),
                    None => {
                        let mut padded = [[0; 3]; CHUNK];
                        padded[..n].copy_from_slice(&source[at..at + n]);
                        split(&padded)
                    }
                };
                for (sums, plane) in sums.iter_mut().zip(&planes) {
                    for (sum, value) in sums.iter_mut().zip(plane) {
                        *sum = sum.wrapping_add(u16::from(*value));
                    }
                }
                for (plane, extreme) in planes.iter().zip([&mut *extremes.0, &mut *extremes.1]) {
                    match extreme[at..].first_chunk_mut::<CHUNK>().filter(|_| n == CHUNK) {
                        Some(extreme) => *extreme = *plane,
                        None => extreme[at..at + n].copy_from_slice(&plane[..n]),
                    }
                }
            }
            let first = left / step;
            for (i, columns) in (0..n / step).map(|i| (first + i, i * step..(i + 1) * step)) {
                let [a, b, c, d, e] = [0, 1, 2, 3, 4].map(|k| total(&sums[k][columns.clone()]) as f32 * scale);
                least[i] = a;
                most[i] = b;
                rgb[i] = [c, d, e];
            }
        }
    }
}

#[inline(always)]
fn total(sums: &[u16]) -> u32 {
    match <&[u16; 8]>::try_from(sums) {
        // The cells of a 1080p picture.
        Ok(eight) => eight.iter().map(|v| u32::from(*v)).sum(),
        Err(_) => sums.iter().map(|v| u32::from(*v)).sum(),
    }
}

/// Least, most, red, green and blue of a run of pixels.
#[inline(always)]
fn split(source: &[Rgb8; CHUNK]) -> [[u8; CHUNK]; 5] {
    let mut planes = [[0_u8; CHUNK]; 5];
    let [least, most, red, green, blue] = &mut planes;
    for i in 0..CHUNK {
        let [r, g, b] = source[i];
        red[i] = r;
        green[i] = g;
        blue[i] = b;
        least[i] = r.min(g).min(b);
        most[i] = r.max(g).max(b);
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};

    #[test]
    fn agrees_with_plain_means() {
        for (width, height, step) in [(37, 22, 1), (67, 41, 5), (530, 19, 8), (500, 230, 192)] {
            let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
            let image = Image::from_vec(width, height, (0..width * height).map(|_| random.random()).collect()).unwrap();
            let mut field = Image::filled(width, height, 255);
            field.set(width / 2, height / 2, 0);
            let (mut cells, mut extremes) = (Cells::new(), Extremes::default());
            cells.average(&image, Some(&field), step, &mut extremes);
            for (index, [r, g, b]) in image.pixels().iter().enumerate() {
                let found = (extremes.least[index], extremes.most[index]);
                assert_eq!(found, (*r.min(g).min(b), *r.max(g).max(b)));
            }
            for y in 0..height / step {
                for x in 0..width / step {
                    let places = || (y * step..(y + 1) * step).flat_map(|v| (x * step..(x + 1) * step).map(move |u| (u, v)));
                    let mean = |of: fn(Rgb8) -> u8| {
                        let sum: u32 = places().map(|(u, v)| u32::from(of(image.at(u, v)))).sum();
                        sum as f32 / (step * step) as f32
                    };
                    let same = |found: f32, of: fn(Rgb8) -> u8| assert!((found - mean(of)).abs() < 1e-3);
                    same(cells.least.at(x, y), |[r, g, b]| r.min(g).min(b));
                    same(cells.most.at(x, y), |[r, g, b]| r.max(g).max(b));
                    let [r, g, b] = cells.rgb.at(x, y);
                    same(r, |p| p[0]);
                    same(g, |p| p[1]);
                    same(b, |p| p[2]);
                    let inside = places().all(|(u, v)| field.at(u, v) != 0);
                    assert_eq!(cells.valid.at(x, y) != 0, inside && mean(|[r, g, b]| r.max(g).max(b)) > 12.0);
                }
            }
        }
    }
}
