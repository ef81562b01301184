//! Activation checkpointing: a backward pass that stores only the input of every block and recomputes the rest.
//!
//! Memory per block is one input instead of all activations, for one more forward pass. The gradients equal those of the
//! plain backward: the same operations on the same values.
// B scenes, N tokens, T target views, Q patches of a view, D width

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Gradients, Tensor};
use clift_model::{Cameras, Clift, Tokens, Views};

use crate::error::TrainError;
use crate::step::batch::BatchTokens;
use crate::step::device_batch::DeviceBatch;
use crate::step::loss::{Loss, LossParts};

/// Adds the gradients of `share` times the loss of a batch to `accumulator`, and returns the loss.
pub(crate) fn backward(
    model: &Clift,
    device_batch: &DeviceBatch,
    batch_tokens: &BatchTokens,
    loss: &Loss,
    share: f64,
    accumulator: &mut GradientsAccumulator<Clift>,
) -> Result<LossParts, TrainError> {
    let mut add = |grads: Gradients| accumulator.accumulate(model, GradientsParams::from_grads(grads, model));
    let plain = model.valid();

    // Forward without autodiff: the inputs of the blocks.
    let context = Views {
        images: device_batch.context.images.clone().inner(),
        cameras: untracked(&device_batch.context.cameras),
    };
    let targets = untracked(&device_batch.targets);
    let context_transforms = plain.encoder.transforms(&context.cameras);
    let target_transforms = plain.renderer.transforms(&targets);
    let (encoder_inputs, encoded) =
        block_inputs(plain.encoder.embed(&context), plain.encoder.num_blocks(), |block, x| {
            plain.encoder.block(block, x, context_transforms.as_ref())
        });
    let lift = Tokens { values: encoded, transforms: context_transforms };
    let tokens = batch_tokens.apply(&plain.condenser, plain.normalize(lift.clone()))?;
    let (renderer_inputs, x) =
        block_inputs(plain.renderer.embed(&tokens, &targets), plain.renderer.num_blocks(), |block, x| {
            plain.renderer.block(block, x, &tokens, target_transforms.as_ref())
        });

    // Backward, one block after the other.
    let x = leaf(x);
    let parts = loss.of(model.renderer.to_image(x.clone(), &device_batch.targets), device_batch.target_images.clone());
    let mut grads = parts.total.clone().mul_scalar(share).backward();
    let parts = LossParts { total: parts.total.inner(), mse: parts.mse.inner() };
    let mut grad_x = take_gradient(&x, &mut grads);
    add(grads);

    let mut grad_tokens: Option<Tensor<3>> = None;
    // A renderer reads the tokens in every block, or before the first.
    let mut add_grad_tokens = |tokens: &Tensor<3>, grads: &mut Gradients| {
        let Some(grad) = tokens.grad_remove(grads) else { return };
        grad_tokens = Some(match grad_tokens.take() {
            Some(sum) => sum + grad,
            None => grad,
        });
    };
    let target_transforms = model.renderer.transforms(&device_batch.targets);
    for (block, input) in renderer_inputs.into_iter().enumerate().rev() {
        let (x, block_tokens) = (leaf(input), leaf(tokens.values().clone()));
        let tokens = tokens.with_values(block_tokens.clone());
        let output = model.renderer.block(block, x.clone(), &tokens, target_transforms.as_ref());
        let mut grads = backward_from(output, grad_x);
        grad_x = take_gradient(&x, &mut grads);
        add_grad_tokens(&block_tokens, &mut grads);
        add(grads);
    }
    let embedded_tokens = leaf(tokens.values().clone());
    let embedded = model.renderer.embed(&tokens.with_values(embedded_tokens.clone()), &device_batch.targets);
    let mut grads = backward_from(embedded, grad_x);
    add_grad_tokens(&embedded_tokens, &mut grads);
    add(grads);
    let Some(grad_tokens) = grad_tokens else {
        return Ok(parts); // a renderer without blocks reads no token
    };

    let encoded = leaf(lift.values.clone());
    let lift = lift.with_values(encoded.clone());
    let output = batch_tokens.apply(&model.condenser, model.normalize(lift.clone()))?.values().clone();
    let mut grads = backward_from(output, grad_tokens);
    let mut grad_x = take_gradient(&encoded, &mut grads);
    add(grads);
    if !trains(&model.encoder) {
        return Ok(parts);
    }
    for (block, input) in encoder_inputs.into_iter().enumerate().rev() {
        let x = leaf(input);
        let mut grads = backward_from(model.encoder.block(block, x.clone(), lift.transforms.as_ref()), grad_x);
        grad_x = take_gradient(&x, &mut grads);
        add(grads);
    }
    add(backward_from(model.encoder.embed(&device_batch.context), grad_x));
    Ok(parts)
}

fn untracked(cameras: &Cameras) -> Cameras {
    Cameras { c2w: cameras.c2w.clone().inner(), intrinsics: cameras.intrinsics.clone().inner(), ..*cameras }
}

/// Returns the inputs of all blocks, and the output of the last.
fn block_inputs(
    first: Tensor<3>,
    num_blocks: usize,
    forward: impl Fn(usize, Tensor<3>) -> Tensor<3>,
) -> (Vec<Tensor<3>>, Tensor<3>) {
    let mut inputs = vec![first];
    for block in 0..num_blocks {
        inputs.push(forward(block, inputs[inputs.len() - 1].clone()));
    }
    let last = inputs.pop().expect("the first input");
    (inputs, last)
}

fn leaf(x: Tensor<3>) -> Tensor<3> {
    x.autodiff().require_grad()
}

fn backward_from(output: Tensor<3>, grad: Tensor<3>) -> Gradients {
    (output * grad.autodiff()).sum().backward()
}

fn take_gradient(leaf: &Tensor<3>, grads: &mut Gradients) -> Tensor<3> {
    leaf.grad_remove(grads).unwrap_or_else(|| leaf.clone().inner().zeros_like())
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
        let plain_loss = render_loss(&model, &device_batch, &batch.tokens, loss).expect("valid").total;
        let plain = GradientsParams::from_grads(plain_loss.clone().mul_scalar(0.5).backward(), &model);
        let mut accumulator = GradientsAccumulator::new();
        let parts = backward(&model, &device_batch, &batch.tokens, loss, 0.5, &mut accumulator).expect("valid");
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
        for network in CliftVariant::ALL.map(of).iter().chain(&relative).chain(&lvsm) {
            for (stage, batch) in cases.iter().filter(|(stage, _)| *stage == Stage::Stage1 || !network.has_latents()) {
                let pairs = both(network, *stage, batch, &Loss::default(), &Device::flex());
                let largest = |values: &[f32]| values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
                let scale = pairs.iter().map(|(plain, _)| largest(plain)).fold(0.0, f32::max);
                for (plain, again) in pairs {
                    if !network.variant.has_norms() && !network.has_latents() {
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
