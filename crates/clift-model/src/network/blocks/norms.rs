//! What stands between the encoder and those who read its tokens.

use burn::module::Module;
use burn::nn::{LayerNorm, RmsNorm};
use burn::tensor::Tensor;

use crate::network::config::ModelConfig;
use crate::network::init::Init;

/// A layer norm of the encoder's tokens in the released DL3DV network, nothing in the others. The encoder is frozen
/// in stage 2, this norm is trained in both.
#[derive(Module, Debug)]
pub struct LiftNorm {
    norm: Option<LayerNorm>,
}

impl LiftNorm {
    /// Makes what the variant has.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self { norm: config.variant.has_norms().then(|| init.layer_norm(config.dim)) }
    }

    /// Whether tokens are changed at all.
    pub fn is_norm(&self) -> bool {
        self.norm.is_some()
    }

    /// The tokens that K-means, condenser and renderer read.
    ///
    /// # Shapes
    /// - `lift` and the result: `[batch, num_tokens, dim]`
    pub fn forward(&self, lift: Tensor<3>) -> Tensor<3> {
        match &self.norm {
            Some(norm) => norm.forward(lift),
            None => lift,
        }
    }
}

/// Two norms over the columns of a head, `x / sqrt(mean(x^2) + 1e-5) * gamma`, each with one gamma `[head width]`
/// for all heads.
#[derive(Module, Debug)]
pub struct QkNorm {
    query: RmsNorm,
    key: RmsNorm,
}

impl QkNorm {
    /// The norms of an attention layer, for variants that have them.
    pub fn of(config: &ModelConfig, init: &mut Init) -> Option<Self> {
        config.variant.has_norms().then(|| {
            let head_width = config.dim / config.num_heads;
            Self { query: init.rms_norm(head_width), key: init.rms_norm(head_width) }
        })
    }

    /// Normalises queries, `[batch, count, dim]`.
    pub(crate) fn queries(&self, query: Tensor<3>) -> Tensor<3> {
        per_head(&self.query, query)
    }

    /// Normalises the keys of keys and values side by side, `[batch, count, 2 dim]`.
    pub(crate) fn keys_beside_values(&self, key_value: Tensor<3>) -> Tensor<3> {
        let [key, value] = parts(&key_value);
        Tensor::cat(vec![per_head(&self.key, key), value], 2)
    }

    /// Normalises the first two of queries, keys and values side by side, `[batch, count, 3 dim]`.
    pub(crate) fn packed(&self, query_key_value: Tensor<3>) -> Tensor<3> {
        let [query, key, value] = parts(&query_key_value);
        Tensor::cat(vec![per_head(&self.query, query), per_head(&self.key, key), value], 2)
    }
}

/// Cuts the columns into equal parts.
fn parts<const COUNT: usize>(x: &Tensor<3>) -> [Tensor<3>; COUNT] {
    let [_batch, _count, columns] = x.dims();
    let width = columns / COUNT;
    std::array::from_fn(|part| x.clone().narrow(2, part * width, width))
}

/// Unlike Burn's own forward, squares are taken in the type of `x`, so that f64 stays f64.
fn per_head(norm: &RmsNorm, x: Tensor<3>) -> Tensor<3> {
    let [batch, count, dim] = x.dims();
    let [head_width] = norm.gamma.dims();
    let x = x.reshape([batch, count, dim / head_width, head_width]); // [B, N, H, E]
    let scale = (x.clone().square().mean_dim(3) + norm.epsilon).sqrt();
    (x / scale * norm.gamma.val().reshape([1, 1, 1, head_width])).reshape([batch, count, dim])
}

#[cfg(test)]
mod qk_norm_tests {
    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::testing::{check_gradients, cpu_devices, devices, random, to_vec};

    fn config() -> ModelConfig {
        ModelConfig { variant: CliftVariant::ReleasedDl3dv, dim: 6, num_heads: 3, ..ModelConfig::default() }
    }

    #[test]
    fn every_head_has_a_mean_square_of_one_and_values_stay_as_they_are() {
        for device in devices() {
            let norm = QkNorm::of(&config(), &mut Init::new(0, &device)).expect("DL3DV has one");
            let x = random([2, 5, 18], 1, &device).cast(burn::tensor::DType::F32) * 30.0;
            let (before, after) = (to_vec(x.clone()), to_vec(norm.packed(x)));
            for (before, after) in before.chunks(18).zip(after.chunks(18)) {
                for head in after[..12].chunks(2) {
                    let mean_square = head.iter().map(|value| value * value).sum::<f64>() / 2.0;
                    assert!((mean_square - 1.0).abs() < 1e-3, "{head:?}"); // epsilon against squares of about 300
                }
                assert_eq!(before[12..], after[12..]);
            }
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            let norm = QkNorm::of(&config(), &mut Init::new(0, &device)).expect("DL3DV has one");
            let gamma = random([2], 5, &device) + 2.0;
            let forward = |x: Tensor<3>| {
                let mut norm = norm.clone();
                let gamma = if x.is_autodiff() { gamma.clone().autodiff() } else { gamma.clone() };
                norm.query.gamma = burn::module::Param::from_tensor(gamma.clone());
                norm.key.gamma = burn::module::Param::from_tensor(gamma * 0.5);
                norm.packed(x)
            };
            check_gradients([random([2, 3, 18], 1, &device)], |[x]| forward(x), 1e-6);
        }
    }
}
