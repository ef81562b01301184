//! Pairs of bf16 values without instructions for them: a reference for tests, slow.

use half::bf16;

use crate::simd::vector::{MAX_LANES, Simd};

#[inline(always)]
pub(crate) fn pairs<S: Simd>(simd: S, first: S::V, second: S::V) -> S::V {
    let (first, second) = (array(simd, first), array(simd, second));
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| pair(first[lane], second[lane])))
}

#[inline(always)]
pub(crate) fn pairs_of_neighbours<S: Simd>(simd: S, first: S::V, second: S::V) -> S::V {
    let mut values = [0.0; 2 * MAX_LANES];
    values[..S::LANES].copy_from_slice(&array(simd, first)[..S::LANES]);
    values[S::LANES..2 * S::LANES].copy_from_slice(&array(simd, second)[..S::LANES]);
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| pair(values[2 * lane], values[2 * lane + 1])))
}

#[inline(always)]
pub(crate) fn dot_pairs<S: Simd>(simd: S, a: S::V, b: S::V, sum: S::V) -> S::V {
    let (a, b, sum) = (array(simd, a), array(simd, b), array(simd, sum));
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| {
        let ([a_first, a_second], [b_first, b_second]) = (values(a[lane]), values(b[lane]));
        sum[lane] + a_first * b_first + a_second * b_second
    }))
}

/// Rounds two values to bf16, ties to even, and packs their bits.
fn pair(first: f32, second: f32) -> f32 {
    let bits = |value| u32::from(bf16::from_f32(value).to_bits());
    f32::from_bits(bits(first) | bits(second) << 16)
}

fn values(pair: f32) -> [f32; 2] {
    [f32::from_bits(pair.to_bits() << 16), f32::from_bits(pair.to_bits() & 0xFFFF_0000)]
}

#[inline(always)]
fn array<S: Simd>(simd: S, vector: S::V) -> [f32; MAX_LANES] {
    let mut array = [0.0; MAX_LANES];
    // SAFETY: no vector is longer than the array.
    unsafe { simd.store(array.as_mut_ptr(), vector) };
    array
}
