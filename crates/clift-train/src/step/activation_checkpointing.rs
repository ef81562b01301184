//! Activation checkpointing: a backward pass that stores only the values between blocks and recomputes the rest.
//!
//! Memory per block is one input instead of all activations, for one more forward pass. The gradients equal those of the
//! plain backward: the same operations on the same values.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Gradients, Tensor};
use clift_model::{Network, PassState};

use crate::error::TrainError;
use crate::step::batch::BatchTokens;
use crate::step::device_batch::DeviceBatch;
use crate::step::loss::{Loss, LossParts, Rendering};

/// Adds the gradients of `share` times the loss of a batch to `accumulator`, and returns the loss.
pub(crate) fn backward(
    model: &Network,
    device_batch: &DeviceBatch,
    batch_tokens: &BatchTokens,
    (loss, step): (&Loss, u64),
    share: f64,
    accumulator: &mut GradientsAccumulator<Network>,
) -> Result<LossParts, TrainError> {
    let mut add = |grads: Gradients| accumulator.accumulate(model, GradientsParams::from_grads(grads, model));
    let token_step = batch_tokens.step();

    // Forward without autodiff: the values between the blocks.
    let (plain_model, plain_batch) = (model.valid(), device_batch.untracked());
    let plain = plain_batch.pass(&plain_model, &token_step);
    let mut inputs = vec![PassState::default()];
    for index in 0..plain.num_blocks() {
        inputs.push(plain.block(index, inputs[index].clone())?);
    }
    drop(plain);

    // Backward, one block after the other.
    let pass = device_batch.pass(model, &token_step);
    let last = leaf(inputs.pop().expect("the first input"));
    let rendering = Rendering::of(&pass, last.clone(), step);
    let parts = device_batch.loss(loss, rendering);
    let mut grads = parts.total.clone().mul_scalar(share).backward();
    let parts = LossParts { total: parts.total.inner(), mse: parts.mse.inner() };
    let mut gradient = StateGradient::take(&last, &mut grads);
    add(grads);
    let first = if trains(&model.encoder) { 0 } else { pass.num_encoder_blocks() };
    while inputs.len() > first {
        let input = leaf(inputs.pop().expect("one input per block"));
        let output = pass.block(inputs.len(), input.clone())?;
        let Some(sum) = gradient.weighted_sum(output) else { break };
        let mut grads = sum.backward();
        gradient = StateGradient::take(&input, &mut grads);
        add(grads);
    }
    Ok(parts)
}

/// Gradients of the loss by the values between two blocks.
struct StateGradient {
    x: Option<Tensor<3>>,
    tokens: Option<Tensor<3>>,
}

impl StateGradient {
    fn take(leaf: &PassState, grads: &mut Gradients) -> Self {
        let mut take = |leaf: &Tensor<3>| leaf.grad_remove(grads);
        Self {
            x: leaf.x.as_ref().and_then(&mut take),
            tokens: leaf.tokens.as_ref().and_then(|tokens| take(tokens.values())),
        }
    }

    /// Returns a scalar whose gradient by `values` is this one; `None` without a gradient.
    fn weighted_sum(self, values: PassState) -> Option<Tensor<1>> {
        let weighted = |value: Tensor<3>, gradient: Tensor<3>| (value * gradient.autodiff()).sum();
        let x = values.x.zip(self.x).map(|(x, gradient)| weighted(x, gradient));
        let tokens = values.tokens.zip(self.tokens);
        let tokens = tokens.map(|(tokens, gradient)| weighted(tokens.values().clone(), gradient));
        x.into_iter().chain(tokens).reduce(|sum, term| sum + term)
    }
}

/// Returns the same values as leaves of a graph.
fn leaf(state: PassState) -> PassState {
    let leaf = |x: Tensor<3>| x.autodiff().require_grad();
    PassState {
        x: state.x.map(leaf),
        tokens: state.tokens.map(|tokens| tokens.with_values(leaf(tokens.values().clone()))),
    }
}

fn trains<M: Module>(module: &M) -> bool {
    struct Any(bool);
    impl ModuleVisitor for Any {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            self.0 |= param.is_require_grad();
        }
    }
    let mut any = Any(false);
    module.visit(&mut any);
    any.0
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use clift_model::{Architecture, CameraEncoding, CliftVariant, CondenserConfig, ModelConfig};

    use super::*;
    use crate::events::Stage;
    use crate::stage::settings::freeze;
    use crate::step::batch::StageBatch;
    use crate::step::device_batch::render_loss;
    use crate::step::loss::LossTerm;
    use crate::step::seeded_inputs::{ClipShape, seeded_batch, seeded_model};

    const SHAPE: ClipShape = ClipShape { num_context: 2, num_targets: 3, size: [16, 24] };
    /// 2 views of 2 x 3 patches.
    const NUM_TOKENS: usize = 12;

    /// Returns the gradient of every parameter by the plain and by the checkpointed backward.
    fn both(
        config: &ModelConfig,
        stage: Stage,
        batch: &StageBatch,
        loss: &Loss,
        device: &Device,
    ) -> Vec<(Vec<f32>, Vec<f32>)> {
        struct Pairs<'a> {
            grads: [&'a GradientsParams; 2],
            pairs: Vec<(Vec<f32>, Vec<f32>)>,
        }
        impl ModuleVisitor for Pairs<'_> {
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                let [a, b] = self.grads.map(|grads| {
                    grads.get::<D>(param.id).map(|grad| grad.into_data().try_to_vec::<f32>().expect("f32"))
                });
                assert_eq!(a.is_some(), b.is_some(), "the same parameters have a gradient");
                self.pairs.extend(a.zip(b));
            }
        }
        let model = freeze(stage, seeded_model(config, 3, device));
        let device_batch = DeviceBatch::upload(&batch.clips, &device.clone().autodiff()).expect("valid");
        let plain_loss = render_loss(&model, &device_batch, &batch.tokens, loss, 3).expect("valid").total;
        let plain = GradientsParams::from_grads(plain_loss.clone().mul_scalar(0.5).backward(), &model);
        let mut accumulator = GradientsAccumulator::new();
        let parts = backward(&model, &device_batch, &batch.tokens, (loss, 3), 0.5, &mut accumulator).expect("valid");
        assert!((parts.total.into_scalar::<f64>() - plain_loss.into_scalar::<f64>()).abs() < 1e-7);
        let again = accumulator.grads();
        let mut pairs = Pairs { grads: [&plain, &again], pairs: Vec::new() };
        model.visit(&mut pairs);
        assert!(pairs.pairs.len() > 20, "most parameters are trained");
        assert!(pairs.pairs.iter().any(|(grad, _)| grad.iter().any(|&value| value != 0.0)));
        pairs.pairs
    }

    fn subsets(count: u32) -> BatchTokens {
        let subset = |scene: u32, view: u32| (0..count).map(|i| (5 * i + view + 2 * scene) % 12).collect();
        BatchTokens::Subsets((0..2).map(|scene| (0..3).map(|view| subset(scene, view)).collect()).collect())
    }

    /// A term of the tokens and the step.
    #[derive(Debug)]
    struct TokenTerm;
    impl LossTerm for TokenTerm {
        fn loss(&self, rendering: &Rendering, _target: &Tensor<5>) -> Tensor<1> {
            rendering.tokens.clone().square().mean() * rendering.step as f64
        }
    }

    #[test]
    fn gradients_equal_those_of_plain_backward() {
        let all = seeded_batch(SHAPE, 2, NUM_TOKENS, None, 1).expect("valid");
        let stored = seeded_batch(SHAPE, 2, NUM_TOKENS, Some(5), 1).expect("valid");
        let few = StageBatch { tokens: subsets(2), ..all.clone() };
        let many = StageBatch { tokens: subsets(7), ..all.clone() };
        let cases = [(Stage::Stage1, all), (Stage::Stage1, few), (Stage::Stage1, many), (Stage::Stage2, stored)];
        let small = ModelConfig {
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 2,
            num_renderer_blocks: 2,
            ..ModelConfig::default()
        };
        let of = |variant| ModelConfig { variant, condenser: CondenserConfig::of(variant), ..small.clone() };
        let relative = [CameraEncoding::Gta, CameraEncoding::Prope];
        let relative = relative.map(|camera_encoding| ModelConfig { camera_encoding, ..small.clone() });
        let lvsm = [CliftVariant::Paper, CliftVariant::ReleasedRe10k].map(|variant| ModelConfig {
            architecture: Architecture::LvsmEd,
            num_latents: 12,
            condenser: CondenserConfig::NONE,
            ..of(variant)
        });
        let networks: Vec<_> = CliftVariant::ALL.map(of).into_iter().chain(relative).chain(lvsm).collect();
        let (plain_loss, token_loss) = (Loss::default(), Loss::default().with_term(0.1, TokenTerm));
        let losses = networks.iter().map(|network| (network, &plain_loss)).chain([(&networks[0], &token_loss)]);
        for (network, loss) in losses {
            for (stage, batch) in
                cases.iter().filter(|(stage, _)| *stage == Stage::Stage1 || network.architecture.supports_clusters())
            {
                let pairs = both(network, *stage, batch, loss, &Device::flex());
                let largest = |values: &[f32]| values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
                let scale = pairs.iter().map(|(plain, _)| largest(plain)).fold(0.0, f32::max);
                for (plain, again) in pairs {
                    let is_plain = std::ptr::eq(loss, &raw const plain_loss);
                    if is_plain && !network.variant.has_norms() && network.architecture == Architecture::Clift {
                        assert_eq!(plain, again, "bit for bit");
                    }
                    // Burn adds the gradients of a composed norm in the order of the whole graph. The floor covers
                    // biases with a gradient near zero.
                    let error = plain.iter().zip(&again).fold(0.0_f32, |error, (a, b)| error.max((a - b).abs()));
                    assert!(error <= 1e-5 * largest(&plain) + 1e-7 * scale, "{network:?}: {error:e} of {scale:e}");
                }
            }
        }
    }
}
