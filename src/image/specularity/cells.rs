//! The picture averaged over square cells, and how bright the darkest channel gets in each.

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
    /// The highest min(R, G, B) of the cell's pixels; 255 where pixels that are in no cell lie beside it.
    pub peak: Image<u8>,
    /// 255 where the cell lies inside the image field and is not all but black.
    pub valid: Mask,
}

impl Cells {
    pub fn new() -> Self {
        Self {
            least: Image::filled(0, 0, 0.0),
            most: Image::filled(0, 0, 0.0),
            rgb: Image::filled(0, 0, [0.0; 3]),
            peak: Image::filled(0, 0, 0),
            valid: Image::filled(0, 0, 0),
        }
    }

    pub fn size(&self) -> (usize, usize) {
        self.valid.size()
    }

    /// Average over cells of `step` px, at most [`CHUNK`]; what is left over at the right and at the bottom is in no cell.
    pub fn average(&mut self, image: &Image<Rgb8>, field: Option<&Mask>, step: usize) {
        let width = image.width();
        let (across, down) = (width / step, image.height() / step);
        if self.size() != (across, down) {
            self.least.resize(across, down, 0.0);
            self.most.resize(across, down, 0.0);
            self.rgb.resize(across, down, [0.0; 3]);
            self.peak.resize(across, down, 0);
            self.valid.resize(across, down, 0);
        }
        let band = step * width;
        let cells = self.least.pixels_mut().par_chunks_mut(across);
        let cells = cells.zip(self.most.pixels_mut().par_chunks_mut(across));
        let cells = cells.zip(self.rgb.pixels_mut().par_chunks_mut(across));
        let cells = cells.zip(self.peak.pixels_mut().par_chunks_mut(across));
        let cells = cells.zip(self.valid.pixels_mut().par_chunks_mut(across));
        let rows = cells.zip(image.pixels().par_chunks(band)).enumerate();
        rows.for_each(|(row, (((((least, most), rgb), peak), valid), source))| {
            wide::run(CellRow {
                source,
                width,
                step,
                least,
                most,
                rgb,
                peak,
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
        if width > across * step {
            self.peak
                .pixels_mut()
                .iter_mut()
                .skip(across - 1)
                .step_by(across)
                .for_each(|peak| *peak = 255);
        }
        if image.height() > down * step {
            self.peak.row_mut(down - 1).fill(255);
        }
    }
}

/// One row of cells.
struct CellRow<'a> {
    /// `step` rows.
    source: &'a [Rgb8],
    width: usize,
    step: usize,
    least: &'a mut [f32],
    most: &'a mut [f32],
    rgb: &'a mut [[f32; 3]],
    peak: &'a mut [u8],
}

impl Kernel for CellRow<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            source,
            width,
            step,
            least,
            most,
            rgb,
            peak,
        } = self;
        let chunk = CHUNK / step * step;
        for left in (0..width).step_by(chunk) {
            let n = chunk.min(width - left);
            // Sums down the columns, of: least, most, red, green, blue.
            let mut sums = [[0_u16; CHUNK]; 5];
            let mut peaks = [0_u8; CHUNK];
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
                for (peak, least) in peaks.iter_mut().zip(&planes[0]) {
                    *peak = (*peak).max(*least);
                }
            }
            // The cells of a 1080p picture are of a size that the compiler knows.
            let (first, cells) = (left / step, n / step);
            let range = first..first + cells;
            let found = Found {
                least: &mut least[range.clone()],
                most: &mut most[range.clone()],
                rgb: &mut rgb[range.clone()],
                peak: &mut peak[range],
            };
            // The step of pictures of the working width, and of views twice as wide, is known to the compiler.
            match step {
                4 => finish::<4>(&sums, &peaks, step, found),
                8 => finish::<8>(&sums, &peaks, step, found),
                _ => finish::<0>(&sums, &peaks, step, found),
            }
        }
    }
}

/// Of neighbouring cells.
struct Found<'a> {
    least: &'a mut [f32],
    most: &'a mut [f32],
    rgb: &'a mut [[f32; 3]],
    peak: &'a mut [u8],
}

/// Means and peaks of cells from the sums and peaks of their columns; `STEP` is `step` or 0.
#[inline(always)]
fn finish<const STEP: usize>(sums: &[[u16; CHUNK]; 5], peaks: &[u8; CHUNK], step: usize, found: Found<'_>) {
    let step = if STEP > 0 { STEP } else { step };
    let scale = 1.0 / (step * step) as f32;
    let mut means = [[0.0; CHUNK]; 5];
    for (means, sums) in means.iter_mut().zip(sums) {
        for (mean, sums) in means.iter_mut().zip(sums.chunks_exact(step)) {
            let mut total = 0;
            for sum in sums {
                total += u32::from(*sum);
            }
            *mean = total as f32 * scale;
        }
    }
    for (peak, peaks) in found.peak.iter_mut().zip(peaks.chunks_exact(step)) {
        let mut highest = 0_u8;
        for value in peaks {
            highest = highest.max(*value);
        }
        *peak = highest;
    }
    let [least, most, red, green, blue] = &means;
    for i in 0..found.least.len().min(CHUNK) {
        found.least[i] = least[i];
        found.most[i] = most[i];
        found.rgb[i] = [red[i], green[i], blue[i]];
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
            let mut cells = Cells::new();
            cells.average(&image, Some(&field), step);
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
                    let peak = places().map(|(u, v)| image.at(u, v).into_iter().fold(255, u8::min)).max();
                    let beside_rest = (x + 2) * step > width && width % step > 0 || (y + 2) * step > height && height % step > 0;
                    assert_eq!(Some(cells.peak.at(x, y)), if beside_rest { Some(255) } else { peak });
                    let inside = places().all(|(u, v)| field.at(u, v) != 0);
                    assert_eq!(cells.valid.at(x, y) != 0, inside && mean(|[r, g, b]| r.max(g).max(b)) > 12.0);
                }
            }
        }
    }
}
