//! The neural condenser: compresses every cluster of tokens into its centroid (paper section 3.2, equations 1 to 4).
// B scenes, N tokens, S centroids, M members, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Int, Tensor};

use crate::network::architecture::CliftVariant;
use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::{Activation, FeedForward};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::cluster_attention::cluster_attention;
use crate::ops::linear::linear_in_f32;
use crate::tokens::clusters::ClusterIndex;

/// Heads of the published condensers, whatever the number of encoder and renderer. A network too narrow for them, as in tests,
/// has `num_heads` here too.
const PUBLISHED_HEADS: usize = 8;
const MIN_HEAD_WIDTH: usize = 8;

/// A condenser. Its gates start at zero: an untrained condenser returns the centroids unchanged, as one without blocks does.
#[derive(Module, Debug)]
pub struct Condenser {
    blocks: Vec<CondenserBlock>,
    /// The one block of the published checkpoints. It departs from the paper: residuals around all three parts; keys and
    /// values are all tokens without a norm, so that a cluster of one token attends to itself; `ReLU`; a gate with bias.
    released: Option<CondenserBlock>,
}

/// One round of equations 1 to 4 on the centroids `c` and the members `m` of each cluster: `eq1 = self_attention(c)`,
/// `eq2 = cluster_attention(eq1, m)`, `eq3 = feed_forward(eq2)`; the result is `c + W_z eq3`.
#[derive(Module, Debug)]
struct CondenserBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    /// Present with residuals only: the printed equation 2 has no norm of the query.
    norm_cross: Option<LayerNorm>,
    /// Absent from the published checkpoints.
    norm_memory: Option<LayerNorm>,
    cluster_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
    /// `W_z` of equation 4, zero at the start.
    gate: Linear,
    /// Whether a cluster's share of members multiplies what equation 4 adds.
    member_share: bool,
}

impl Condenser {
    /// Makes a condenser of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        if !config.variant.is_released() {
            let blocks = (0..config.condenser.num_blocks).map(|_| CondenserBlock::new(config, init)).collect();
            return Self { blocks, released: None };
        }
        let has_published_heads = config.dim.is_multiple_of(PUBLISHED_HEADS * MIN_HEAD_WIDTH);
        let num_heads = if has_published_heads { PUBLISHED_HEADS } else { config.num_heads };
        // The network for DL3DV has the same condenser: only its encoder and renderer have norms of queries and keys.
        let config = ModelConfig { num_heads, variant: CliftVariant::ReleasedRe10k, ..config.clone() };
        Self { blocks: Vec::new(), released: Some(CondenserBlock::new(&config, init)) }
    }

    /// Sets the gates to zero: the condenser returns the centroids unchanged, as an untrained one does.
    #[must_use]
    pub fn close_gates(mut self) -> Self {
        for CondenserBlock { gate, .. } in self.blocks.iter_mut().chain(&mut self.released) {
            gate.weight = gate.weight.clone().map(|weight| weight.zeros_like());
            gate.bias = gate.bias.take().map(|bias| bias.map(|values| values.zeros_like()));
        }
        self
    }

    /// Compresses every cluster of tokens into its centroid. The cost is linear in `num_tokens`, because a token is a
    /// key of its own centroid only.
    ///
    /// # Shapes
    /// - `lift`: `[batch, num_tokens, dim]`, encoder output after its norm
    /// - returns `[batch, num_storage_tokens, dim]`
    pub fn forward(&self, lift: Tokens, clusters: &ClusterIndex) -> Tokens {
        let centroids = lift.centroids(clusters); // [B, N, D] -> [B, S, D]
        if let Some(block) = &self.released {
            return block.forward(centroids, Some((&lift, &clusters.segment)), clusters);
        }
        // "The remaining LiFTs": a centroid is not among its keys.
        let members = clusters.members.as_ref();
        let members = members.map(|members| (lift.map(|rows| clusters.gather(rows, &members.token)), &members.segment)); // [B, M, D]
        let keys = members.as_ref().map(|(tokens, segment)| (tokens, *segment));
        self.blocks.iter().fold(centroids, |centroids, block| block.forward(centroids, keys, clusters))
    }
}

impl CondenserBlock {
    fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let (dim, is_released) = (config.dim, config.variant.is_released());
        let activation = if is_released { Activation::Relu } else { Activation::Gelu };
        Self {
            norm_self: init.layer_norm(dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: config.condenser.residual.then(|| init.layer_norm(dim)),
            norm_memory: (!is_released).then(|| init.layer_norm(dim)),
            cluster_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(dim),
            feed_forward: FeedForward::new(activation, dim, config.feed_forward_dim, init),
            gate: init.zero_linear(dim, is_released),
            member_share: config.condenser.member_share,
        }
    }

    /// Applies equations 1 to 4 with keys and the centroid row of each. Without keys, every cluster is one token and equation
    /// 2 does nothing.
    fn forward(&self, centroids: Tokens, keys: Option<(&Tokens, &Tensor<1, Int>)>, clusters: &ClusterIndex) -> Tokens {
        let Tokens { values: centroids, transforms } = centroids;
        let attended = self.self_attn.forward(&self.norm_self, centroids.clone(), transforms.as_ref());
        let eq1 = self.residual(&centroids, attended);
        let eq2 = match keys {
            Some(keys) => self.attend_keys(eq1, transforms.as_ref(), keys, clusters),
            None => eq1,
        };
        let eq3 = self.residual(&eq2, self.feed_forward.forward(&self.norm_ff, eq2.clone()));
        let mut update = linear_in_f32(&self.gate, eq3);
        if self.member_share {
            let share = clusters.member_share.clone().cast(update.dtype());
            update = update * share;
        }
        Tokens { values: centroids + update, transforms } // equation 4
    }

    /// Equation 2: each centroid attends to the keys of its cluster. A cluster of one token without members as keys keeps the
    /// value of equation 1.
    fn attend_keys(
        &self,
        eq1: Tensor<3>,
        transforms: Option<&Tensor<3>>,
        (tokens, segment): (&Tokens, &Tensor<1, Int>),
        clusters: &ClusterIndex,
    ) -> Tensor<3> {
        let key_value = self.cluster_attn.project_key_value(self.norm_memory.as_ref(), tokens.clone());
        let query = self.cluster_attn.project_query(self.norm_cross.as_ref(), eq1.clone(), transforms);
        let attended = cluster_attention(query, key_value, segment.clone(), self.cluster_attn.num_heads());
        let eq2 = self.residual(&eq1, self.cluster_attn.project_out(attended, transforms));
        match &clusters.singleton {
            Some(singleton) if self.norm_memory.is_some() => {
                eq2.clone().mask_where(singleton.clone().expand(eq2.dims()), eq1)
            }
            _ => eq2,
        }
    }

    /// Adds the input to the output ("Add & `LayerNorm`" of the paper's text), or returns the output as equations 1 to 3
    /// print it.
    fn residual(&self, input: &Tensor<3>, output: Tensor<3>) -> Tensor<3> {
        if self.norm_cross.is_some() { input.clone() + output } else { output }
    }
}

#[cfg(test)]
mod tests {
    use burn::module::{Module, ModuleMapper, Param};
    use burn::tensor::{DType, Tensor};

    use super::*;
    use crate::network::config::CondenserConfig;
    use crate::testing::{Fixture, assert_close, devices, load_weights, random, small_config, weight_gradients};
    use crate::tokens::clusters::{Clusters, SceneClusters};

    fn config(variant: CliftVariant) -> ModelConfig {
        let condenser = CondenserConfig::of(variant);
        ModelConfig { variant, dim: 16, num_heads: 4, feed_forward_dim: 24, condenser, ..ModelConfig::default() }
    }

    fn fixture_clusters(fixture: &Fixture) -> Clusters {
        let per_scene = |name: &str| {
            let (values, count) = (fixture.integers(name), fixture.shape(name)[1]);
            values.chunks(count).map(|row| row.iter().map(|&v| v as u32).collect()).collect::<Vec<Vec<u32>>>()
        };
        let scenes = per_scene("input.assignment").into_iter().zip(per_scene("input.centroid_index"));
        Clusters::new(scenes.map(|(a, c)| SceneClusters::new(a, c).expect("valid")).collect()).expect("equal counts")
    }

    #[test]
    fn equals_dense_masked_attention_with_gradients_in_all_forms() {
        for (name, residual, member_share) in
            [("condenser", false, false), ("condenser_residual", true, false), ("condenser_member_share", true, true)]
        {
            let fixture = Fixture::open(name);
            let clusters = fixture_clusters(&fixture);
            let mut config = config(CliftVariant::Paper);
            config.condenser = CondenserConfig { residual, member_share, ..config.condenser };
            for device in devices() {
                let device = device.autodiff();
                let condenser = Condenser::new(&config, &mut Init::new(0, &device));
                let condenser = load_weights(condenser, &fixture, "weight.");
                let lift = fixture.tensor::<3>("input.lift", &device).require_grad();
                let output = condenser.forward(Tokens::without_cameras(lift.clone()), &clusters.upload(&device)).values;
                let expected = fixture.tensor::<3>("output.clift", &device).inner();
                assert_close(&output.clone().inner(), &expected, 1e-5);
                let grads = (output * fixture.tensor("input.cotangent", &device)).sum().backward();
                let expected = fixture.tensor::<3>("grad.input.lift", &device).inner();
                assert_close(&lift.grad(&grads).expect("tracked"), &expected, 5e-5);
                weight_gradients(&condenser, &grads, &fixture, "grad.weight.", 5e-5);
            }
        }
    }

    struct PlusOne;
    impl ModuleMapper for PlusOne {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            param.map(|tensor| tensor + 1.0)
        }
    }

    #[test]
    fn a_condenser_with_closed_gates_returns_the_centroids() {
        for (device, variant) in devices().into_iter().flat_map(|device| CliftVariant::ALL.map(|v| (device.clone(), v)))
        {
            let untrained = Condenser::new(&config(variant), &mut Init::new(0, &device));
            let closed = untrained.clone().map(&mut PlusOne).close_gates();
            let lift = random([2, 6, 16], 1, &device).cast(DType::F32);
            let scene = SceneClusters::new(vec![0, 1, 1, 0, 0, 1], vec![3, 2]).expect("valid");
            let index = Clusters::new(vec![scene.clone(), scene]).expect("equal").upload(&device);
            let expected = index.gather(lift.clone(), &index.centroid);
            for condenser in [untrained, closed] {
                assert_close(&condenser.forward(Tokens::without_cameras(lift.clone()), &index).values, &expected, 0.0);
            }
        }
    }

    #[test]
    fn published_condensers_have_eight_heads() {
        for (dim, num_heads, expected) in [(512, 8, 8), (768, 12, 8), (16, 4, 4)] {
            let config =
                ModelConfig { dim, num_heads, feed_forward_dim: 8, ..small_config(CliftVariant::ReleasedRe10k) };
            let condenser = Condenser::new(&config, &mut Init::new(5, &devices()[0]));
            assert_eq!(condenser.released.expect("published").cluster_attn.num_heads(), expected, "{dim}");
        }
    }
}
