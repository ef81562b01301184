//! Random values, references and comparisons for the unit tests.

use crate::attention::shapes::AttentionSizes;

/// Samples uniform values in `[-1, 1)` from a seed.
pub fn random(count: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    for _ in 0..16 {
        next();
    }
    (0..count).map(|_| next()).collect()
}

/// Asserts that values equal the expected values to `tolerance` of the largest expected magnitude.
#[track_caller]
pub fn assert_close(got: &[f32], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len());
    let scale = expected.iter().fold(f64::MIN_POSITIVE, |scale, value| scale.max(value.abs()));
    for (i, (&got, &expected)) in got.iter().zip(expected).enumerate() {
        let error = (f64::from(got) - expected).abs() / scale;
        assert!(error <= tolerance, "entry {i}: {got} against {expected}, {error:.2e} of the largest");
    }
}

/// Computes output and gradients of queries, keys and values in f64, as in the paper's formulas.
pub fn attention_reference(sizes: &AttentionSizes, [q, k, v, grad]: [&[f32]; 4]) -> [Vec<f64>; 4] {
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
