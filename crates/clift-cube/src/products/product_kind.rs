//! Launch arguments and compile-time parameters of the kernels of products.

use cubecl::prelude::*;

use crate::buffers::load::{Lines, Side};
use crate::products::epilogue::Epilogue;

/// Sizes of a product, and of the splits of its sums.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(crate) struct Sizes {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    pub(crate) terms: usize,
    pub(crate) splits: usize,
    pub(crate) split_terms: usize,
}

/// Compile-time parameters of a kernel of products.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct ProductKind {
    /// The terms of a sum lie side by side, in the left and the right operand.
    pub(crate) terms_inner: [bool; 2],
    pub(crate) epilogue: Epilogue,
}

/// The tile of a cube: of a batch and of a split of the terms.
#[derive(CubeType, Clone, Copy)]
pub(crate) struct CubeTile {
    pub(crate) lhs: Side,
    pub(crate) rhs: Side,
    pub(crate) first_term: usize,
    pub(crate) last_term: usize,
}

/// Returns the tile of the cube, of `m` rows and `n` columns.
#[cube]
pub(crate) fn cube_tile(
    lhs: &Lines,
    rhs: &Lines,
    sizes: &Sizes,
    #[comptime] m: usize,
    #[comptime] n: usize,
) -> CubeTile {
    let batch = CUBE_POS_Z as usize / sizes.splits;
    let first_term = CUBE_POS_Z as usize % sizes.splits * sizes.split_terms;
    CubeTile {
        lhs: Side {
            start: lhs.start + batch * lhs.batch_stride,
            stride: lhs.stride,
            first: CUBE_POS_Y as usize * m,
            limit: sizes.rows,
        },
        rhs: Side {
            start: rhs.start + batch * rhs.batch_stride,
            stride: rhs.stride,
            first: CUBE_POS_X as usize * n,
            limit: sizes.columns,
        },
        first_term,
        last_term: min(first_term + sizes.split_terms, sizes.terms),
    }
}
