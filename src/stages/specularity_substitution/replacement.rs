//! The picture replaced where it is brighter than what was measured: decided in the reduced picture, done in the picture itself.

use rayon::prelude::*;

use crate::frame::provenance_code;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::wide;
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

/// What becomes of the reduced pixels; keeps its memory.
#[derive(Debug)]
pub struct Shares {
    /// 0 where nothing was known, [`TISSUE`], else how much goes, of 255.
    own: Image<u8>,
    /// The most of a pixel and those around it.
    around: Image<u8>,
}

impl Default for Shares {
    fn default() -> Self {
        Self {
            own: Image::filled(0, 0, 0),
            around: Image::filled(0, 0, 0),
        }
    }
}

impl Shares {
    /// Decide how much of each reduced pixel goes.
    pub fn decide(&mut self, scene: &Scene<'_>, canvas: &Canvas, settings: &Settings) {
        let (width, height) = canvas.belief.size();
        for plane in [&mut self.own, &mut self.around] {
            if plane.size() != (width, height) {
                plane.resize(width, height, 0);
            }
        }
        let rows = self.own.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
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
        self.look_around();
    }

    /// Fill `around`.
    fn look_around(&mut self) {
        let (width, height) = self.own.size();
        let own = &self.own;
        let rows = self.around.pixels_mut().par_chunks_mut(width.max(1)).enumerate();
        rows.with_min_len(16).for_each(|(y, around)| {
            let rows = [own.row(y.saturating_sub(1)), own.row(y), own.row((y + 1).min(height - 1))];
            wide::run(MostAround { rows, around });
        });
    }
}

struct MostAround<'a> {
    rows: [&'a [u8]; 3],
    around: &'a mut [u8],
}

impl wide::Kernel for MostAround<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { rows: [a, b, c], around } = self;
        let last = around.len() - 1;
        let column = |x: usize| a[x].max(b[x]).max(c[x]);
        around[0] = column(0).max(column(last.min(1)));
        around[last] = column(last).max(column(last.saturating_sub(1)));
        for (out, ((a, b), c)) in around[1..].iter_mut().zip(a.windows(3).zip(b.windows(3)).zip(c.windows(3))) {
            let column = |x: usize| a[x].max(b[x]).max(c[x]);
            *out = column(0).max(column(1)).max(column(2));
        }
    }
}

/// What was decided, and the blocks of the reduced picture where anything was.
#[derive(Clone, Copy, Debug)]
pub struct Decision<'a> {
    /// The new colours.
    pub canvas: &'a Canvas,
    /// How much goes.
    pub shares: &'a Shares,
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

/// Sums of colours times what they replace, and of that.
type Weighted = [f32; 4];

impl Decision<'_> {
    fn replace_block(&self, i: usize, j: usize, strip: &mut Strip<'_>) {
        let (width, height) = self.shares.own.size();
        let side = self.grid.block();
        for row in j * side..((j + 1) * side).min(height) {
            let (own, around) = (self.shares.own.row(row), self.shares.around.row(row));
            for column in i * side..((i + 1) * side).min(width) {
                if around[column] == 0 {
                    continue;
                }
                let pixel = row * width + column;
                if self.step > 1 && around[column] > TISSUE {
                    self.replace_square(column, row, strip);
                } else if own[column] > TISSUE {
                    let color = self.canvas.color.pixels()[pixel].map(f32::from);
                    self.put(strip, (column, row), pixel, f32::from(own[column]) / 255.0, color);
                } else if own[column] == TISSUE {
                    for place in self.square(column, row, strip) {
                        self.acquit(strip, place);
                    }
                }
            }
        }
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
        let (shares, colors) = (self.shares.own.pixels(), self.canvas.color.pixels());
        let (width, height) = self.shares.own.size();
        let columns = [column.saturating_sub(1), column, (column + 1).min(width - 1)];
        let rows = [row.saturating_sub(1), row, (row + 1).min(height - 1)].map(|row| row * width);
        let mut around = [[[0.0_f32; 4]; 3]; 3];
        for (around, row) in around.iter_mut().zip(rows) {
            for (weighted, column) in around.iter_mut().zip(columns) {
                let (share, [r, g, b]) = (shares[row + column], colors[row + column]);
                if share > TISSUE {
                    let share = f32::from(share);
                    *weighted = [share * f32::from(r), share * f32::from(g), share * f32::from(b), share];
                }
            }
        }
        // A reduced pixel that is not replaced itself takes its origin from the neighbour that counts most.
        let mut origin = (1, 1);
        if around[1][1][3] == 0.0 {
            for place in [(0, 1), (1, 0), (1, 2), (2, 1), (0, 0), (0, 2), (2, 0), (2, 2)] {
                if around[place.0][place.1][3] > around[origin.0][origin.1][3] {
                    origin = place;
                }
            }
        }
        let origin = rows[origin.0] + columns[origin.1];
        let inverse = 1.0 / self.step as f32;
        for (x, y) in self.square(column, row, strip) {
            // Where the pixel's middle lies from that of the reduced one, and which neighbour is on that side.
            let aside = |at: usize| {
                let off = (at as i32 as f32 + 0.5) * inverse - 0.5;
                (if off < 0.0 { 0 } else { 2 }, off.abs())
            };
            let ((i, fx), (j, fy)) = (aside(x - column * self.step), aside(y - row * self.step));
            let level = mixed(&around[1][1], &around[1][i], fx);
            let aside = mixed(&around[j][1], &around[j][i], fx);
            let [r, g, b, share] = mixed(&level, &aside, fy);
            if share >= 255.0 * LEAST_SHARE {
                let inverse = 1.0 / share;
                self.put(
                    strip,
                    (x, y),
                    origin,
                    share * (1.0 / 255.0),
                    [r * inverse, g * inverse, b * inverse],
                );
            } else if shares[rows[1] + column] != 0 {
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

#[inline(always)]
fn mixed(a: &Weighted, b: &Weighted, share: f32) -> Weighted {
    let mut sum = [0.0; 4];
    for i in 0..4 {
        sum[i] = a[i] + share * (b[i] - a[i]);
    }
    sum
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

#[cfg(test)]
mod tests {
    use super::*;

    const OLD: Rgb8 = [200, 180, 160];
    const NEW: Rgb8 = [120, 60, 40];

    /// A picture of which a disc of reduced pixels is replaced wholly; its right half may not be touched.
    struct Replaced {
        image: Image<Rgb8>,
        code: Image<u8>,
        view: Image<u16>,
    }

    fn replaced(step: usize, forbidden_from: usize) -> Replaced {
        let (width, height) = (96, 64);
        let grid = Grid::over((width, height));
        let mut canvas = Canvas::default();
        canvas.color.resize(width, height, NEW);
        canvas.belief.resize(width, height, 200);
        canvas.source.resize(width, height, 7);
        let mut shares = Shares::default();
        shares.own.resize(width, height, 0);
        shares.around.resize(width, height, 0);
        for y in 0..height {
            for x in 0..width {
                let far = (x as f32 - 48.0).hypot(y as f32 - 32.0);
                shares.own.set(x, y, if far < 10.0 { 255 } else { u8::from(far < 14.0) });
            }
        }
        shares.look_around();
        // One pixel more than whole squares.
        let (full_width, full_height) = (step * width - usize::from(step > 1), step * height - usize::from(step > 1));
        let mut out = Replaced {
            image: Image::filled(full_width, full_height, OLD),
            code: Image::filled(full_width, full_height, provenance_code::LEFT),
            view: Image::filled(full_width, full_height, 0),
        };
        let mut forbidden = Image::filled(full_width, full_height, 0);
        for y in 0..full_height {
            forbidden.row_mut(y)[forbidden_from.min(full_width)..].fill(255);
        }
        let decision = Decision {
            canvas: &canvas,
            shares: &shares,
            step,
            grid,
            blocks: &vec![1; grid.blocks().0 * grid.blocks().1],
            forbidden: &forbidden,
        };
        let planes = Planes {
            image: &mut out.image,
            code: &mut out.code,
            view: &mut out.view,
            confidence: &mut Image::filled(full_width, full_height, 0),
        };
        replace(&decision, planes);
        out
    }

    #[test]
    fn a_disc_is_replaced_at_every_size_with_a_soft_rim() {
        for step in [1, 2, 3] {
            let out = replaced(step, usize::MAX);
            let middle = |at: usize| (at as f32 + 0.5) / step as f32 - 0.5;
            for y in 0..out.image.height() {
                for x in 0..out.image.width() {
                    let far = (middle(x) - 48.0).hypot(middle(y) - 32.0);
                    let (color, code) = (out.image.at(x, y), out.code.at(x, y));
                    // Between two reduced pixels the share falls from one to zero.
                    if far < 8.5 {
                        assert_eq!((color, code), (NEW, provenance_code::LIGHT_FIELD), "({x}, {y}) at {step}");
                        assert_eq!(out.view.at(x, y), 7);
                    } else if far > 11.5 {
                        assert_eq!(color, OLD, "({x}, {y}) at {step}");
                    }
                    if (11.5..12.5).contains(&far) {
                        assert_eq!(code, provenance_code::UNTOUCHED, "({x}, {y}) at {step}");
                    } else if far > 15.5 {
                        assert_eq!(code, provenance_code::LEFT, "({x}, {y}) at {step}");
                    }
                    assert!((0..3).all(|c| (NEW[c]..=OLD[c]).contains(&color[c])));
                }
            }
        }
    }

    #[test]
    fn what_is_forbidden_in_the_picture_stays_to_the_pixel() {
        for step in [1, 2, 3] {
            let border = 48 * step + 1;
            let out = replaced(step, border);
            for y in 0..out.image.height() {
                assert!(out.image.row(y)[border..].iter().all(|&pixel| pixel == OLD));
                assert!(out.code.row(y)[border..].iter().all(|&code| code == provenance_code::LEFT));
            }
            assert_eq!(out.image.at(border - 1, 32 * step), NEW);
        }
    }

    #[test]
    fn the_most_around_equals_its_plain_twin() {
        for (width, height) in [(1, 1), (2, 3), (17, 9)] {
            let mut shares = Shares::default();
            shares.own.resize(width, height, 0);
            shares.around.resize(width, height, 0);
            for (i, share) in shares.own.pixels_mut().iter_mut().enumerate() {
                *share = (i * 89 % 251) as u8;
            }
            shares.look_around();
            for y in 0..height {
                for x in 0..width {
                    let rows = y.saturating_sub(1)..(y + 2).min(height);
                    let most = rows
                        .flat_map(|v| shares.own.row(v)[x.saturating_sub(1)..(x + 2).min(width)].iter())
                        .max();
                    assert_eq!(Some(&shares.around.at(x, y)), most, "({x}, {y}) of {width}");
                }
            }
        }
    }
}
