use rayon::prelude::*;

use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

/// Values a task works on: a piece of each slice that stays in the cache.
pub(crate) const PIECE: usize = 1 << 14;

/// `to = f(from)`, vector by vector.
pub(crate) trait Map: Copy + Sync {
    fn apply<S: Simd>(self, simd: S, from: S::V) -> S::V;
}

/// `to = f(from, to)`, vector by vector.
pub(crate) trait Combine: Copy + Sync {
    fn apply<S: Simd>(self, simd: S, from: S::V, to: S::V) -> S::V;
}

pub(crate) fn map(set: InstructionSet, function: impl Map, from: &[f32], to: &mut [f32]) {
    assert_eq!(from.len(), to.len(), "one value for one value");
    let pieces = from.par_chunks(PIECE).zip(to.par_chunks_mut(PIECE));
    pieces.for_each(|(from, to)| set.run(MapPiece { function, from, to }));
}

pub(crate) fn combine(set: InstructionSet, function: impl Combine, from: &[f32], to: &mut [f32]) {
    assert_eq!(from.len(), to.len(), "one value for one value");
    let pieces = from.par_chunks(PIECE).zip(to.par_chunks_mut(PIECE));
    pieces.for_each(|(from, to)| set.run(CombinePiece { function, from, to }));
}

struct MapPiece<'a, F> {
    function: F,
    from: &'a [f32],
    to: &'a mut [f32],
}

impl<F: Map> Kernel for MapPiece<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for (from, to) in self.from.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
            simd.write(to, self.function.apply(simd, simd.read(from)));
        }
    }
}

struct CombinePiece<'a, F> {
    function: F,
    from: &'a [f32],
    to: &'a mut [f32],
}

impl<F: Combine> Kernel for CombinePiece<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for (from, to) in self.from.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
            simd.write(to, self.function.apply(simd, simd.read(from), simd.read(to)));
        }
    }
}
