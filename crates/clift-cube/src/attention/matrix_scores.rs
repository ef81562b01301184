//! Parts of attention on cooperative matrices: f16 operands, f32 sums.
// E width of a head

use cubecl::cmma::{self, Matrix, MatrixIdent, MatrixLayout};
use cubecl::prelude::*;
use half::f16;

use crate::adapter::MatrixShape;
use crate::attention::head_rows::{Head, Rows, write_values};
use crate::buffers::load::{Four, load_four};
use crate::products::matrix_product::{PAD, StagedMatrix, load_matrix};

/// Tile of a cube.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct AttentionTile {
    /// Shape of the matrices.
    pub shape: MatrixShape,
    /// Planes of a cube.
    pub planes: usize,
    /// Columns of a block: a multiple of the sizes of a matrix.
    pub columns: usize,
    /// Width of a head.
    pub width: usize,
}

impl AttentionTile {
    pub(crate) fn rows(self) -> usize {
        self.planes * self.shape.sizes[0]
    }

    pub(crate) fn units(self) -> usize {
        self.planes * self.shape.plane
    }

    /// Units of a row.
    pub(crate) fn lanes(self) -> usize {
        self.shape.plane / self.shape.sizes[0]
    }

    /// Vectors of a row's scores that a unit has.
    pub(crate) fn fours(self) -> usize {
        self.columns / 4 / self.lanes()
    }

    /// Width of a head in whole matrices.
    pub(crate) fn padded(self) -> usize {
        self.width.next_multiple_of(self.shape.sizes[1].max(self.shape.sizes[2]))
    }

    /// Values between two lines of a stage, rows of weights, and rows of scores.
    pub(crate) fn pitches(self) -> [usize; 3] {
        [self.padded() + PAD, self.columns + PAD, self.columns + 4]
    }

    /// Lines as the right operand of scores, weights, and lines as the right operand of sums, which on an H100 are
    /// faster than a transposed stage.
    pub(crate) fn staged(self) -> [StagedMatrix; 3] {
        let [lines, weights, _] = self.pitches();
        let staged = |ident, terms_inner, pitch| StagedMatrix { ident, terms_inner, pitch, shape: self.shape };
        [
            staged(MatrixIdent::B, true, lines),
            staged(MatrixIdent::A, true, weights),
            staged(MatrixIdent::B, false, lines),
        ]
    }

    /// Vectors of a block that a unit copies.
    pub(crate) fn fetches(self) -> usize {
        (self.columns * self.padded() / 4).div_ceil(self.units())
    }

    /// Bytes of shared memory of a kernel: two stages and weights in f16, and scores.
    pub fn shared_bytes(self) -> usize {
        let [lines, weights, scores] = self.pitches();
        2 * (2 * self.columns * lines + self.rows() * weights) + 4 * self.rows() * scores
    }

    /// Matrices of a row along its terms, and along its values.
    pub(crate) fn matrices(self) -> [usize; 2] {
        [self.padded() / self.shape.sizes[2], self.padded() / self.shape.sizes[1]]
    }
}

pub(crate) type Stage = Shared<[Four<f16>]>;
pub(crate) type Scores = Shared<[Four<f32>]>;

/// Reads a block of lines to registers, zeros after the last line.
#[cube]
pub(crate) fn fetch_block<E: Numeric, V: Size>(
    to: &mut Array<Four<f16>>,
    from: &[Vector<E, V>],
    lines: &Rows,
    head: &Head,
    first: usize,
    #[comptime] tile: AttentionTile,
) {
    let fours = comptime!(tile.padded() / 4);
    let groups = comptime!(tile.columns * fours);
    let units = comptime!(tile.units());
    let start = lines.start_of(head);
    #[unroll]
    for step in 0..comptime!(tile.fetches()) {
        let group = UNIT_POS as usize + step * units;
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            let (line, value) = (first + group / fours, group % fours * 4);
            to[step] = load_four::<E, V, f16>(from, start, lines.stride, line, value, lines.count, tile.width);
        }
    }
}

/// Writes a block that [`fetch_block`] read to shared memory.
#[cube]
pub(crate) fn put_block(stage: &mut [Four<f16>], from: &Array<Four<f16>>, #[comptime] tile: AttentionTile) {
    let fours = comptime!(tile.padded() / 4);
    let groups = comptime!(tile.columns * fours);
    let units = comptime!(tile.units());
    #[unroll]
    for step in 0..comptime!(tile.fetches()) {
        let group = UNIT_POS as usize + step * units;
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            stage[group / fours * comptime!(tile.pitches()[0] / 4) + group % fours] = from[step];
        }
    }
}

/// Loads the rows of the planes to registers, through a stage.
#[cube]
pub(crate) fn load_rows<E: Numeric, V: Size>(
    stage: &mut [Four<f16>],
    from: &[Vector<E, V>],
    lines: &Rows,
    head: &Head,
    first: usize,
    #[comptime] tile: AttentionTile,
) -> Sequence<Matrix<f16>> {
    let [m, n, k] = comptime!(tile.shape.sizes);
    let mut matrices = Sequence::<Matrix<f16>>::new();
    #[unroll]
    for _ in 0..comptime!(tile.matrices()[0]) {
        matrices.push(Matrix::<f16>::from_value(MatrixIdent::A, m, n, k, MatrixLayout::RowMajor, f16::new(0.0)));
    }
    let row = first_row_of_plane(tile);
    let mut block = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    #[unroll]
    for pass in 0..comptime!(tile.rows().div_ceil(tile.columns)) {
        sync_cube();
        fetch_block::<E, V>(&mut block, from, lines, head, first + pass * tile.columns, tile);
        put_block(stage, &block, tile);
        sync_cube();
        if row / tile.columns == pass {
            #[unroll]
            for e in 0..comptime!(tile.matrices()[0]) {
                let first = (row % tile.columns * comptime!(tile.pitches()[0]) + e * k) / 4;
                let len = stage.len();
                cmma::load(matrices.index_mut(e), &stage[first..len], comptime!(tile.pitches()[0] as u32));
            }
        }
    }
    matrices
}

#[cube]
pub(crate) fn first_row_of_plane(#[comptime] tile: AttentionTile) -> usize {
    UNIT_POS as usize / tile.shape.plane * comptime!(tile.shape.sizes[0])
}

/// Returns `count` sums of zero.
#[cube]
pub(crate) fn zero_sums(#[comptime] count: usize, #[comptime] tile: AttentionTile) -> Sequence<Matrix<f32>> {
    let [m, n, k] = comptime!(tile.shape.sizes);
    let mut sums = Sequence::<Matrix<f32>>::new();
    #[unroll]
    for _ in 0..count {
        sums.push(Matrix::<f32>::from_value(MatrixIdent::Accumulator, m, n, k, MatrixLayout::Undefined, 0.0));
    }
    sums
}

/// Writes the scores of the plane's rows and the lines of a stage.
#[cube]
pub(crate) fn write_scores(
    scores: &mut [Four<f32>],
    rows: &Sequence<Matrix<f16>>,
    stage: &[Four<f16>],
    #[comptime] tile: AttentionTile,
) {
    let [_, n, k] = comptime!(tile.shape.sizes);
    let blocks = comptime!(tile.columns / n);
    let sums = zero_sums(blocks, tile);
    #[unroll]
    for e in 0..comptime!(tile.matrices()[0]) {
        #[unroll]
        for j in 0..blocks {
            let b = load_matrix(stage, j * n, e * k, comptime!(tile.staged()[0]));
            cmma::execute(rows.index(e), &b, sums.index(j), sums.index(j));
        }
    }
    sync_plane();
    let pitch = comptime!(tile.pitches()[2]);
    #[unroll]
    for j in 0..blocks {
        let first = (first_row_of_plane(tile) * pitch + j * n) / 4;
        let len = scores.len();
        cmma::store(&mut scores[first..len], sums.index(j), pitch as u32, MatrixLayout::RowMajor);
    }
    sync_plane();
}

/// Adds the products of the plane's weights and the lines of a stage.
#[cube]
pub(crate) fn add_products(
    sums: &Sequence<Matrix<f32>>,
    weights: &[Four<f16>],
    stage: &[Four<f16>],
    #[comptime] tile: AttentionTile,
) {
    let [_, n, k] = comptime!(tile.shape.sizes);
    #[unroll]
    for c in 0..comptime!(tile.columns / k) {
        let a = load_matrix(weights, first_row_of_plane(tile), c * k, comptime!(tile.staged()[1]));
        #[unroll]
        for j in 0..comptime!(tile.matrices()[1]) {
            let b = load_matrix(stage, j * n, c * k, comptime!(tile.staged()[2]));
            cmma::execute(&a, &b, sums.index(j), sums.index(j));
        }
    }
}

/// Returns the row of the unit in its cube.
#[cube]
pub(crate) fn row_of_unit(#[comptime] tile: AttentionTile) -> usize {
    UNIT_POS as usize / comptime!(tile.lanes())
}

/// Returns the column of the unit's vector `i`, in its block.
#[cube]
pub(crate) fn column_of_unit(i: usize, #[comptime] tile: AttentionTile) -> usize {
    (UNIT_POS as usize % comptime!(tile.lanes()) + i * comptime!(tile.lanes())) * 4
}

/// Replaces the values of columns at and after the limit by 0.
#[cube]
pub(crate) fn mask(values: Four<f32>, column: usize, limit: usize) -> Four<f32> {
    let mut masked = values;
    #[unroll]
    for j in 0..4usize {
        masked.insert(j, select(column + j < limit, values.extract(j), 0.0));
    }
    masked
}

/// Writes the plane's sums, through the scores, multiplied by the factor of the unit's row.
#[cube]
pub(crate) fn write_sums<V: Size>(
    output: &mut [Vector<f32, V>],
    sums: &Sequence<Matrix<f32>>,
    scores: &mut [Four<f32>],
    factor: f32,
    lines: &Rows,
    head: &Head,
    first_row: usize,
    #[comptime] tile: AttentionTile,
) {
    let n = comptime!(tile.shape.sizes[1]);
    let pitch = comptime!(tile.pitches()[2]);
    let row = first_row + row_of_unit(tile);
    #[unroll]
    for j in 0..comptime!(tile.matrices()[1]) {
        sync_plane();
        let first = first_row_of_plane(tile) * pitch / 4;
        let len = scores.len();
        cmma::store(&mut scores[first..len], sums.index(j), pitch as u32, MatrixLayout::RowMajor);
        sync_plane();
        if row < lines.count {
            #[unroll]
            for i in 0..comptime!(n / 4 / tile.lanes()) {
                let column = column_of_unit(i, tile);
                let values = scores[(row_of_unit(tile) * pitch + column) / 4] * Four::<f32>::new(factor);
                let index = lines.start_of(head) + row * lines.stride + j * n + column;
                write_values::<V>(output, values, index, j * n + column, tile.width);
            }
        }
    }
}

/// Multiplies the rows of the plane's sums by the factor of the unit's row.
#[cube]
pub(crate) fn scale_sums(
    sums: &mut Sequence<Matrix<f32>>,
    scores: &mut [Four<f32>],
    factor: f32,
    #[comptime] tile: AttentionTile,
) {
    let n = comptime!(tile.shape.sizes[1]);
    let pitch = comptime!(tile.pitches()[2]);
    let first = first_row_of_plane(tile) * pitch / 4;
    #[unroll]
    for j in 0..comptime!(tile.matrices()[1]) {
        sync_plane();
        let len = scores.len();
        cmma::store(&mut scores[first..len], sums.index(j), pitch as u32, MatrixLayout::RowMajor);
        sync_plane();
        #[unroll]
        for i in 0..comptime!(n / 4 / tile.lanes()) {
            let index = (row_of_unit(tile) * pitch + column_of_unit(i, tile)) / 4;
            scores[index] *= Four::<f32>::new(factor);
        }
        sync_plane();
        cmma::load_with_layout(sums.index_mut(j), &scores[first..len], pitch as u32, MatrixLayout::RowMajor);
    }
    sync_plane();
}

/// Returns the maximum of the units of a row.
#[cube]
pub(crate) fn max_of_row(value: f32, #[comptime] tile: AttentionTile) -> f32 {
    let mut result = value;
    #[unroll]
    for bit in 0..comptime!(tile.lanes().ilog2()) {
        result = max(result, plane_shuffle_xor(result, comptime!(1u32 << bit)));
    }
    result
}

/// Returns the sum of the units of a row.
#[cube]
pub(crate) fn sum_of_row(value: f32, #[comptime] tile: AttentionTile) -> f32 {
    let mut result = value;
    #[unroll]
    for bit in 0..comptime!(tile.lanes().ilog2()) {
        result += plane_shuffle_xor(result, comptime!(1u32 << bit));
    }
    result
}
