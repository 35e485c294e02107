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
