//! Single operations at the paper's sizes (`full`) and at those of a small network (`tiny`):
//! `cargo bench --workspace --features clift-model/criterion --bench operations`
// B scenes, N tokens, S stored, D width

use std::time::Duration;

use burn::module::Module;
use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_model::{Init, KMeans, cluster_attention, gelu_linear, linear, norm_linear, self_sdpa};
use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Sizes of one network.
struct Sizes {
    name: &'static str,
    batch: usize,
    num_tokens: usize,
    num_storage_tokens: usize,
    dim: usize,
    num_heads: usize,
    feed_forward_dim: usize,
}

const SIZES: [Sizes; 2] = [
    Sizes {
        name: "tiny",
        batch: 8,
        num_tokens: 256,
        num_storage_tokens: 64,
        dim: 128,
        num_heads: 8,
        feed_forward_dim: 341,
    },
    Sizes {
        name: "full",
        batch: 1,
        num_tokens: 4096,
        num_storage_tokens: 1024,
        dim: 768,
        num_heads: 8,
        feed_forward_dim: 2048,
    },
];

/// Values of unit variance.
fn random(shape: [usize; 3], seed: u64, device: &Device) -> Tensor<3> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let bound = 3.0_f32.sqrt();
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random_range(-bound..bound)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Times an operation, and the operation with its backward pass.
fn both<const COUNT: usize>(
    group: &mut BenchmarkGroup<WallTime>,
    size: &str,
    inputs: [Tensor<3>; COUNT],
    operation: impl Fn([Tensor<3>; COUNT]) -> Tensor<3>,
) {
    group.bench_function(format!("forward/{size}"), |bencher| bencher.iter(|| operation(inputs.clone())));
    // Mean of squares, whose cotangent is no constant.
    let tracked = inputs.map(|input| input.autodiff().require_grad());
    group.bench_function(format!("forward_backward/{size}"), |bencher| {
        bencher.iter(|| operation(tracked.clone()).square().mean().backward());
    });
}

fn attention(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("sdpa");
    for Sizes { name, batch, num_tokens, dim, num_heads, .. } in SIZES {
        let packed = random([batch, num_tokens, 3 * dim], 1, &device);
        both(&mut group, name, [packed], |[packed]| self_sdpa(packed, num_heads));
    }
}

fn intra_cluster_attention(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("cluster_attention");
    for Sizes { name, batch, num_tokens, num_storage_tokens, dim, num_heads, .. } in SIZES {
        let num_members = num_tokens - num_storage_tokens;
        let inputs = [(num_storage_tokens, dim, 1), (num_members, 2 * dim, 2)]
            .map(|(rows, columns, seed)| random([batch, rows, columns], seed, &device));
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let segment: Vec<i64> = (0..batch * num_members)
            .map(|row| (row / num_members * num_storage_tokens + rng.random_range(0..num_storage_tokens)) as i64)
            .collect();
        let segment = Tensor::<1, Int>::from_data(TensorData::new(segment, [batch * num_members]), &device);
        both(&mut group, name, inputs, |[query, key_value]| {
            cluster_attention(query, key_value, segment.clone(), num_heads)
        });
    }
}

fn layers(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("layers");
    for Sizes { name, batch, num_tokens, dim, feed_forward_dim, .. } in SIZES {
        let mut init = Init::new(0, &device.clone().autodiff());
        let (up, down) = (init.linear(dim, feed_forward_dim), init.linear(feed_forward_dim, dim));
        let norm = init.layer_norm(dim);
        let x = random([batch, num_tokens, dim], 1, &device);
        let hidden = random([batch, num_tokens, feed_forward_dim], 1, &device);
        // On a device without autodiff the layers' own copies are needed.
        let plain = |x: &Tensor<3>| !x.is_autodiff();
        let (up_plain, down_plain, norm_plain) = (up.valid(), down.valid(), norm.valid());
        both(&mut group, &format!("linear/{name}"), [x.clone()], |[x]| {
            linear(if plain(&x) { &up_plain } else { &up }, x)
        });
        both(&mut group, &format!("linear_of_gelu/{name}"), [hidden], |[x]| {
            gelu_linear(if plain(&x) { &down_plain } else { &down }, x)
        });
        both(&mut group, &format!("linear_of_norm/{name}"), [x], |[x]| {
            if plain(&x) { norm_linear(&norm_plain, &up_plain, x) } else { norm_linear(&norm, &up, x) }
        });
    }
}

fn clustering(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("kmeans");
    for Sizes { name, batch, num_tokens, num_storage_tokens, dim, .. } in SIZES {
        let tokens = random([batch, num_tokens, dim], 1, &device);
        let seeds: Vec<u64> = (0..batch as u64).collect();
        group.bench_function(name, |bencher| {
            bencher.iter(|| KMeans::default().fit(tokens.clone(), num_storage_tokens, &seeds).expect("finite tokens"));
        });
    }
}

/// Ten samples: one of the full attention takes seconds on a few cores.
fn settings() -> Criterion {
    Criterion::default().sample_size(10).warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(5))
}

criterion_group! {
    name = operations;
    config = settings();
    targets = attention, intra_cluster_attention, layers, clustering
}
criterion_main!(operations);
