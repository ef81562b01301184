//! Launch arguments and compile-time parameters of the kernels of products.

use cubecl::prelude::*;

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
    pub(crate) lhs: OperandKind,
    pub(crate) rhs: OperandKind,
    pub(crate) epilogue: Epilogue,
}

/// Layout of an operand.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct OperandKind {
    /// The terms of a sum lie side by side.
    pub(crate) terms_inner: bool,
}

impl OperandKind {
    /// Returns the vectors of a stage of register tiles that a unit fetches.
    pub(crate) fn fetches(self, side: usize, terms: usize, units: usize) -> usize {
        let block = if self.terms_inner { 4 } else { 1 };
        (side * terms / 4 / block).div_ceil(units) * block
    }
}
