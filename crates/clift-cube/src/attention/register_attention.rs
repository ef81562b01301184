//! Attention on register tiles in f32: scores stay in registers and shared memory.
//!
//! A cube has 64 rows of one head, queries, or keys in the backward by keys, and reads the other side in blocks of 32 columns.
//! A unit has 4 x 4 scores and, of its 4 rows, some columns of the sums.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::attention::head_rows::{Rows, head_of_cube, read_rows};
use crate::attention::register_scores::{
    COLUMN_PITCH, COLUMNS, ROW_PITCH, ROWS, SLICE, UNITS_X, add_lines, add_scores, clear, column_of, stage_lines,
    sum_fours, write_sums,
};
use crate::buffers::load::Four;

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
