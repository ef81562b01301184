//! The neural condenser: compresses every cluster of tokens into its centroid (paper section 3.2).
// B scenes, N tokens, S centroids, D width

use burn::tensor::assert_shape;

use crate::network::architecture::Architecture;
use crate::network::clift::condenser::PaperCondenser;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::parts::module_enum::module_enum;
use crate::network::released::ReleasedCondenser;
use crate::network::tokens::Tokens;
use crate::tokens::clusters::ClusterIndex;

module_enum! {
    #[expect(clippy::large_enum_variant, reason = "a model has one condenser")]
    /// A condenser. Its gates start at zero: an untrained condenser returns the centroids unchanged.
    Condenser {
        /// The paper's blocks; none for networks without a condenser.
        Paper(PaperCondenser),
        /// The block of the published checkpoints.
        Released(ReleasedCondenser),
    }
}

impl Condenser {
    /// Makes a condenser of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        if config.architecture == Architecture::Clift && config.variant.is_released() {
            Self::Released(ReleasedCondenser::new(config, init))
        } else {
            Self::Paper(PaperCondenser::new(config, init))
        }
    }

    /// Sets the gates to zero: the condenser returns the centroids unchanged, as an untrained one does.
    #[must_use]
    pub fn close_gates(mut self) -> Self {
        let gates: Vec<_> = match &mut self {
            Self::Paper(condenser) => condenser.gates().collect(),
            Self::Released(condenser) => vec![condenser.gate()],
        };
        for gate in gates {
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
    pub fn forward(&self, lift: Tokens, clusters: &ClusterIndex) -> Tokens {
        let [_batch, _num_tokens, dim] = lift.dims();
        let centroids = lift.centroids(clusters); // [B, N, D] -> [B, S, D]
        assert_shape!(centroids.values, [clusters.batch, clusters.num_storage_tokens, dim]);
        match self {
            Self::Paper(condenser) => condenser.forward(centroids, &lift, clusters),
            Self::Released(condenser) => condenser.forward(centroids, lift, clusters),
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::module::{Module, ModuleMapper, Param};
    use burn::tensor::{DType, Tensor};

    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::config::CondenserConfig;
    use crate::testing::{Fixture, assert_close, devices, load_weights, random, weight_gradients};
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
                let output = condenser.forward(Tokens::without_cameras(lift.clone()), &index).values;
                let gradient = lift.grad(&output.clone().square().sum().backward()).expect("tracked");
                for values in [output.inner(), gradient] {
                    let sum = values.abs().sum().into_scalar::<f32>();
                    assert!(sum.is_finite() && sum > 0.0, "{residual} {distinct} {scene:?}: {sum}");
                }
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
}
