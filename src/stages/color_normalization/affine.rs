//! One affine map per pixel, blended out toward black and toward clipped white.
//!
//! The map would lift black (and the surround) by its offset and tint what the sensor clipped; both are what they are in
//! every camera. So a pixel p becomes p + w (A p + b − p) with w = 0 up to a brightest channel of 10, 1 from 26 on, and
//! falling to 0 again as the darkest channel goes from 238 to 254.

use nalgebra::{Matrix3, Vector3};

use crate::image::buffer::Rgb8;
use crate::image::wide::{Kernel, byte_from};

/// Below this brightest channel a pixel is left exactly as it is, levels.
pub const BLACK_LEVEL: f32 = 10.0;
const RAMP_LEVELS: f32 = 16.0;
/// From this darkest channel on a pixel is left exactly as it is, levels.
pub const WHITE_LEVEL: f32 = 254.0;

/// f' = A f + b in 8-bit levels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    linear: [[f32; 3]; 3],
    offset: [f32; 3],
}

impl Affine {
    /// Leaves colors alone.
    pub const IDENTITY: Self = Self {
        linear: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        offset: [0.0; 3],
    };

    /// From matrix and offset.
    pub fn new(linear: Matrix3<f64>, offset: Vector3<f64>) -> Self {
        Self {
            linear: std::array::from_fn(|r| std::array::from_fn(|c| linear[(r, c)] as f32)),
            offset: std::array::from_fn(|r| offset[r] as f32),
        }
    }

    /// A.
    pub fn linear(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|r, c| f64::from(self.linear[r][c]))
    }

    /// b.
    pub fn offset(&self) -> Vector3<f64> {
        Vector3::from_fn(|r, _| f64::from(self.offset[r]))
    }

    /// Move the share `alpha` of the way to `other`.
    pub fn approach(&mut self, other: &Self, alpha: f32) {
        for (row, target) in self.linear.iter_mut().zip(&other.linear) {
            for (value, target) in row.iter_mut().zip(target) {
                *value += alpha * (target - *value);
            }
        }
        for (value, target) in self.offset.iter_mut().zip(&other.offset) {
            *value += alpha * (target - *value);
        }
    }

    /// Largest change this makes to any color with levels 0 to 255, levels.
    pub fn largest_change(&self) -> f32 {
        (0..3)
            .map(|r| {
                let ends = (0..3).map(|c| (self.linear[r][c] - if r == c { 1.0 } else { 0.0 }) * 255.0);
                let (up, down) = ends.fold((0.0, 0.0), |(up, down): (f32, f32), e| (up + e.max(0.0), down + e.min(0.0)));
                (self.offset[r] + up).abs().max((self.offset[r] + down).abs())
            })
            .fold(0.0, f32::max)
    }

    /// The full map without blending out, levels, not clamped.
    #[inline(always)]
    pub fn apply(&self, color: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|r| {
            self.linear[r][0] * color[0] + self.linear[r][1] * color[1] + self.linear[r][2] * color[2] + self.offset[r]
        })
    }

    /// The map as pixels get it: blended out at black and at clipped white.
    #[inline(always)]
    pub fn apply_blended(&self, color: [f32; 3]) -> [f32; 3] {
        let weight = weight(color);
        let full = self.apply(color);
        std::array::from_fn(|c| color[c] + weight * (full[c] - color[c]))
    }
}

/// How far a color may be changed, 0 to 1.
#[inline(always)]
pub fn weight(color: [f32; 3]) -> f32 {
    let highest = color[0].max(color[1]).max(color[2]);
    let lowest = color[0].min(color[1]).min(color[2]);
    let lit = ((highest - BLACK_LEVEL) * (1.0 / RAMP_LEVELS)).clamp(0.0, 1.0);
    let unclipped = ((WHITE_LEVEL - lowest) * (1.0 / RAMP_LEVELS)).clamp(0.0, 1.0);
    lit * unclipped
}

/// Pixels at a time, split into channels within the first-level cache.
const CHUNK: usize = 128;

/// Apply a map to a run of pixels.
#[derive(Debug)]
pub struct AffineRun<'a> {
    /// The map.
    pub map: Affine,
    /// In.
    pub source: &'a [Rgb8],
    /// Out; as long as `source`.
    pub target: &'a mut [Rgb8],
    /// 0 where the pixel must stay; empty = nowhere.
    pub field_of_view: &'a [u8],
}

impl Kernel for AffineRun<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            map,
            source,
            target,
            field_of_view,
        } = self;
        let (sources, rest) = source.as_chunks::<CHUNK>();
        let (targets, rest_target) = target.as_chunks_mut::<CHUNK>();
        for (source, target) in sources.iter().zip(targets) {
            *target = chunk(&map, source);
        }
        let mut padded = [[0; 3]; CHUNK];
        padded[..rest.len()].copy_from_slice(rest);
        rest_target.copy_from_slice(&chunk(&map, &padded)[..rest.len()]);
        if !field_of_view.is_empty() {
            keep_surround(source, target, field_of_view);
        }
    }
}

/// Put back what lies outside the image field.
#[inline(always)]
pub fn keep_surround(source: &[Rgb8], target: &mut [Rgb8], field_of_view: &[u8]) {
    for ((source, target), inside) in source.iter().zip(target).zip(field_of_view) {
        if *inside == 0 {
            *target = *source;
        }
    }
}

/// The length is fixed and known, so that nothing is left over for a loop over single pixels.
#[inline(always)]
fn chunk(map: &Affine, source: &[Rgb8; CHUNK]) -> [Rgb8; CHUNK] {
    let (mut red, mut green, mut blue) = ([0_u8; CHUNK], [0_u8; CHUNK], [0_u8; CHUNK]);
    for i in 0..CHUNK {
        [red[i], green[i], blue[i]] = source[i];
    }
    for i in 0..CHUNK {
        let [r, g, b] = map.apply_blended([f32::from(red[i]), f32::from(green[i]), f32::from(blue[i])]);
        red[i] = byte_from(r);
        green[i] = byte_from(g);
        blue[i] = byte_from(b);
    }
    let mut target = [[0; 3]; CHUNK];
    for i in 0..CHUNK {
        target[i] = [red[i], green[i], blue[i]];
    }
    target
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::wide;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_kernel_agrees_with_the_formula_and_keeps_black_white_and_surround() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let map = Affine::new(
            Matrix3::new(0.87, 0.05, -0.02, 0.01, 1.04, 0.0, -0.03, 0.02, 1.27),
            Vector3::new(4.0, -6.0, 9.0),
        );
        let mut source: Vec<Rgb8> = (0..1003).map(|_| random.random()).collect();
        source[7] = [255; 3];
        source[8] = [10, 3, 0];
        source[9] = [0; 3];
        let mut field_of_view = vec![255; source.len()];
        field_of_view[20] = 0;
        let mut target = vec![[0; 3]; source.len()];
        wide::run(AffineRun {
            map,
            source: &source,
            target: &mut target,
            field_of_view: &field_of_view,
        });
        for i in (0..source.len()).filter(|i| *i != 20) {
            let expected = map
                .apply_blended(source[i].map(f32::from))
                .map(|v| v.clamp(0.0, 255.0).round_ties_even() as u8);
            assert_eq!(target[i], expected, "{:?}", source[i]);
        }
        for i in [7, 8, 9, 20] {
            assert_eq!(target[i], source[i]);
        }
    }
}
