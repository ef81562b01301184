//! Attention on register tiles in f32: scores stay in registers and shared memory.
//!
//! A cube has 64 rows of one head, queries or, in the backward by keys, keys, and reads the others in blocks of 32 columns.
//! A unit has 4 x 4 scores and, of its 4 rows, some columns of the sums.
// E width of a head; 16 rows of 8 units

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::head_rows::{Head, Rows, head_of_cube, read_rows, write_values};
use crate::load::{Four, load_four};
use crate::register_product::{fetch, put};

/// Rows of a cube.
pub(crate) const ROWS: usize = 64;
/// Columns of a block.
const COLUMNS: usize = 32;
/// Values of heads in a stage of scores.
const SLICE: usize = 16;
/// Columns of units, and all units.
const UNITS_X: usize = 8;
pub(crate) const UNITS: usize = 128;
const ROW_PITCH: usize = ROWS / 4 + 1;
const COLUMN_PITCH: usize = COLUMNS / 4 + 1;

/// Adds the scores of the unit's four rows (values of the vectors) and four columns, `sum_e row_e column_e`.
#[cube]
fn add_scores<R: Numeric, C: Numeric, V: Size>(
    scores: &mut Array<Four<f32>>,
    rows: &[Vector<R, V>],
    columns: &[Vector<C, V>],
    row_lines: &Rows,
    column_lines: &Rows,
    head: &Head,
    first_row: usize,
    first_column: usize,
    row_stage: &mut [Four<f32>],
    column_stage: &mut [Four<f32>],
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let mut row_next = Array::<Four<f32>>::new(comptime!((ROWS * SLICE / 16).div_ceil(UNITS) * 4));
    let mut column_next = Array::<Four<f32>>::new(comptime!((COLUMNS * SLICE / 16).div_ceil(UNITS) * 4));
    let row_start = row_lines.start_of(head);
    let column_start = column_lines.start_of(head);
    for slice in 0..comptime!(width.div_ceil(SLICE)) {
        let term = slice * SLICE;
        fetch::<R, V>(
            &mut row_next,
            rows,
            row_start,
            row_lines.stride,
            first_row,
            term,
            row_lines.count,
            width,
            true,
            ROWS,
            SLICE,
            UNITS,
        );
        fetch::<C, V>(
            &mut column_next,
            columns,
            column_start,
            column_lines.stride,
            first_column,
            term,
            column_lines.count,
            width,
            true,
            COLUMNS,
            SLICE,
            UNITS,
        );
        sync_cube();
        put(row_stage, &row_next, true, ROWS, SLICE, UNITS);
        put(column_stage, &column_next, true, COLUMNS, SLICE, UNITS);
        sync_cube();
        for e in 0..SLICE {
            let row = row_stage[e * ROW_PITCH + y];
            let column = column_stage[e * COLUMN_PITCH + x];
            #[unroll]
            for j in 0..4usize {
                scores[j] = fma(row, Four::<f32>::new(column.extract(j)), scores[j]);
            }
        }
    }
}

/// Copies the block's lines of heads, `[COLUMNS][width]`, to shared memory.
#[cube]
fn stage_lines<C: Numeric, V: Size>(
    stage: &mut [Four<f32>],
    from: &[Vector<C, V>],
    lines: &Rows,
    head: &Head,
    first: usize,
    #[comptime] width: usize,
) {
    let groups = comptime!(width.div_ceil(4));
    let pitch = comptime!(sum_fours(width) * UNITS_X);
    let start = lines.start_of(head);
    #[unroll]
    for step in 0..comptime!((COLUMNS * groups).div_ceil(UNITS)) {
        let group = UNIT_POS as usize + step * UNITS;
        if group < COLUMNS * groups {
            let line = group / groups;
            let four = group % groups;
            stage[line * pitch + four] =
                load_four::<C, V, f32>(from, start, lines.stride, first + line, four * 4, lines.count, width);
        }
    }
}

/// Returns the vectors of a row's sums that a unit has.
pub(crate) fn sum_fours(width: usize) -> usize {
    width.div_ceil(4).div_ceil(UNITS_X)
}

/// Adds `sum_c weight_rc line_c` to the unit's sums; the weights are `[COLUMNS][ROWS]`.
#[cube]
fn add_lines(sums: &mut Array<Four<f32>>, weights: &[Four<f32>], lines: &[Four<f32>], #[comptime] width: usize) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    for c in 0..COLUMNS {
        let weight = weights[c * ROW_PITCH + y];
        #[unroll]
        for g in 0..fours {
            let line = lines[c * comptime!(fours * UNITS_X) + x + g * UNITS_X];
            #[unroll]
            for i in 0..4usize {
                sums[i * fours + g] = fma(Four::<f32>::new(weight.extract(i)), line, sums[i * fours + g]);
            }
        }
    }
}

/// Writes the unit's sums, multiplied by the factor of their row.
#[cube]
fn write_sums<V: Size>(
    output: &mut [Vector<f32, V>],
    sums: &Array<Four<f32>>,
    factors: Four<f32>,
    lines: &Rows,
    head: &Head,
    first_row: usize,
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let start = lines.start_of(head);
    #[unroll]
    for i in 0..4usize {
        let row = first_row + y * 4 + i;
        if row < lines.count {
            #[unroll]
            for g in 0..fours {
                let column = (x + g * UNITS_X) * 4;
                let values = sums[i * fours + g] * Four::<f32>::new(factors.extract(i));
                let index = start + row * lines.stride + column;
                write_values::<V>(output, values, index, column, width);
            }
        }
    }
}

#[cube]
fn clear(array: &mut Array<Four<f32>>) {
    #[unroll]
    for i in 0..array.len() {
        array[i] = Four::<f32>::new(0.0);
    }
}

/// Returns whether a block's column of the unit is below the limit.
#[cube]
fn column_of(first: usize, j: usize) -> usize {
    first + UNIT_POS as usize % UNITS_X * 4 + j
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
    #[comptime] width: usize,
    #[define(F)] _values: ElemType,
) {
    let head = head_of_cube(num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let mut row_stage = Shared::<[Four<f32>]>::new_slice(SLICE * ROW_PITCH);
    let mut column_stage = Shared::<[Four<f32>]>::new_slice(SLICE * COLUMN_PITCH);
    let mut weights = Shared::<[Four<f32>]>::new_slice(COLUMNS * ROW_PITCH);
    let mut lines = Shared::<[Four<f32>]>::new_slice(comptime!(COLUMNS * fours * UNITS_X));
    let mut scores = Array::<Four<f32>>::new(4usize);
    let mut sums = Array::<Four<f32>>::new(comptime!(4 * fours));
    clear(&mut sums);
    let mut maximum = Four::<f32>::new(f32::MIN);
    // Of the unit's columns.
    let mut total = Four::<f32>::new(0.0);

    let mut first = 0usize;
    while first < key_rows.count {
        clear(&mut scores);
        add_scores::<F, F, V>(
            &mut scores,
            query,
            key,
            &query_rows,
            &key_rows,
            &head,
            first_row,
            first,
            &mut row_stage,
            &mut column_stage,
            width,
        );
        let mut largest = maximum;
        #[unroll]
        for j in 0..4usize {
            let inside = column_of(first, j) < key_rows.count;
            scores[j] = select(inside, scores[j] * Four::<f32>::new(scale), Four::<f32>::new(f32::MIN));
            largest = max(largest, scores[j]);
        }
        // The stages are free: the maxima of the units of a row.
        sync_cube();
        row_stage[y * UNITS_X + x] = largest;
        stage_lines::<F, V>(&mut lines, value, &value_rows, &head, first, width);
        sync_cube();
        #[unroll]
        for i in 0..UNITS_X {
            largest = max(largest, row_stage[y * UNITS_X + i]);
        }
        let decay = (maximum - largest).exp();
        maximum = largest;
        total *= decay;
        #[unroll]
        for i in 0..comptime!(4 * fours) {
            sums[i] *= Four::<f32>::new(decay.extract(i / fours));
        }
        #[unroll]
        for j in 0..4usize {
            let weight = (scores[j] - maximum).exp();
            total += weight;
            weights[(x * 4 + j) * ROW_PITCH + y] = weight;
        }
        sync_cube();
        add_lines(&mut sums, &weights, &lines, width);
        first += COLUMNS;
    }

    sync_cube();
    row_stage[y * UNITS_X + x] = total;
    sync_cube();
    total = Four::<f32>::new(0.0);
    #[unroll]
    for i in 0..UNITS_X {
        total += row_stage[y * UNITS_X + i];
    }
    write_sums::<V>(output, &sums, Four::<f32>::new(1.0) / total, &output_rows, &head, first_row, width);
    if x == 0 {
        let logarithm = maximum + total.ln();
        #[unroll]
        for i in 0..4usize {
            let row = first_row + y * 4 + i;
            if row < query_rows.count {
                log_sum[CUBE_POS_Y as usize * query_rows.count + row] = logarithm.extract(i);
            }
        }
    }
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
    #[comptime] width: usize,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let mut row_stage = Shared::<[Four<f32>]>::new_slice(SLICE * ROW_PITCH);
    let mut column_stage = Shared::<[Four<f32>]>::new_slice(SLICE * COLUMN_PITCH);
    let mut weights = Shared::<[Four<f32>]>::new_slice(COLUMNS * ROW_PITCH);
    let mut lines = Shared::<[Four<f32>]>::new_slice(comptime!(COLUMNS * fours * UNITS_X));
    let mut scores = Array::<Four<f32>>::new(4usize);
    let mut grads = Array::<Four<f32>>::new(4usize);
    let mut sums = Array::<Four<f32>>::new(comptime!(4 * fours));
    clear(&mut sums);
    let start = CUBE_POS_Y as usize * query_rows.count;
    let logs = read_rows(log_sum, start, first_row + y * 4, query_rows.count);
    let deltas = read_rows(delta, start, first_row + y * 4, query_rows.count);

    let mut first = 0usize;
    while first < key_rows.count {
        clear(&mut scores);
        clear(&mut grads);
        add_scores::<F, F, V>(
            &mut scores,
            query,
            key,
            &query_rows,
            &key_rows,
            &head,
            first_row,
            first,
            &mut row_stage,
            &mut column_stage,
            width,
        );
        add_scores::<G, F, V>(
            &mut grads,
            grad_output,
            value,
            &output_rows,
            &value_rows,
            &head,
            first_row,
            first,
            &mut row_stage,
            &mut column_stage,
            width,
        );
        sync_cube();
        stage_lines::<F, V>(&mut lines, key, &key_rows, &head, first, width);
        #[unroll]
        for j in 0..4usize {
            // Keys after the last are zeros in `lines`.
            let weight = (scores[j] * Four::<f32>::new(scale) - logs).exp();
            let inside = column_of(first, j) < key_rows.count;
            weights[(x * 4 + j) * ROW_PITCH + y] = select(inside, weight * (grads[j] - deltas), Four::<f32>::new(0.0));
        }
        sync_cube();
        add_lines(&mut sums, &weights, &lines, width);
        first += COLUMNS;
    }
    write_sums::<V>(grad_query, &sums, Four::<f32>::new(scale), &grad_rows, &head, first_row, width);
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
    #[comptime] width: usize,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let mut row_stage = Shared::<[Four<f32>]>::new_slice(SLICE * ROW_PITCH);
    let mut column_stage = Shared::<[Four<f32>]>::new_slice(SLICE * COLUMN_PITCH);
    let mut weights = Shared::<[Four<f32>]>::new_slice(COLUMNS * ROW_PITCH);
    let mut lines = Shared::<[Four<f32>]>::new_slice(comptime!(COLUMNS * fours * UNITS_X));
    let mut scores = Array::<Four<f32>>::new(4usize);
    let mut grads = Array::<Four<f32>>::new(4usize);
    let mut key_sums = Array::<Four<f32>>::new(comptime!(4 * fours));
    let mut value_sums = Array::<Four<f32>>::new(comptime!(4 * fours));
    clear(&mut key_sums);
    clear(&mut value_sums);
    let start = CUBE_POS_Y as usize * query_rows.count;

    let mut first = 0usize;
    while first < query_rows.count {
        clear(&mut scores);
        clear(&mut grads);
        add_scores::<F, F, V>(
            &mut scores,
            key,
            query,
            &key_rows,
            &query_rows,
            &head,
            first_row,
            first,
            &mut row_stage,
            &mut column_stage,
            width,
        );
        add_scores::<F, G, V>(
            &mut grads,
            value,
            grad_output,
            &value_rows,
            &output_rows,
            &head,
            first_row,
            first,
            &mut row_stage,
            &mut column_stage,
            width,
        );
        let logs = read_rows(log_sum, start, column_of(first, 0), query_rows.count);
        let deltas = read_rows(delta, start, column_of(first, 0), query_rows.count);
        sync_cube();
        stage_lines::<G, V>(&mut lines, grad_output, &output_rows, &head, first, width);
        #[unroll]
        for j in 0..4usize {
            let inside = column_of(first, j) < query_rows.count;
            let weight = (scores[j] * Four::<f32>::new(scale) - Four::<f32>::new(logs.extract(j))).exp();
            scores[j] = select(inside, weight, Four::<f32>::new(0.0));
            weights[(x * 4 + j) * ROW_PITCH + y] = scores[j];
        }
        sync_cube();
        add_lines(&mut value_sums, &weights, &lines, width);
        sync_cube();
        stage_lines::<F, V>(&mut lines, query, &query_rows, &head, first, width);
        #[unroll]
        for j in 0..4usize {
            weights[(x * 4 + j) * ROW_PITCH + y] = scores[j] * (grads[j] - Four::<f32>::new(deltas.extract(j)));
        }
        sync_cube();
        add_lines(&mut key_sums, &weights, &lines, width);
        first += COLUMNS;
    }
    write_sums::<V>(grad_key_value, &key_sums, Four::<f32>::new(scale), &grad_key_rows, &head, first_row, width);
    write_sums::<V>(grad_key_value, &value_sums, Four::<f32>::new(1.0), &grad_value_rows, &head, first_row, width);
}
