//! Elementwise kernels, one vector at a time.

use rayon::prelude::*;

use crate::primitives::partition::PIECE;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

/// A function `to = f(from, to)` of vectors.
pub(crate) trait Elementwise: Copy + Sync {
    fn apply<S: Simd>(self, simd: S, from: S::V, to: S::V) -> S::V;
}

/// Computes `to = f(from, to)` for every value, in parallel.
pub(crate) fn apply(set: InstructionSet, function: impl Elementwise, from: &[f32], to: &mut [f32]) {
    assert_eq!(from.len(), to.len(), "slices of equal length");
    let pieces = from.par_chunks(PIECE).zip(to.par_chunks_mut(PIECE));
    pieces.for_each(|(from, to)| set.run(Piece { function, from, to }));
}

struct Piece<'a, F> {
    function: F,
    from: &'a [f32],
    to: &'a mut [f32],
}

impl<F: Elementwise> Kernel for Piece<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for (from, to) in self.from.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
            simd.write(to, self.function.apply(simd, simd.read(from), simd.read(to)));
        }
    }
}
