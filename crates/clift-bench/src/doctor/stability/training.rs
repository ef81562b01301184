//! Training at ten times the learning rate.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Device;
use clift_model::Network;
use clift_train::{
    DeviceBatch, Loss, OptimizerConfig, Stage, StageBatch, StageOptimizer, TrainError, clip_factor, freeze,
    global_norm, render_loss, seeded_batch, seeded_model,
};

use crate::cases::reference::{ToF64, module_in_f64, values};
use crate::doctor::stability::case::StabilityCase;
use crate::doctor::stability::updates::{network, num_tokens, shape};

pub(crate) const CASES: &[StabilityCase] = &[StabilityCase {
    name: "ten times the learning rate, from the first step",
    breaks: "updates that blow up, second moments near zero",
    bound: 5e-2,
    reason: "loss after 20 updates against a run in f64: rounding grows with every update, and the loss must have fallen",
    run: |devices| {
        let batch = seeded_batch(shape(devices, 2), 2, num_tokens(devices, 2), None, 0)?;
        let model = freeze(Stage::Stage1, seeded_model(&network(devices), 0, &devices.device));
        let copy = module_in_f64(&model, &devices.reference).train();
        let found = losses(model, &batch, &devices.device, false)?;
        let reference = losses(copy, &batch, &devices.reference, true)?;
        let (Some(first), Some(last), Some(expected)) = (found.first(), found.last(), reference.last()) else {
            return Ok(f64::NAN);
        };
        let has_fallen = last < first;
        Ok(if has_fallen { (last - expected).abs() / expected } else { f64::INFINITY })
    },
}];

const STEPS: usize = 20;

/// Returns the losses of [`STEPS`] updates on one batch.
fn losses(mut model: Network, batch: &StageBatch, device: &Device, in_f64: bool) -> Result<Vec<f64>, TrainError> {
    let config = OptimizerConfig::default();
    let mut optimizer = StageOptimizer::new(&config, device);
    let device = device.clone().autodiff();
    let mut losses = Vec::new();
    for _ in 0..STEPS {
        let device_batch = DeviceBatch::upload(&batch.clips, &device)?;
        let device_batch = if in_f64 { device_batch.in_f64(&device) } else { device_batch };
        let loss = render_loss(&model, &device_batch, &batch.tokens, &Loss::default(), batch.step)?.total;
        losses.push(values(loss.clone().inner())[0]);
        let grads = GradientsParams::from_grads(loss.backward(), &model);
        let norm = global_norm(&model, &grads);
        model = optimizer.step(10.0 * config.learning_rate, model, grads, clip_factor(norm, config.max_grad_norm));
    }
    Ok(losses)
}
