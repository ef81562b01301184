//! Products on register tiles: every thread sums a tile of the output in registers, from stages in shared memory.
// M rows, N columns, K terms of a sum; U units (threads) of a cube (workgroup)

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::load::{Four, Lines, Side, load_four};
use crate::products::epilogue::write_four;
use crate::products::product_kind::{ProductKind, Sizes, cube_tile};

/// Tile of a cube and of a unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct RegisterTile {
    /// Rows, columns and terms of a stage: multiples of four.
    pub stage: [usize; 3],
    /// Rows and columns of a unit: multiples of four.
    pub unit: [usize; 2],
}

impl RegisterTile {
    /// Returns the columns and rows of units.
    pub(crate) fn units(self) -> [usize; 2] {
        [self.stage[1] / self.unit[1], self.stage[0] / self.unit[0]]
    }

    pub(crate) fn num_units(self) -> usize {
        let [x, y] = self.units();
        x * y
    }
}

/// An operand's part of a stage, `[terms][side]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct StagePart {
    /// The terms lie side by side in the buffer.
    pub(crate) terms_inner: bool,
    pub(crate) side: usize,
    pub(crate) terms: usize,
    pub(crate) units: usize,
}

impl StagePart {
    /// Vectors that a unit copies at once: one along the side (M or N), or a block of 4 x 4 values that it transposes.
    fn block(self) -> usize {
        if self.terms_inner { 4 } else { 1 }
    }

    fn blocks(self) -> usize {
        self.side * self.terms / 4 / self.block()
    }

    /// Vectors of a unit.
    pub(crate) fn fetches(self) -> usize {
        self.blocks().div_ceil(self.units) * self.block()
    }

    /// Vectors between two terms.
    pub(crate) fn pitch(self) -> usize {
        self.side / 4 + 1
    }
}

/// Reads an operand's part of a stage into registers.
#[cube]
pub(crate) fn fetch<E: Numeric, V: Size>(
    to: &mut Array<Four<f32>>,
    from: &[Vector<E, V>],
    side: &Side,
    first_term: usize,
    term_limit: usize,
    #[comptime] part: StagePart,
) {
    let (blocks, block) = comptime!((part.blocks(), part.block()));
    #[unroll]
    for step in 0..blocks.div_ceil(part.units) {
        let index = UNIT_POS as usize + step * part.units;
        #[unroll]
        for j in 0..block {
            let mut values = Four::<f32>::new(0.0);
            if comptime!(blocks.is_multiple_of(part.units)) || index < blocks {
                values = if comptime!(part.terms_inner) {
                    let line = side.first + index / (part.terms / 4) * 4 + j;
                    let term = first_term + index % (part.terms / 4) * 4;
                    load_four::<E, V, f32>(from, side.start, side.stride, line, term, side.limit, term_limit)
                } else {
                    let first = side.first + index % (part.side / 4) * 4;
                    let term = first_term + index / (part.side / 4);
                    load_four::<E, V, f32>(from, side.start, side.stride, term, first, term_limit, side.limit)
                };
            }
            to[step * block + j] = values;
        }
    }
}

/// Writes the values that [`fetch`] read into a stage.
#[cube]
pub(crate) fn put(stage: &mut [Four<f32>], from: &Array<Four<f32>>, #[comptime] part: StagePart) {
    let blocks = comptime!(part.blocks());
    #[unroll]
    for step in 0..blocks.div_ceil(part.units) {
        let index = UNIT_POS as usize + step * part.units;
        if comptime!(blocks.is_multiple_of(part.units)) || index < blocks {
            if comptime!(part.terms_inner) {
                let column = index / (part.terms / 4);
                let term = index % (part.terms / 4) * 4;
                #[unroll]
                for k in 0..4usize {
                    let mut values = Four::<f32>::new(0.0);
                    #[unroll]
                    for j in 0..4usize {
                        values.insert(j, from[step * 4 + j].extract(k));
                    }
                    stage[(term + k) * part.pitch() + column] = values;
                }
            } else {
                stage[index / (part.side / 4) * part.pitch() + index % (part.side / 4)] = from[step];
            }
        }
    }
}

/// Computes `output = epilogue(lhs rhs)`. A cube computes a tile of a batch and of a split of the terms.
#[cube(launch_unchecked)]
pub(crate) fn register_product<A: Float, B: Float, O: Float, VA: Size, VB: Size, VO: Size>(
    lhs: &[Vector<A, VA>],
    rhs: &[Vector<B, VB>],
    bias: &[f32],
    residual: &[Vector<f32, VO>],
    output: &mut [Vector<O, VO>],
    lhs_lines: Lines,
    rhs_lines: Lines,
    sizes: Sizes,
    #[comptime] kind: ProductKind,
    #[comptime] tile: RegisterTile,
    #[define(A, B, O)] _types: [ElemType; 3],
) {
    let units = comptime!(tile.num_units());
    let units_x = comptime!(tile.units()[0]);
    let units_y = comptime!(tile.units()[1]);
    let m = comptime!(tile.stage[0]);
    let n = comptime!(tile.stage[1]);
    let k = comptime!(tile.stage[2]);
    let rows = comptime!(tile.unit[0]);
    let columns = comptime!(tile.unit[1]);

    let at = cube_tile(&lhs_lines, &rhs_lines, &sizes, m, n);
    let lhs_part = comptime!(StagePart { terms_inner: kind.terms_inner[0], side: m, terms: k, units });
    let rhs_part = comptime!(StagePart { terms_inner: kind.terms_inner[1], side: n, terms: k, units });
    let mut lhs_stage = Shared::<[Four<f32>]>::new_slice(comptime!(k * lhs_part.pitch()));
    let mut rhs_stage = Shared::<[Four<f32>]>::new_slice(comptime!(k * rhs_part.pitch()));
    let mut lhs_next = Array::<Four<f32>>::new(comptime!(lhs_part.fetches()));
    let mut rhs_next = Array::<Four<f32>>::new(comptime!(rhs_part.fetches()));

    let x = UNIT_POS as usize % units_x;
    let y = UNIT_POS as usize / units_x;
    let sums_len = comptime!(rows * columns / 4);
    let mut sums = Array::<Four<f32>>::new(sums_len);
    #[unroll]
    for i in 0..sums_len {
        sums[i] = Four::<f32>::new(0.0);
    }
    let mut a = Array::<Four<f32>>::new(comptime!(rows / 4));
    let mut b = Array::<Four<f32>>::new(comptime!(columns / 4));

    let mut term = at.first_term;
    fetch::<A, VA>(&mut lhs_next, lhs, &at.lhs, term, at.last_term, lhs_part);
    fetch::<B, VB>(&mut rhs_next, rhs, &at.rhs, term, at.last_term, rhs_part);
    while term < at.last_term {
        sync_cube();
        put(&mut lhs_stage, &lhs_next, lhs_part);
        put(&mut rhs_stage, &rhs_next, rhs_part);
        sync_cube();
        term += k;
        fetch::<A, VA>(&mut lhs_next, lhs, &at.lhs, term, at.last_term, lhs_part);
        fetch::<B, VB>(&mut rhs_next, rhs, &at.rhs, term, at.last_term, rhs_part);
        for t in 0..k {
            #[unroll]
            for i in 0..rows / 4 {
                a[i] = lhs_stage[t * comptime!(lhs_part.pitch()) + y + i * units_y];
            }
            #[unroll]
            for i in 0..columns / 4 {
                b[i] = rhs_stage[t * comptime!(rhs_part.pitch()) + x + i * units_x];
            }
            #[unroll]
            for i in 0..rows {
                let factor = Four::<f32>::new(a[i / 4].extract(i % 4));
                #[unroll]
                for j in 0..columns / 4 {
                    sums[i * (columns / 4) + j] = fma(factor, b[j], sums[i * (columns / 4) + j]);
                }
            }
        }
    }

    let start = CUBE_POS_Z as usize * sizes.rows * sizes.columns;
    #[unroll]
    for i in 0..rows {
        let row = at.lhs.first + (y + i / 4 * units_y) * 4 + i % 4;
        #[unroll]
        for j in 0..columns / 4 {
            let column = at.rhs.first + (x + j * units_x) * 4;
            let sum = sums[i * (columns / 4) + j];
            write_four::<O, VO>(
                output,
                bias,
                residual,
                sum,
                start,
                row,
                column,
                sizes.rows,
                sizes.columns,
                comptime!(kind.epilogue),
            );
        }
    }
}
