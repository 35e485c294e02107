//! The picture replaced where it is brighter than what was measured: decided in the reduced picture, done in the picture itself.

use rayon::prelude::*;

use crate::frame::provenance_code;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::stages::specularity_substitution::blend::{Canvas, PLAIN};
use crate::stages::specularity_substitution::grid::Grid;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::settings::Settings;

/// Below this share of the new colour a pixel stays as it was.
const LEAST_SHARE: f32 = 0.12;

/// At the end of its reach a replacement wants so much more evidence, levels.
const FAR_DOUBT_LEVELS: f32 = 4.0;

/// So much more evidence is wanted for every level by which the surroundings are darker than what was measured.
const AGAINST_WEIGHT: f32 = 1.5;
/// The same for what the detector marked.
const AGAINST_DETECTED: f32 = 0.4;

/// Planes to fill, all of the picture's size.
#[derive(Debug)]
pub struct Planes<'a> {
    /// The new picture; holds the old one.
    pub image: &'a mut Image<Rgb8>,
    /// Provenance codes; hold what was detected.
    pub code: &'a mut Image<u8>,
    /// Loudest view of each replaced pixel.
    pub view: &'a mut Image<u16>,
    /// How sure each replaced pixel is.
    pub confidence: &'a mut Image<u8>,
}

/// Looked at, and found to be tissue.
const TISSUE: u8 = 1;

/// How much of each reduced pixel goes: 0 where nothing was known, [`TISSUE`], else the share of 255.
pub fn decide(scene: &Scene<'_>, canvas: &Canvas, settings: &Settings, shares: &mut Image<u8>) {
    let (width, height) = canvas.belief.size();
    if shares.size() != (width, height) {
        shares.resize(width, height, 0);
    }
    let rows = shares.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
    rows.with_min_len(16).for_each(|(y, shares)| {
        for (x, (share, &belief)) in shares.iter_mut().zip(canvas.belief.row(y)).enumerate() {
            *share = if belief <= PLAIN {
                0
            } else {
                match share_of(scene, canvas, settings, x, y) {
                    share if share < LEAST_SHARE => TISSUE,
                    share => (255.0 * share + 0.5) as u8,
                }
            };
        }
    });
}

/// What was decided, and the blocks of the reduced picture where anything was.
#[derive(Clone, Copy, Debug)]
pub struct Decision<'a> {
    /// The new colours.
    pub canvas: &'a Canvas,
    /// See [`decide`].
    pub shares: &'a Image<u8>,
    /// Picture pixels along a reduced pixel.
    pub step: usize,
    /// Of the reduced picture.
    pub grid: Grid,
    /// 1 for every block with something to replace.
    pub blocks: &'a [u8],
    /// 255 where nothing may be touched, in the picture itself.
    pub forbidden: &'a Mask,
}

/// Replace, block by block.
pub fn replace(decision: &Decision<'_>, planes: Planes<'_>) {
    let (width, side) = (planes.image.width(), decision.grid.block() * decision.step);
    let across = decision.grid.blocks().0;
    (planes.image.pixels_mut().par_chunks_mut(width * side))
        .zip(planes.code.pixels_mut().par_chunks_mut(width * side))
        .zip(planes.view.pixels_mut().par_chunks_mut(width * side))
        .zip(planes.confidence.pixels_mut().par_chunks_mut(width * side))
        .enumerate()
        .for_each(|(j, (((image, code), view), confidence))| {
            let mut strip = Strip {
                width,
                top: j * side,
                image,
                code,
                view,
                confidence,
            };
            let blocks = &decision.blocks[j * across..(j + 1) * across];
            for i in (0..across).filter(|&i| blocks[i] != 0) {
                decision.replace_block(i, j, &mut strip);
            }
        });
}

/// Rows of the planes, a block high.
struct Strip<'a> {
    width: usize,
    top: usize,
    image: &'a mut [Rgb8],
    code: &'a mut [u8],
    view: &'a mut [u16],
    confidence: &'a mut [u8],
}

impl Decision<'_> {
    fn replace_block(&self, i: usize, j: usize, strip: &mut Strip<'_>) {
        let (width, height) = self.shares.size();
        let side = self.grid.block();
        for row in j * side..((j + 1) * side).min(height) {
            for column in i * side..((i + 1) * side).min(width) {
                let pixel = row * width + column;
                let share = self.shares.pixels()[pixel];
                if self.step == 1 {
                    if share > TISSUE {
                        let color = self.canvas.color.pixels()[pixel].map(f32::from);
                        self.put(strip, (column, row), pixel, f32::from(share) / 255.0, color);
                    } else if share == TISSUE {
                        self.acquit(strip, (column, row));
                    }
                } else if self.is_replaced_around(column, row) {
                    self.replace_square(column, row, strip);
                } else if share == TISSUE {
                    for place in self.square(column, row, strip) {
                        self.acquit(strip, place);
                    }
                }
            }
        }
    }

    /// True if a reduced pixel or one around it is replaced.
    #[inline(always)]
    fn is_replaced_around(&self, column: usize, row: usize) -> bool {
        let (width, height) = self.shares.size();
        let columns = column.saturating_sub(1)..(column + 2).min(width);
        (row.saturating_sub(1)..(row + 2).min(height))
            .any(|row| self.shares.row(row)[columns.clone()].iter().any(|&s| s > TISSUE))
    }

    /// The pixels of a reduced one.
    #[inline(always)]
    fn square(&self, column: usize, row: usize, strip: &Strip<'_>) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (step, bottom) = (self.step, strip.top + strip.image.len() / strip.width);
        let (columns, rows) = (
            column * step..((column + 1) * step).min(strip.width),
            row * step..((row + 1) * step).min(bottom),
        );
        rows.flat_map(move |y| columns.clone().map(move |x| (x, y)))
    }

    /// The pixels of a reduced one, linear between it and those around.
    fn replace_square(&self, column: usize, row: usize, strip: &mut Strip<'_>) {
        let (shares, colors) = (self.shares.pixels(), self.canvas.color.pixels());
        let (width, height) = self.shares.size();
        let pixel = row * width + column;
        let inverse = 1.0 / self.step as f32;
        for (x, y) in self.square(column, row, strip) {
            // Where the pixel's middle lies from that of the reduced one, and the neighbours on that side.
            let aside = |at: usize, of: usize, end: usize| {
                let off = ((at - of * self.step) as i32 as f32 + 0.5) * inverse - 0.5;
                let next = if off < 0.0 {
                    of.saturating_sub(1)
                } else {
                    (of + 1).min(end - 1)
                };
                (next, off.abs())
            };
            let ((beside, fx), (below, fy)) = (aside(x, column, width), aside(y, row, height));
            let corners = [pixel, row * width + beside, below * width + column, below * width + beside];
            let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
            let (mut share, mut color) = (0.0, [0.0; 3]);
            for (corner, weight) in corners.into_iter().zip(weights) {
                // Colours count as much as they replace.
                if shares[corner] > TISSUE {
                    let weight = weight * f32::from(shares[corner]);
                    share += weight;
                    for (sum, &channel) in color.iter_mut().zip(&colors[corner]) {
                        *sum += weight * f32::from(channel);
                    }
                }
            }
            if share >= 255.0 * LEAST_SHARE {
                // A reduced pixel that is not replaced itself takes its origin from the neighbour that counts most.
                let origin = if shares[pixel] > TISSUE {
                    pixel
                } else {
                    let counts = |corner: usize| {
                        if shares[corners[corner]] > TISSUE {
                            weights[corner]
                        } else {
                            0.0
                        }
                    };
                    corners[(1..4).fold(0, |best, corner| if counts(corner) > counts(best) { corner } else { best })]
                };
                let inverse = 1.0 / share;
                let color = [color[0] * inverse, color[1] * inverse, color[2] * inverse];
                self.put(strip, (x, y), origin, share * (1.0 / 255.0), color);
            } else if shares[pixel] != 0 {
                self.acquit(strip, (x, y));
            }
        }
    }

    /// Replace a pixel of the picture.
    #[inline(always)]
    fn put(&self, strip: &mut Strip<'_>, (x, y): (usize, usize), origin: usize, share: f32, color: [f32; 3]) {
        if self.forbidden.at(x, y) != 0 {
            return;
        }
        let index = (y - strip.top) * strip.width + x;
        for (old, new) in strip.image[index].iter_mut().zip(color) {
            let before = f32::from(*old);
            *old = (before + share * (new - before) + 0.5) as i32 as u8;
        }
        strip.code[index] = provenance_code::LIGHT_FIELD;
        strip.view[index] = self.canvas.source.pixels()[origin];
        strip.confidence[index] = self.canvas.belief.pixels()[origin];
    }

    /// A pixel that was found to be tissue.
    #[inline(always)]
    fn acquit(&self, strip: &mut Strip<'_>, (x, y): (usize, usize)) {
        if self.forbidden.at(x, y) == 0 {
            strip.code[(y - strip.top) * strip.width + x] = provenance_code::UNTOUCHED;
        }
    }
}

/// How much of the old pixel goes, 0…1.
fn share_of(scene: &Scene<'_>, canvas: &Canvas, settings: &Settings, x: usize, y: usize) -> f32 {
    // Noise does not decide: the mean over 3 × 3 pixels.
    let excess = mean_of_neighbours(canvas, x, y).max(0.6 * canvas.excess.at(x, y));
    let near = (1.0 - f32::from(scene.distance.at(x, y)) / f32::from(scene.reach)).clamp(0.0, 1.0);
    let against = if scene.distance.at(x, y) == 0 {
        AGAINST_DETECTED
    } else {
        AGAINST_WEIGHT
    };
    let doubt = FAR_DOUBT_LEVELS * (1.0 - 2.0 * near).max(0.0) + against * canvas.against[scene.grid.cell_at(x, y)];
    let (low, high) = (settings.excess_low_levels + doubt, settings.excess_high_levels + doubt);
    let brighter = ((excess - low) / (high - low)).clamp(0.0, 1.0);
    smooth(brighter) * smooth((4.0 * near).min(1.0))
}

fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

fn mean_of_neighbours(canvas: &Canvas, x: usize, y: usize) -> f32 {
    let (width, height) = canvas.belief.size();
    let (mut sum, mut count) = (0.0, 0.0);
    for v in y.saturating_sub(1)..(y + 2).min(height) {
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        for (&belief, &excess) in canvas.belief.row(v)[columns.clone()]
            .iter()
            .zip(&canvas.excess.row(v)[columns])
        {
            if belief > 0 {
                sum += excess;
                count += 1.0;
            }
        }
    }
    sum / f32::max(count, 1.0)
}
