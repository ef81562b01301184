//! Differences between the stages: steps, batch, learning rates, trained networks.

use burn::module::Module;
use clift_model::{Network, Part};

use crate::config::config::{Config, OptimizerConfig};
use crate::events::Stage;

/// Settings of a stage that makes updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageSettings<'a> {
    /// The stage.
    pub stage: Stage,
    /// Number of optimizer updates.
    pub steps: u64,
    /// Number of the first updates whose images have half the width and height.
    pub half_resolution_steps: u64,
    /// Scenes per update.
    pub batch_size: usize,
    /// Number of micro-batches per update, at most the batch size.
    pub accumulate: usize,
    /// The update rule, with the learning rate of every trained network but the renderer.
    pub optimizer: &'a OptimizerConfig,
    /// Learning rate of the renderer, as a factor of the optimizer's.
    pub renderer_lr_factor: f64,
}

impl Stage {
    /// Returns the networks that the stage trains.
    pub fn trained(self) -> &'static [Part] {
        match self {
            Self::Stage1 => &[Part::Encoder, Part::TokenNorm, Part::Renderer],
            Self::Stage2 => &[Part::Condenser, Part::TokenNorm, Part::Renderer],
        }
    }
}

/// Freezes the networks that the stage does not train: their parameters get no gradient and no weight decay.
pub fn freeze(stage: Stage, model: Network) -> Network {
    match stage {
        Stage::Stage1 => Network { condenser: model.condenser.no_grad(), ..model },
        Stage::Stage2 => Network { encoder: model.encoder.no_grad(), ..model },
    }
}

impl StageSettings<'_> {
    /// Returns the most scenes of a micro-batch.
    pub fn micro_batch_size(&self) -> usize {
        self.batch_size.div_ceil(self.accumulate)
    }
}

/// Makes up for the rounding of a share of steps: 0.29 * 100 is below 29.
const ROUNDING: f64 = 1e-6;

impl Config {
    /// Returns the settings of a stage.
    pub fn stage(&self, stage: Stage) -> StageSettings<'_> {
        let Self { stage1, stage2, .. } = self;
        let settings = StageSettings {
            stage,
            steps: stage1.steps,
            half_resolution_steps: (stage1.half_resolution * stage1.steps as f64 + ROUNDING) as u64,
            batch_size: stage1.batch_size,
            accumulate: stage1.accumulate,
            optimizer: &stage1.optimizer,
            renderer_lr_factor: 1.0,
        };
        match stage {
            Stage::Stage1 => settings,
            // The encoder is frozen. The condenser learns at the full rate, the renderer at 0.1 of it by default.
            Stage::Stage2 => StageSettings {
                steps: stage2.steps,
                half_resolution_steps: 0,
                batch_size: stage2.batch_size,
                accumulate: stage2.accumulate,
                optimizer: &stage2.optimizer,
                renderer_lr_factor: stage2.renderer_lr_factor,
                ..settings
            },
        }
    }

    /// Sets the number of micro-batches per update of a stage.
    pub fn set_accumulate(&mut self, stage: Stage, parts: usize) {
        match stage {
            Stage::Stage1 => self.stage1.accumulate = parts,
            Stage::Stage2 => self.stage2.accumulate = parts,
        }
    }
}
