//! Products on cooperative matrices: every plane (subgroup) multiplies f16 matrices of the hardware's shape, from stages in
//! shared memory, and sums in f32.
// M rows, N columns, K terms of a sum

use cubecl::cmma::{self, Matrix, MatrixIdent, MatrixLayout};
use cubecl::ir::ElemType;
use cubecl::prelude::*;
use half::f16;

use crate::adapter::MatrixShape;
use crate::buffers::load::{Four, Lines, Side, load_four};
use crate::products::epilogue::write_four;
use crate::products::product_kind::{ProductKind, Sizes, cube_tile};

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
    /// Stages in shared memory: 2 let planes write the next stage while others read the last one.
    pub buffers: usize,
}

impl MatrixTile {
    /// Returns the rows and columns of matrices of a plane.
    pub(crate) fn matrices(self) -> [usize; 2] {
        [0, 1].map(|i| self.stage[i] / self.planes[i] / self.shape.sizes[i])
    }

    pub(crate) fn num_planes(self) -> usize {
        self.planes[0] * self.planes[1]
    }

    /// Bytes of shared memory of a cube: stages in f16, and a matrix of sums a plane.
    pub(crate) fn shared_bytes(self) -> usize {
        let ([m, n, k], [rows, columns, _]) = (self.stage, self.shape.sizes);
        2 * self.buffers * (m + n) * (k + PAD) + 4 * self.num_planes() * rows * columns
    }
}

/// An operand's part of a stage: lines of the terms of a row or a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct StagePart {
    /// The terms lie side by side in the buffer, too.
    terms_inner: bool,
    sides: usize,
    terms: usize,
    units: usize,
}

impl StagePart {
    /// Vectors that a unit copies at once: one, or a block of 4 x 4 values that it transposes.
    fn block(self) -> usize {
        if self.terms_inner { 1 } else { 4 }
    }

    fn blocks(self) -> usize {
        self.sides * self.terms / 4 / self.block()
    }

    /// Vectors of a unit.
    fn fetches(self) -> usize {
        self.blocks().div_ceil(self.units) * self.block()
    }

    /// Vectors of a line.
    fn pitch(self) -> usize {
        (self.terms + PAD) / 4
    }

    /// Vectors of the stage.
    fn len(self) -> usize {
        self.sides * self.pitch()
    }
}

/// Reads an operand's part of a stage into registers.
#[cube]
fn fetch<E: Numeric, V: Size>(
    to: &mut Array<Four<f16>>,
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
        let line = side.first + index / (part.terms / 4) * block;
        let term = first_term + index % (part.terms / 4) * 4;
        #[unroll]
        for j in 0..block {
            let mut four = Four::<f16>::new(f16::new(0.0));
            if comptime!(blocks.is_multiple_of(part.units)) || index < blocks {
                four = if comptime!(part.terms_inner) {
                    load_four::<E, V, f16>(from, side.start, side.stride, line, term, side.limit, term_limit)
                } else {
                    load_four::<E, V, f16>(from, side.start, side.stride, term + j, line, term_limit, side.limit)
                };
            }
            to[step * block + j] = four;
        }
    }
}

/// Writes the values that [`fetch`] read into the stage at `first`.
#[cube]
fn put(stage: &mut [Four<f16>], from: &Array<Four<f16>>, first: usize, #[comptime] part: StagePart) {
    let (blocks, block) = comptime!((part.blocks(), part.block()));
    #[unroll]
    for step in 0..blocks.div_ceil(part.units) {
        let index = UNIT_POS as usize + step * part.units;
        if comptime!(blocks.is_multiple_of(part.units)) || index < blocks {
            let side = index / (part.terms / 4) * block;
            let term = index % (part.terms / 4);
            if comptime!(part.terms_inner) {
                stage[first + side * part.pitch() + term] = from[step];
            } else {
                #[unroll]
                for i in 0..4usize {
                    let mut four = Four::<f16>::new(f16::new(0.0));
                    #[unroll]
                    for j in 0..4usize {
                        four.insert(j, from[step * 4 + j].extract(i));
                    }
                    stage[first + (side + i) * part.pitch() + term] = four;
                }
            }
        }
    }
}

/// Operand of a product of matrices in a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct StagedMatrix {
    pub(crate) ident: MatrixIdent,
    /// A line has the terms of a sum: up to twice as fast in products on an H100.
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

    let at = cube_tile(&lhs_lines, &rhs_lines, &sizes, m, n);
    let lhs_part = comptime!(StagePart { terms_inner: kind.terms_inner[0], sides: m, terms: k, units });
    let rhs_part = comptime!(StagePart { terms_inner: kind.terms_inner[1], sides: n, terms: k, units });
    let mut lhs_stage = Shared::<[Four<f16>]>::new_slice(comptime!(tile.buffers * lhs_part.len()));
    let mut rhs_stage = Shared::<[Four<f16>]>::new_slice(comptime!(tile.buffers * rhs_part.len()));
    let lhs_staged =
        comptime!(StagedMatrix { ident: MatrixIdent::A, terms_inner: true, pitch: k + PAD, shape: tile.shape });
    let rhs_staged =
        comptime!(StagedMatrix { ident: MatrixIdent::B, terms_inner: true, pitch: k + PAD, shape: tile.shape });
    let mut lhs_next = Array::<Four<f16>>::new(comptime!(lhs_part.fetches()));
    let mut rhs_next = Array::<Four<f16>>::new(comptime!(rhs_part.fetches()));

    let plane = UNIT_POS as usize / plane_units;
    let lane = UNIT_POS as usize % plane_units;
    let plane_row = plane / comptime!(tile.planes[1]) * comptime!(rows * sm);
    let plane_column = plane % comptime!(tile.planes[1]) * comptime!(columns * sn);

    let mut sums = Sequence::<Matrix<f32>>::new();
    #[unroll]
    for _ in 0..comptime!(rows * columns) {
        sums.push(Matrix::<f32>::from_value(MatrixIdent::Accumulator, sm, sn, sk, MatrixLayout::Undefined, 0.0));
    }

    let mut term = at.first_term;
    let mut buffer = 0usize;
    fetch::<A, VA>(&mut lhs_next, lhs, &at.lhs, term, at.last_term, lhs_part);
    fetch::<B, VB>(&mut rhs_next, rhs, &at.rhs, term, at.last_term, rhs_part);
    while term < at.last_term {
        if comptime!(tile.buffers == 1) {
            sync_cube();
        }
        let (lhs_first, rhs_first) = (buffer * comptime!(lhs_part.len()), buffer * comptime!(rhs_part.len()));
        put(&mut lhs_stage, &lhs_next, lhs_first, lhs_part);
        put(&mut rhs_stage, &rhs_next, rhs_first, rhs_part);
        sync_cube();
        let lhs_now = &lhs_stage[lhs_first..lhs_stage.len()];
        let rhs_now = &rhs_stage[rhs_first..rhs_stage.len()];
        buffer = (buffer + 1) % tile.buffers;
        term += k;
        fetch::<A, VA>(&mut lhs_next, lhs, &at.lhs, term, at.last_term, lhs_part);
        fetch::<B, VB>(&mut rhs_next, rhs, &at.rhs, term, at.last_term, rhs_part);
        #[unroll]
        for t in 0..comptime!(k / sk) {
            let mut b = Sequence::<Matrix<f16>>::new();
            #[unroll]
            for j in 0..columns {
                b.push(load_matrix(rhs_now, plane_column + j * sn, t * sk, rhs_staged));
            }
            #[unroll]
            for i in 0..rows {
                let a = load_matrix(lhs_now, plane_row + i * sm, t * sk, lhs_staged);
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
            sync_plane();
            #[unroll]
            for step in 0..comptime!((sm * sn / 4).div_ceil(plane_units)) {
                let four = lane + step * plane_units;
                let row = at.lhs.first + plane_row + i * sm + four / (sn / 4);
                let column = at.rhs.first + plane_column + j * sn + four % (sn / 4) * 4;
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
            sync_plane();
        }
    }
}
