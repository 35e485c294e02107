//! Runs a pixel kernel compiled for the widest vector unit the machine has.
//!
//! A kernel is plain safe code; [`run`] holds a second copy of it compiled for AVX2, where the compiler finds the byte
//! shuffles that split and join interleaved colors. Both copies do the same integer arithmetic.

/// Work on pixels. `run` must be `#[inline(always)]`, or the wide copy stays narrow.
pub trait Kernel {
    /// Do it.
    fn run(self);
}

/// Run `kernel` with the widest instructions at hand.
#[inline]
pub fn run<K: Kernel>(kernel: K) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor was just asked whether it has AVX2; the function needs nothing else.
        #[expect(unsafe_code, reason = "the call of a target-feature function; measured 2 to 4 times faster")]
        unsafe {
            run_avx2(kernel);
        }
        return;
    }
    kernel.run();
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn run_avx2<K: Kernel>(kernel: K) {
    kernel.run();
}

/// Ask for the memory of an item that will soon be read, and go on without waiting for it; nothing happens where there is none.
///
/// Looking up a few pixels in each of many pictures is bound by the time of one access to memory after the other.
#[inline(always)]
pub fn fetch<T>(items: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(item) = items.get(index) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint that reads and changes nothing; the address is an item's.
        #[expect(
            unsafe_code,
            reason = "there is no safe way to ask ahead; choosing views took 7.0 instead of 10.5 ms a frame"
        )]
        unsafe {
            _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(item).cast());
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, index);
}

/// Rounded to the nearest level, ties to even: added to 2²³ a float keeps its integer in the low bits. A plain conversion
/// saturates, for which there is no vector instruction.
#[inline(always)]
pub fn byte_from(value: f32) -> u8 {
    const INTEGER_BITS: f32 = 8_388_608.0;
    (value.clamp(0.0, 255.0) + INTEGER_BITS).to_bits() as u8
}
