//! Attention over many tokens and with large scores.
// B = 1 scene, N tokens, Q queries, D width

use burn::tensor::{Int, Tensor, TensorData};
use clift_model::{cluster_attention, cross_sdpa};
use clift_train::{TrainError, seeded_uniform};

use crate::cases::reference::{ToF64, largest_magnitude, relative_error};
use crate::doctor::stability::case::{CaseDevices, StabilityCase};

pub(crate) const CASES: &[StabilityCase] = &[
    StabilityCase {
        name: "64k tokens through attention",
        breaks: "sums of 65,536 weights and of their gradients",
        bound: 2e-5,
        reason: "1,024 queries on 65,536 keys; sums in blocks, so that the error does not grow with the tokens",
        run: long_attention,
    },
    StabilityCase {
        name: "logits near 1e4 and near -1e4, whole rows of them",
        breaks: "the maximum that is taken off, differences of large scores",
        bound: 2e-2,
        reason: "an f32 step at 1e4 is 1e-3, and a weight changes by as much as its logit does",
        run: |devices| {
            let count = devices.size.pick(64, 1024);
            let inputs = level_scores(devices, 1e4, [count, count]);
            operation_error(devices, inputs, |[query, key_value]| cross_sdpa(query, key_value, 2))
        },
    },
    StabilityCase {
        name: "the same inside clusters",
        breaks: "the maximum of a segment",
        bound: 2e-2,
        reason: "as above",
        run: clustered_attention,
    },
    StabilityCase {
        name: "logits of 0: every score the same",
        breaks: "weights of 1 / N",
        bound: 1e-5,
        reason: "sums of equal parts",
        run: |devices| {
            let count = devices.size.pick(64, 1024);
            let [query, key_value] = level_scores(devices, 0.0, [count, count]);
            operation_error(devices, [query.mul_scalar(0.0), key_value], |[query, key_value]| {
                cross_sdpa(query, key_value, 2)
            })
        },
    },
];

fn long_attention(devices: &CaseDevices) -> Result<f64, TrainError> {
    const DIM: usize = 32;
    let (keys, queries) = (devices.size.pick(2048, 1 << 16), devices.size.pick(16, 1024));
    let query = seeded_uniform([1, queries, DIM], 0, "stability query", &devices.device);
    let key_value = seeded_uniform([1, keys, 2 * DIM], 0, "stability key", &devices.device);
    operation_error(devices, [query, key_value], |[query, key_value]| cross_sdpa(query, key_value, 2))
}

/// Makes queries whose scores are all near `level` or all near `-level` and differ by about one, and keys with values.
fn level_scores(devices: &CaseDevices, level: f64, [queries, keys]: [usize; 2]) -> [Tensor<3>; 2] {
    const DIM: usize = 32;
    let head_width = DIM / 2;
    let uniform =
        |count: usize, width: usize, purpose: &str| seeded_uniform([1, count, width], 0, purpose, &devices.device);
    // The first column of a head holds the level, the others hold the differences.
    let columns = (0..DIM).map(|column| if column % head_width == 0 { 0.0 } else { 1.0 }).collect::<Vec<f64>>();
    let is_other = Tensor::<1>::from_data(TensorData::new(columns, [DIM]), &devices.device).reshape([1, 1, DIM]);
    let is_level = is_other.clone().mul_scalar(-1.0).add_scalar(1.0);
    let signs = (0..queries).map(|query| if query % 2 == 0 { level } else { -level }).collect::<Vec<f64>>();
    let signs = Tensor::<1>::from_data(TensorData::new(signs, [queries]), &devices.device).reshape([1, queries, 1]);
    let scale = (head_width as f64).sqrt();
    let query: Tensor<3> = uniform(queries, DIM, "stability query").mul_scalar(scale);
    let query = query * is_other.clone() + signs.mul_scalar(scale) * is_level.clone();
    let key: Tensor<3> = uniform(keys, DIM, "stability key") * is_other + is_level;
    [query, Tensor::cat(vec![key, uniform(keys, DIM, "stability value")], 2)]
}

fn clustered_attention(devices: &CaseDevices) -> Result<f64, TrainError> {
    let (stored, members) = (devices.size.pick(8, 64), devices.size.pick(64, 1024));
    let inputs = level_scores(devices, 1e4, [stored, members]);
    let segment: Vec<i64> = (0..members).map(|member| (member * 7 % stored) as i64).collect();
    operation_error(devices, inputs, move |[query, key_value]| {
        let segment = TensorData::new(segment.clone(), [segment.len()]);
        let segment = Tensor::<1, Int>::from_data(segment, &query.device().without_autodiff()).autodiff();
        cluster_attention(query, key_value, segment, 2)
    })
}

/// Returns the largest error of an operation's output and of the gradients of its inputs.
fn operation_error(
    devices: &CaseDevices,
    inputs: [Tensor<3>; 2],
    operation: impl Fn([Tensor<3>; 2]) -> Tensor<3>,
) -> Result<f64, TrainError> {
    let run = |inputs: [Tensor<3>; 2]| -> Result<[Tensor<3>; 3], TrainError> {
        let leaves = inputs.map(|input| input.autodiff().require_grad());
        let output = operation(leaves.clone());
        // A cotangent that varies over the output.
        let cotangent = output.clone().inner().cos();
        let mut grads = (output.clone() * cotangent.autodiff()).sum().backward();
        let [a, b] = leaves.map(|leaf| {
            leaf.grad_remove(&mut grads).ok_or_else(|| TrainError::Device { reason: "an input has no gradient".into() })
        });
        Ok([output.inner(), a?, b?])
    };
    let reference = inputs.each_ref().map(|input| input.in_f64(&devices.reference));
    let pairs = run(inputs)?.into_iter().zip(run(reference)?);
    Ok(largest_magnitude(pairs.map(|(result, reference)| relative_error(result, reference))))
}
