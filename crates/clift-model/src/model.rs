//! The three networks of a model together.

use burn::module::Module;
use burn::tensor::{Device, Tensor};

use crate::{Condenser, Encoder, Init, LiftNorm, ModelConfig, Renderer, Views};

/// Encoder, condenser and renderer. Stage 1 trains the first and the last, stage 2 the last two.
#[derive(Module, Debug)]
pub struct Clift {
    /// Posed pictures to light-field tokens.
    pub encoder: Encoder,
    /// A norm of those, in the variant that has one. Both stages train it.
    pub lift_norm: LiftNorm,
    /// Light-field tokens to compressed ones.
    pub condenser: Condenser,
    /// Tokens and a camera to a picture.
    pub renderer: Renderer,
}

/// What stage 1 trains.
#[derive(Module, Debug)]
pub struct Stage1 {
    /// Posed pictures to light-field tokens.
    pub encoder: Encoder,
    /// A norm of those, in the variant that has one.
    pub lift_norm: LiftNorm,
    /// Tokens and a camera to a picture.
    pub renderer: Renderer,
}

impl Clift {
    /// Makes a model with random weights, the same for a seed on every device.
    pub fn new(config: &ModelConfig, seed: u64, device: &Device) -> Self {
        let mut init = Init::new(seed, device);
        let encoder = Encoder::new(config, &mut init);
        let renderer = Renderer::new(config, &mut init);
        // Last, so that stage 1 does not depend on the condenser's settings.
        let condenser = Condenser::new(config, &mut init);
        let lift_norm = LiftNorm::new(config, &mut init);
        Self { encoder, lift_norm, condenser, renderer }
    }

    /// The tokens of context views that condenser and renderer read.
    ///
    /// # Shapes
    /// - returns `[batch, num_tokens, dim]`
    pub fn lift(&self, context: &Views) -> Tensor<3> {
        self.lift_norm.forward(self.encoder.forward(context))
    }

    /// The networks of stage 1, sharing this model's parameters.
    pub fn stage1(&self) -> Stage1 {
        Stage1 { encoder: self.encoder.clone(), lift_norm: self.lift_norm.clone(), renderer: self.renderer.clone() }
    }

    /// Takes the networks of stage 1 from elsewhere.
    pub fn set_stage1(&mut self, stage1: Stage1) {
        let Stage1 { encoder, lift_norm, renderer } = stage1;
        (self.encoder, self.lift_norm, self.renderer) = (encoder, lift_norm, renderer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Cameras;
    use crate::testing::{Fixture, assert_close, devices, load_weights, weight_gradients};

    #[test]
    fn encoder_and_renderer_equal_pytorchs_with_the_gradients_of_the_loss() {
        let fixture = Fixture::open("model");
        let config = ModelConfig {
            dim: 16,
            num_heads: 4,
            feed_forward_dim: 24,
            num_encoder_blocks: 2,
            num_renderer_blocks: 2,
            ..ModelConfig::default()
        };
        for device in devices() {
            let device = device.autodiff();
            let model = load_weights(Clift::new(&config, 0, &device).stage1(), &fixture, "weight.");
            let cameras = |kind: &str| Cameras {
                height: 16,
                width: 24,
                c2w: fixture.tensor(&format!("input.{kind}_c2w"), &device),
                intrinsics: fixture.tensor(&format!("input.{kind}_intrinsics"), &device),
            };
            let context =
                Views { images: fixture.tensor("input.context_images", &device), cameras: cameras("context") };
            let lift = model.encoder.forward(&context);
            assert_close(&lift.clone().inner(), &fixture.tensor::<3>("output.lift", &device).inner(), 1e-5);
            let rendering = model.renderer.forward(lift, &cameras("target"));
            let expected = fixture.tensor::<5>("output.rendering", &device);
            assert_close(&rendering.clone().inner(), &expected.inner(), 1e-5);
            let target: Tensor<5> = fixture.tensor("input.target_images", &device);
            let loss = (rendering - target).square().mean();
            let expected = fixture.tensor::<1>("output.loss", &device);
            assert_close(&loss.clone().inner(), &expected.inner(), 1e-6);
            weight_gradients(&model, &loss.backward(), &fixture, "grad.weight.", 5e-5);
        }
    }

    #[test]
    fn the_papers_model_has_81_million_parameters_in_stage_1() {
        let model = Clift::new(&ModelConfig::default(), 0, &Device::flex());
        let stage1 = model.encoder.num_params() + model.renderer.num_params();
        assert_eq!(stage1, 81_239_232);
    }
}
