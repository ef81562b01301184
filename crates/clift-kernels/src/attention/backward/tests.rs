use super::*;
use crate::attention::forward::attention_forward;
use crate::testing::{assert_close, attention_reference, random};

fn rows(values: &[f32], sizes: &AttentionSizes, count: usize) -> StridedRows<'static> {
    let values: &'static [f32] = values.to_vec().leak();
    StridedRows { values, batch_stride: count * sizes.dim(), row_stride: sizes.dim() }
}

fn gradients(
    set: InstructionSet,
    operands: OperandType,
    sizes: AttentionSizes,
    saved: BackwardInputs<'_>,
) -> [Vec<f32>; 3] {
    let AttentionSizes { batch, num_queries, num_keys, .. } = sizes;
    let dim = sizes.dim();
    let part = |packed: &[f32], parts: usize, part: usize| {
        packed.chunks_exact(parts * dim).flat_map(|row| row[part * dim..(part + 1) * dim].to_vec()).collect()
    };
    let mut query = vec![f32::NAN; batch * num_queries * dim];
    let mut key_value = vec![f32::NAN; batch * num_keys * 2 * dim];
    let to = AttentionGradients::Separate { query: &mut query, key_value: &mut key_value };
    attention_backward(set, operands, sizes, saved, to);
    let separate = [query, part(&key_value, 2, 0), part(&key_value, 2, 1)];
    if num_queries == num_keys {
        let mut packed = vec![f32::NAN; batch * num_queries * 3 * dim];
        attention_backward(set, operands, sizes, saved, AttentionGradients::Packed(&mut packed));
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
    let expected = attention_reference(&sizes, [&q, &k, &v, &grad]);
    // bf16 has 8 bits of significand; errors of scores grow with the scores.
    let bf16 = (OperandType::Bf16, 1e-2 * f64::from(spread));
    let all = InstructionSet::available().flat_map(|set| [(OperandType::F32, 1e-5), bf16].map(|with| (set, with)));
    for (set, (operands, tolerance)) in all {
        let mut output = vec![f32::NAN; q.len()];
        let mut log_sum = vec![f32::NAN; batch * num_heads * num_queries];
        let [query, key, value] =
            [rows(&q, &sizes, num_queries), rows(&k, &sizes, num_keys), rows(&v, &sizes, num_keys)];
        attention_forward(set, operands, sizes, [query, key, value], &mut output, &mut log_sum);
        assert_close(&output, &expected[0], tolerance);
        let saved = BackwardInputs {
            query,
            key,
            value,
            output: rows(&output, &sizes, num_queries),
            log_sum: &log_sum,
            grad_output: rows(&grad, &sizes, num_queries),
        };
        let grads = gradients(set, operands, sizes, saved);
        for (grad, expected) in grads.iter().zip(&expected[1..]) {
            // One key: the exact gradient of queries and keys is zero.
            if num_keys > 1 || expected.iter().any(|&value| value != 0.0) {
                assert_close(grad, expected, tolerance);
            } else {
                assert!(grad.iter().all(|value| f64::from(value.abs()) < tolerance));
            }
        }
    }
}

#[test]
fn every_instruction_set_equals_f64_at_odd_shapes() {
    for ([batch, num_queries, num_keys, num_heads, head_width], spread) in [
        ([1, 1, 7, 1, 12], 1.0),
        ([2, 5, 1, 2, 12], 1.0),
        ([1, 97, 601, 2, 12], 3.0),
        ([2, 131, 67, 3, 96], 1.0),
        ([1, 13, 1031, 1, 96], 2.0),
        ([1, 200, 33, 1, 16], 1.0),
        ([1, 24, 48, 2, 40], 1.0),
        ([2, 51, 51, 2, 20], 1.0),
    ] {
        check(AttentionSizes { batch, num_queries, num_keys, num_heads, head_width }, spread);
    }
}
