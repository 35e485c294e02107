//! The bilinear remap eight pixels at a time, for AVX2, where a map is as smooth as a lens's.
//!
//! Four neighbours in the output mostly come from four neighbours in the source, in one row or two: sixteen bytes of each of three rows
//! hold all that they need, and a byte shuffle per row picks it. So a table of its own says where the sixteen bytes of either half of
//! eight pixels begin, and in 16 bits where in them each pixel lies: 24 bytes for eight pixels, three loads for four of them.
//! Eight pixels that lie otherwise (at borders, or where the source is shrunk) are left to [`crate::image::remap_bilinear`].
//!
//! The arithmetic is exact. With U and L, the upper and lower row blended across in 1/32, the result is
//! ⌊(32 U + fy (L − U) + 512) / 1024⌋ = ⌊(U + 16 + ⌊fy (L − U) / 32⌋) / 32⌋, and the inner ⌊⌋ is the upper half of a product of 16-bit
//! numbers, 4 (L − U) and 512 fy.

use crate::image::remap::Place;

/// Pixels treated together.
pub(crate) const EIGHT: usize = 8;
const HALF: usize = EIGHT / 2;
/// Source bytes looked at in a row.
const WINDOW: usize = 16;
/// Source columns that the window holds as left neighbours.
const COLUMNS: i32 = 4;
/// Not a source pixel.
const NOWHERE: u32 = u32::MAX;

/// Where eight neighbours in an output row come from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Octet {
    /// The source pixel where the windows of either half begin; [`NOWHERE`] twice if they do not hold all.
    corners: [u32; 2],
    /// From low to high: fx (5 bits), fy (5), byte in the window (4), unused, one row further down.
    steps: [u16; EIGHT],
}

impl Octet {
    /// Of these places, in a source of this many columns and rows. Empty unless all places are `inner`, with all four neighbours in
    /// the source.
    pub fn new(places: &[Option<Place>; EIGHT], (width, height): (usize, usize), inner: impl Fn(&Place) -> bool) -> Self {
        let mut octet = Self {
            corners: [NOWHERE; 2],
            steps: [0; EIGHT],
        };
        let mut corners = [NOWHERE; 2];
        let (halves, _) = places.as_chunks::<HALF>();
        for ((half, corner), steps) in halves.iter().zip(&mut corners).zip(octet.steps.chunks_mut(HALF)) {
            let near = half.iter().flatten();
            let (Some(left), Some(top)) = (near.clone().map(|p| p.x).min(), near.map(|p| p.y).min()) else {
                return octet;
            };
            for (place, step) in half.iter().zip(steps) {
                let Some(place) = place.as_ref().filter(|place| inner(place)) else {
                    return octet;
                };
                let (column, row) = (place.x - left, place.y - top);
                if column >= COLUMNS || row > 1 {
                    return octet;
                }
                *step = u16::from(place.fx) | u16::from(place.fy) << 5 | (3 * column as u16) << 10 | (row as u16) << 15;
            }
            let first = top as usize * width + left as usize;
            if 3 * (first + 2 * width) + WINDOW > 3 * width * height {
                return octet;
            }
            *corner = first as u32;
        }
        octet.corners = corners;
        octet
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2 {
    use std::arch::x86_64::{
        __m128i, __m256i, _mm256_add_epi8, _mm256_add_epi16, _mm256_and_si256, _mm256_blendv_epi8, _mm256_castsi128_si256,
        _mm256_castsi256_si128, _mm256_extract_epi64, _mm256_maddubs_epi16, _mm256_mulhi_epi16, _mm256_mullo_epi16,
        _mm256_packus_epi16, _mm256_permute4x64_epi64, _mm256_permutevar8x32_epi32, _mm256_set_m128i, _mm256_set1_epi8,
        _mm256_set1_epi16, _mm256_setr_epi8, _mm256_setr_epi32, _mm256_shuffle_epi8, _mm256_slli_epi16, _mm256_srai_epi16,
        _mm256_srli_epi16, _mm256_sub_epi16,
    };

    use super::{EIGHT, Octet, WINDOW};
    use crate::image::buffer::Rgb8;

    /// A source as it is seen from a pixel in it: its row, the next and the one after.
    #[derive(Clone, Copy, Debug)]
    pub struct Rows<'a>([&'a [u8]; 3]);

    impl<'a> Rows<'a> {
        /// Of a source of `stride` bytes a row; `None` of fewer than three rows.
        pub fn new(source: &'a [u8], stride: usize) -> Option<Self> {
            // All of the same length: a place that is checked in one is checked in all.
            let length = source.len().checked_sub(2 * stride)?;
            Some(Self([
                &source[..length],
                &source[stride..][..length],
                &source[2 * stride..][..length],
            ]))
        }

        #[inline]
        #[target_feature(enable = "avx2")]
        fn window(&self, row: usize, at: usize) -> Option<__m128i> {
            Some(bytemuck::cast::<[u8; WINDOW], __m128i>(
                *self.0[row].get(at..)?.first_chunk()?,
            ))
        }
    }

    impl Octet {
        /// Fill eight pixels; false if the windows do not hold them.
        #[inline]
        #[target_feature(enable = "avx2")]
        pub fn fill(&self, source: &Rows<'_>, out: &mut [Rgb8; EIGHT]) -> bool {
            let [left, right] = [3 * self.corners[0] as usize, 3 * self.corners[1] as usize];
            let (Some(first), Some(second)) = (source.window(0, left), source.window(0, right)) else {
                return false;
            };
            let (Some(third), Some(fourth)) = (source.window(1, left), source.window(1, right)) else {
                return false;
            };
            let (Some(fifth), Some(sixth)) = (source.window(2, left), source.window(2, right)) else {
                return false;
            };
            // One half of the pixels in each 128-bit lane.
            let rows = [
                _mm256_set_m128i(second, first),
                _mm256_set_m128i(fourth, third),
                _mm256_set_m128i(sixth, fifth),
            ];
            let steps = _mm256_castsi128_si256(bytemuck::cast::<[u16; EIGHT], __m128i>(self.steps));
            let steps = _mm256_permute4x64_epi64::<0b01_01_00_00>(steps);
            let low_five = _mm256_set1_epi16(31);
            // Bytes (32−fx, fx): their word is 255 fx + 32.
            let across = _mm256_mullo_epi16(_mm256_and_si256(steps, low_five), _mm256_set1_epi16(255));
            let weights = Weights {
                across: _mm256_add_epi16(across, _mm256_set1_epi16(32)),
                down: _mm256_slli_epi16::<4>(_mm256_and_si256(steps, _mm256_set1_epi16(31 << 5))),
                lower: _mm256_srai_epi16::<15>(steps),
            };
            let first = _mm256_and_si256(_mm256_srli_epi16::<10>(steps), _mm256_set1_epi16(15));
            let first = _mm256_mullo_epi16(first, _mm256_set1_epi16(0x0101));
            let red_green = _mm256_add_epi8(
                first,
                _mm256_setr_epi8(
                    0, 3, 0, 3, 0, 3, 0, 3, 1, 4, 1, 4, 1, 4, 1, 4, 0, 3, 0, 3, 0, 3, 0, 3, 1, 4, 1, 4, 1, 4, 1, 4,
                ),
            );
            // The upper half of each lane is not used.
            let blue = _mm256_add_epi8(red_green, _mm256_set1_epi8(2));
            let planes = _mm256_packus_epi16(weights.blended(&rows, red_green), weights.blended(&rows, blue));
            let join = _mm256_setr_epi8(
                0, 4, 8, 1, 5, 9, 2, 6, 10, 3, 7, 11, -1, -1, -1, -1, 0, 4, 8, 1, 5, 9, 2, 6, 10, 3, 7, 11, -1, -1, -1, -1,
            );
            let joined = _mm256_shuffle_epi8(planes, join);
            let joined = _mm256_permutevar8x32_epi32(joined, _mm256_setr_epi32(0, 1, 2, 4, 5, 6, 7, 7));
            let (low, high) = out.as_flattened_mut().split_at_mut(WINDOW);
            low.copy_from_slice(&bytemuck::cast::<__m128i, [u8; 16]>(_mm256_castsi256_si128(joined)));
            high.copy_from_slice(&_mm256_extract_epi64::<2>(joined).to_ne_bytes());
            true
        }
    }

    struct Weights {
        /// Bytes (32−fx, fx).
        across: __m256i,
        /// Words 512 fy.
        down: __m256i,
        /// All bits set in the words of pixels between the second and the third row.
        lower: __m256i,
    }

    impl Weights {
        /// The bytes of each row that `order` picks, pairs of neighbours, blended: a word for each pair.
        #[inline]
        #[target_feature(enable = "avx2")]
        fn blended(&self, rows: &[__m256i; 3], order: __m256i) -> __m256i {
            let [first, second, third] = [
                _mm256_maddubs_epi16(_mm256_shuffle_epi8(rows[0], order), self.across),
                _mm256_maddubs_epi16(_mm256_shuffle_epi8(rows[1], order), self.across),
                _mm256_maddubs_epi16(_mm256_shuffle_epi8(rows[2], order), self.across),
            ];
            let upper = _mm256_blendv_epi8(first, second, self.lower);
            let lower = _mm256_blendv_epi8(second, third, self.lower);
            let difference = _mm256_slli_epi16::<2>(_mm256_sub_epi16(lower, upper));
            let down = _mm256_mulhi_epi16(difference, self.down);
            let sum = _mm256_add_epi16(_mm256_add_epi16(upper, _mm256_set1_epi16(16)), down);
            _mm256_srli_epi16::<5>(sum)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::buffer::{Image, Rgb8};
    use crate::image::remap::{Interpolation, RemapTable, Row, blend, pixel_at};
    use rand::{RngExt as _, SeedableRng as _};

    const SIZE: (usize, usize) = (150, 90);

    fn noise() -> Image<Rgb8> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let data = (0..SIZE.0 * SIZE.1).map(|_| rng.random()).collect();
        Image::from_vec(SIZE.0, SIZE.1, data).unwrap()
    }

    /// Whether the table's octets give the pixels that its places ask for, and the share of octets that fit.
    fn share_of_fitting(source_of: impl Fn(f64, f64) -> (f64, f64) + Sync) -> f64 {
        let source = noise();
        let table = RemapTable::new((157, 90), SIZE, |x, y| Some(source_of(x as f64, y as f64))).unwrap();
        let mut out = Image::filled(0, 0, [0; 3]);
        table.remap_rgb(&source, &mut out, Interpolation::Bilinear).unwrap();
        let (mut fitting, mut all) = (0, 0);
        for y in 0..90 {
            let row: Row<'_> = table.row(y);
            all += row.octets.len();
            fitting += row.octets.iter().filter(|octet| octet.corners[0] != NOWHERE).count();
            for x in 0..157 {
                let expected = table.place(x, y).map_or([0; 3], |p| {
                    let at = |dx, dy| pixel_at(&source, p.x + dx, p.y + dy).unwrap_or([0; 3]);
                    let four = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
                    std::array::from_fn(|c| blend(four.map(|pixel| pixel[c]), u32::from(p.fx), u32::from(p.fy)))
                });
                assert_eq!(out.at(x, y), expected, "({x}, {y})");
            }
        }
        f64::from(fitting as u32) / f64::from(all as u32)
    }

    #[test]
    fn octets_give_what_the_plain_formula_gives_and_most_of_them_fit() {
        // Enlarged; turned by a few degrees; mirrored; a barrel.
        assert!(share_of_fitting(|x, y| (0.8 * x + 9.1, 0.7 * y + 3.3)) > 0.9);
        assert!(share_of_fitting(|x, y| (0.9 * x + 0.12 * y + 1.3, 0.9 * y - 0.12 * x + 12.7)) > 0.9);
        assert!(share_of_fitting(|x, y| (140.4 - 0.9 * x, 0.9 * y + 0.1 * x)) > 0.9);
        let barrel = |x: f64, y: f64| {
            let (u, v) = ((x - 75.0) / 100.0, (y - 45.0) / 100.0);
            let k = 1.0 - 0.3 * (u * u + v * v);
            (75.0 + 100.0 * k * u, 45.0 + 100.0 * k * v)
        };
        assert!(share_of_fitting(barrel) > 0.85);
    }

    #[test]
    fn what_does_not_fit_is_left_to_the_other_kernel() {
        assert_eq!(share_of_fitting(|x, y| (1.6 * x, y)), 0.0);
        assert_eq!(share_of_fitting(|x, y| (0.5 * x + y, 0.7 * x + 0.1 * y)), 0.0);
        assert_eq!(share_of_fitting(|x, y| (x + 200.0, y)), 0.0);
    }
}
