//! Products on cooperative matrices: every plane (subgroup) multiplies f16 matrices of the hardware's shape, from stages in
//! shared memory, and sums in f32.
// M rows, N columns, K terms of a sum

use cubecl::cmma::{self, Matrix, MatrixIdent, MatrixLayout};
use cubecl::ir::ElemType;
use cubecl::prelude::*;
use half::f16;

use crate::adapter::MatrixShape;
use crate::buffers::load::{Four, Lines, load_four};
use crate::products::epilogue::write_four;
use crate::products::product_kind::{ProductKind, Sizes};

/// Padding of the lines of a stage, in values, so that lines begin in different banks.
pub(crate) const PAD: usize = 8;

/// Tile of a cube and of a plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MatrixTile {
    /// Shape of the matrices.
    pub shape: MatrixShape,
    /// Rows, columns and terms of a stage.
    pub stage: [usize; 3],
    /// Rows and columns of planes.
    pub planes: [usize; 2],
}

impl MatrixTile {
    /// Returns the rows and columns of matrices of a plane.
    pub(crate) fn matrices(self) -> [usize; 2] {
        [0, 1].map(|i| self.stage[i] / self.planes[i] / self.shape.sizes[i])
    }

    pub(crate) fn num_planes(self) -> usize {
        self.planes[0] * self.planes[1]
    }
}

/// Reads lines of an operand into registers.
#[cube]
pub(crate) fn fetch_lines<E: Numeric, V: Size>(
    to: &mut Array<Four<f16>>,
    from: &[Vector<E, V>],
    start: usize,
    stride: usize,
    first_line: usize,
    first_value: usize,
    line_limit: usize,
    value_limit: usize,
    #[comptime] lines: usize,
    #[comptime] values: usize,
    #[comptime] units: usize,
) {
    let groups = comptime!(lines * values / 4);
    #[unroll]
    for step in 0..groups.div_ceil(units) {
        let group = UNIT_POS as usize + step * units;
        let mut four = Four::<f16>::new(f16::new(0.0));
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            let line = first_line + group / (values / 4);
            let value = first_value + group % (values / 4) * 4;
            four = load_four::<E, V, f16>(from, start, stride, line, value, line_limit, value_limit);
        }
        to[step] = four;
    }
}

/// Reads an operand's part of a stage, as [`fetch_lines`].
#[cube]
fn fetch_operand<E: Numeric, V: Size>(
    to: &mut Array<Four<f16>>,
    from: &[Vector<E, V>],
    start: usize,
    stride: usize,
    side: usize,
    term: usize,
    side_limit: usize,
    term_limit: usize,
    #[comptime] terms_inner: bool,
    #[comptime] sides: usize,
    #[comptime] terms: usize,
    #[comptime] units: usize,
) {
    if comptime!(terms_inner) {
        fetch_lines::<E, V>(to, from, start, stride, side, term, side_limit, term_limit, sides, terms, units);
    } else {
        fetch_lines::<E, V>(to, from, start, stride, term, side, term_limit, side_limit, terms, sides, units);
    }
}

/// Writes the values that [`fetch_lines`] read into a stage.
#[cube]
pub(crate) fn put_lines(
    stage: &mut [Four<f16>],
    from: &Array<Four<f16>>,
    #[comptime] lines: usize,
    #[comptime] values: usize,
    #[comptime] units: usize,
) {
    let groups = comptime!(lines * values / 4);
    let pitch = comptime!((values + PAD) / 4);
    #[unroll]
    for step in 0..groups.div_ceil(units) {
        let group = UNIT_POS as usize + step * units;
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            stage[group / (values / 4) * pitch + group % (values / 4)] = from[step];
        }
    }
}

/// Operand of a product of matrices, and its layout in a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct StagedMatrix {
    pub(crate) ident: MatrixIdent,
    /// A line has the terms of a sum.
    pub(crate) terms_inner: bool,
    /// Values between two lines.
    pub(crate) pitch: usize,
    pub(crate) shape: MatrixShape,
}

impl StagedMatrix {
    fn layout(self) -> MatrixLayout {
        let is_lhs = self.ident == MatrixIdent::A;
        if is_lhs == self.terms_inner { MatrixLayout::RowMajor } else { MatrixLayout::ColMajor }
    }
}

/// Loads the matrix of a stage whose first value belongs to row or column `side` and to `term`.
#[cube]
pub(crate) fn load_matrix(
    stage: &[Four<f16>],
    side: usize,
    term: usize,
    #[comptime] staged: StagedMatrix,
) -> Matrix<f16> {
    let [m, n, k] = comptime!(staged.shape.sizes);
    // SAFETY: the matrix is loaded below.
    let mut matrix =
        unsafe { Matrix::<f16>::uninitialized(comptime!(staged.ident), m, n, k, comptime!(staged.layout())) };
    let first = if comptime!(staged.terms_inner) { side * staged.pitch + term } else { term * staged.pitch + side };
    cmma::load(&mut matrix, &stage[first / 4..stage.len()], comptime!(staged.pitch as u32));
    matrix
}

/// Computes `output = epilogue(lhs rhs)`. A cube computes a tile of a batch and of a split of the terms.
#[cube(launch_unchecked)]
pub(crate) fn matrix_product<A: Float, B: Float, O: Float, VA: Size, VB: Size, VO: Size>(
    lhs: &[Vector<A, VA>],
    rhs: &[Vector<B, VB>],
    bias: &[f32],
    residual: &[Vector<f32, VO>],
    output: &mut [Vector<O, VO>],
    lhs_lines: Lines,
    rhs_lines: Lines,
    sizes: Sizes,
    #[comptime] kind: ProductKind,
    #[comptime] tile: MatrixTile,
    #[define(A, B, O)] _types: [ElemType; 3],
) {
    let plane_units = comptime!(tile.shape.plane);
    let units = comptime!(tile.num_planes() * plane_units);
    let m = comptime!(tile.stage[0]);
    let n = comptime!(tile.stage[1]);
    let k = comptime!(tile.stage[2]);
    let sm = comptime!(tile.shape.sizes[0]);
    let sn = comptime!(tile.shape.sizes[1]);
    let sk = comptime!(tile.shape.sizes[2]);
    let rows = comptime!(tile.matrices()[0]);
    let columns = comptime!(tile.matrices()[1]);

    let batch = CUBE_POS_Z as usize / sizes.splits;
    let split = CUBE_POS_Z as usize % sizes.splits;
    let first_row = CUBE_POS_Y as usize * m;
    let first_column = CUBE_POS_X as usize * n;
    let first_term = split * sizes.split_terms;
    let last_term = min(first_term + sizes.split_terms, sizes.terms);
    let lhs_start = lhs_lines.start + batch * lhs_lines.batch_stride;
    let rhs_start = rhs_lines.start + batch * rhs_lines.batch_stride;

    // Lines and values of the stages.
    let lhs_inner = comptime!(kind.lhs.terms_inner);
    let rhs_inner = comptime!(kind.rhs.terms_inner);
    let (lhs_count, lhs_values) = comptime!(if lhs_inner { (m, k) } else { (k, m) });
    let (rhs_count, rhs_values) = comptime!(if rhs_inner { (n, k) } else { (k, n) });
    let lhs_pitch = comptime!(lhs_values + PAD);
    let rhs_pitch = comptime!(rhs_values + PAD);
    let mut lhs_stage = Shared::<[Four<f16>]>::new_slice(comptime!(lhs_count * lhs_pitch / 4));
    let mut rhs_stage = Shared::<[Four<f16>]>::new_slice(comptime!(rhs_count * rhs_pitch / 4));
    let lhs_staged =
        comptime!(StagedMatrix { ident: MatrixIdent::A, terms_inner: lhs_inner, pitch: lhs_pitch, shape: tile.shape });
    let rhs_staged =
        comptime!(StagedMatrix { ident: MatrixIdent::B, terms_inner: rhs_inner, pitch: rhs_pitch, shape: tile.shape });
    let mut lhs_next = Array::<Four<f16>>::new(comptime!((m * k / 4).div_ceil(units)));
    let mut rhs_next = Array::<Four<f16>>::new(comptime!((n * k / 4).div_ceil(units)));

    let plane = UNIT_POS as usize / plane_units;
    let lane = UNIT_POS as usize % plane_units;
    let plane_row = plane / comptime!(tile.planes[1]) * comptime!(rows * sm);
    let plane_column = plane % comptime!(tile.planes[1]) * comptime!(columns * sn);

    let mut sums = Sequence::<Matrix<f32>>::new();
    #[unroll]
    for _ in 0..comptime!(rows * columns) {
        sums.push(Matrix::<f32>::from_value(MatrixIdent::Accumulator, sm, sn, sk, MatrixLayout::Undefined, 0.0));
    }

    let mut term = first_term;
    fetch_operand::<A, VA>(
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
    fetch_operand::<B, VB>(
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
    while term < last_term {
        sync_cube();
        put_lines(&mut lhs_stage, &lhs_next, lhs_count, lhs_values, units);
        put_lines(&mut rhs_stage, &rhs_next, rhs_count, rhs_values, units);
        sync_cube();
        term += k;
        fetch_operand::<A, VA>(
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
        fetch_operand::<B, VB>(
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
        #[unroll]
        for t in 0..comptime!(k / sk) {
            let mut b = Sequence::<Matrix<f16>>::new();
            #[unroll]
            for j in 0..columns {
                b.push(load_matrix(&rhs_stage, plane_column + j * sn, t * sk, rhs_staged));
            }
            #[unroll]
            for i in 0..rows {
                let a = load_matrix(&lhs_stage, plane_row + i * sm, t * sk, lhs_staged);
                #[unroll]
                for j in 0..columns {
                    let sum = &sums[i * columns + j];
                    cmma::execute(&a, &b[j], sum, sum);
                }
            }
        }
    }

    // The layout of a matrix in registers is the driver's: the sums pass through shared memory.
    let mut scratch = Shared::<[Four<f32>]>::new_slice(comptime!(tile.num_planes() * sm * sn / 4));
    let first = plane * comptime!(sm * sn / 4);
    let start = CUBE_POS_Z as usize * sizes.rows * sizes.columns;
    #[unroll]
    for i in 0..rows {
        #[unroll]
        for j in 0..columns {
            cmma::store(
                &mut scratch[first..first + comptime!(sm * sn / 4)],
                &sums[i * columns + j],
                sn as u32,
                MatrixLayout::RowMajor,
            );
            sync_cube();
            #[unroll]
            for step in 0..comptime!((sm * sn / 4).div_ceil(plane_units)) {
                let four = lane + step * plane_units;
                let row = first_row + plane_row + i * sm + four / (sn / 4);
                let column = first_column + plane_column + j * sn + four % (sn / 4) * 4;
                write_four::<O, VO>(
                    output,
                    bias,
                    residual,
                    scratch[first + four],
                    start,
                    row,
                    column,
                    sizes.rows,
                    sizes.columns,
                    comptime!(kind.epilogue),
                );
            }
            sync_cube();
        }
    }
}
