//! Values that are kept in bf16, two in the place of an f32.

use std::iter::once;

use rayon::prelude::*;

use crate::primitives::packing::pack_rows;
use crate::primitives::partition::PIECE;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Bf16, Operands, Simd};

/// Rounds values to bf16, ties to even. Entry `i` of `to` has the bits of value `2 i`, and above them those of value `2 i + 1`;
/// behind an odd number of values follows zero.
pub fn pack_bf16(set: InstructionSet, values: &[f32], to: &mut [f32]) {
    assert_eq!(to.len(), values.len().div_ceil(2), "one entry per pair");
    let pieces = values.par_chunks(2 * PIECE).zip(to.par_chunks_mut(PIECE));
    pieces.for_each(|(values, to)| set.run(Pack { values, to }));
}

/// Returns what [`pack_bf16`] packed.
pub fn unpack_bf16(packed: &[f32], to: &mut [f32]) {
    assert_eq!(packed.len(), to.len().div_ceil(2), "one entry per pair");
    packed.par_chunks(PIECE).zip(to.par_chunks_mut(2 * PIECE)).for_each(|(packed, to)| {
        let (pairs, last) = to.as_chunks_mut::<2>();
        for (to, pair) in pairs.iter_mut().zip(packed) {
            let bits = pair.to_bits();
            *to = [f32::from_bits(bits << 16), f32::from_bits(bits & 0xffff_0000)];
        }
        if let ([to], Some(pair)) = (last, packed.last()) {
            *to = f32::from_bits(pair.to_bits() << 16);
        }
    });
}

struct Pack<'a> {
    values: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for Pack<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        pack_rows::<S, Bf16>(simd, once(self.values), self.to.len(), self.to);
    }
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::testing::random;

    #[test]
    fn values_return_rounded_to_bf16() {
        for count in [0, 1, 2, 31, 33, 2 * PIECE + 1, 5 * PIECE] {
            let mut values = random(count, 1);
            for (value, special) in values.iter_mut().zip([f32::INFINITY, f32::NAN, -0.0, f32::MAX, 1e-40]) {
                *value = special;
            }
            for set in InstructionSet::available() {
                let mut packed = vec![f32::NAN; count.div_ceil(2)];
                pack_bf16(set, &values, &mut packed);
                let mut unpacked = vec![f32::NAN; count];
                unpack_bf16(&packed, &mut unpacked);
                for (&got, &value) in unpacked.iter().zip(&values) {
                    // The instruction flushes values below the normal ones to zero.
                    let is_flushed = got == 0.0 && value.abs() < f32::MIN_POSITIVE;
                    let is_equal = got.to_bits() == bf16::from_f32(value).to_f32().to_bits();
                    assert!(is_equal || is_flushed || got.is_nan() && value.is_nan(), "{value} gives {got}, {set:?}");
                }
            }
        }
    }
}
