//! The bilinear kernels of [`crate::image::remap`]: a plain one, and one for AVX2.
//!
//! For one output pixel the AVX2 kernel puts the eight bytes from the upper row (two pixels and a bit) and the eight from the
//! lower row side by side, shuffles them to r₀₀ r₁₀ r₀₁ r₁₁ g₀₀ …, multiplies and adds neighbours with (32−fx, fx)
//! (`pmaddubsw`), then with (32−fy, fy) (`pmaddwd`): three exact sums in 1/1024. Two output pixels share a register. It takes any map;
//! where eight pixels lie as a lens has them, [`crate::image::remap_octets`] is half as fast again and goes first.

use crate::image::buffer::{Image, Rgb8};
use crate::image::remap::{BLOCK, OUTSIDE, Row, blend, pair, unpacked};

/// Fills one output row from what the table says about it and the source.
pub(crate) type RowKernel = fn(&Row<'_>, &Image<Rgb8>, &mut [Rgb8]);

/// The fastest kernel for this machine.
pub(crate) fn row_kernel() -> RowKernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return avx2::row;
    }
    row
}

/// One output row, any machine.
fn row(row: &Row<'_>, source: &Image<Rgb8>, out: &mut [Rgb8]) {
    for ((entries, out), base) in row.entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(row.bases) {
        for (entry, out) in entries.iter().zip(out) {
            *out = pixel(*entry, *base, source);
        }
    }
}

#[inline(always)]
fn pixel(entry: u32, base: u32, source: &Image<Rgb8>) -> Rgb8 {
    if entry == OUTSIDE {
        return [0; 3];
    }
    let (at, fx, fy) = unpacked(entry, base);
    let (Some([a, b]), Some([c, d])) = (pair(source.pixels(), at), pair(source.pixels(), at + source.width())) else {
        return [0; 3];
    };
    [0, 1, 2].map(|k| blend([a[k], b[k], c[k], d[k]], fx, fy))
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{
        __m128i, __m256i, _mm_blend_epi32, _mm_cvtsi64_si128, _mm_set1_epi64x, _mm256_add_epi32, _mm256_and_si256,
        _mm256_andnot_si256, _mm256_blend_epi32, _mm256_broadcastsi128_si256, _mm256_castsi128_si256, _mm256_cmpeq_epi32,
        _mm256_extract_epi64, _mm256_madd_epi16, _mm256_maddubs_epi16, _mm256_max_epu32, _mm256_movemask_epi8, _mm256_or_si256,
        _mm256_packus_epi16, _mm256_packus_epi32, _mm256_permutevar8x32_epi32, _mm256_set1_epi32, _mm256_setr_epi8,
        _mm256_setr_epi32, _mm256_setzero_si256, _mm256_shuffle_epi8, _mm256_shuffle_epi32, _mm256_slli_epi32, _mm256_srli_epi32,
        _mm256_sub_epi32,
    };

    use crate::image::buffer::{Image, Rgb8};
    use crate::image::remap::{BLOCK, FRACTION_BITS, Row};
    use crate::image::remap_octets::EIGHT;
    use crate::image::remap_octets::avx2::Rows;

    pub(super) fn row(row: &Row<'_>, source: &Image<Rgb8>, out: &mut [Rgb8]) {
        #[expect(unsafe_code, reason = "AVX2 makes the remap of a 1080p frame several times faster")]
        // SAFETY: `row_kernel` hands this function out only where the machine has AVX2.
        unsafe {
            row_avx2(row, source, out);
        }
    }

    #[target_feature(enable = "avx2")]
    fn row_avx2(row: &Row<'_>, source: &Image<Rgb8>, out: &mut [Rgb8]) {
        let stride = 3 * source.width();
        let rows = Rows::new(source.as_bytes(), stride);
        let mut smooth = row.octets.chunks(BLOCK / EIGHT);
        for ((entries, out), base) in row.entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(row.bases) {
            let (octets, rest) = entries.as_chunks::<EIGHT>();
            let (out_octets, out_rest) = out.as_chunks_mut::<EIGHT>();
            let smooth = smooth.next().unwrap_or(&[]);
            let mut block = None;
            for ((octet, smooth), out) in octets.iter().zip(smooth).zip(out_octets) {
                if let Some(rows) = &rows
                    && smooth.fill(rows, out)
                {
                    continue;
                }
                if block.is_none() {
                    let from_base = source.as_bytes().get(3 * *base as usize..).unwrap_or(&[]);
                    block = Block::new(octets, from_base, stride);
                }
                match &block {
                    Some(block) if all_inside(octet) => block.eight(octet, out),
                    _ => {
                        for (entry, out) in octet.iter().zip(out) {
                            *out = super::pixel(*entry, *base, source);
                        }
                    }
                }
            }
            for (entry, out) in rest.iter().zip(out_rest) {
                *out = super::pixel(*entry, *base, source);
            }
        }
    }

    /// The source, seen from the base of a block of output pixels.
    struct Block<'a> {
        /// From the base on.
        upper: &'a [u8],
        /// From one row below the base on.
        lower: &'a [u8],
        /// The largest byte offset that may be read from.
        last: u32,
    }

    impl<'a> Block<'a> {
        /// `None` unless eight bytes can be read at every entry and one row below it.
        #[target_feature(enable = "avx2")]
        fn new(octets: &[[u32; 8]], from_base: &'a [u8], stride: usize) -> Option<Self> {
            let largest = octets.iter().fold(_mm256_setzero_si256(), |largest, octet| {
                let entries = bytemuck::cast::<[u32; 8], __m256i>(*octet);
                _mm256_max_epu32(largest, _mm256_andnot_si256(outside(entries), entries))
            });
            let last = bytemuck::cast::<__m256i, [u32; 8]>(largest).into_iter().max()?;
            let last = 3 * (last >> FRACTION_BITS);
            let lower = from_base.get(stride..)?;
            (last as usize + 8 <= lower.len()).then_some(Self {
                upper: from_base,
                lower,
                last,
            })
        }

        /// Eight pixels, all of them inside.
        #[inline]
        #[target_feature(enable = "avx2")]
        fn eight(&self, octet: &[u32; 8], out: &mut [Rgb8; 8]) {
            let entries = bytemuck::cast::<[u32; 8], __m256i>(*octet);
            let pixels = _mm256_srli_epi32::<{ FRACTION_BITS as i32 }>(entries);
            let offsets = bytemuck::cast::<__m256i, [u32; 8]>(_mm256_add_epi32(pixels, _mm256_add_epi32(pixels, pixels)));
            // Weights per 32 bits: bytes (32−fx, fx, 32−fx, fx), words (32−fy, fy).
            let (low_five, all) = (_mm256_set1_epi32(31), _mm256_set1_epi32(32));
            let fx = _mm256_and_si256(entries, low_five);
            let fy = _mm256_and_si256(_mm256_srli_epi32::<5>(entries), low_five);
            let across = _mm256_or_si256(_mm256_sub_epi32(all, fx), _mm256_slli_epi32::<8>(fx));
            let across = _mm256_or_si256(across, _mm256_slli_epi32::<16>(across));
            let down = _mm256_or_si256(_mm256_sub_epi32(all, fy), _mm256_slli_epi32::<16>(fy));
            // Lane 0 holds pixels 0 to 3, lane 1 pixels 4 to 7, each r g b 0; then the zeros are squeezed out.
            let first = _mm256_packus_epi32(
                self.pair::<0x00>([offsets[0], offsets[4]], across, down),
                self.pair::<0x55>([offsets[1], offsets[5]], across, down),
            );
            let second = _mm256_packus_epi32(
                self.pair::<0xaa>([offsets[2], offsets[6]], across, down),
                self.pair::<0xff>([offsets[3], offsets[7]], across, down),
            );
            let squeeze = _mm256_setr_epi8(
                0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1, 0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, -1, -1, -1, -1,
            );
            let squeezed = _mm256_shuffle_epi8(_mm256_packus_epi16(first, second), squeeze);
            let joined = _mm256_permutevar8x32_epi32(squeezed, _mm256_setr_epi32(0, 1, 2, 4, 5, 6, 7, 7));
            *out = bytemuck::cast::<[i64; 3], [Rgb8; 8]>([
                _mm256_extract_epi64::<0>(joined),
                _mm256_extract_epi64::<1>(joined),
                _mm256_extract_epi64::<2>(joined),
            ]);
        }

        /// The colors of two pixels, 32 bits a channel, one in each lane; `WHICH` picks their weights in `across` and `down`.
        #[inline]
        #[target_feature(enable = "avx2")]
        fn pair<const WHICH: i32>(&self, [left, right]: [u32; 2], across: __m256i, down: __m256i) -> __m256i {
            let neighbours = _mm256_blend_epi32::<0xf0>(
                _mm256_castsi128_si256(self.window(left)),
                _mm256_broadcastsi128_si256(self.window(right)),
            );
            let order = _mm256_setr_epi8(
                0, 3, 8, 11, 1, 4, 9, 12, 2, 5, 10, 13, -1, -1, -1, -1, 0, 3, 8, 11, 1, 4, 9, 12, 2, 5, 10, 13, -1, -1, -1, -1,
            );
            let ordered = _mm256_shuffle_epi8(neighbours, order);
            let rows = _mm256_maddubs_epi16(ordered, _mm256_shuffle_epi32::<WHICH>(across));
            let sums = _mm256_madd_epi16(rows, _mm256_shuffle_epi32::<WHICH>(down));
            _mm256_srli_epi32::<10>(_mm256_add_epi32(sums, _mm256_set1_epi32(512)))
        }

        /// Eight bytes of the upper row (two pixels and a bit), then eight of the lower.
        #[inline]
        #[target_feature(enable = "avx2")]
        fn window(&self, offset: u32) -> __m128i {
            debug_assert!(offset <= self.last);
            let at = offset as usize;
            #[expect(unsafe_code, reason = "checks of single reads take a third of the time of a remap")]
            // SAFETY: no entry of the block has a larger offset than `last`, and `new` found eight bytes after it in `lower`, which
            // is the end of `upper`.
            let (upper, lower) = unsafe {
                (
                    self.upper.as_ptr().add(at).cast::<i64>().read_unaligned(),
                    self.lower.as_ptr().add(at).cast::<i64>().read_unaligned(),
                )
            };
            _mm_blend_epi32::<0b1100>(_mm_cvtsi64_si128(upper), _mm_set1_epi64x(lower))
        }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn all_inside(octet: &[u32; 8]) -> bool {
        _mm256_movemask_epi8(outside(bytemuck::cast::<[u32; 8], __m256i>(*octet))) == 0
    }

    /// All bits set in each entry that says outside.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn outside(entries: __m256i) -> __m256i {
        _mm256_cmpeq_epi32(entries, _mm256_set1_epi32(-1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::remap::{Interpolation, RemapTable};
    use crate::image::remap_octets::{EIGHT, Octet};
    use rand::{RngExt as _, SeedableRng as _};

    fn noise(width: usize, height: usize, seed: u64) -> Image<Rgb8> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let data = (0..width * height).map(|_| rng.random::<Rgb8>()).collect();
        Image::from_vec(width, height, data).unwrap()
    }

    /// The plainest possible: f64, at the position that the table says.
    fn reference(table: &RemapTable, source: &Image<Rgb8>, x: usize, y: usize) -> [f64; 3] {
        let Some((sx, sy)) = table.position(x, y) else {
            return [0.0; 3];
        };
        let at = |x: f64, y: f64, c: usize| {
            if x < 0.0 || y < 0.0 || x >= source.width() as f64 || y >= source.height() as f64 {
                0.0
            } else {
                f64::from(source.at(x as usize, y as usize)[c])
            }
        };
        let (x0, y0) = (sx.floor(), sy.floor());
        let (u, v) = (sx - x0, sy - y0);
        [0, 1, 2].map(|c| {
            (at(x0, y0, c) * (1.0 - u) + at(x0 + 1.0, y0, c) * u) * (1.0 - v)
                + (at(x0, y0 + 1.0, c) * (1.0 - u) + at(x0 + 1.0, y0 + 1.0, c) * u) * v
        })
    }

    #[test]
    fn agrees_with_the_plain_twin() {
        for (seed, (w, h)) in [(67, 41), (128, 64), (3, 3), (1, 5), (2, 2), (200, 9)]
            .into_iter()
            .enumerate()
        {
            let source = noise(w, h, seed as u64);
            let table = RemapTable::new((w + 3, h), (w, h), |x, y| {
                let (x, y) = (x as f64, y as f64);
                Some((x * 1.03 - 1.7 + 0.01 * y, y * 1.1 - 0.9 - 0.004 * x))
            })
            .unwrap();
            let mut out = Image::filled(0, 0, [0; 3]);
            table.remap_rgb(&source, &mut out, Interpolation::Bilinear).unwrap();
            for y in 0..h {
                for x in 0..w + 3 {
                    let expected = reference(&table, &source, x, y);
                    for (found, expected) in out.at(x, y).iter().zip(expected) {
                        let difference = (f64::from(*found) - expected).abs();
                        assert!(difference <= 0.5, "{w}x{h} ({x}, {y}): {difference}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_plain_and_the_fast_kernel_are_equal() {
        let source = noise(131, 57, 9);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let entries: Vec<u32> = (0..131)
            .map(|_| {
                if rng.random_bool(0.1) {
                    OUTSIDE
                } else {
                    rng.random_range(0..131 * 55) << 10 | rng.random_range(0..1024)
                }
            })
            .collect();
        let (mut plain, mut fast) = (vec![[1; 3]; 131], vec![[2; 3]; 131]);
        let nowhere = Octet::new(&[None; EIGHT], (131, 57), |_| true);
        let what = Row {
            entries: &entries,
            bases: &[5, 0, 70],
            octets: &[nowhere; 131 / EIGHT],
        };
        row(&what, &source, &mut plain);
        row_kernel()(&what, &source, &mut fast);
        assert_eq!(plain, fast);
    }
}
