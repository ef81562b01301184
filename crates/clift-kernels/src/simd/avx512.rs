//! AVX-512 vectors.
#![expect(clippy::undocumented_unsafe_blocks, reason = "a value of `Avx512` proves that the processor has AVX-512")]

use crate::simd::vector::{Simd, Tile, binary_intrinsics};

#[allow(clippy::wildcard_imports, reason = "names of intrinsics have a prefix; Clippy exempts tests")]
use std::arch::x86_64::*;

/// AVX-512: 16 lanes, 32 registers.
#[derive(Clone, Copy, Debug)]
pub struct Avx512(());

impl Avx512 {
    /// Creates the proof that the processor has the instructions.
    ///
    /// # Safety
    /// The processor must have AVX-512 F, VL, BW and DQ.
    pub unsafe fn new() -> Self {
        Self(())
    }
}

impl Simd for Avx512 {
    const LANES: usize = 16;
    const TILE_ROWS: usize = 12;
    const TILE_VECTORS: usize = 2;
    type V = __m512;

    #[inline(always)]
    fn splat(self, value: f32) -> __m512 {
        unsafe { _mm512_set1_ps(value) }
    }
    #[inline(always)]
    unsafe fn load(self, from: *const f32) -> __m512 {
        unsafe { _mm512_loadu_ps(from) }
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32, value: __m512) {
        unsafe { _mm512_storeu_ps(to, value) }
    }
    binary_intrinsics! {
        add = _mm512_add_ps, sub = _mm512_sub_ps, mul = _mm512_mul_ps,
        div = _mm512_div_ps, max = _mm512_max_ps, min = _mm512_min_ps,
    }
    #[inline(always)]
    fn mul_add(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn select_negative(self, condition: __m512, yes: __m512, no: __m512) -> __m512 {
        unsafe {
            let negative = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(condition, _mm512_setzero_ps());
            _mm512_mask_blend_ps(negative, no, yes)
        }
    }
    #[inline(always)]
    fn round(self, a: __m512) -> __m512 {
        unsafe { _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a) }
    }
    #[inline(always)]
    fn scale_by_power(self, a: __m512, n: __m512) -> __m512 {
        unsafe { _mm512_scalef_ps(a, n) }
    }
    #[inline(always)]
    fn sum(self, a: __m512) -> f32 {
        unsafe { _mm512_reduce_add_ps(a) }
    }
    #[inline(always)]
    fn largest(self, a: __m512) -> f32 {
        unsafe { _mm512_reduce_max_ps(a) }
    }
    #[inline(always)]
    unsafe fn full_tile(self, tile: Tile) {
        unsafe { tile.run::<Self, 12, 2>(self) }
    }
}
