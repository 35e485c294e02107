//! The last frames, split into color planes, the newest first.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::{ParallelSlice as _, ParallelSliceMut as _};

use crate::image::buffer::{Image, Rgb8};
use crate::image::wide::{self, Kernel};

/// The longest window, frames.
pub const MAX_FRAMES: usize = 7;

/// One frame as planes: red, green, blue, and a gray for the motion guard.
#[derive(Clone, Debug, Default)]
pub struct Planes {
    /// Red, green, blue.
    pub color: [Vec<u8>; 3],
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
                color: std::array::from_fn(|_| vec![0; pixels]),
                gray: vec![0; pixels],
            };
            self.ring = vec![planes; MAX_FRAMES];
        }
        self.newest = (self.newest + 1) % MAX_FRAMES;
        self.count = (self.count + 1).min(MAX_FRAMES);
        let band = (band_rows * image.width()).max(1);
        let Planes {
            color: [red, green, blue],
            gray,
        } = &mut self.ring[self.newest];
        image
            .pixels()
            .par_chunks(band)
            .zip(red.par_chunks_mut(band))
            .zip(green.par_chunks_mut(band))
            .zip(blue.par_chunks_mut(band))
            .zip(gray.par_chunks_mut(band))
            .for_each(|((((source, red), green), blue), gray)| {
                wide::run(Split {
                    source,
                    red,
                    green,
                    blue,
                    gray,
                })
            });
    }
}

struct Split<'a> {
    source: &'a [Rgb8],
    red: &'a mut [u8],
    green: &'a mut [u8],
    blue: &'a mut [u8],
    gray: &'a mut [u8],
}

impl Kernel for Split<'_> {
    #[inline(always)]
    fn run(self) {
        let n = self.source.len();
        let (red, green, blue) = (&mut self.red[..n], &mut self.green[..n], &mut self.blue[..n]);
        for (i, pixel) in self.source.iter().enumerate() {
            red[i] = pixel[0];
            green[i] = pixel[1];
            blue[i] = pixel[2];
        }
        for (((gray, r), g), b) in self.gray.iter_mut().zip(red.iter()).zip(green.iter()).zip(blue.iter()) {
            *gray = ((u16::from(*r) + 2 * u16::from(*g) + u16::from(*b) + 2) >> 2) as u8;
        }
    }
}
