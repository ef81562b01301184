//! Attention on cooperative matrices: f16 operands, f32 sums.
//!
//! A plane keeps the rows of one matrix in registers: queries of one head, or keys in the backward by keys. The cube reads the
//! other side in blocks of columns. Scores pass through shared memory, where the plane that computed them turns them into
//! weights.
// E width of a head

use cubecl::ir::ElemType;
use cubecl::prelude::*;
use half::f16;

use crate::attention::head_rows::{Attention, Rows, head_of_cube, read_rows};
use crate::attention::matrix_scores::{
    AttentionTile, Scores, Stage, add_products, column_of_unit, fetch_block, load_rows, mask, max_of_row, put_block,
    row_of_unit, scale_sums, sum_of_row, write_scores, write_sums, zero_sums,
};
use crate::buffers::load::Four;

/// Largest excess of a score over the maximum that is subtracted from it: weights are at most `exp(LEEWAY)`.
const LEEWAY: f32 = 8.0;

/// Computes the output and the log sums `[batch, heads, queries]`.
#[cube(launch_unchecked)]
pub(crate) fn forward<F: Float, V: Size>(
    query: &[Vector<F, V>],
    key: &[Vector<F, V>],
    value: &[Vector<F, V>],
    output: &mut [Vector<f32, V>],
    log_sum: &mut [f32],
    at: Attention,
    #[comptime] tile: AttentionTile,
    #[define(F)] _values: ElemType,
) {
    let head = head_of_cube(at.num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut keys = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut values = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let queries = load_rows::<F, V>(&mut keys, query, &at.query, &head, first_row, tile);
    let mut sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut scaled = Array::<Four<f32>>::new(fours);
    let mut maximum = f32::new(f32::MIN);
    // Of the unit's columns.
    let mut total = Four::<f32>::new(0.0);

    let mut next_keys = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    let mut next_values = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    fetch_block::<F, V>(&mut next_keys, key, &at.key, &head, 0usize, tile);
    fetch_block::<F, V>(&mut next_values, value, &at.value, &head, 0usize, tile);
    let mut first = 0usize;
    while first < at.key.count {
        sync_cube();
        put_block(&mut keys, &next_keys, tile);
        put_block(&mut values, &next_values, tile);
        sync_cube();
        fetch_block::<F, V>(&mut next_keys, key, &at.key, &head, first + tile.columns, tile);
        fetch_block::<F, V>(&mut next_values, value, &at.value, &head, first + tile.columns, tile);
        write_scores(&mut scores, &queries, &keys, tile);
        let mut largest = f32::new(f32::MIN);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            scaled[i] = scores[(score_row + column) / 4] * Four::<f32>::new(at.scale);
            #[unroll]
            for j in 0..4usize {
                if first + column + j < at.key.count {
                    largest = max(largest, scaled[i].extract(j));
                }
            }
        }
        // Of all units of the row.
        largest = max_of_row(largest, tile);
        if plane_any(largest - maximum > LEEWAY) {
            let raised = max(maximum, largest);
            let decay = (maximum - raised).exp();
            maximum = raised;
            total *= Four::<f32>::new(decay);
            scale_sums(&mut sums, &mut scores, decay, tile);
        }
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let weight = mask((scaled[i] - Four::<f32>::new(maximum)).exp(), first + column, at.key.count);
            total += weight;
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(weight);
        }
        sync_plane();
        add_products(&sums, &weights, &values, tile);
        first += tile.columns;
    }

    let mut sum = 0.0f32;
    #[unroll]
    for j in 0..4usize {
        sum += total.extract(j);
    }
    sum = sum_of_row(sum, tile);
    write_sums::<V>(output, &sums, &mut scores, 1.0 / sum, &at.output, &head, first_row, tile);
    if UNIT_POS as usize % comptime!(tile.lanes()) == 0 && first_row + row < at.query.count {
        log_sum[CUBE_POS_Y as usize * at.query.count + first_row + row] = maximum + sum.ln();
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
    #[comptime] tile: AttentionTile,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(at.num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut keys = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut values = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let queries = load_rows::<F, V>(&mut keys, query, &at.query, &head, first_row, tile);
    let grads = load_rows::<G, V>(&mut keys, grad_output, &at.output, &head, first_row, tile);
    let sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut softmax = Array::<Four<f32>>::new(fours);
    let index = CUBE_POS_Y as usize * at.query.count + min(first_row + row, at.query.count - 1);
    let log = Four::<f32>::new(log_sum[index]);
    let delta = Four::<f32>::new(delta[index]);

    let mut next_keys = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    let mut next_values = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    fetch_block::<F, V>(&mut next_keys, key, &at.key, &head, 0usize, tile);
    fetch_block::<F, V>(&mut next_values, value, &at.value, &head, 0usize, tile);
    let mut first = 0usize;
    while first < at.key.count {
        sync_cube();
        put_block(&mut keys, &next_keys, tile);
        put_block(&mut values, &next_values, tile);
        sync_cube();
        fetch_block::<F, V>(&mut next_keys, key, &at.key, &head, first + tile.columns, tile);
        fetch_block::<F, V>(&mut next_values, value, &at.value, &head, first + tile.columns, tile);
        write_scores(&mut scores, &queries, &keys, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            softmax[i] = (scores[(score_row + column) / 4] * Four::<f32>::new(at.scale) - log).exp();
        }
        write_scores(&mut scores, &grads, &values, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let slope = softmax[i] * (scores[(score_row + column) / 4] - delta);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(mask(slope, first + column, at.key.count));
        }
        sync_plane();
        add_products(&sums, &weights, &keys, tile);
        first += tile.columns;
    }
    write_sums::<V>(grad_query, &sums, &mut scores, at.scale, &grad_rows, &head, first_row, tile);
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
    #[comptime] tile: AttentionTile,
    #[define(F, G)] _values: [ElemType; 2],
) {
    let head = head_of_cube(at.num_heads, tile.width);
    let first_row = CUBE_POS_X as usize * comptime!(tile.rows());
    let mut queries = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut grads = Stage::new_slice(comptime!(tile.columns * tile.pitches()[0] / 4));
    let mut weights = Stage::new_slice(comptime!(tile.rows() * tile.pitches()[1] / 4));
    let mut scores = Scores::new_slice(comptime!(tile.rows() * tile.pitches()[2] / 4));
    let row = row_of_unit(tile);
    let score_row = row * comptime!(tile.pitches()[2]);
    let weight_row = row * comptime!(tile.pitches()[1]);
    let fours = comptime!(tile.fours());

    let keys = load_rows::<F, V>(&mut queries, key, &at.key, &head, first_row, tile);
    let values = load_rows::<F, V>(&mut queries, value, &at.value, &head, first_row, tile);
    let key_sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let value_sums = zero_sums(comptime!(tile.matrices()[1]), tile);
    let mut softmax = Array::<Four<f32>>::new(fours);
    let start = CUBE_POS_Y as usize * at.query.count;

    let mut next_queries = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    let mut next_grads = Array::<Four<f16>>::new(comptime!(tile.fetches()));
    fetch_block::<F, V>(&mut next_queries, query, &at.query, &head, 0usize, tile);
    fetch_block::<G, V>(&mut next_grads, grad_output, &at.output, &head, 0usize, tile);
    let mut first = 0usize;
    while first < at.query.count {
        sync_cube();
        put_block(&mut queries, &next_queries, tile);
        put_block(&mut grads, &next_grads, tile);
        sync_cube();
        fetch_block::<F, V>(&mut next_queries, query, &at.query, &head, first + tile.columns, tile);
        fetch_block::<G, V>(&mut next_grads, grad_output, &at.output, &head, first + tile.columns, tile);
        write_scores(&mut scores, &keys, &queries, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let log = read_rows(log_sum, start, first + column, at.query.count);
            let weight = (scores[(score_row + column) / 4] * Four::<f32>::new(at.scale) - log).exp();
            softmax[i] = mask(weight, first + column, at.query.count);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(softmax[i]);
        }
        sync_plane();
        add_products(&value_sums, &weights, &grads, tile);
        write_scores(&mut scores, &values, &grads, tile);
        #[unroll]
        for i in 0..fours {
            let column = column_of_unit(i, tile);
            let delta = read_rows(delta, start, first + column, at.query.count);
            let slope = softmax[i] * (scores[(score_row + column) / 4] - delta);
            weights[(weight_row + column) / 4] = Four::<f16>::cast_from(slope);
        }
        sync_plane();
        add_products(&key_sums, &weights, &queries, tile);
        first += tile.columns;
    }
    write_sums::<V>(grad_key_value, &key_sums, &mut scores, at.scale, &grad_key_rows, &head, first_row, tile);
    write_sums::<V>(grad_key_value, &value_sums, &mut scores, 1.0, &grad_value_rows, &head, first_row, tile);
}
