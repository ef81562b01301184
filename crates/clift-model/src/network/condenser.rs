//! The neural condenser: compresses every cluster of tokens into its centroid (paper section 3.2, equations 1 to 4).
// B scenes, N tokens, S centroids, M = N - S members, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, assert_shape};

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::FeedForward;
use crate::network::camera_encoding::TokenTransforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::released_condenser::ReleasedCondenser;
use crate::network::tokens::Tokens;
use crate::ops::cluster_attention::cluster_attention;
use crate::ops::linear::linear_in_f32;
use crate::tokens::clusters::ClusterIndex;

/// Condenser blocks. Their gates start at zero: an untrained condenser returns the centroids unchanged.
#[derive(Module, Debug)]
pub struct Condenser {
    /// The paper's blocks; empty in the released networks, and in those without a condenser.
    blocks: Vec<CondenserBlock>,
    /// The single block of the released networks.
    released: Option<ReleasedCondenser>,
}

/// One round of equations 1 to 4 on the centroids `c` and the members `m` of each cluster: `eq1 = self_attention(c)`,
/// `eq2 = cluster_attention(eq1, m)`, `eq3 = feed_forward(eq2)`; the result is `c + W_z eq3`.
#[derive(Module, Debug)]
struct CondenserBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    /// Present with residuals only: the printed equation 2 has no norm of the query.
    norm_cross: Option<LayerNorm>,
    norm_memory: LayerNorm,
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
        if config.has_released_condenser() {
            return Self { blocks: Vec::new(), released: Some(ReleasedCondenser::new(config, init)) };
        }
        let blocks = (0..config.condenser.num_blocks).map(|_| CondenserBlock::new(config, init)).collect();
        Self { blocks, released: None }
    }

    /// Sets the gates to zero: the condenser returns the centroids unchanged, as an untrained one does.
    #[must_use]
    pub fn close_gates(mut self) -> Self {
        let gates = self.blocks.iter_mut().map(|block| &mut block.gate);
        for gate in gates.chain(self.released.iter_mut().map(|released| &mut released.gate)) {
            gate.weight = gate.weight.clone().map(|weight| weight.zeros_like());
            gate.bias = gate.bias.take().map(|bias| bias.map(|values| values.zeros_like()));
        }
        self
    }

    /// Compresses every cluster of tokens into its centroid. The cost is linear in `num_tokens`, because a token is a
    /// key of its own centroid only.
    ///
    /// # Shapes
    /// - `lift`: `[batch, num_tokens, dim]`, encoder output after [`LiftNorm`](crate::LiftNorm)
    /// - returns `[batch, num_storage_tokens, dim]`
    pub fn forward(&self, lift: impl Into<Tokens>, clusters: &ClusterIndex) -> Tokens {
        let lift = lift.into();
        let [_batch, _num_tokens, dim] = lift.dims();
        let centroids = lift.centroids(clusters); // [B, N, D] -> [B, S, D]
        assert_shape!(centroids.values, [clusters.batch, clusters.num_storage_tokens, dim]);
        if let Some(released) = &self.released {
            return released.forward(centroids.values, lift.values, clusters).into();
        }
        // "The remaining LiFTs": a centroid is not among its keys.
        let members = clusters.members.as_ref().map(|members| lift.gather(clusters, &members.token)); // [B, M, D]
        let forward = |centroids, block: &CondenserBlock| block.forward(centroids, members.as_ref(), clusters);
        self.blocks.iter().fold(centroids, forward)
    }
}

impl CondenserBlock {
    fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let dim = config.dim;
        Self {
            norm_self: init.layer_norm(dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: config.condenser.residual.then(|| init.layer_norm(dim)),
            norm_memory: init.layer_norm(dim),
            cluster_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(dim),
            feed_forward: FeedForward::new(dim, config.feed_forward_dim, init),
            gate: init.zero_linear(dim, dim),
            member_share: config.condenser.member_share,
        }
    }

    /// Applies equations 1 to 4. Without members, every cluster is one token and equation 2 does nothing.
    fn forward(&self, centroids: Tokens, members: Option<&Tokens>, clusters: &ClusterIndex) -> Tokens {
        let Tokens { values: centroids, transforms } = centroids;
        let attended = self.self_attn.forward(&self.norm_self, centroids.clone(), transforms.as_ref());
        let eq1 = self.residual(&centroids, attended);
        let eq2 = match members {
            Some(members) => self.attend_members(eq1, transforms.as_ref(), members.clone(), clusters),
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

    /// Equation 2: each centroid attends to the members of its cluster. A cluster of one token has no keys and keeps the
    /// value of equation 1.
    fn attend_members(
        &self,
        eq1: Tensor<3>,
        transforms: Option<&TokenTransforms>,
        members: Tokens,
        clusters: &ClusterIndex,
    ) -> Tensor<3> {
        let segment = clusters.members.as_ref().expect("there are members").segment.clone();
        let key_value = self.cluster_attn.project_key_value(Some(&self.norm_memory), members);
        let query = self.cluster_attn.project_query(self.norm_cross.as_ref(), eq1.clone(), transforms);
        let attended = cluster_attention(query, key_value, segment, self.cluster_attn.num_heads());
        let eq2 = self.residual(&eq1, self.cluster_attn.project_out(attended, transforms));
        match &clusters.singleton {
            Some(singleton) => eq2.clone().mask_where(singleton.clone().expand(eq2.dims()), eq1),
            None => eq2,
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
    use burn::module::{ModuleMapper, Param};
    use burn::tensor::DType;

    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::config::CondenserConfig;
    use crate::testing::{
        Fixture, assert_close, check_gradients, cpu_devices, devices, load_weights, random, to_f64, weight_gradients,
    };
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
                let output = condenser.forward(lift.clone(), &clusters.upload(&device)).values;
                let expected = fixture.tensor::<3>("output.clift", &device).inner();
                assert_close(&output.clone().inner(), &expected, 1e-5);
                let grads = (output * fixture.tensor("input.cotangent", &device)).sum().backward();
                let expected = fixture.tensor::<3>("grad.input.lift", &device).inner();
                assert_close(&lift.grad(&grads).expect("tracked"), &expected, 5e-5);
                weight_gradients(&condenser, &grads, &fixture, "grad.weight.", 5e-5);
            }
        }
    }

    #[test]
    fn singletons_and_duplicate_tokens_give_finite_gradients() {
        let cases = [
            SceneClusters::new(vec![0; 5], vec![4]).expect("one cluster"),
            SceneClusters::identity(5),
            SceneClusters::new(vec![0, 1, 1, 1, 1], vec![0, 2]).expect("a singleton"),
        ];
        for (residual, distinct) in [(false, 5), (true, 5), (false, 1), (true, 1)] {
            let mut config = config(CliftVariant::Paper);
            config.condenser.residual = residual;
            for (scene, device) in cases.iter().flat_map(|scene| devices().into_iter().map(move |d| (scene, d))) {
                let device = device.autodiff();
                let condenser = Condenser::new(&config, &mut Init::new(0, &device));
                let fixture = Fixture::open(if residual { "condenser_residual" } else { "condenser" });
                // The gates of the fixture are open.
                let condenser = load_weights(condenser, &fixture, "weight.");
                let tokens = random([1, distinct, 16], 2, &device).cast(DType::F32);
                let lift = tokens.expand([1, 5, 16]).detach().require_grad();
                let index = Clusters::new(vec![scene.clone()]).expect("one scene").upload(&device);
                let output = condenser.forward(lift.clone(), &index).values;
                let gradient = lift.grad(&output.clone().square().sum().backward()).expect("tracked");
                for values in [output.inner(), gradient] {
                    let sum = values.abs().sum().into_scalar::<f32>();
                    assert!(sum.is_finite() && sum > 0.0, "{residual} {distinct} {scene:?}: {sum}");
                }
            }
        }
    }

    #[test]
    fn released_gradients_equal_central_differences_in_f64() {
        for variant in [CliftVariant::ReleasedRe10k, CliftVariant::ReleasedDl3dv] {
            for device in cpu_devices() {
                let mut init = Init::new(5, &device);
                let mut condenser = Condenser::new(&config(variant), &mut init);
                condenser.released.as_mut().expect("a released network").gate = init.linear(16, 16);
                let condenser = to_f64(condenser);
                // Cluster 2 has one token, which attends to itself.
                let scene = SceneClusters::new(vec![0, 1, 1, 2, 1], vec![0, 4, 3]).expect("valid");
                let clusters = Clusters::new(vec![scene]).expect("one");
                let forward = |lift: Tensor<3>| {
                    let device = lift.device();
                    if lift.is_autodiff() {
                        condenser.clone().train().forward(lift, &clusters.upload(&device.autodiff())).values
                    } else {
                        condenser.clone().forward(lift, &clusters.upload(&device)).values
                    }
                };
                check_gradients([random([1, 5, 16], 6, &device)], |[lift]| forward(lift), 1e-6);
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
                assert_close(&condenser.forward(lift.clone(), &index).values, &expected, 0.0);
            }
        }
    }
}
