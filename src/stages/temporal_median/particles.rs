//! Tells particles from the edges of what moves.
//!
//! Input: the newest frame, the median, and the pixels where they depart from each other. Each connected blob of such
//! pixels is judged by its contrast across its own border, in the newest frame and in the median. A particle is there in
//! the newest frame and gone in the median: the contrast falls. Where an edge has moved, the contrast has moved along and
//! stays what it was. Where something has gone (the median still shows it), the contrast rises: motion, or a particle that
//! stood still for too long; the newest frame is right in both cases.

use crate::image::buffer::{Image, Rgb8};
use crate::stages::temporal_median::motion::{BLOCK, BlockStats, Motion};
use crate::stages::temporal_median::noise::Noise;

/// A particle's contrast in the median is at most this share of that in the newest frame; where the median speaks anyway,
/// and where it speaks only for particles.
const MAX_CONTRAST_STILL: f32 = 0.75;
const MAX_CONTRAST_SLOW: f32 = 0.45;
/// Particles that touch make a blob of up to this many times the extent of one; it must lose this much contrast, and all of
/// it must lie where motion would have shown.
const CLUSTER_EXTENTS: usize = 2;
const MAX_CONTRAST_CLUSTER: f32 = 0.35;
/// Below this share the other way round, something has gone.
const GONE_CONTRAST: f32 = 0.75;
/// Where the border is looked at: this far out, px.
const REACH: usize = 2;
/// What was judged is grown by this, px: the soft rim of a particle lies below the threshold.
const GROW: usize = 2;
/// A block whose texture exceeds the noise by this factor would have shown motion.
const TEXTURED: f32 = 2.0;
/// Blocks around something that has gone in which nothing is taken for a particle.
const GONE_REACH: usize = 2;

/// Bits of [`Particles::marks`].
const SEEN: u8 = 1;
const TAKE_MEDIAN: u8 = 2;
const KEEP_NEWEST: u8 = 4;

/// Which of the two pictures is right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The frame as it came.
    Newest,
    /// The median.
    Median,
}

/// What was found about a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    /// One side is right everywhere.
    All(Side),
    /// The marks tell; where there are none, the median if it rules.
    ByMark { median_rules: bool },
}

#[derive(Clone, Copy, Debug)]
struct Blob {
    first: usize,
    count: usize,
    left: usize,
    top: usize,
    right: usize,
    bottom: usize,
    contrast_newest: u32,
    contrast_median: u32,
}

/// The judge and its buffers.
#[derive(Debug, Default)]
pub struct Particles {
    size: (usize, usize),
    marks: Vec<u8>,
    stack: Vec<u32>,
    members: Vec<u32>,
    blobs: Vec<Blob>,
    /// Per block: bit 0 something has gone near, bit 1 a change too large for a particle.
    suspect: Vec<u8>,
    busy: Vec<bool>,
}

/// What the judge looks at.
#[derive(Debug)]
pub struct Evidence<'a> {
    /// Gray of the newest frame.
    pub gray: &'a [u8],
    /// 255 where newest and median depart from each other; 0 in moving blocks.
    pub departs: &'a [u8],
    /// Per block: whether it has such a pixel.
    pub departing: &'a [bool],
    /// Per block.
    pub stats: &'a [BlockStats],
    /// Per block.
    pub motions: &'a [Motion],
    /// The noise.
    pub noise: &'a Noise,
    /// Largest extent of a particle, px.
    pub max_extent_px: usize,
    /// What is no particle stays as it came even where the picture is still: the window is too short to tell slow motion.
    pub particles_only: bool,
}

fn gray(color: Rgb8) -> i32 {
    (i32::from(color[0]) + 2 * i32::from(color[1]) + i32::from(color[2]) + 2) >> 2
}

impl Particles {
    /// Judge what departs; `median` may hold anything in moving blocks.
    pub fn settle(&mut self, evidence: &Evidence<'_>, median: &Image<Rgb8>) {
        let (width, height) = median.size();
        let columns = width.div_ceil(BLOCK);
        self.prepare((width, height), evidence.motions.len());
        self.find_blobs(evidence, median);
        self.suspect_blocks(columns, evidence);
        for index in 0..self.blobs.len() {
            let blob = self.blobs[index];
            let mark = if self.is_particle(&blob, columns, evidence) {
                TAKE_MEDIAN
            } else {
                KEEP_NEWEST
            };
            for member in blob.first..blob.first + blob.count {
                let at = self.members[member] as usize;
                let (x, y) = (at % width, at / width);
                let (left, right) = (x.saturating_sub(GROW), (x + GROW).min(width - 1));
                let (top, bottom) = (y.saturating_sub(GROW), (y + GROW).min(height - 1));
                for row in top..=bottom {
                    for near in &mut self.marks[row * width + left..=row * width + right] {
                        *near |= mark;
                    }
                }
                for row in [top / BLOCK, bottom / BLOCK] {
                    self.busy[row * columns + left / BLOCK] = true;
                    self.busy[row * columns + right / BLOCK] = true;
                }
            }
        }
    }

    fn prepare(&mut self, (width, height): (usize, usize), blocks: usize) {
        let pixels = width * height;
        if self.size != (width, height) {
            self.size = (width, height);
            self.marks = vec![0; pixels];
            self.stack = Vec::with_capacity(pixels);
            self.members = Vec::with_capacity(pixels);
            self.blobs = Vec::with_capacity(pixels / 4 + 1);
            self.suspect = vec![0; blocks];
            self.busy = vec![false; blocks];
        }
        // All marks of the last frame lie in its busy blocks.
        let columns = width.div_ceil(BLOCK);
        for (block, _) in self.busy.iter().enumerate().filter(|(_, busy)| **busy) {
            let (left, top) = (block % columns * BLOCK, block / columns * BLOCK);
            for y in top..(top + BLOCK).min(height) {
                match self.marks[y * width + left..]
                    .first_chunk_mut::<BLOCK>()
                    .filter(|_| left + BLOCK <= width)
                {
                    Some(marks) => *marks = [0; BLOCK],
                    None => self.marks[y * width + left..(y + 1) * width].fill(0),
                }
            }
        }
        self.suspect.fill(0);
        self.busy.fill(false);
        self.members.clear();
        self.blobs.clear();
    }

    fn find_blobs(&mut self, evidence: &Evidence<'_>, median: &Image<Rgb8>) {
        let (width, height) = median.size();
        let columns = width.div_ceil(BLOCK);
        for (by, departing) in evidence.departing.chunks_exact(columns).enumerate() {
            for (bx, _) in departing.iter().enumerate().filter(|(_, departing)| **departing) {
                let (left, right) = (bx * BLOCK, (bx * BLOCK + BLOCK).min(width));
                for y in by * BLOCK..(by * BLOCK + BLOCK).min(height) {
                    let row = &evidence.departs[y * width + left..y * width + right];
                    if row.iter().fold(0, |any, v| any | v) == 0 {
                        continue;
                    }
                    for x in left..right {
                        let at = y * width + x;
                        if evidence.departs[at] != 0 && self.marks[at] & SEEN == 0 {
                            self.flood(at, evidence, median);
                        }
                    }
                }
            }
        }
    }

    fn flood(&mut self, seed: usize, evidence: &Evidence<'_>, median: &Image<Rgb8>) {
        let (width, height) = median.size();
        let columns = width.div_ceil(BLOCK);
        let departs = evidence.departs;
        let first = self.members.len();
        let (x, y) = (seed % width, seed / width);
        let mut blob = Blob {
            first,
            count: 0,
            left: x,
            top: y,
            right: x,
            bottom: y,
            contrast_newest: 0,
            contrast_median: 0,
        };
        self.marks[seed] |= SEEN;
        self.stack.push(seed as u32);
        while let Some(at) = self.stack.pop() {
            let at = at as usize;
            let (x, y) = (at % width, at / width);
            self.members.push(at as u32);
            blob.left = blob.left.min(x);
            blob.right = blob.right.max(x);
            blob.top = blob.top.min(y);
            blob.bottom = blob.bottom.max(y);
            for ny in y.saturating_sub(1)..(y + 2).min(height) {
                for nx in x.saturating_sub(1)..(x + 2).min(width) {
                    let near = ny * width + nx;
                    if departs[near] != 0 && self.marks[near] & SEEN == 0 {
                        self.marks[near] |= SEEN;
                        self.stack.push(near as u32);
                    }
                }
            }
            let across = [
                (x + REACH < width).then(|| at + REACH),
                (x >= REACH).then(|| at.wrapping_sub(REACH)),
                (y + REACH < height).then(|| at + REACH * width),
                (y >= REACH).then(|| at.wrapping_sub(REACH * width)),
            ];
            for outside in across.into_iter().flatten() {
                if departs[outside] == 0 {
                    let newest = evidence.gray[at].abs_diff(evidence.gray[outside]);
                    let block = outside / width / BLOCK * columns + outside % width / BLOCK;
                    let n = match evidence.motions[block] {
                        Motion::Moving => i32::from(evidence.gray[outside]),
                        _ => gray(median.pixels()[outside]),
                    };
                    let m = gray(median.pixels()[at]);
                    blob.contrast_newest += u32::from(newest);
                    blob.contrast_median += m.abs_diff(n);
                }
            }
        }
        blob.count = self.members.len() - first;
        self.blobs.push(blob);
    }

    fn suspect_blocks(&mut self, columns: usize, evidence: &Evidence<'_>) {
        let rows = evidence.motions.len() / columns;
        // Blobs are not sought in moving blocks, so what has gone from there is not found either: a specularity that
        // wanders from a moving block into a smooth still one would look like a particle.
        for (block, motion) in evidence.motions.iter().enumerate() {
            if *motion == Motion::Moving {
                let (bx, by) = (block % columns, block / columns);
                for y in by.saturating_sub(1)..(by + 2).min(rows) {
                    for x in bx.saturating_sub(1)..(bx + 2).min(columns) {
                        self.suspect[y * columns + x] |= 1;
                    }
                }
            }
        }
        for blob in &self.blobs {
            let large = extent(blob) > evidence.max_extent_px && !is_cluster(blob, columns, evidence);
            let gone = (blob.contrast_newest as f32) < GONE_CONTRAST * blob.contrast_median as f32;
            if !large && !gone {
                continue;
            }
            let (flag, reach) = if large { (2, 1) } else { (1, GONE_REACH) };
            for y in (blob.top / BLOCK).saturating_sub(reach)..(blob.bottom / BLOCK + reach + 1).min(rows) {
                for x in (blob.left / BLOCK).saturating_sub(reach)..(blob.right / BLOCK + reach + 1).min(columns) {
                    self.suspect[y * columns + x] |= flag;
                }
            }
        }
    }

    fn is_particle(&self, blob: &Blob, columns: usize, evidence: &Evidence<'_>) -> bool {
        if extent(blob) > evidence.max_extent_px && !is_cluster(blob, columns, evidence) {
            return false;
        }
        let mut limit = MAX_CONTRAST_STILL;
        for y in blob.top / BLOCK..=blob.bottom / BLOCK {
            for x in blob.left / BLOCK..=blob.right / BLOCK {
                let block = y * columns + x;
                let still = evidence.motions[block] == Motion::Still;
                if !still || evidence.particles_only {
                    limit = MAX_CONTRAST_SLOW;
                }
                let suspect = self.suspect[block];
                if suspect & 2 != 0 || (suspect & 1 != 0 && !is_convincing(block, evidence)) {
                    return false;
                }
            }
        }
        (blob.contrast_median as f32) < limit * blob.contrast_newest as f32
    }

    /// Copy the pixels for which `side` is right from its picture to the other's; the rest of `to` stays.
    pub fn copy(&self, evidence: &Evidence<'_>, side: Side, from: &Image<Rgb8>, to: &mut Image<Rgb8>) {
        let (width, height) = to.size();
        let columns = width.div_ceil(BLOCK);
        for (by, motions) in evidence.motions.chunks_exact(columns).enumerate() {
            let busy = &self.busy[by * columns..(by + 1) * columns];
            let rows = by * BLOCK..(by * BLOCK + BLOCK).min(height);
            let verdict = |bx: usize| self.verdict(evidence, motions[bx], busy[bx]);
            let mut first = 0;
            while first < columns {
                let alike = (first..columns).take_while(|bx| verdict(*bx) == verdict(first)).count();
                let (left, right) = (first * BLOCK, ((first + alike) * BLOCK).min(width));
                match verdict(first) {
                    Verdict::All(right_side) if right_side == side => {
                        for y in rows.clone() {
                            to.row_mut(y)[left..right].copy_from_slice(&from.row(y)[left..right]);
                        }
                    }
                    Verdict::All(_) => {}
                    Verdict::ByMark { median_rules } => {
                        for y in rows.clone() {
                            let marks = &self.marks[y * width + left..y * width + right];
                            let pixels = to.row_mut(y)[left..right].iter_mut().zip(&from.row(y)[left..right]);
                            for ((to, from), mark) in pixels.zip(marks) {
                                let newest = if median_rules {
                                    mark & (KEEP_NEWEST | TAKE_MEDIAN) == KEEP_NEWEST
                                } else {
                                    mark & TAKE_MEDIAN == 0
                                };
                                if newest == (side == Side::Newest) {
                                    *to = *from;
                                }
                            }
                        }
                    }
                }
                first += alike;
            }
        }
    }

    fn verdict(&self, evidence: &Evidence<'_>, motion: Motion, busy: bool) -> Verdict {
        let median_rules = motion == Motion::Still && !evidence.particles_only;
        match (motion, busy) {
            (Motion::Moving, _) => Verdict::All(Side::Newest),
            (_, true) => Verdict::ByMark { median_rules },
            (_, false) if median_rules => Verdict::All(Side::Median),
            (_, false) => Verdict::All(Side::Newest),
        }
    }
}

/// Still, and textured enough that motion would have shown.
fn is_convincing(block: usize, evidence: &Evidence<'_>) -> bool {
    let stats = &evidence.stats[block];
    let textured = stats.texture > TEXTURED * evidence.noise.variance_at(stats.level);
    evidence.motions[block] == Motion::Still && textured
}

fn is_cluster(blob: &Blob, columns: usize, evidence: &Evidence<'_>) -> bool {
    let small = extent(blob) <= CLUSTER_EXTENTS * evidence.max_extent_px;
    let mut blocks = (blob.top / BLOCK..=blob.bottom / BLOCK)
        .flat_map(|y| (blob.left / BLOCK..=blob.right / BLOCK).map(move |x| y * columns + x));
    small
        && (blob.contrast_median as f32) < MAX_CONTRAST_CLUSTER * blob.contrast_newest as f32
        && blocks.all(|block| is_convincing(block, evidence))
}

fn extent(blob: &Blob) -> usize {
    (blob.right - blob.left).max(blob.bottom - blob.top) + 1
}
