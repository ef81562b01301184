//! AVX-512 vectors, with and without bf16 and AMX.
#![expect(clippy::undocumented_unsafe_blocks, reason = "a value of `Avx512` proves that the processor has AVX-512")]

use crate::simd::amx;
use crate::simd::vector::{
    MAX_LANES, Simd, Tile, binary_intrinsics, emulated_dot_pairs, emulated_pairs, emulated_pairs_of_neighbours,
};

#[allow(clippy::wildcard_imports, reason = "names of intrinsics have a prefix; Clippy exempts tests")]
use std::arch::x86_64::*;

/// AVX-512: 16 lanes, 32 registers.
#[derive(Clone, Copy, Debug)]
pub struct Avx512<const BF16: bool, const AMX: bool>(());

impl<const BF16: bool, const AMX: bool> Avx512<BF16, AMX> {
    /// Creates the proof that the processor has AVX-512 F, VL, BW and DQ, BF16 if `BF16`, and that the tiles
    /// of this thread are configured if `AMX`.
    pub unsafe fn new() -> Self {
        Self(())
    }
}

/// Positions in two halves of 16 values each, alternating between the halves.
const ALTERNATING: [i16; 32] = {
    let mut order = [0; 32];
    let mut lane = 0;
    while lane < 16 {
        order[2 * lane as usize] = lane;
        order[2 * lane as usize + 1] = lane + 16;
        lane += 1;
    }
    order
};

impl<const BF16: bool, const AMX: bool> Simd for Avx512<BF16, AMX> {
    const LANES: usize = 16;
    const TILE_ROWS: usize = 12;
    const TILE_VECTORS: usize = 2;
    const HAS_MATRIX_TILES: bool = AMX;
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
    fn pairs(self, first: __m512, second: __m512) -> __m512 {
        if !BF16 {
            return emulated_pairs(self, first, second);
        }
        unsafe {
            let both = _mm512_cvtne2ps_pbh(second, first);
            let order = _mm512_loadu_epi16(ALTERNATING.as_ptr());
            let pairs = _mm512_permutexvar_epi16(order, std::mem::transmute::<__m512bh, __m512i>(both));
            _mm512_castsi512_ps(pairs)
        }
    }
    #[inline(always)]
    fn pairs_of_neighbours(self, first: __m512, second: __m512) -> __m512 {
        if !BF16 {
            return emulated_pairs_of_neighbours(self, first, second);
        }
        unsafe { std::mem::transmute::<__m512bh, __m512>(_mm512_cvtne2ps_pbh(second, first)) }
    }
    #[inline(always)]
    fn dot_pairs(self, a: __m512, b: __m512, sum: __m512) -> __m512 {
        if !BF16 {
            return emulated_dot_pairs(self, a, b, sum);
        }
        unsafe {
            let a = std::mem::transmute::<__m512, __m512bh>(a);
            _mm512_dpbf16_ps(sum, a, std::mem::transmute::<__m512, __m512bh>(b))
        }
    }
    #[inline(always)]
    unsafe fn multiply_tile(self, tile: Tile) {
        assert!(AMX, "only with matrix tiles");
        unsafe { amx::multiply_tile(tile) };
    }
    #[inline(always)]
    fn transpose(self, rows: &mut [__m512; MAX_LANES]) {
        const ORDERS: [[[i32; 16]; 2]; 4] =
            [exchanged_lanes(1), exchanged_lanes(2), exchanged_lanes(4), exchanged_lanes(8)];
        for (bit, orders) in ORDERS.iter().enumerate() {
            let [low, high] = [0, 1].map(|i| unsafe { _mm512_loadu_epi32(orders[i].as_ptr()) });
            let step = 1 << bit;
            for row in (0..16).filter(|row| row & step == 0) {
                let (a, b) = (rows[row], rows[row + step]);
                rows[row] = unsafe { _mm512_permutex2var_ps(a, low, b) };
                rows[row + step] = unsafe { _mm512_permutex2var_ps(a, high, b) };
            }
        }
    }
}

/// Lanes of two rows after a step of a transposition, those of the second row from 16 on: the rows, `step` apart, exchange
/// the lanes whose index differs from the row's in the bit `step`.
const fn exchanged_lanes(step: usize) -> [[i32; 16]; 2] {
    let mut orders = [[0; 16]; 2];
    let mut lane = 0;
    while lane < 16 {
        let other = (lane ^ step) as i32;
        orders[0][lane] = if lane & step == 0 { lane as i32 } else { 16 + other };
        orders[1][lane] = if lane & step == 0 { other } else { 16 + lane as i32 };
        lane += 1;
    }
    orders
}
