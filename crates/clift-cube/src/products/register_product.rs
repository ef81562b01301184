//! Products on register tiles: every thread sums a tile of the output in registers, from stages in shared memory.
// M rows, N columns, K terms of a sum; U units (threads) of a cube (workgroup)

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::load::{Four, Lines, load_four};
use crate::products::epilogue::write_four;
use crate::products::product_kind::{ProductKind, Sizes};

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

/// Reads an operand's part of a stage into registers. A group is four values along the side (M or N), or, where the terms
/// lie side by side, a block of four by four values.
#[cube]
pub(crate) fn fetch<E: Numeric, V: Size>(
    to: &mut Array<Four<f32>>,
    from: &[Vector<E, V>],
    start: usize,
    stride: usize,
    side: usize,
    term: usize,
    side_limit: usize,
    term_limit: usize,
    #[comptime] terms_inner: bool,
    #[comptime] stage_side: usize,
    #[comptime] stage_terms: usize,
    #[comptime] units: usize,
) {
    let block = comptime!(if terms_inner { 4 } else { 1 });
    let groups = comptime!(stage_side * stage_terms / 4 / block);
    #[unroll]
    for step in 0..groups.div_ceil(units) {
        let group = UNIT_POS as usize + step * units;
        #[unroll]
        for j in 0..block {
            let mut values = Four::<f32>::new(0.0);
            if comptime!(groups.is_multiple_of(units)) || group < groups {
                if comptime!(terms_inner) {
                    let side = side + group / (stage_terms / 4) * 4 + j;
                    let term = term + group % (stage_terms / 4) * 4;
                    values = load_four::<E, V, f32>(from, start, stride, side, term, side_limit, term_limit);
                } else {
                    let side = side + group % (stage_side / 4) * 4;
                    let term = term + group / (stage_side / 4);
                    values = load_four::<E, V, f32>(from, start, stride, term, side, term_limit, side_limit);
                }
            }
            to[step * block + j] = values;
        }
    }
}

/// Writes the values that [`fetch`] read into a stage `[terms][side]`.
#[cube]
pub(crate) fn put(
    stage: &mut [Four<f32>],
    from: &Array<Four<f32>>,
    #[comptime] terms_inner: bool,
    #[comptime] stage_side: usize,
    #[comptime] stage_terms: usize,
    #[comptime] units: usize,
) {
    let block = comptime!(if terms_inner { 4 } else { 1 });
    let groups = comptime!(stage_side * stage_terms / 4 / block);
    let pitch = comptime!(stage_side / 4 + 1);
    #[unroll]
    for step in 0..groups.div_ceil(units) {
        let group = UNIT_POS as usize + step * units;
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            if comptime!(terms_inner) {
                let column = group / (stage_terms / 4);
                let term = group % (stage_terms / 4) * 4;
                #[unroll]
                for k in 0..4usize {
                    let mut values = Four::<f32>::new(0.0);
                    #[unroll]
                    for j in 0..4usize {
                        values.insert(j, from[step * 4 + j].extract(k));
                    }
                    stage[(term + k) * pitch + column] = values;
                }
            } else {
                stage[group / (stage_side / 4) * pitch + group % (stage_side / 4)] = from[step];
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

    let batch = CUBE_POS_Z as usize / sizes.splits;
    let split = CUBE_POS_Z as usize % sizes.splits;
    let first_row = CUBE_POS_Y as usize * m;
    let first_column = CUBE_POS_X as usize * n;
    let first_term = split * sizes.split_terms;
    let last_term = min(first_term + sizes.split_terms, sizes.terms);
    let lhs_start = lhs_lines.start + batch * lhs_lines.batch_stride;
    let rhs_start = rhs_lines.start + batch * rhs_lines.batch_stride;

    let mut lhs_stage = Shared::<[Four<f32>]>::new_slice(comptime!(k * (m / 4 + 1)));
    let mut rhs_stage = Shared::<[Four<f32>]>::new_slice(comptime!(k * (n / 4 + 1)));
    let lhs_fetch = comptime!(kind.lhs.fetches(m, k, units));
    let rhs_fetch = comptime!(kind.rhs.fetches(n, k, units));
    let mut lhs_next = Array::<Four<f32>>::new(lhs_fetch);
    let mut rhs_next = Array::<Four<f32>>::new(rhs_fetch);
    let lhs_inner = comptime!(kind.lhs.terms_inner);
    let rhs_inner = comptime!(kind.rhs.terms_inner);

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

    fetch::<A, VA>(
        &mut lhs_next,
        lhs,
        lhs_start,
        lhs_lines.stride,
        first_row,
        first_term,
        sizes.rows,
        last_term,
        lhs_inner,
        m,
        k,
        units,
    );
    fetch::<B, VB>(
        &mut rhs_next,
        rhs,
        rhs_start,
        rhs_lines.stride,
        first_column,
        first_term,
        sizes.columns,
        last_term,
        rhs_inner,
        n,
        k,
        units,
    );
    let mut term = first_term;
    while term < last_term {
        sync_cube();
        put(&mut lhs_stage, &lhs_next, lhs_inner, m, k, units);
        put(&mut rhs_stage, &rhs_next, rhs_inner, n, k, units);
        sync_cube();
        term += k;
        fetch::<A, VA>(
            &mut lhs_next,
            lhs,
            lhs_start,
            lhs_lines.stride,
            first_row,
            term,
            sizes.rows,
            last_term,
            lhs_inner,
            m,
            k,
            units,
        );
        fetch::<B, VB>(
            &mut rhs_next,
            rhs,
            rhs_start,
            rhs_lines.stride,
            first_column,
            term,
            sizes.columns,
            last_term,
            rhs_inner,
            n,
            k,
            units,
        );
        for t in 0..k {
            #[unroll]
            for i in 0..rows / 4 {
                a[i] = lhs_stage[t * (m / 4 + 1) + y + i * units_y];
            }
            #[unroll]
            for i in 0..columns / 4 {
                b[i] = rhs_stage[t * (n / 4 + 1) + x + i * units_x];
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
        let row = first_row + (y + i / 4 * units_y) * 4 + i % 4;
        #[unroll]
        for j in 0..columns / 4 {
            let column = first_column + (x + j * units_x) * 4;
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
