//! The neural condenser: writes what each cluster knows into its centroid (paper section 3.2).
// B scenes, N tokens, S centroids, M = N - S members, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, assert_shape};

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::FeedForward;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::released_condenser::ReleasedCondenser;
use crate::ops::cluster_attention::operation::cluster_attention;
use crate::ops::mac_counter;
use crate::tokens::clusters::ClusterIndex;

/// Blocks of inter-cluster self-attention, intra-cluster cross-attention and feed-forward behind a
/// gate that starts at zero: an untrained condenser returns the centroids unchanged.
#[derive(Module, Debug)]
pub struct Condenser {
    /// The paper's blocks; none in the released networks.
    blocks: Vec<CondenserBlock>,
    /// What the released networks have in their place.
    released: Option<ReleasedCondenser>,
}

/// One round of equations 1-4.
#[derive(Module, Debug)]
struct CondenserBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    /// With residuals only: equation 2 prints its query without a norm.
    norm_cross: Option<LayerNorm>,
    norm_memory: LayerNorm,
    cluster_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
    /// `W_z`, zero at the start.
    gate: Linear,
}

impl Condenser {
    /// Makes a condenser of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        if config.variant.is_released() {
            return Self { blocks: Vec::new(), released: Some(ReleasedCondenser::new(config, init)) };
        }
        let blocks = (0..config.condenser.num_blocks).map(|_| CondenserBlock::new(config, init)).collect();
        Self { blocks, released: None }
    }

    /// Writes what each cluster knows into its centroid (paper section 3.2, equations 1-4).
    ///
    /// # Shapes
    /// - `lift`: `[batch, num_tokens, dim]`, encoder output behind [`LiftNorm`](crate::network::blocks::norms::LiftNorm)
    /// - returns `[batch, num_storage_tokens, dim]`
    ///
    /// Cost is linear in `num_tokens`: a token is a key for its own centroid only.
    pub fn forward(&self, lift: Tensor<3>, clusters: &ClusterIndex) -> Tensor<3> {
        let [_batch, _num_tokens, dim] = lift.dims();
        let centroids = clusters.gather_centroids(lift.clone()); // [B, N, D] -> [B, S, D]
        assert_shape!(centroids, [clusters.batch, clusters.num_storage_tokens, dim]);
        if let Some(released) = &self.released {
            return released.forward(centroids, lift, clusters);
        }
        // "The remaining LiFTs": the centroid itself is not among its keys.
        let members = clusters.members.as_ref().map(|members| clusters.gather(lift, &members.token)); // [B, M, D]
        self.blocks.iter().fold(centroids, |centroids, block| block.forward(centroids, members.as_ref(), clusters))
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
        }
    }

    fn forward(&self, centroids: Tensor<3>, members: Option<&Tensor<3>>, clusters: &ClusterIndex) -> Tensor<3> {
        let mixed = self.add_or_replace(&centroids, self.self_attn.forward(&self.norm_self, centroids.clone())); // eq. 1
        let gathered = match members {
            Some(members) => self.gather_members(mixed, members.clone(), clusters), // eq. 2
            None => mixed,
        };
        let update = self.feed_forward.forward(&self.norm_ff, gathered.clone()); // eq. 3
        let update = self.add_or_replace(&gathered, update);
        let [batch, stored, dim] = update.dims();
        mac_counter::add_linear(batch * stored, dim, dim); // the one layer without a bias, which is Burn's own
        centroids + self.gate.forward(update) // eq. 4
    }

    /// Equation 2. A cluster of one token has no keys and keeps equation 1's value.
    fn gather_members(&self, mixed: Tensor<3>, members: Tensor<3>, clusters: &ClusterIndex) -> Tensor<3> {
        let segment = clusters.members.as_ref().expect("there are members").segment.clone();
        let key_value = self.cluster_attn.project_memory(Some(&self.norm_memory), members);
        let query = self.cluster_attn.project_query(self.norm_cross.as_ref(), mixed.clone());
        let found = cluster_attention(query, key_value, segment, self.cluster_attn.num_heads());
        let gathered = self.add_or_replace(&mixed, self.cluster_attn.project_out(found));
        match &clusters.singleton {
            Some(singleton) => gathered.clone().mask_where(singleton.clone().expand(gathered.dims()), mixed),
            None => gathered,
        }
    }

    /// "Add & `LayerNorm`" of the text, or the plain assignment the equations print.
    fn add_or_replace(&self, input: &Tensor<3>, output: Tensor<3>) -> Tensor<3> {
        if self.norm_cross.is_some() { input.clone() + output } else { output }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::config::CondenserConfig;
    use crate::testing::{
        Fixture, assert_close, check_gradients, cpu_devices, devices, load_weights, random, to_vec, weight_gradients,
    };
    use crate::tokens::clusters::{Clusters, SceneClusters};

    fn config(residual: bool) -> ModelConfig {
        ModelConfig {
            dim: 16,
            num_heads: 4,
            feed_forward_dim: 24,
            condenser: CondenserConfig { num_blocks: 2, residual },
            ..ModelConfig::default()
        }
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
    fn equals_dense_masked_attention_with_gradients_in_both_forms() {
        for (name, residual) in [("condenser", false), ("condenser_residual", true)] {
            let fixture = Fixture::open(name);
            let clusters = fixture_clusters(&fixture);
            for device in devices() {
                let device = device.autodiff();
                let condenser = Condenser::new(&config(residual), &mut Init::new(0, &device));
                let condenser = load_weights(condenser, &fixture, "weight.");
                let lift = fixture.tensor::<3>("input.lift", &device).require_grad();
                let output = condenser.forward(lift.clone(), &clusters.upload(&device));
                let expected = fixture.tensor::<3>("output.clift", &device).inner();
                assert_close(&output.clone().inner(), &expected, 1e-5);
                let grads = (output * fixture.tensor("input.cotangent", &device)).sum().backward();
                let expected = fixture.tensor::<3>("grad.input.lift", &device).inner();
                assert_close(&lift.grad(&grads).expect("tracked"), &expected, 5e-5);
                weight_gradients(&condenser, &grads, &fixture, "grad.weight.", 5e-5);
            }
        }
    }

    /// A condenser whose gates are open, so that it does something.
    fn open_condenser(device: &Device, residual: bool) -> Condenser {
        let mut init = Init::new(3, device);
        let mut condenser = Condenser::new(&config(residual), &mut init);
        for block in &mut condenser.blocks {
            block.gate.weight = init.linear(16, 16).weight;
        }
        condenser
    }

    /// Parameters in f64.
    struct Widen;

    impl burn::module::ModuleMapper for Widen {
        fn map_float<const D: usize>(
            &mut self,
            param: burn::module::Param<Tensor<D>>,
        ) -> burn::module::Param<Tensor<D>> {
            burn::module::Param::from_tensor(param.val().cast(DType::F64))
        }
    }

    #[test]
    fn gradients_of_the_released_networks_equal_central_differences_in_f64() {
        for variant in [CliftVariant::ReleasedRe10k, CliftVariant::ReleasedDl3dv] {
            for device in cpu_devices() {
                let config = ModelConfig { variant, condenser: CondenserConfig::of(variant), ..config(true) };
                let mut init = Init::new(5, &device);
                let mut condenser = Condenser::new(&config, &mut init);
                let released = condenser.released.as_mut().expect("a released network");
                released.open(&mut init);
                let condenser = burn::module::Module::map(condenser, &mut Widen);
                // A cluster of one attends to itself.
                let scene = SceneClusters::new(vec![0, 1, 1, 2, 1], vec![0, 4, 3]).expect("valid");
                let clusters = Clusters::new(vec![scene]).expect("one");
                let forward = |lift: Tensor<3>| {
                    let device = lift.device();
                    if lift.is_autodiff() {
                        condenser.clone().train().forward(lift, &clusters.upload(&device.autodiff()))
                    } else {
                        condenser.clone().forward(lift, &clusters.upload(&device))
                    }
                };
                check_gradients([random([1, 5, 16], 6, &device)], |[lift]| forward(lift), 1e-6);
            }
        }
    }

    #[test]
    fn an_untrained_condenser_returns_the_centroids() {
        let variants = CliftVariant::ALL.map(|variant| ModelConfig {
            variant,
            condenser: CondenserConfig::of(variant),
            ..config(true)
        });
        for (device, config) in devices().into_iter().flat_map(|device| variants.clone().map(|v| (device.clone(), v))) {
            let condenser = Condenser::new(&config, &mut Init::new(0, &device));
            let lift = random([2, 6, 16], 1, &device).cast(DType::F32);
            let scene = SceneClusters::new(vec![0, 1, 1, 0, 0, 1], vec![3, 2]).expect("valid");
            let index = Clusters::new(vec![scene.clone(), scene]).expect("equal").upload(&device);
            let expected = index.gather_centroids(lift.clone());
            assert_close(&condenser.forward(lift, &index), &expected, 0.0);
        }
    }

    #[test]
    fn one_cluster_all_singletons_and_duplicate_tokens_are_finite_with_finite_gradients() {
        let cases = [
            SceneClusters::new(vec![0; 5], vec![4]).expect("one cluster"),
            SceneClusters::identity(5),
            SceneClusters::new(vec![0, 1, 1, 1, 1], vec![0, 2]).expect("a singleton"),
        ];
        for (residual, duplicate) in [(false, false), (true, false), (false, true), (true, true)] {
            for scene in &cases {
                for device in devices() {
                    let device = device.autodiff();
                    let condenser = open_condenser(&device, residual);
                    let one = random([1, if duplicate { 1 } else { 5 }, 16], 2, &device).cast(DType::F32);
                    let lift = one.expand([1, 5, 16]).detach().require_grad();
                    let index = Clusters::new(vec![scene.clone()]).expect("one").upload(&device);
                    let output = condenser.forward(lift.clone(), &index);
                    assert!(to_vec(output.clone().inner()).iter().all(|v| v.is_finite()));
                    let gradient = lift.grad(&output.square().sum().backward()).expect("tracked");
                    assert!(to_vec(gradient).iter().all(|v| v.is_finite()));
                }
            }
        }
    }

    #[test]
    fn a_token_changes_its_own_centroid_through_its_cluster_and_order_of_members_does_not_matter() {
        let device = Device::flex();
        let condenser = open_condenser(&device, true);
        let lift = random([1, 5, 16], 4, &device).cast(DType::F32);
        let forward = |lift: Tensor<3>, assignment: Vec<u32>, centroids: Vec<u32>| {
            let scene = SceneClusters::new(assignment, centroids).expect("valid");
            condenser.forward(lift, &Clusters::new(vec![scene]).expect("one").upload(&device))
        };
        let output = forward(lift.clone(), vec![0, 0, 0, 1, 1], vec![0, 3]);
        let order = Tensor::from_ints([0, 2, 1, 3, 4], &device);
        let swapped = forward(lift.clone().select(1, order), vec![0, 0, 0, 1, 1], vec![0, 3]);
        assert_close(&swapped, &output, 1e-6);
        let moved = forward(lift, vec![0, 0, 1, 1, 1], vec![0, 3]);
        assert!(to_vec((moved - output).abs().max())[0] > 1e-4, "membership matters");
    }
}
