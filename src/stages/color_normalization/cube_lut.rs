//! Three-dimensional color tables: Adobe's `.cube` files, and the table into which a frame's color chain is baked.
//!
//! Between the nodes of the table colors are interpolated in the tetrahedron around them: the cube between eight nodes is
//! cut along its gray diagonal into six tetrahedra, the order of the three fractions says in which one a color lies, and
//! four nodes remain to be weighted. Cheaper than eight, and grays stay gray. A node's three channels live in one 64-bit
//! word, 21 bits each, so that one multiplication weights all three.

use std::path::{Path, PathBuf};

use crate::image::buffer::Rgb8;
use crate::image::wide::Kernel;

/// Largest table read; the format's own limit is 256.
const MAX_SIZE: usize = 129;
/// Bits of a channel within a node, and of its fraction below a level.
const CHANNEL_BITS: u32 = 21;
const FRACTION_BITS: u32 = 4;
const CHANNEL_MASK: u64 = (1 << CHANNEL_BITS) - 1;
/// Weights sum to 256.
const WEIGHT_BITS: u32 = 8;

/// Why a file is no table.
#[derive(Debug, thiserror::Error)]
pub enum CubeError {
    /// The disk said no.
    #[error("cannot read the color table {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content.
    #[error("{}, line {line}: {what}; expected an Adobe .cube file with LUT_3D_SIZE", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        what: String,
    },
}

/// A table as the file holds it: values 0 to 1, red fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct CubeLut {
    size: usize,
    lowest: [f32; 3],
    highest: [f32; 3],
    nodes: Vec<[f32; 3]>,
}

impl CubeLut {
    /// Read a `.cube` file.
    pub fn read(path: &Path) -> Result<Self, CubeError> {
        let text = std::fs::read_to_string(path).map_err(|source| CubeError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text).map_err(|(line, what)| CubeError::Content {
            path: path.to_owned(),
            line,
            what,
        })
    }

    /// From the text of a `.cube` file; an error is line and complaint.
    pub fn parse(text: &str) -> Result<Self, (usize, String)> {
        let mut size = None;
        let (mut lowest, mut highest) = ([0.0; 3], [1.0; 3]);
        let mut nodes = Vec::new();
        let mut last = 0;
        for (index, line) in text.lines().enumerate() {
            last = index + 1;
            let line = line.split('#').next().unwrap_or("").trim();
            let mut words = line.split_whitespace();
            let Some(first) = words.next() else { continue };
            match first {
                "TITLE" => {}
                "LUT_1D_SIZE" => return Err((last, "this is a one-dimensional table".to_owned())),
                "LUT_3D_SIZE" => {
                    let value = words.next().and_then(|w| w.parse::<usize>().ok());
                    let Some(value) = value.filter(|v| (2..=MAX_SIZE).contains(v)) else {
                        return Err((last, format!("the size must be 2 to {MAX_SIZE}: `{line}`")));
                    };
                    size = Some(value);
                    nodes.reserve(value * value * value);
                }
                "DOMAIN_MIN" => lowest = triple(words).ok_or((last, format!("three numbers expected: `{line}`")))?,
                "DOMAIN_MAX" => highest = triple(words).ok_or((last, format!("three numbers expected: `{line}`")))?,
                _ if first.starts_with(|c: char| c.is_ascii_alphabetic()) && !first.starts_with(['n', 'i', 'N', 'I']) => {
                    // Other programs' keywords; the format says to ignore what one does not know.
                }
                _ => {
                    let node = triple(line.split_whitespace());
                    nodes.push(node.ok_or((last, format!("three finite numbers expected: `{line}`")))?);
                }
            }
        }
        let Some(size) = size else {
            return Err((last, "LUT_3D_SIZE is missing".to_owned()));
        };
        if nodes.len() != size * size * size {
            return Err((
                last,
                format!(
                    "{} colors expected for size {size}, found {}",
                    size * size * size,
                    nodes.len()
                ),
            ));
        }
        if (0..3).any(|c| highest[c] <= lowest[c]) {
            return Err((last, "DOMAIN_MAX must lie above DOMAIN_MIN".to_owned()));
        }
        Ok(Self {
            size,
            lowest,
            highest,
            nodes,
        })
    }

    /// The table's color for a color in 8-bit levels; within 0 to 255. Tetrahedral.
    pub fn apply(&self, color: [f32; 3]) -> [f32; 3] {
        let last = (self.size - 1) as f32;
        let place: [f32; 3] = std::array::from_fn(|c| {
            ((color[c] / 255.0 - self.lowest[c]) / (self.highest[c] - self.lowest[c])).clamp(0.0, 1.0) * last
        });
        let cell = place.map(|v| (v as usize).min(self.size - 2));
        let fraction: [f32; 3] = std::array::from_fn(|c| place[c] - cell[c] as f32);
        let strides = [1, self.size, self.size * self.size];
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| fraction[*b].total_cmp(&fraction[*a]));
        let mut at = cell[0] + cell[1] * strides[1] + cell[2] * strides[2];
        let mut sum = self.nodes[at].map(|v| v * (1.0 - fraction[order[0]]));
        for (step, axis) in order.into_iter().enumerate() {
            at += strides[axis];
            let weight = fraction[axis] - order.get(step + 1).map_or(0.0, |next| fraction[*next]);
            for (sum, value) in sum.iter_mut().zip(self.nodes[at]) {
                *sum += weight * value;
            }
        }
        sum.map(|v| v.clamp(0.0, 1.0) * 255.0)
    }
}

fn triple<'a>(words: impl Iterator<Item = &'a str>) -> Option<[f32; 3]> {
    let mut values = [0.0; 3];
    let mut count = 0;
    for word in words {
        *values.get_mut(count)? = word.parse::<f32>().ok().filter(|v| v.is_finite())?;
        count += 1;
    }
    (count == 3).then_some(values)
}

/// Nodes per axis of the baked table.
const BAKED: usize = 33;

/// A color chain baked into a table that is quick to apply to 8-bit pixels.
#[derive(Debug)]
pub struct BakedLut {
    nodes: Vec<u64>,
    /// For each level: node below, and weight of the node above, 0 to 256.
    cells: [(u16, u16); 256],
}

impl Default for BakedLut {
    fn default() -> Self {
        let cells = std::array::from_fn(|level| {
            let place = level * (BAKED - 1) * 256 / 255;
            let cell = (place / 256).min(BAKED - 2);
            (cell as u16, (place - cell * 256) as u16)
        });
        Self {
            nodes: vec![0; BAKED * BAKED * BAKED],
            cells,
        }
    }
}

impl BakedLut {
    /// Bake `chain`, which maps 8-bit levels to levels within 0 to 255.
    pub fn bake(&mut self, chain: impl Fn([f32; 3]) -> [f32; 3]) {
        let step = 255.0 / (BAKED - 1) as f32;
        let scale = (1 << FRACTION_BITS) as f32;
        let mut node = self.nodes.iter_mut();
        for blue in 0..BAKED {
            for green in 0..BAKED {
                for red in 0..BAKED {
                    let color = chain([red, green, blue].map(|v| v as f32 * step));
                    let word = color.iter().enumerate().fold(0, |word, (c, value)| {
                        word | (((value.clamp(0.0, 255.0) * scale).round() as u64) << (c as u32 * CHANNEL_BITS))
                    });
                    if let Some(node) = node.next() {
                        *node = word;
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn look_up(&self, color: Rgb8) -> Rgb8 {
        let [(cr, fr), (cg, fg), (cb, fb)] = color.map(|level| self.cells[usize::from(level)]);
        let base = usize::from(cr) + usize::from(cg) * BAKED + usize::from(cb) * BAKED * BAKED;
        // A fraction and its stride in one number: sorting the numbers sorts the fractions.
        let key = |fraction: u16, stride: usize| (u32::from(fraction) << 16) | stride as u32;
        let (r, g, b) = (key(fr, 1), key(fg, BAKED), key(fb, BAKED * BAKED));
        let (high, low) = (r.max(g), r.min(g));
        let (first, rest) = (high.max(b), high.min(b));
        let (second, third) = (rest.max(low), rest.min(low));
        let stride = |key: u32| (key & 0xffff) as usize;
        let fraction = |key: u32| u64::from(key >> 16);
        let (i1, i2) = (base + stride(first), base + stride(first) + stride(second));
        let i3 = base + 1 + BAKED + BAKED * BAKED;
        let sum = self.nodes[base] * (256 - fraction(first))
            + self.nodes[i1] * (fraction(first) - fraction(second))
            + self.nodes[i2] * (fraction(second) - fraction(third))
            + self.nodes[i3] * fraction(third);
        let half = 1 << (WEIGHT_BITS + FRACTION_BITS - 1);
        let channel = |c: u32| ((((sum >> (c * CHANNEL_BITS)) & CHANNEL_MASK) + half) >> (WEIGHT_BITS + FRACTION_BITS)) as u8;
        [channel(0), channel(1), channel(2)]
    }
}

/// Apply a baked table to a run of pixels.
#[derive(Debug)]
pub struct LutRun<'a> {
    /// The table.
    pub lut: &'a BakedLut,
    /// In.
    pub source: &'a [Rgb8],
    /// Out; as long as `source`.
    pub target: &'a mut [Rgb8],
    /// 0 where the pixel must stay; empty = nowhere.
    pub field_of_view: &'a [u8],
    /// Pixels whose brightest channel is not above this stay as they are.
    pub black_level: u8,
}

impl Kernel for LutRun<'_> {
    #[inline(always)]
    fn run(self) {
        for (source, target) in self.source.iter().zip(self.target.iter_mut()) {
            let lit = source[0].max(source[1]).max(source[2]) > self.black_level;
            *target = if lit { self.lut.look_up(*source) } else { *source };
        }
        if !self.field_of_view.is_empty() {
            super::affine::keep_surround(self.source, self.target, self.field_of_view);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    fn text(size: usize, f: impl Fn([f32; 3]) -> [f32; 3]) -> String {
        let mut text = format!("# a comment\nTITLE \"x\"\nLUT_3D_SIZE {size}\nDOMAIN_MIN 0 0 0\nDOMAIN_MAX 1 1 1\n\n");
        let last = (size - 1) as f32;
        for b in 0..size {
            for g in 0..size {
                for r in 0..size {
                    let [r, g, b] = f([r as f32 / last, g as f32 / last, b as f32 / last]);
                    text += &format!("{r:.6} {g:.6} {b:.6}\n");
                }
            }
        }
        text
    }

    #[test]
    fn a_linear_table_is_exact_and_the_baked_one_follows_it() {
        let linear = |[r, g, b]: [f32; 3]| [0.8 * r + 0.1 * g, 0.9 * g + 0.05, 0.7 * b + 0.2 * r];
        let lut = CubeLut::parse(&text(5, linear)).unwrap();
        let mut baked = BakedLut::default();
        baked.bake(|color| lut.apply(color));
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..2000 {
            let color: Rgb8 = random.random();
            let expected = linear(color.map(|v| f32::from(v) / 255.0)).map(|v| v * 255.0);
            let table = lut.apply(color.map(f32::from));
            let quick = baked.look_up(color);
            for c in 0..3 {
                assert!((table[c] - expected[c]).abs() < 1e-2);
                assert!(
                    (f32::from(quick[c]) - expected[c]).abs() < 0.65,
                    "{color:?}: {quick:?}, expected {expected:?}"
                );
            }
        }
    }

    #[test]
    fn the_identity_is_the_identity() {
        let mut baked = BakedLut::default();
        baked.bake(|color| color);
        for level in 0..=255 {
            assert_eq!(baked.look_up([level; 3]), [level; 3]);
            assert_eq!(baked.look_up([level, 255, 0]), [level, 255, 0]);
        }
    }

    #[test]
    fn faults_are_named_with_their_line() {
        assert!(CubeLut::parse("TITLE \"x\"\n").unwrap_err().1.contains("LUT_3D_SIZE"));
        assert_eq!(CubeLut::parse("LUT_3D_SIZE 2\n0 0\n").unwrap_err().0, 2);
        assert!(CubeLut::parse("LUT_3D_SIZE 2\n0 0 0\n").unwrap_err().1.contains("8 colors"));
        assert!(CubeLut::parse("LUT_3D_SIZE 2\nnan 0 0\n").is_err());
        assert!(CubeLut::parse("LUT_1D_SIZE 2\n").is_err());
    }
}
