//! AVX2 and FMA vectors.
#![expect(clippy::undocumented_unsafe_blocks, reason = "a value of `Avx2` proves that the processor has AVX2 and FMA")]

use crate::simd::vector::{MAX_LANES, Simd, binary_intrinsics};

#[allow(clippy::wildcard_imports, reason = "names of intrinsics have a prefix; Clippy exempts tests")]
use std::arch::x86_64::*;

/// AVX2 with FMA: 8 lanes, 16 registers.
#[derive(Clone, Copy, Debug)]
pub struct Avx2(());

impl Avx2 {
    /// Creates the proof that the processor has AVX2 and FMA.
    pub unsafe fn new() -> Self {
        Self(())
    }
}

impl Simd for Avx2 {
    const LANES: usize = 8;
    const TILE_ROWS: usize = 6;
    const TILE_VECTORS: usize = 2;
    type V = __m256;

    #[inline(always)]
    fn splat(self, value: f32) -> __m256 {
        unsafe { _mm256_set1_ps(value) }
    }
    #[inline(always)]
    unsafe fn load(self, from: *const f32) -> __m256 {
        unsafe { _mm256_loadu_ps(from) }
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32, value: __m256) {
        unsafe { _mm256_storeu_ps(to, value) }
    }
    binary_intrinsics! {
        add = _mm256_add_ps, sub = _mm256_sub_ps, mul = _mm256_mul_ps,
        div = _mm256_div_ps, max = _mm256_max_ps, min = _mm256_min_ps,
    }
    #[inline(always)]
    fn mul_add(self, a: __m256, b: __m256, c: __m256) -> __m256 {
        unsafe { _mm256_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn select_negative(self, condition: __m256, yes: __m256, no: __m256) -> __m256 {
        unsafe {
            let negative = _mm256_cmp_ps::<_CMP_LT_OQ>(condition, _mm256_setzero_ps());
            _mm256_blendv_ps(no, yes, negative)
        }
    }
    #[inline(always)]
    fn round(self, a: __m256) -> __m256 {
        unsafe { _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a) }
    }
    #[inline(always)]
    fn scale_by_power(self, a: __m256, n: __m256) -> __m256 {
        unsafe {
            let exponent = _mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127));
            _mm256_mul_ps(a, _mm256_castsi256_ps(_mm256_slli_epi32::<23>(exponent)))
        }
    }
    #[inline(always)]
    fn sum(self, a: __m256) -> f32 {
        unsafe {
            let four = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
        }
    }
    #[inline(always)]
    fn largest(self, a: __m256) -> f32 {
        unsafe {
            let four = _mm_max_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
            let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_max_ss(two, _mm_movehdup_ps(two)))
        }
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [__m256; MAX_LANES]) {
        unsafe {
            for row in [0, 2, 4, 6] {
                let (a, b) = (rows[row], rows[row + 1]);
                rows[row] = _mm256_unpacklo_ps(a, b);
                rows[row + 1] = _mm256_unpackhi_ps(a, b);
            }
            for row in [0, 1, 4, 5] {
                let (a, b) = (_mm256_castps_pd(rows[row]), _mm256_castps_pd(rows[row + 2]));
                rows[row] = _mm256_castpd_ps(_mm256_unpacklo_pd(a, b));
                rows[row + 2] = _mm256_castpd_ps(_mm256_unpackhi_pd(a, b));
            }
            for row in [0, 1, 2, 3] {
                let (a, b) = (rows[row], rows[row + 4]);
                rows[row] = _mm256_permute2f128_ps::<0x20>(a, b);
                rows[row + 4] = _mm256_permute2f128_ps::<0x31>(a, b);
            }
        }
        rows.swap(1, 2);
        rows.swap(5, 6);
    }
}
