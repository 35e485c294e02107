//! The last frames, split into color planes, the newest first.
//!
//! The median reads up to seven frames at the same place at once. With a plane of its own for each color these were 21 places, most of
//! them at the same distance from a page's start, where the first-level cache has room for eight. So the planes of a frame are cut into
//! tiles and a tile's three lie side by side.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::{ParallelSlice as _, ParallelSliceMut as _};

use crate::image::buffer::{Image, Rgb8};
use crate::image::wide::{self, Kernel};

/// The longest window, frames.
pub const MAX_FRAMES: usize = 7;

/// Pixels of a tile; tiles run on over the ends of rows.
pub const TILE: usize = 64;

/// Red, green and blue of consecutive pixels.
pub type Tile = [[u8; TILE]; 3];

/// One frame as planes: red, green, blue, and a gray for the motion guard.
#[derive(Clone, Debug, Default)]
pub struct Planes {
    /// The last one holds anything past the picture's end.
    pub color: Vec<Tile>,
    /// (r + 2 g + b) / 4.
    pub gray: Vec<u8>,
}

/// A ring of planes.
#[derive(Debug, Default)]
pub struct History {
    ring: Vec<Planes>,
    newest: usize,
    count: usize,
    size: (usize, usize),
}

impl History {
    /// Forget everything; the buffers stay.
    pub fn clear(&mut self) {
        self.count = 0;
    }

    /// How many frames are held, at most [`MAX_FRAMES`].
    pub fn count(&self) -> usize {
        self.count
    }

    /// The frame `age` frames ago; 0 is the newest.
    pub fn planes(&self, age: usize) -> &Planes {
        &self.ring[(self.newest + MAX_FRAMES - age) % MAX_FRAMES]
    }

    /// Take in the next frame. Another size forgets the past.
    pub fn push(&mut self, image: &Image<Rgb8>, band_rows: usize) {
        if self.size != image.size() || self.ring.len() != MAX_FRAMES {
            self.size = image.size();
            self.count = 0;
            let pixels = image.pixels().len();
            let planes = Planes {
                color: vec![[[0; TILE]; 3]; pixels.div_ceil(TILE)],
                gray: vec![0; pixels],
            };
            self.ring = vec![planes; MAX_FRAMES];
        }
        self.newest = (self.newest + 1) % MAX_FRAMES;
        self.count = (self.count + 1).min(MAX_FRAMES);
        let band = (band_rows * image.width()).next_multiple_of(TILE);
        let Planes { color, gray } = &mut self.ring[self.newest];
        image
            .pixels()
            .par_chunks(band)
            .zip(color.par_chunks_mut(band / TILE))
            .zip(gray.par_chunks_mut(band))
            .for_each(|((source, color), gray)| wide::run(Split { source, color, gray }));
    }
}

struct Split<'a> {
    source: &'a [Rgb8],
    color: &'a mut [Tile],
    gray: &'a mut [u8],
}

impl Kernel for Split<'_> {
    #[inline(always)]
    fn run(self) {
        let (sources, rest) = self.source.as_chunks::<TILE>();
        let (grays, rest_gray) = self.gray.as_chunks_mut::<TILE>();
        for ((source, color), gray) in sources.iter().zip(self.color.iter_mut()).zip(grays) {
            split(source, color, gray);
        }
        if let (false, Some(color)) = (rest.is_empty(), self.color.last_mut()) {
            let (mut source, mut gray) = ([[0; 3]; TILE], [0; TILE]);
            source[..rest.len()].copy_from_slice(rest);
            split(&source, color, &mut gray);
            rest_gray.copy_from_slice(&gray[..rest.len()]);
        }
    }
}

#[inline(always)]
fn split(source: &[Rgb8; TILE], [red, green, blue]: &mut Tile, gray: &mut [u8; TILE]) {
    for i in 0..TILE {
        [red[i], green[i], blue[i]] = source[i];
    }
    for i in 0..TILE {
        gray[i] = ((u16::from(red[i]) + 2 * u16::from(green[i]) + u16::from(blue[i]) + 2) >> 2) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_and_gray_hold_the_pixels() {
        for (width, height) in [(64, 2), (37, 41), (3, 1)] {
            let pixels: Vec<Rgb8> = (0..width * height)
                .map(|i| [i as u8, (i * 7) as u8, ((i * 31) >> 3) as u8])
                .collect();
            let mut history = History::default();
            history.push(&Image::filled(width, height, [9; 3]), 16);
            history.push(&Image::from_vec(width, height, pixels.clone()).unwrap(), 16);
            let planes = history.planes(0);
            for (i, [r, g, b]) in pixels.into_iter().enumerate() {
                let tile = &planes.color[i / TILE];
                assert_eq!([tile[0][i % TILE], tile[1][i % TILE], tile[2][i % TILE]], [r, g, b]);
                let gray = (u32::from(r) + 2 * u32::from(g) + u32::from(b) + 2) / 4;
                assert_eq!(u32::from(planes.gray[i]), gray);
            }
        }
    }
}
