//! Whole updates by the code of training: loss, gradient, AdamW.

use clift_model::{Clusters, Network, RenderTokens, upload_images};
use clift_train::{BatchTokens, Loss, OptimizerConfig, Rendering, Stage, StageBatch, TrainState, freeze};

use crate::modules::subsets;
use crate::place::{Place, clusters, gradients, parameters};
use crate::table::{Case, Named, Tolerance, Values};

const UPDATE: Tolerance = Tolerance::both(1e-5, 1e-4, "three sums over everything above");

pub const CASES: &[Case] = &[
    UPDATE.case("stage 1: loss, gradient norm, update; tokens dropped", |place| update(place, Stage::Stage1, 1, false)),
    UPDATE.case("stage 1: two micro-batches, activation checkpointing", |place| update(place, Stage::Stage1, 2, true)),
    UPDATE
        .because("the same through the condenser")
        .case("stage 2: loss, gradient norm, update; encoder frozen", |place| update(place, Stage::Stage2, 1, false)),
];

const LEARNING_RATE: f64 = 1e-3;

pub fn learner(place: &Place, stage: Stage, activation_checkpointing: bool) -> TrainState {
    let model = freeze(stage, place.model());
    let state = TrainState::new(model, &OptimizerConfig::default(), place.device.clone());
    TrainState { activation_checkpointing, ..state }
}

pub fn batch(place: &Place, stage: Stage) -> StageBatch {
    let tokens = match stage {
        Stage::Stage2 => BatchTokens::Clusters(clusters()),
        Stage::Stage1 => BatchTokens::Subsets(subsets(5)),
    };
    StageBatch { step: 0, clips: place.clips(), tokens, skipped: Vec::new() }
}

pub fn step(learner: TrainState, batch: &StageBatch, parts: usize) -> (TrainState, clift_train::Update) {
    let (learner, update) = learner.step(batch, parts, LEARNING_RATE.into(), 1.0).expect("the model takes the batch");
    assert!(update.applied, "{update:?}");
    (learner, update)
}

fn update(place: &Place, stage: Stage, parts: usize, activation_checkpointing: bool) -> Values {
    let batch = batch(place, stage);
    let learner = learner(place, stage, activation_checkpointing);
    let mut backward = gradient(place, &learner.model, &batch);
    let before = parameters(&learner.model);
    let (learner, update) = step(learner, &batch, parts);
    let after = parameters(&learner.model);
    // The first update makes the moments of AdamW, the second one is a kernel's on GPUs.
    let (learner, _) = step(learner, &batch, parts);
    let moves =
        [moved("update", &before, &after, &backward), moved("second", &after, &parameters(&learner.model), &backward)];
    backward.extend(moves.into_iter().flatten());
    let numbers = [("loss", update.loss), ("mse", update.mse), ("gradient norm", update.grad_norm)];
    Values { forward: numbers.map(|(name, value)| (name.to_owned(), vec![value])).into(), backward }
}

fn gradient(place: &Place, model: &Network, batch: &StageBatch) -> Named {
    let lift = model.encode(&place.context());
    let tokens: RenderTokens = match &batch.tokens {
        BatchTokens::Subsets(subsets) => RenderTokens::subsets(lift, subsets),
        BatchTokens::Clusters(clusters) => {
            let index = Clusters::new(clusters.clone()).expect("equal counts").upload(&place.device);
            model.condenser.forward(lift, &index).into()
        }
        BatchTokens::All => lift.into(),
    };
    let targets: Vec<_> = batch.clips.iter().map(|clip| &clip.target).collect();
    let pictures = upload_images(&targets, &place.device).expect("equal sizes");
    let values = tokens.values().clone();
    let images = model.renderer.forward(tokens, &place.targets());
    let loss = Loss::default().of(&Rendering { images, tokens: values, step: 0 }, pictures).total;
    gradients(model, &loss.backward())
}

/// Change of every weight in units of the learning rate, times its gradient:
/// `AdamW`'s first update is the sign of the gradient, which is random where the gradient is rounding.
fn moved(step: &str, before: &Named, after: &Named, gradients: &Named) -> Named {
    let weights = before.iter().zip(after);
    let moved = weights.filter_map(|((name, before), (_, after))| {
        let (_, gradient) = gradients.iter().find(|(of, _)| of == name)?;
        let moved = before.iter().zip(after).zip(gradient);
        let moved = moved.map(|((before, after), gradient)| (after - before) / LEARNING_RATE * gradient);
        Some((format!("{step} of {name}"), moved.collect()))
    });
    moved.collect()
}
