//! Attention on register tiles in f32: scores stay in registers and shared memory.
//!
//! A cube has 64 rows of one head, queries, or keys in the backward by keys, and reads the other side in blocks of 32 columns.
//! A unit has 4 x 4 scores and, of its 4 rows, some columns of the sums.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::attention::head_rows::{Attention, Rows, head_of_cube, read_rows};
use crate::attention::register_scores::{
    COLUMNS, ROW_PITCH, ROWS, Stages, UNITS_X, add_lines, add_scores, clear, column_of, stage_lines, sum_fours,
    write_sums, zeros,
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
    at: Attention,
    #[comptime] width: usize,
    #[define(F)] _values: ElemType,
) {
    let head = head_of_cube(at.num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let mut stages = Stages::new(width);
    let mut scores = zeros(4usize);
    let mut sums = zeros(comptime!(4 * fours));
    let queries = at.query.side(&head, first_row);
    let mut maximum = Four::<f32>::new(f32::MIN);
    // Of the unit's columns.
    let mut total = Four::<f32>::new(0.0);

    let mut first = 0usize;
    while first < at.key.count {
        clear(&mut scores);
        add_scores::<F, F, V>(&mut scores, query, key, &queries, &at.key.side(&head, first), &mut stages, width);
        let mut largest = maximum;
        #[unroll]
        for j in 0..4usize {
            let inside = column_of(first, j) < at.key.count;
            scores[j] = select(inside, scores[j] * Four::<f32>::new(at.scale), Four::<f32>::new(f32::MIN));
            largest = max(largest, scores[j]);
        }
        // The stages are free: the maxima of the units of a row.
        sync_cube();
        stages.rows[y * UNITS_X + x] = largest;
        stage_lines::<F, V>(&mut stages, value, &at.value.side(&head, first), width);
        sync_cube();
        #[unroll]
        for i in 0..UNITS_X {
            largest = max(largest, stages.rows[y * UNITS_X + i]);
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
            stages.weights[(x * 4 + j) * ROW_PITCH + y] = weight;
        }
        sync_cube();
        add_lines(&mut sums, &stages, width);
        first += COLUMNS;
    }

    sync_cube();
    stages.rows[y * UNITS_X + x] = total;
    sync_cube();
    total = Four::<f32>::new(0.0);
    #[unroll]
    for i in 0..UNITS_X {
        total += stages.rows[y * UNITS_X + i];
    }
    write_sums::<V>(output, &sums, Four::<f32>::new(1.0) / total, &at.output.side(&head, first_row), width);
    if x == 0 {
        let logarithm = maximum + total.ln();
        #[unroll]
        for i in 0..4usize {
            let row = first_row + y * 4 + i;
            if row < at.query.count {
                log_sum[CUBE_POS_Y as usize * at.query.count + row] = logarithm.extract(i);
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
    at: Attention,
    grad_rows: Rows,
    #[comptime] width: usize,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(at.num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let mut stages = Stages::new(width);
    let mut scores = zeros(4usize);
    let mut grads = zeros(4usize);
    let mut sums = zeros(comptime!(4 * sum_fours(width)));
    let (queries, outputs) = (at.query.side(&head, first_row), at.output.side(&head, first_row));
    let start = CUBE_POS_Y as usize * at.query.count;
    let logs = read_rows(log_sum, start, first_row + y * 4, at.query.count);
    let deltas = read_rows(delta, start, first_row + y * 4, at.query.count);

    let mut first = 0usize;
    while first < at.key.count {
        clear(&mut scores);
        clear(&mut grads);
        let (keys, values) = (at.key.side(&head, first), at.value.side(&head, first));
        add_scores::<F, F, V>(&mut scores, query, key, &queries, &keys, &mut stages, width);
        add_scores::<G, F, V>(&mut grads, grad_output, value, &outputs, &values, &mut stages, width);
        sync_cube();
        stage_lines::<F, V>(&mut stages, key, &keys, width);
        #[unroll]
        for j in 0..4usize {
            // Keys after the last are zeros in `lines`.
            let weight = (scores[j] * Four::<f32>::new(at.scale) - logs).exp();
            let inside = column_of(first, j) < at.key.count;
            let slope = select(inside, weight * (grads[j] - deltas), Four::<f32>::new(0.0));
            stages.weights[(x * 4 + j) * ROW_PITCH + y] = slope;
        }
        sync_cube();
        add_lines(&mut sums, &stages, width);
        first += COLUMNS;
    }
    write_sums::<V>(grad_query, &sums, Four::<f32>::new(at.scale), &grad_rows.side(&head, first_row), width);
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
    at: Attention,
    grad_key_rows: Rows,
    grad_value_rows: Rows,
    #[comptime] width: usize,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(at.num_heads, width);
    let first_row = CUBE_POS_X as usize * ROWS;
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let mut stages = Stages::new(width);
    let mut scores = zeros(4usize);
    let mut grads = zeros(4usize);
    let mut key_sums = zeros(comptime!(4 * sum_fours(width)));
    let mut value_sums = zeros(comptime!(4 * sum_fours(width)));
    let (keys, values) = (at.key.side(&head, first_row), at.value.side(&head, first_row));
    let start = CUBE_POS_Y as usize * at.query.count;

    let mut first = 0usize;
    while first < at.query.count {
        clear(&mut scores);
        clear(&mut grads);
        let (queries, outputs) = (at.query.side(&head, first), at.output.side(&head, first));
        add_scores::<F, F, V>(&mut scores, key, query, &keys, &queries, &mut stages, width);
        add_scores::<F, G, V>(&mut grads, value, grad_output, &values, &outputs, &mut stages, width);
        let logs = read_rows(log_sum, start, column_of(first, 0), at.query.count);
        let deltas = read_rows(delta, start, column_of(first, 0), at.query.count);
        sync_cube();
        stage_lines::<G, V>(&mut stages, grad_output, &outputs, width);
        #[unroll]
        for j in 0..4usize {
            let inside = column_of(first, j) < at.query.count;
            let weight = (scores[j] * Four::<f32>::new(at.scale) - Four::<f32>::new(logs.extract(j))).exp();
            scores[j] = select(inside, weight, Four::<f32>::new(0.0));
            stages.weights[(x * 4 + j) * ROW_PITCH + y] = scores[j];
        }
        sync_cube();
        add_lines(&mut value_sums, &stages, width);
        sync_cube();
        stage_lines::<F, V>(&mut stages, query, &queries, width);
        #[unroll]
        for j in 0..4usize {
            stages.weights[(x * 4 + j) * ROW_PITCH + y] = scores[j] * (grads[j] - Four::<f32>::new(deltas.extract(j)));
        }
        sync_cube();
        add_lines(&mut key_sums, &stages, width);
        first += COLUMNS;
    }
    let (to_keys, to_values) = (grad_key_rows.side(&head, first_row), grad_value_rows.side(&head, first_row));
    write_sums::<V>(grad_key_value, &key_sums, Four::<f32>::new(at.scale), &to_keys, width);
    write_sums::<V>(grad_key_value, &value_sums, Four::<f32>::new(1.0), &to_values, width);
}
