//! Attention on cooperative matrices: f16 operands, f32 sums.
//!
//! A plane has as many rows of one head, queries or, in the backward by keys, keys, as a matrix has, and keeps them in
//! registers; the cube reads the others in blocks of columns. Scores pass through shared memory, where the plane that made
//! them turns them into weights.
// E width of a head

use cubecl::cmma::{self, Matrix, MatrixIdent, MatrixLayout};
use cubecl::ir::ElemType;
use cubecl::prelude::*;
use half::f16;

use crate::head_rows::{Head, Rows, head_of_cube, read_rows, write_values};
use crate::load::{Four, load_four};
use crate::matrix_product::{MatrixShape, PAD, StagedMatrix, load_matrix};

/// How far scores may exceed the maximum by which weights are divided: weights are at most `exp(LEEWAY)`.
const LEEWAY: f32 = 8.0;

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
    fn lanes(self) -> usize {
        self.shape.plane / self.shape.sizes[0]
    }

    /// Vectors of a row's scores that a unit has.
    fn fours(self) -> usize {
        self.columns / 4 / self.lanes()
    }

    /// Width of a head in whole matrices.
    fn padded(self) -> usize {
        self.width.next_multiple_of(self.shape.sizes[1].max(self.shape.sizes[2]))
    }

    /// Values between two lines of a stage, rows of weights, and rows of scores.
    fn pitches(self) -> [usize; 3] {
        [self.padded() + PAD, self.columns + PAD, self.columns + 4]
    }

    /// Rows, lines as the right operand of scores, weights, and lines as the right operand of sums.
    fn staged(self) -> [StagedMatrix; 4] {
        let [lines, weights, _] = self.pitches();
        let staged = |ident, terms_inner, pitch| StagedMatrix { ident, terms_inner, pitch, shape: self.shape };
        [
            staged(MatrixIdent::A, true, lines),
            staged(MatrixIdent::B, true, lines),
            staged(MatrixIdent::A, true, weights),
            staged(MatrixIdent::B, false, lines),
        ]
    }

    /// Matrices of a row along its terms, and along its values.
    fn matrices(self) -> [usize; 2] {
        [self.padded() / self.shape.sizes[2], self.padded() / self.shape.sizes[1]]
    }
}

type Stage = Shared<[Four<f16>]>;
type Scores = Shared<[Four<f32>]>;

/// Copies a block of lines to shared memory.
#[cube]
fn stage_block<E: Numeric, V: Size>(
    stage: &mut [Four<f16>],
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
    for step in 0..comptime!(groups.div_ceil(units)) {
        let group = UNIT_POS as usize + step * units;
        if comptime!(groups.is_multiple_of(units)) || group < groups {
            let line = group / fours;
            let value = group % fours * 4;
            stage[line * comptime!(tile.pitches()[0] / 4) + value / 4] =
                load_four::<E, V, f16>(from, start, lines.stride, first + line, value, lines.count, tile.width);
        }
    }
}

/// Loads the rows of the planes to registers, through a stage.
#[cube]
fn load_rows<E: Numeric, V: Size>(
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
    #[unroll]
    for pass in 0..comptime!(tile.rows().div_ceil(tile.columns)) {
        sync_cube();
        stage_block::<E, V>(stage, from, lines, head, first + pass * tile.columns, tile);
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
fn first_row_of_plane(#[comptime] tile: AttentionTile) -> usize {
    UNIT_POS as usize / tile.shape.plane * comptime!(tile.shape.sizes[0])
}

/// Returns `count` sums of zero.
#[cube]
fn zero_sums(#[comptime] count: usize, #[comptime] tile: AttentionTile) -> Sequence<Matrix<f32>> {
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
fn write_scores(
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
            let b = load_matrix(stage, j * n, e * k, comptime!(tile.staged()[1]));
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
fn add_products(
    sums: &Sequence<Matrix<f32>>,
    weights: &[Four<f16>],
    stage: &[Four<f16>],
    #[comptime] tile: AttentionTile,
) {
    let [_, n, k] = comptime!(tile.shape.sizes);
    #[unroll]
    for c in 0..comptime!(tile.columns / k) {
        let a = load_matrix(weights, first_row_of_plane(tile), c * k, comptime!(tile.staged()[2]));
        #[unroll]
        for j in 0..comptime!(tile.matrices()[1]) {
            let b = load_matrix(stage, j * n, c * k, comptime!(tile.staged()[3]));
            cmma::execute(&a, &b, sums.index(j), sums.index(j));
        }
    }
}

/// Returns the row of the unit in its cube.
#[cube]
fn row_of_unit(#[comptime] tile: AttentionTile) -> usize {
    UNIT_POS as usize / comptime!(tile.lanes())
}

/// Returns the column of the unit's vector `i`, in its block.
#[cube]
fn column_of_unit(i: usize, #[comptime] tile: AttentionTile) -> usize {
    (UNIT_POS as usize % comptime!(tile.lanes()) + i * comptime!(tile.lanes())) * 4
}

/// Returns 0 in place of the values of columns at and after the limit.
#[cube]
fn mask(values: Four<f32>, column: usize, limit: usize) -> Four<f32> {
    let mut masked = values;
    #[unroll]
    for j in 0..4usize {
        masked.insert(j, select(column + j < limit, values.extract(j), 0.0));
    }
    masked
}

/// Writes the plane's sums, through the scores, multiplied by the factor of the unit's row.
#[cube]
fn write_sums<V: Size>(
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
fn scale_sums(
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

/// Computes the output and the log sums `[batch, heads, queries]`.
#[cube(launch_unchecked)]
pub(crate) fn forward<F: Float, V: Size>(
    query: &[Vector<F, V>],
    key: &[Vector<F, V>],
    value: &[Vector<F, V>],
    output: &mut [Vector<f32, V>],
    log_sum: &mut [f32],
    query_rows: Rows,
    key_rows: Rows,
    value_rows: Rows,
    output_rows: Rows,
    num_heads: usize,
    scale: f32,
    #[comptime] tile: AttentionTile,
    #[define(F)] _values: ElemType,
) {
    let head = head_of_cube(num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut stage = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let mut partial = Shared::<[f32]>::new_slice(comptime!(tile.units()));
    let queries = load_rows::<F, V>(&mut stage, query, &query_rows, &head, first_row, tile);
    let mut sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut values = Array::<Four<f32>>::new(fours);
    let mut maximum = f32::new(f32::MIN);
    // Of the unit's columns.
    let mut total = Four::<f32>::new(0.0);

    let mut first = 0usize;
    while first < key_rows.count {
        sync_cube();
        stage_block::<F, V>(&mut stage, key, &key_rows, &head, first, tile);
        sync_cube();
        write_scores(&mut scores, &queries, &stage, tile);
        sync_cube();
        stage_block::<F, V>(&mut stage, value, &value_rows, &head, first, tile);
        let mut largest = f32::new(f32::MIN);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            values[i] = scores[(score_row + column) / 4] * Four::<f32>::new(scale);
            #[unroll]
            for j in 0..4usize {
                if first + column + j < key_rows.count {
                    largest = max(largest, values[i].extract(j));
                }
            }
        }
        // Of all units of the row.
        largest = max_of_row(&mut partial, largest, tile);
        if max_of_plane(&mut partial, largest - maximum, tile) > LEEWAY {
            let raised = max(maximum, largest);
            let decay = (maximum - raised).exp();
            maximum = raised;
            total *= Four::<f32>::new(decay);
            scale_sums(&mut sums, &mut scores, decay, tile);
        }
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let weight = mask((values[i] - Four::<f32>::new(maximum)).exp(), first + column, key_rows.count);
            total += weight;
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(weight);
        }
        sync_cube();
        add_products(&sums, &weights, &stage, tile);
        first += tile.columns;
    }

    let mut sum = 0.0f32;
    #[unroll]
    for j in 0..4usize {
        sum += total.extract(j);
    }
    sum = sum_of_row(&mut partial, sum, tile);
    write_sums::<V>(output, &sums, &mut scores, 1.0 / sum, &output_rows, &head, first_row, tile);
    if UNIT_POS as usize % comptime!(tile.lanes()) == 0 && first_row + row < query_rows.count {
        log_sum[CUBE_POS_Y as usize * query_rows.count + first_row + row] = maximum + sum.ln();
    }
}

/// Writes a value of every unit where the others of its plane read it.
#[cube]
fn share(stage: &mut [f32], value: f32) {
    sync_plane();
    stage[UNIT_POS as usize] = value;
    sync_plane();
}

/// Returns the maximum of the units of a row.
#[cube]
fn max_of_row(stage: &mut [f32], value: f32, #[comptime] tile: AttentionTile) -> f32 {
    share(stage, value);
    let mut result = value;
    #[unroll]
    for i in 0..comptime!(tile.lanes()) {
        result = max(result, stage[row_of_unit(tile) * comptime!(tile.lanes()) + i]);
    }
    result
}

/// Returns the sum of the units of a row.
#[cube]
fn sum_of_row(stage: &mut [f32], value: f32, #[comptime] tile: AttentionTile) -> f32 {
    share(stage, value);
    let mut result = 0.0f32;
    #[unroll]
    for i in 0..comptime!(tile.lanes()) {
        result += stage[row_of_unit(tile) * comptime!(tile.lanes()) + i];
    }
    result
}

/// Returns the maximum of the units of the plane.
#[cube]
fn max_of_plane(stage: &mut [f32], value: f32, #[comptime] tile: AttentionTile) -> f32 {
    share(stage, value);
    let plane = comptime!(tile.shape.plane);
    let first = UNIT_POS as usize / plane * plane;
    let mut result = value;
    for i in 0..plane {
        result = max(result, stage[first + i]);
    }
    result
}

/// Computes the gradient of the queries: `dQ = s dS K`, with `dS = P (dO V^T - delta)`.
#[cube(launch_unchecked)]
pub(crate) fn backward_by_queries<F: Float, G: Float, V: Size>(
    query: &[Vector<F, V>],
    key: &[Vector<F, V>],
    value: &[Vector<F, V>],
    grad_output: &[Vector<G, V>],
    log_sum: &[f32],
    delta: &[f32],
    grad_query: &mut [Vector<f32, V>],
    query_rows: Rows,
    key_rows: Rows,
    value_rows: Rows,
    output_rows: Rows,
    grad_rows: Rows,
    num_heads: usize,
    scale: f32,
    #[comptime] tile: AttentionTile,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut keys = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut values = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let queries = load_rows::<F, V>(&mut keys, query, &query_rows, &head, first_row, tile);
    let grads = load_rows::<G, V>(&mut keys, grad_output, &output_rows, &head, first_row, tile);
    let sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut softmax = Array::<Four<f32>>::new(fours);
    let index = CUBE_POS_Y as usize * query_rows.count + min(first_row + row, query_rows.count - 1);
    let log = Four::<f32>::new(log_sum[index]);
    let delta = Four::<f32>::new(delta[index]);

    let mut first = 0usize;
    while first < key_rows.count {
        sync_cube();
        stage_block::<F, V>(&mut keys, key, &key_rows, &head, first, tile);
        stage_block::<F, V>(&mut values, value, &value_rows, &head, first, tile);
        sync_cube();
        write_scores(&mut scores, &queries, &keys, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            softmax[i] = (scores[(score_row + column) / 4] * Four::<f32>::new(scale) - log).exp();
        }
        write_scores(&mut scores, &grads, &values, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let slope = softmax[i] * (scores[(score_row + column) / 4] - delta);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(mask(slope, first + column, key_rows.count));
        }
        sync_plane();
        add_products(&sums, &weights, &keys, tile);
        first += tile.columns;
    }
    write_sums::<V>(grad_query, &sums, &mut scores, scale, &grad_rows, &head, first_row, tile);
}

/// Computes the gradients of keys and values: `dV = P^T dO`, `dK = s dS^T Q`.
#[cube(launch_unchecked)]
pub(crate) fn backward_by_keys<F: Float, G: Float, V: Size>(
    query: &[Vector<F, V>],
    key: &[Vector<F, V>],
    value: &[Vector<F, V>],
    grad_output: &[Vector<G, V>],
    log_sum: &[f32],
    delta: &[f32],
    grad_key_value: &mut [Vector<f32, V>],
    query_rows: Rows,
    key_rows: Rows,
    value_rows: Rows,
    output_rows: Rows,
    grad_key_rows: Rows,
    grad_value_rows: Rows,
    num_heads: usize,
    scale: f32,
    #[comptime] tile: AttentionTile,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut queries = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut grads = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let keys = load_rows::<F, V>(&mut queries, key, &key_rows, &head, first_row, tile);
    let values = load_rows::<F, V>(&mut queries, value, &value_rows, &head, first_row, tile);
    let key_sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let value_sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut softmax = Array::<Four<f32>>::new(fours);
    let start = CUBE_POS_Y as usize * query_rows.count;

    let mut first = 0usize;
    while first < query_rows.count {
        sync_cube();
        stage_block::<F, V>(&mut queries, query, &query_rows, &head, first, tile);
        stage_block::<G, V>(&mut grads, grad_output, &output_rows, &head, first, tile);
        sync_cube();
        write_scores(&mut scores, &keys, &queries, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let log = read_rows(log_sum, start, first + column, query_rows.count);
            let weight = (scores[(score_row + column) / 4] * Four::<f32>::new(scale) - log).exp();
            softmax[i] = mask(weight, first + column, query_rows.count);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(softmax[i]);
        }
        sync_plane();
        add_products(&value_sums, &weights, &grads, tile);
        write_scores(&mut scores, &values, &grads, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let delta = read_rows(delta, start, first + column, query_rows.count);
            let slope = softmax[i] * (scores[(score_row + column) / 4] - delta);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(slope);
        }
        sync_plane();
        add_products(&key_sums, &weights, &queries, tile);
        first += tile.columns;
    }
    write_sums::<V>(grad_key_value, &key_sums, &mut scores, scale, &grad_key_rows, &head, first_row, tile);
    write_sums::<V>(grad_key_value, &value_sums, &mut scores, 1.0, &grad_value_rows, &head, first_row, tile);
}
