//! The codec end to end: rates near the entropy, bounded errors, hostile words, and its file.

use std::collections::BTreeMap;

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::codec::histogram::Histograms;
use crate::codec::prediction::NeighbourProducts;
use crate::codec::rates::tests::rates;
use crate::codec::transform::Moments;

const DIM: usize = 8;

/// Tokens whose entries are sums of two-sided exponential values, with a few strong directions.
fn tokens(count: usize, dim: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let laplace = |rng: &mut ChaCha8Rng| {
        let uniform: f32 = rng.random_range(-1.0..1.0);
        -uniform.signum() * (1.0 - uniform.abs()).max(1e-6).ln()
    };
    let token = move |rng: &mut ChaCha8Rng| {
        let sources: Vec<f32> = (0..dim).map(|d| laplace(rng) * 8.0 / (1.0 + d as f32)).collect();
        // A mixture of the sources that any basis but the right one codes badly.
        (0..dim).map(|d| 3.0 + sources[d] + 0.7 * sources[(d * d + 1) % dim]).collect::<Vec<f32>>()
    };
    (0..count).flat_map(|_| token(&mut rng)).collect()
}

/// A codec for the model of the scenes in the tests of scene files.
pub(crate) fn codec(model: ModelConfig, kind: TokenKind, renderer_hash: String) -> TokenCodec {
    let dim = model.dim;
    let scenes: Vec<Vec<f32>> = (0..20).map(|seed| tokens(256, dim, seed)).collect();
    let mut moments = Moments::new(dim);
    for scene in &scenes {
        moments.add(scene);
    }
    let transform = moments.transform();
    let ids = ids(256);
    let places = places(&ids);
    let mut products = NeighbourProducts::new(dim);
    for scene in &scenes {
        products.add(&transform, scene, places);
    }
    let prediction = products.prediction(&transform);
    let mut histograms = Histograms::new(dim);
    for scene in &scenes {
        histograms.add(&transform, &prediction, scene, places);
    }
    let network = (model, kind, renderer_hash);
    TokenCodec::new(network, (transform, prediction), histograms.distributions(), rates()).expect("valid")
}

fn small() -> TokenCodec {
    let model = ModelConfig { dim: DIM, num_heads: 2, ..ModelConfig::default() };
    codec(model, TokenKind::Clift, "0123456789abcdef".repeat(4))
}

fn ids(count: usize) -> Vec<u32> {
    (0..count as u32).map(|id| 3 * id).collect()
}

/// Every third patch of views of 6 x 10.
fn places(ids: &[u32]) -> Places<'_> {
    Places { ids, grid: grid(ids.len()) }
}

fn grid(count: usize) -> [usize; 3] {
    [(3 * count).div_ceil(60), 6, 10]
}

#[test]
fn streams_take_the_bits_of_their_entropy() {
    let codec = small();
    let (unseen, ids) = (tokens(32_000, DIM, 99), ids(32_000));
    let mut of_ids = Encoder::default();
    encode_ids(&mut of_ids, &ids, grid(ids.len()).iter().product());
    let of_ids = of_ids.finish().len();
    for step in [0.2, 1.0, 4.0] {
        let stream = (codec.encode(&unseen, places(&ids), step).unwrap().len() - of_ids) as f64 * 32.0;
        let (levels, neighbours) = codec.quantize(&unseen, places(&ids), step).unwrap();
        let mut counts = BTreeMap::<_, BTreeMap<i32, f64>>::new();
        for (direction, levels) in levels.iter().enumerate() {
            for (level, &(class, nearest)) in levels.iter().zip(&neighbours) {
                let expected = codec.prediction.level(class, direction, nearest.map(|token| levels[token]));
                *counts.entry((direction, class)).or_default().entry(level - expected).or_default() += 1.0;
            }
        }
        let bits = |counts: &BTreeMap<i32, f64>| {
            let total: f64 = counts.values().sum();
            counts.values().map(|count| count * (total / count).log2()).sum::<f64>()
        };
        let entropy: f64 = counts.values().map(bits).sum();
        assert!(stream < 1.02 * entropy + 64.0, "step {step}: {stream} bits, entropy {entropy}");
        assert!(stream > 0.99 * entropy, "step {step}: {stream} bits, entropy {entropy}");
    }
}

#[test]
fn tokens_come_back_as_rounded() {
    let codec = small();
    let unseen = tokens(40, DIM, 7);
    let mut last = f32::INFINITY;
    for step in [4.0, 0.5, 0.01, 1e-4] {
        let words = codec.encode(&unseen, places(&ids(40)), step).unwrap();
        let rounded = codec.round(&unseen, places(&ids(40)), step).unwrap();
        let back = codec.decode(words, 40, grid(40), step).unwrap();
        assert_eq!(back, (ids(40), rounded.clone()));
        // A level is at most one step from its coefficient, and the basis is orthonormal.
        let error = rounded.iter().zip(&unseen).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
        assert!(error <= unseen.len() as f32 * (step * step + 1e-8), "step {step}: {error}");
        assert!(error < last);
        last = error;
    }
}

#[test]
fn tokens_unlike_all_training_tokens_are_coded() {
    let codec = small();
    let far: Vec<f32> = (0..4 * DIM).map(|i| if i == 5 { 1e6 } else { -3e4 }).collect();
    let words = codec.encode(&far, places(&ids(4)), 0.5).unwrap();
    let (_, back) = codec.decode(words, 4, grid(4), 0.5).unwrap();
    assert!(back.iter().zip(&far).all(|(a, b)| (a - b).abs() < 3.0), "{back:?}");
    for (step, expected) in [(1e-6, "write a larger step, or f32"), (0.0, "write a positive"), (f32::NAN, "positive")] {
        let message = codec.round(&far, places(&ids(4)), step).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    let message = codec.round(&[f32::MAX; DIM], places(&[0]), 1.0).unwrap_err().to_string();
    assert!(message.contains("write a larger step, or f32"), "{message}");
}

#[test]
fn hostile_words_are_refused_in_bounded_memory() {
    let codec = small();
    let words = codec.encode(&tokens(40, DIM, 7), places(&ids(40)), 0.5).unwrap();
    let refuse = |words: &[u32], count, patches: usize, step| {
        codec.decode(words.to_vec(), count, [1, 1, patches], step).unwrap_err()
    };
    assert!(refuse(&words, 0, 120, 0.5).contains("0 tokens, expected 1 to 120"));
    assert!(refuse(&words, 121, 120, 0.5).contains("121 tokens"));
    assert!(refuse(&words, 1 << 20, 1 << 20, 0.5).contains("expected at most"));
    let many = vec![1; 20_000];
    assert!(refuse(&many, 1 << 26, 1 << 26, 0.5).contains("expected at most 268435456 values"), "1 GiB");
    assert!(refuse(&[1, 0], 1, 1, 0.5).contains("last word"));
    assert!(refuse(&words, 40, 120, -1.0).contains("step -1"));
    assert!(refuse(&[&[7], &words[..]].concat(), 40, 120, 0.5).contains("words are left"));
    // Random words: an error or tokens, in time that the number of tokens bounds.
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for _ in 0..200 {
        let random: Vec<u32> = (0..40).map(|_| rng.next_u32() | 1).collect();
        for step in [1e-30, 1e-3, 1.0, 1e30] {
            let _ = codec.decode(random.clone(), 40, grid(40), step);
        }
    }
}

#[test]
fn codecs_survive_their_file_and_damage_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = TokenCodec::path_of(&folder.path().join("model.safetensors"));
    assert!(matches!(TokenCodec::read(&path), Err(ModelError::NoCodec { .. })));
    let codec = small();
    codec.write(&path).unwrap();
    assert_eq!(TokenCodec::read(&path).unwrap(), codec);
    assert_eq!(
        TokenCodec::path_of("run/model-9-steps.safetensors".as_ref()).to_str(),
        Some("run/codec-9-steps.safetensors")
    );
    assert_eq!(TokenCodec::path_of("re10k.ckpt".as_ref()).to_str(), Some("re10k.codec.safetensors"));
    let bytes = std::fs::read(&path).unwrap();
    let text = |from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    for (bytes, expected) in [
        (bytes[..bytes.len() - 1].to_vec(), "reading the token codec failed"),
        (text("clift-codec", "clift-scene"), "format \"clift-scene\", expected"),
        (text("\"version\":\"2\"", "\"version\":\"3\""), "version 3, this clift reads version 2"),
        (text("\\\"dim\\\":8", "\\\"dim\\\":4"), "`mean` is F32 [8], expected F32 [4]"),
        (text("rate_loss", "rate_lost"), "no tensor `rate_loss`"),
        (b"{}".to_vec(), "fit it again with `clift codec`"),
    ] {
        std::fs::write(&path, bytes).unwrap();
        let message = TokenCodec::read(&path).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    let damaged = |damage: &dyn Fn(&mut TokenCodec), expected: &str| {
        let mut codec = small();
        damage(&mut codec);
        codec.write(&path).unwrap();
        let message = TokenCodec::read(&path).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    };
    damaged(&|codec| codec.transform.deviations[3] = 0.0, "deviation 0 of direction 3");
    damaged(&|codec| codec.transform.basis[..DIM].fill(0.0), "direction 0 has no length");
    damaged(&|codec| codec.transform.mean[0] = f32::NAN, "`mean` contains NaN");
    damaged(&|codec| codec.distributions.knots[1] = 90.0, "the knots are not ascending numbers");
    damaged(&|codec| codec.distributions.cumulative[7] = 0.9, "the probabilities of direction 0");
    damaged(&|codec| codec.prediction.scales[0] = 0.0, "scale 0, expected a positive number");
    damaged(&|codec| codec.rates.steps[0] = 9.0, "`rates` =");
}
