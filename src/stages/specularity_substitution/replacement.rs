//! The picture replaced where it is brighter than what was measured: decided in the reduced picture, done in the picture itself.

use std::ops::Range;

use rayon::prelude::*;

use crate::frame::provenance_code;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::components::set_runs;
use crate::image::wide;
use crate::stages::specularity_substitution::blend::{Canvas, PLAIN};
use crate::stages::specularity_substitution::cut_patches::CutPatches;
use crate::stages::specularity_substitution::grid::Grid;
use crate::stages::specularity_substitution::lamp_light::LampLight;
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
    /// The new picture.
    pub image: &'a mut Image<Rgb8>,
    /// Provenance codes.
    pub code: &'a mut Image<u8>,
    /// Loudest view; filled only where a pixel is replaced.
    pub view: &'a mut Image<u16>,
    /// How sure; filled only where a pixel is replaced.
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
    lamp_light: LampLight,
    cut_patches: CutPatches,
}

impl Default for Shares {
    fn default() -> Self {
        Self {
            own: Image::filled(0, 0, 0),
            around: Image::filled(0, 0, 0),
            lamp_light: LampLight::default(),
            cut_patches: CutPatches::default(),
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
            shares.fill(0);
            for (left, shares) in (0..).step_by(LANES).zip(shares.chunks_mut(LANES)) {
                let believed = &canvas.belief.row(y)[left..left + shares.len()];
                if believed.iter().any(|&belief| belief > PLAIN) {
                    wide::run(Decide {
                        scene,
                        canvas,
                        settings,
                        place: (left, y),
                        shares,
                    });
                }
            }
        });
        self.lamp_light.leave_others(scene, canvas, &mut self.own, TISSUE + 1);
        self.cut_patches.leave(scene, canvas, &mut self.own, TISSUE + 1);
        self.look_around();
    }

    /// How much of each pixel goes, and up to where that means nothing.
    pub fn decided(&self) -> (&Image<u8>, u8) {
        (&self.own, TISSUE)
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
    /// The picture as it was.
    pub picture: &'a Image<Rgb8>,
    /// 255 where the lamp was detected.
    pub specular: &'a Mask,
    /// The new colours.
    pub canvas: &'a Canvas,
    /// How much goes.
    pub shares: &'a Shares,
    /// Picture pixels along a pixel that was looked at.
    pub step: usize,
    /// Of the picture that was looked at.
    pub grid: Grid,
    /// 1 for every block with something to replace.
    pub blocks: &'a [u8],
    /// 255 where nothing may be touched.
    pub forbidden: &'a Mask,
    /// The [`provenance_code`] of what is replaced.
    pub filled: u8,
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
            // Strip by strip the picture stays in the cache from one step to the next.
            let first = strip.top * width;
            strip
                .image
                .copy_from_slice(&decision.picture.pixels()[first..first + strip.image.len()]);
            let seen = (decision.specular, Some(&decision.shares.own));
            mark_left(seen, decision.step, (strip.top, width), strip.code);
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

/// So many reduced pixels of a row are carried back at a time …
const LANES: usize = 16;
/// … with one more at each side.
const WITH_SIDES: usize = LANES + 2;

impl Decision<'_> {
    fn replace_block(&self, i: usize, j: usize, strip: &mut Strip<'_>) {
        let (width, height) = self.shares.own.size();
        let side = self.grid.block();
        let right = ((i + 1) * side).min(width);
        for row in j * side..((j + 1) * side).min(height) {
            for left in (i * side..right).step_by(LANES) {
                let columns = left..(left + LANES).min(right);
                if self.shares.around.row(row)[columns.clone()].iter().any(|&most| most > TISSUE) {
                    wide::run(Carry {
                        decision: self,
                        columns,
                        row,
                        strip,
                    });
                }
            }
        }
    }

    /// Where a pixel of the picture lies from the middle of its reduced pixel: by how much, and the lane on that side, counted from the
    /// one before.
    #[inline(always)]
    fn aside(&self, at: usize) -> (usize, f32) {
        let off = (at as i32 as f32 + 0.5) / self.step as f32 - 0.5;
        (if off < 0.0 { 0 } else { 2 }, off.abs())
    }

    /// The reduced pixel of which a replaced pixel has its origin: its own, or where that is not replaced the neighbour that counts most.
    fn origin(&self, column: usize, row: usize) -> usize {
        let own = &self.shares.own;
        let (width, height) = own.size();
        if own.at(column, row) > TISSUE {
            return row * width + column;
        }
        let (mut most, mut origin) = (0, row * width + column);
        for y in row.saturating_sub(1)..(row + 2).min(height) {
            for x in column.saturating_sub(1)..(column + 2).min(width) {
                if own.at(x, y) > most {
                    (most, origin) = (own.at(x, y), y * width + x);
                }
            }
        }
        origin
    }
}

/// Some reduced pixels of a row, carried to the pixels of the picture: linear between each and those around.
struct Carry<'a, 'b, 'c> {
    decision: &'a Decision<'b>,
    columns: Range<usize>,
    row: usize,
    strip: &'a mut Strip<'c>,
}

impl wide::Kernel for Carry<'_, '_, '_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            decision,
            columns,
            row,
            strip,
        } = self;
        let own = &decision.shares.own;
        let (width, height) = own.size();
        let forbidden = &decision.forbidden.row(row)[columns.clone()];
        // Colours times what they replace, and that; of the row before, this one and the next.
        let mut rows = [[[0.0_f32; WITH_SIDES]; 4]; 3];
        for (planes, row) in rows.iter_mut().zip([row.saturating_sub(1), row, (row + 1).min(height - 1)]) {
            let (shares, colors) = (own.row(row), decision.canvas.color.row(row));
            for lane in 0..columns.len() + 2 {
                let column = (columns.start + lane).saturating_sub(1).min(width - 1);
                if shares[column] > TISSUE {
                    let (share, [r, g, b]) = (f32::from(shares[column]), colors[column]);
                    planes[0][lane] = share * f32::from(r);
                    planes[1][lane] = share * f32::from(g);
                    planes[2][lane] = share * f32::from(b);
                    planes[3][lane] = share;
                }
            }
        }
        let step = decision.step;
        let below = strip.top + strip.image.len() / strip.width;
        for (y, v) in (row * step..below).zip(0..step) {
            let (side, t) = decision.aside(v);
            let mut between = [[0.0_f32; WITH_SIDES]; 4];
            for c in 0..4 {
                for lane in 0..WITH_SIDES {
                    between[c][lane] = rows[1][c][lane] + t * (rows[side][c][lane] - rows[1][c][lane]);
                }
            }
            for u in 0..step {
                let (side, t) = decision.aside(u);
                let mut mixed = [[0.0_f32; LANES]; 4];
                for c in 0..4 {
                    for lane in 0..LANES {
                        mixed[c][lane] = between[c][lane + 1] + t * (between[c][lane + side] - between[c][lane + 1]);
                    }
                }
                let left = columns.start * step + u;
                let count = strip.width.saturating_sub(left).div_ceil(step).min(columns.len());
                if count == 0 {
                    continue;
                }
                let first = (y - strip.top) * strip.width + left;
                let line = &mut strip.image[first..first + (count - 1) * step + 1];
                let mut old = [[0.0_f32; LANES]; 3];
                for lane in 0..count {
                    for c in 0..3 {
                        old[c][lane] = f32::from(line[lane * step][c]);
                    }
                }
                let mut new = [[0_u8; LANES]; 3];
                for c in 0..3 {
                    for lane in 0..LANES {
                        let more = (mixed[c][lane] - mixed[3][lane] * old[c][lane]) * (1.0 / 255.0);
                        new[c][lane] = wide::byte_from(old[c][lane] + more);
                    }
                }
                for lane in 0..count {
                    if mixed[3][lane] < 255.0 * LEAST_SHARE || forbidden[lane] != 0 {
                        continue;
                    }
                    line[lane * step] = [new[0][lane], new[1][lane], new[2][lane]];
                    let (index, origin) = (first + lane * step, decision.origin(columns.start + lane, row));
                    strip.code[index] = decision.filled;
                    strip.view[index] = decision.canvas.source.pixels()[origin];
                    strip.confidence[index] = decision.canvas.belief.pixels()[origin];
                }
            }
        }
    }
}

/// Fill the `codes` of a stretch of rows from row `top` on, `width` px wide: left is all of `specular`, of pixels `step` times as large,
/// but what was looked at.
pub fn mark_left((specular, looked_at): (&Mask, Option<&Mask>), step: usize, (top, width): (usize, usize), codes: &mut [u8]) {
    codes.fill(provenance_code::UNTOUCHED);
    for (y, codes) in (top..).zip(codes.chunks_mut(width)) {
        for run in set_runs(specular.row(y / step)) {
            codes[run.start * step..(run.end * step).min(width)].fill(provenance_code::LEFT);
        }
        for run in looked_at.into_iter().flat_map(|looked_at| set_runs(looked_at.row(y / step))) {
            codes[run.start * step..(run.end * step).min(width)].fill(provenance_code::UNTOUCHED);
        }
    }
}

/// How much of some pixels in a row goes.
struct Decide<'a> {
    scene: &'a Scene<'a>,
    canvas: &'a Canvas,
    settings: &'a Settings,
    /// Column and row of the first.
    place: (usize, usize),
    shares: &'a mut [u8],
}

impl wide::Kernel for Decide<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            scene,
            canvas,
            settings,
            place: (left, y),
            shares,
        } = self;
        let (width, height) = canvas.belief.size();
        let columns = left..left + shares.len();
        // Sums down three rows, one column more at each side.
        let (mut sums, mut counts) = ([0.0_f32; WITH_SIDES], [0.0_f32; WITH_SIDES]);
        let with_sides = left.saturating_sub(1)..(columns.end + 1).min(width);
        let first = with_sides.start + 1 - left;
        for v in y.saturating_sub(1)..(y + 2).min(height) {
            let (beliefs, excesses) = (
                &canvas.belief.row(v)[with_sides.clone()],
                &canvas.excess.row(v)[with_sides.clone()],
            );
            let columns = sums[first..].iter_mut().zip(&mut counts[first..]);
            for ((sum, count), (&belief, &excess)) in columns.zip(beliefs.iter().zip(excesses)) {
                *sum += if belief > 0 { excess } else { 0.0 };
                *count += if belief > 0 { 1.0 } else { 0.0 };
            }
        }
        let (mut excess, mut distance, mut against) = ([0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
        for (lane, &own) in canvas.excess.row(y)[columns.clone()].iter().enumerate() {
            excess[lane] = own;
        }
        for (lane, &from) in scene.distance.row(y)[columns.clone()].iter().enumerate() {
            distance[lane] = f32::from(from);
        }
        for (lane, x) in columns.clone().enumerate() {
            against[lane] = canvas.against[scene.grid.cell_at(x, y)];
        }
        let reach = 1.0 / f32::from(scene.reach);
        let (low, range) = (
            settings.excess_low_levels,
            1.0 / (settings.excess_high_levels - settings.excess_low_levels),
        );
        let mut decided = [0_u8; LANES];
        for lane in 0..LANES {
            // Noise does not decide: the mean over 3 × 3 pixels.
            let sum = sums[lane] + sums[lane + 1] + sums[lane + 2];
            let count = (counts[lane] + counts[lane + 1] + counts[lane + 2]).max(1.0);
            let excess = (sum / count).max(0.6 * excess[lane]);
            let near = (1.0 - distance[lane] * reach).max(0.0);
            let weight = if distance[lane] == 0.0 {
                AGAINST_DETECTED
            } else {
                AGAINST_WEIGHT
            };
            let doubt = FAR_DOUBT_LEVELS * (1.0 - 2.0 * near).max(0.0) + weight * against[lane];
            let brighter = ((excess - low - doubt) * range).clamp(0.0, 1.0);
            let share = smooth(brighter) * smooth((4.0 * near).min(1.0));
            decided[lane] = if share < LEAST_SHARE {
                TISSUE
            } else {
                wide::byte_from(255.0 * share)
            };
        }
        let beliefs = &canvas.belief.row(y)[columns];
        for ((share, &belief), &decided) in shares.iter_mut().zip(beliefs).zip(&decided) {
            *share = if belief > PLAIN { decided } else { 0 };
        }
    }
}

#[inline(always)]
fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
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
                let share = if far < 10.0 { 255 } else { u8::from(far < 14.0) };
                shares.own.set(x, y, if x < forbidden_from { share } else { 0 });
            }
        }
        shares.look_around();
        // One pixel more than whole squares.
        let (full_width, full_height) = (step * width - usize::from(step > 1), step * height - usize::from(step > 1));
        let mut out = Replaced {
            image: Image::filled(full_width, full_height, [0; 3]),
            code: Image::filled(full_width, full_height, 1),
            view: Image::filled(full_width, full_height, 0),
        };
        let mut forbidden = Image::filled(width, height, 0);
        for y in 0..height {
            forbidden.row_mut(y)[forbidden_from.min(width)..].fill(255);
        }
        let decision = Decision {
            picture: &Image::filled(full_width, full_height, OLD),
            specular: &Image::filled(width, height, 255),
            canvas: &canvas,
            shares: &shares,
            step,
            grid,
            blocks: &vec![1; grid.blocks().0 * grid.blocks().1],
            forbidden: &forbidden,
            filled: provenance_code::LIGHT_FIELD,
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
    fn what_is_forbidden_stays_to_the_pixel() {
        for step in [1, 2, 3] {
            let out = replaced(step, 49);
            let border = 49 * step;
            for y in 0..out.image.height() {
                assert!(out.image.row(y)[border..].iter().all(|&pixel| pixel == OLD));
                assert!(out.code.row(y)[border..].iter().all(|&code| code == provenance_code::LEFT));
            }
            // The rim is soft.
            assert_eq!(out.image.at(border - 1 - step, 32 * step), NEW);
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
