//! The bilinear kernels of [`crate::image::remap`]: a plain one, and one for AVX2.
//!
//! For one output pixel the AVX2 kernel puts the eight bytes from the upper row (two pixels and a bit) and the eight from the
//! lower row side by side, shuffles them to r₀₀ r₁₀ r₀₁ r₁₁ g₀₀ …, multiplies and adds neighbours with (32−fx, fx)
//! (`pmaddubsw`), then with (32−fy, fy) (`pmaddwd`): three exact sums in 1/1024. Two output pixels share a register.

use crate::image::buffer::{Image, Rgb8};
use crate::image::remap::{BLOCK, OUTSIDE, RowKernel, blend, pair, unpacked};

/// The fastest kernel for this machine.
pub(crate) fn row_kernel() -> RowKernel {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        return avx2::row;
    }
    row
}

/// One output row, any machine.
pub(crate) fn row(entries: &[u32], bases: &[u32], source: &Image<Rgb8>, out: &mut [Rgb8]) {
    for ((entries, out), base) in entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(bases) {
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
        __m256i, _mm_and_si128, _mm_cmpeq_epi32, _mm_movemask_epi8, _mm_or_si128, _mm_set_epi32, _mm_set1_epi32, _mm_slli_epi32,
        _mm_srli_epi32, _mm_sub_epi32, _mm256_add_epi32, _mm256_broadcastsi128_si256, _mm256_extract_epi64, _mm256_madd_epi16,
        _mm256_maddubs_epi16, _mm256_packus_epi16, _mm256_packus_epi32, _mm256_permutevar8x32_epi32, _mm256_set_epi64x,
        _mm256_set1_epi32, _mm256_setr_epi8, _mm256_setr_epi32, _mm256_shuffle_epi8, _mm256_srli_epi32,
    };

    use crate::image::buffer::{Image, Rgb8};
    use crate::image::remap::{BLOCK, unpacked};

    pub(super) fn row(entries: &[u32], bases: &[u32], source: &Image<Rgb8>, out: &mut [Rgb8]) {
        #[expect(unsafe_code, reason = "AVX2 makes the remap of a 1080p frame several times faster")]
        // SAFETY: `row_kernel` hands this function out only where the machine has AVX2.
        unsafe {
            row_avx2(entries, bases, source, out);
        }
    }

    #[target_feature(enable = "avx2")]
    fn row_avx2(entries: &[u32], bases: &[u32], source: &Image<Rgb8>, out: &mut [Rgb8]) {
        let bytes = source.as_bytes();
        // From the first byte of the upper left pixel to the last of the eight read below it.
        let reach = 3 * source.width() + 8;
        for ((entries, out), base) in entries.chunks(BLOCK).zip(out.chunks_mut(BLOCK)).zip(bases) {
            let (quads, rest) = entries.as_chunks::<4>();
            let (out_quads, out_rest) = out.as_chunks_mut::<4>();
            for (quad, out) in quads.iter().zip(out_quads) {
                *out = four(quad, *base, bytes, reach).unwrap_or_else(|| quad.map(|entry| super::pixel(entry, *base, source)));
            }
            for (entry, out) in rest.iter().zip(out_rest) {
                *out = super::pixel(*entry, *base, source);
            }
        }
    }

    /// `None` when one of the four lies outside.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn four(quad: &[u32; 4], base: u32, bytes: &[u8], reach: usize) -> Option<[Rgb8; 4]> {
        let entries = _mm_set_epi32(quad[3] as i32, quad[2] as i32, quad[1] as i32, quad[0] as i32);
        if _mm_movemask_epi8(_mm_cmpeq_epi32(entries, _mm_set1_epi32(-1))) != 0 {
            return None;
        }
        // Weights per 32 bits: bytes (32−fx, fx, 32−fx, fx), words (32−fy, fy).
        let (low_five, all) = (_mm_set1_epi32(31), _mm_set1_epi32(32));
        let (fx, fy) = (
            _mm_and_si128(entries, low_five),
            _mm_and_si128(_mm_srli_epi32::<5>(entries), low_five),
        );
        let across = _mm_or_si128(_mm_sub_epi32(all, fx), _mm_slli_epi32::<8>(fx));
        let across = _mm256_broadcastsi128_si256(_mm_or_si128(across, _mm_slli_epi32::<16>(across)));
        let down = _mm256_broadcastsi128_si256(_mm_or_si128(_mm_sub_epi32(all, fy), _mm_slli_epi32::<16>(fy)));
        let window = |entry: u32| {
            let at = 3 * unpacked(entry, base).0;
            let window = bytes.get(at..at + reach)?;
            Some((
                i64::from_le_bytes(*window.first_chunk::<8>()?),
                i64::from_le_bytes(*window.last_chunk::<8>()?),
            ))
        };
        let sums = |first: u32, second: u32, lanes: __m256i| {
            let ((top0, bottom0), (top1, bottom1)) = (window(first)?, window(second)?);
            let neighbours = _mm256_set_epi64x(bottom1, top1, bottom0, top0);
            let order = _mm256_setr_epi8(
                0, 3, 8, 11, 1, 4, 9, 12, 2, 5, 10, 13, -1, -1, -1, -1, 0, 3, 8, 11, 1, 4, 9, 12, 2, 5, 10, 13, -1, -1, -1, -1,
            );
            let ordered = _mm256_shuffle_epi8(neighbours, order);
            let rows = _mm256_maddubs_epi16(ordered, _mm256_permutevar8x32_epi32(across, lanes));
            let sums = _mm256_madd_epi16(rows, _mm256_permutevar8x32_epi32(down, lanes));
            Some(_mm256_srli_epi32::<10>(_mm256_add_epi32(sums, _mm256_set1_epi32(512))))
        };
        let even = sums(quad[0], quad[2], _mm256_setr_epi32(0, 0, 0, 0, 2, 2, 2, 2))?;
        let odd = sums(quad[1], quad[3], _mm256_setr_epi32(1, 1, 1, 1, 3, 3, 3, 3))?;
        // Lane 0 now holds pixels 0 and 1, lane 1 pixels 2 and 3, each r g b 0; then the zeros are squeezed out.
        let words = _mm256_packus_epi32(even, odd);
        let packed = _mm256_packus_epi16(words, words);
        let squeeze = _mm256_setr_epi8(
            0, 1, 2, 4, 5, 6, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, 0, 1, 2, 4, 5, 6, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1,
        );
        let squeezed = _mm256_shuffle_epi8(packed, squeeze);
        let left = _mm256_extract_epi64::<0>(squeezed) as u64;
        let right = _mm256_extract_epi64::<2>(squeezed) as u64;
        let mut pixels = [0_u8; 12];
        pixels[..8].copy_from_slice(&(left | right << 48).to_le_bytes());
        pixels[8..].copy_from_slice(&((right >> 16) as u32).to_le_bytes());
        Some(bytemuck::cast(pixels))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::remap::{Interpolation, RemapTable};
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
        row(&entries, &[5, 0, 70], &source, &mut plain);
        row_kernel()(&entries, &[5, 0, 70], &source, &mut fast);
        assert_eq!(plain, fast);
    }
}
