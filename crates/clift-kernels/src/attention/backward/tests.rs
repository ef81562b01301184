use super::*;
use crate::attention::forward::attention_forward;
use crate::simd::dispatch::InstructionSet;
use crate::testing::{assert_close, random};

/// Returns contiguous rows.
fn rows(values: &[f32], sizes: &AttentionSizes, count: usize) -> StridedRows<'static> {
    let values: &'static [f32] = values.to_vec().leak();
    StridedRows { values, batch_stride: count * sizes.dim(), row_stride: sizes.dim() }
}

/// Computes output and gradients of queries, keys and values in f64, as in the paper's formulas.
fn reference(sizes: &AttentionSizes, [q, k, v, grad]: [&[f32]; 4]) -> [Vec<f64>; 4] {
    let AttentionSizes { batch, num_queries, num_keys, num_heads, head_width } = *sizes;
    let dim = sizes.dim();
    let scale = 1.0 / (head_width as f64).sqrt();
    let mut results = [q.len(), q.len(), k.len(), v.len()].map(|len| vec![0.0_f64; len]);
    let [output, grad_q, grad_k, grad_v] = &mut results;
    for (scene, head) in (0..batch).flat_map(|scene| (0..num_heads).map(move |head| (scene, head))) {
        let at = |count: usize, row: usize, e: usize| (scene * count + row) * dim + head * head_width + e;
        for i in 0..num_queries {
            let dot = |a: &[f32], j: usize, b: &[f32]| -> f64 {
                (0..head_width).map(|e| f64::from(a[at(num_queries, i, e)]) * f64::from(b[at(num_keys, j, e)])).sum()
            };
            let scores: Vec<f64> = (0..num_keys).map(|j| dot(q, j, k) * scale).collect();
            let highest = scores.iter().copied().fold(f64::MIN, f64::max);
            let total: f64 = scores.iter().map(|score| (score - highest).exp()).sum();
            let weights: Vec<f64> = scores.iter().map(|score| (score - highest).exp() / total).collect();
            let slopes: Vec<f64> = (0..num_keys).map(|j| dot(grad, j, v)).collect();
            let mean: f64 = weights.iter().zip(&slopes).map(|(weight, slope)| weight * slope).sum();
            for j in 0..num_keys {
                let grad_score = weights[j] * (slopes[j] - mean) * scale;
                for e in 0..head_width {
                    let (row, column) = (at(num_queries, i, e), at(num_keys, j, e));
                    output[row] += weights[j] * f64::from(v[column]);
                    grad_q[row] += grad_score * f64::from(k[column]);
                    grad_k[column] += grad_score * f64::from(q[row]);
                    grad_v[column] += weights[j] * f64::from(grad[row]);
                }
            }
        }
    }
    results
}

/// Computes the gradients of queries, keys and values and unpacks them.
fn gradients(set: InstructionSet, sizes: AttentionSizes, saved: BackwardInputs<'_>) -> [Vec<f32>; 3] {
    let AttentionSizes { batch, num_queries, num_keys, .. } = sizes;
    let dim = sizes.dim();
    let part = |packed: &[f32], parts: usize, part: usize| {
        packed.chunks_exact(parts * dim).flat_map(|row| row[part * dim..(part + 1) * dim].to_vec()).collect()
    };
    let mut query = vec![f32::NAN; batch * num_queries * dim];
    let mut key_value = vec![f32::NAN; batch * num_keys * 2 * dim];
    attention_backward(
        set,
        sizes,
        saved,
        AttentionGradients::Separate { query: &mut query, key_value: &mut key_value },
    );
    let separate = [query, part(&key_value, 2, 0), part(&key_value, 2, 1)];
    if num_queries == num_keys {
        let mut packed = vec![f32::NAN; batch * num_queries * 3 * dim];
        attention_backward(set, sizes, saved, AttentionGradients::Packed(&mut packed));
        assert_eq!([0, 1, 2].map(|i| part(&packed, 3, i)), separate);
    }
    separate
}

fn check(sizes: AttentionSizes, spread: f32) {
    let AttentionSizes { batch, num_queries, num_keys, num_heads, .. } = sizes;
    let make = |count: usize, seed: u64| random(batch * count * sizes.dim(), seed);
    let mut q = make(num_queries, 1);
    for value in &mut q {
        *value *= spread;
    }
    let (k, v, grad) = (make(num_keys, 2), make(num_keys, 3), make(num_queries, 4));
    let expected = reference(&sizes, [&q, &k, &v, &grad]);
    for set in InstructionSet::available() {
        let mut output = vec![f32::NAN; q.len()];
        let mut log_sum = vec![f32::NAN; batch * num_heads * num_queries];
        let [query, key, value] =
            [rows(&q, &sizes, num_queries), rows(&k, &sizes, num_keys), rows(&v, &sizes, num_keys)];
        attention_forward(set, sizes, [query, key, value], &mut output, Some(&mut log_sum));
        assert_close(&output, &expected[0], 1e-5);
        let saved = BackwardInputs {
            query,
            key,
            value,
            output: rows(&output, &sizes, num_queries),
            log_sum: &log_sum,
            grad_output: rows(&grad, &sizes, num_queries),
        };
        let grads = gradients(set, sizes, saved);
        for (grad, expected) in grads.iter().zip(&expected[1..]) {
            // One key: the exact gradient of queries and keys is zero.
            if num_keys > 1 || expected.iter().any(|&value| value != 0.0) {
                assert_close(grad, expected, 1e-5);
            } else {
                assert!(grad.iter().all(|value| value.abs() < 1e-5));
            }
        }
    }
}

#[test]
fn every_instruction_set_equals_f64_at_odd_shapes() {
    let sizes = |batch, num_queries, num_keys, num_heads, head_width| AttentionSizes {
        batch,
        num_queries,
        num_keys,
        num_heads,
        head_width,
    };
    check(sizes(1, 1, 7, 1, 12), 1.0);
    check(sizes(2, 5, 1, 2, 12), 1.0);
    check(sizes(1, 97, 601, 2, 12), 3.0);
    check(sizes(2, 131, 67, 3, 96), 1.0);
    check(sizes(1, 13, 1031, 1, 96), 2.0);
    check(sizes(1, 200, 33, 1, 16), 1.0);
    check(sizes(1, 24, 48, 2, 40), 1.0);
    check(sizes(2, 51, 51, 2, 20), 1.0);
}
