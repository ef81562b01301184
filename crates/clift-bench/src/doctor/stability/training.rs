//! Steps at ten times the learning rate.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Device;
use clift_model::Clift;
use clift_train::{
    DeviceBatch, Loss, OptimizerConfig, Stage, StageBatch, TrainError, adamw, clip_global_norm, freeze, global_norm,
    render_loss, seeded_batch, seeded_model,
};

use crate::cases::reference::{ToF64, module_in_f64, values};
use crate::doctor::stability::case::{Bound, Case, Outcome};
use crate::doctor::stability::updates::{network, num_tokens, shape};

pub(crate) const CASES: &[Case] = &[Case {
    name: "ten times the learning rate, from the first step",
    breaks: "updates that blow up, second moments near zero",
    bound: Bound::Most(5e-2),
    reason: "loss after 20 updates against a run in f64: rounding grows with every update, and the loss must have fallen",
    run: |place| {
        let batch = seeded_batch(shape(place, 2), 2, num_tokens(place, 2), None, 0)?;
        let model = freeze(Stage::Stage1, seeded_model(&network(place), 0, &place.device));
        let copy = module_in_f64(&model, &place.reference).train();
        let ours = losses(model, &batch, &place.device, false)?;
        let theirs = losses(copy, &batch, &place.reference, true)?;
        let (Some(first), Some(last), Some(expected)) = (ours.first(), ours.last(), theirs.last()) else {
            return Ok(Outcome::Error(f64::NAN));
        };
        // NaN is not less either.
        let has_fallen = last < first;
        Ok(Outcome::Error(if has_fallen { (last - expected).abs() / expected } else { f64::INFINITY }))
    },
}];

/// Updates that are made.
const STEPS: usize = 20;

/// The losses of a few updates on one batch.
fn losses(mut model: Clift, batch: &StageBatch, device: &Device, in_f64: bool) -> Result<Vec<f64>, TrainError> {
    let config = OptimizerConfig::default();
    let mut optimizer = adamw(&config);
    let device = device.clone().autodiff();
    let mut losses = Vec::new();
    for _ in 0..STEPS {
        let shown = DeviceBatch::upload(batch, &device)?;
        let shown = if in_f64 { shown.in_f64(&device) } else { shown };
        let loss = render_loss(&model, &shown, &batch.tokens, &Loss::default())?.total;
        losses.push(values(loss.clone().inner())[0]);
        let grads = GradientsParams::from_grads(loss.backward(), &model);
        let norm = global_norm(&model, &grads);
        let grads = clip_global_norm(&model, grads, norm, config.max_grad_norm);
        model = optimizer.step(10.0 * config.learning_rate, model, grads);
    }
    Ok(losses)
}
