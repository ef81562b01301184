//! Updates by the code of training: their results against the CPU's.

use burn::tensor::Device;
use clift_model::DeviceName;
use clift_train::{
    BatchTokens, ClipShape, OptimizerConfig, Stage, StageBatch, TrainState, Update, freeze, seeded_batch, seeded_model,
};

use crate::{config, gpu};

/// Two scenes of 12 tokens: of stage 1, where each view has `kept` of them, or of stage 2 without `kept`.
fn batch(kept: Option<u32>) -> StageBatch {
    let shape = ClipShape { num_context: 2, num_targets: 2, size: [16, 24] };
    let batch = seeded_batch(shape, 2, Some([12, 3]), 0).expect("valid sizes");
    let Some(kept) = kept else { return batch };
    // Views share some.
    let view = |start: u32| (0..kept).map(|i| (start + 5 * i) % 12).collect::<Vec<_>>();
    let scene = |first: u32| vec![view(first), view(first + 3)];
    StageBatch { tokens: BatchTokens::Subsets(vec![scene(0), scene(1)]), ..batch }
}

fn start(device: &Device, stage: Stage) -> TrainState {
    let model = freeze(stage, seeded_model(&config(&[]).model, 0, device));
    TrainState::new(model, &OptimizerConfig::default(), device.clone().autodiff())
}

fn step(state: TrainState, batch: &StageBatch, parts: usize) -> (TrainState, Update) {
    let (state, update) = state.step(batch, parts, 1e-3_f64.into(), 1.0).expect("the model takes the batch");
    assert!(update.applied, "{update:?}");
    (state, update)
}

#[test]
fn updates_are_those_of_the_cpu() {
    let Some((gpu, _guard)) = gpu() else { return };
    let cpu = DeviceName::Flex.open().expect("the CPU device");
    for (stage, kept, parts) in [
        (Stage::Stage1, Some(5), 1),
        // Most tokens: rows of keys and values are gathered. Two micro-batches.
        (Stage::Stage1, Some(8), 2),
        (Stage::Stage2, None, 1),
    ] {
        let batch = batch(kept);
        let [mut state, mut expected] = [&gpu, &cpu].map(|device| start(device, stage));
        for number in 0..3 {
            let (next, update) = step(state, &batch, parts);
            let (next_expected, update_expected) = step(expected, &batch, parts);
            (state, expected) = (next, next_expected);
            println!("{stage:?}, update {number}: {update:?}");
            let apart = |a: f64, b: f64| (a / b - 1.0).abs();
            let [loss, norm] =
                [apart(update.loss, update_expected.loss), apart(update.grad_norm, update_expected.grad_norm)];
            // The first update of AdamW is the sign of the gradient, which is random where the gradient is rounding.
            assert!(loss < 1e-4 && norm < 1e-3, "{stage:?}, {kept:?}, update {number}: {loss:e}, {norm:e}");
            assert!(number > 0 || (loss < 1e-5 && norm < 1e-4), "{stage:?}, {kept:?}: {loss:e}, {norm:e}");
        }
    }
}
