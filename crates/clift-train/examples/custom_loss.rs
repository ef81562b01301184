//! Trains a small network with two loss terms of its own: the difference of horizontal image gradients, and a penalty of large
//! tokens that grows over the first updates.
//!
//! `cargo run --release -p clift-train --example custom_loss`

use burn::tensor::Tensor;
use clift_model::{DeviceName, ModelConfig, psnr_of_mse};
use clift_train::{
    ClipShape, Loss, LossTerm, OptimizerConfig, Rendering, TrainError, TrainState, seeded_batch, seeded_model,
};

/// Mean absolute difference of the horizontal gradients of rendering and target.
#[derive(Debug)]
struct EdgeLoss;

impl LossTerm for EdgeLoss {
    // Images are `[batch, views, height, width, 3]` in `[0, 1]`.
    fn loss(&self, rendering: &Rendering, target: &Tensor<5>) -> Tensor<1> {
        let gradient = |images: &Tensor<5>| {
            let width = images.dims()[3];
            images.clone().narrow(3, 1, width - 1) - images.clone().narrow(3, 0, width - 1)
        };
        (gradient(&rendering.images) - gradient(target)).abs().mean()
    }
}

/// Mean square of the tokens, with a weight that rises to 1 over ten updates.
#[derive(Debug)]
struct TokenPenalty;

impl LossTerm for TokenPenalty {
    fn loss(&self, rendering: &Rendering, _target: &Tensor<5>) -> Tensor<1> {
        rendering.tokens.clone().square().mean() * (rendering.step as f64 / 10.0).min(1.0)
    }
}

fn main() -> Result<(), TrainError> {
    let model = ModelConfig {
        dim: 32,
        num_heads: 4,
        feed_forward_dim: 64,
        num_encoder_blocks: 2,
        num_renderer_blocks: 2,
        ..ModelConfig::default()
    };
    let device = DeviceName::Flex.open()?;
    let trained = seeded_model(&model, 0, &device);
    let mut state = TrainState::new(trained, &OptimizerConfig::default(), device.autodiff());
    state.loss = Loss::default().with_term(0.1, EdgeLoss).with_term(1e-4, TokenPenalty);
    // Two scenes of two context and two target views; the renderer receives all tokens, as in stage 1.
    let shape = ClipShape { num_context: 2, num_targets: 2, size: [32, 32] };
    let mut batch = seeded_batch(shape, 2, model.num_tokens(2, 32, 32)?, None, 0)?;
    for step in 1..=20 {
        batch.step = step - 1;
        let (next, update) = state.step(&batch, 1, 1e-3.into(), 1.0)?;
        state = next;
        println!("step {step}: loss {:.4}, PSNR {:.2} dB", update.loss, psnr_of_mse(update.mse));
    }
    Ok(())
}
