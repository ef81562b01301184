//! The differences between the stages, in one place: steps, batch, learning rates, trained networks.

use crate::config::config::{Config, OptimizerConfig};
use crate::events::Stage;

/// A network with parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TapeSegment {
    /// Context views to light-field tokens.
    Encoder,
    /// The norm of the light-field tokens.
    TokenNorm,
    /// Clusters of tokens to their centroids.
    Condenser,
    /// Tokens and a camera to an image.
    Renderer,
}

/// Settings of a stage that makes updates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageSettings<'a> {
    /// Which stage.
    pub stage: Stage,
    /// Optimiser updates.
    pub steps: u64,
    /// Scenes per update.
    pub batch_size: usize,
    /// Number of micro-batches per update, at most the batch size.
    pub accumulate: usize,
    /// The update rule, with the learning rate of every trained network but the renderer.
    pub optimizer: &'a OptimizerConfig,
    /// Learning rate of the renderer, as a factor of the optimiser's.
    pub renderer_lr_factor: f64,
    /// Networks that are trained; the others are frozen.
    pub trained: &'static [TapeSegment],
}

impl Stage {
    /// The networks that the stage trains.
    pub fn trained(self) -> &'static [TapeSegment] {
        match self {
            Self::Stage1 => &[TapeSegment::Encoder, TapeSegment::TokenNorm, TapeSegment::Renderer],
            Self::Stage2 => &[TapeSegment::TokenNorm, TapeSegment::Condenser, TapeSegment::Renderer],
            Self::Clusters | Self::Eval => &[],
        }
    }
}

impl Config {
    /// The settings of a stage. The cluster cache and the evaluation make no updates: no step, no trained network.
    pub fn stage(&self, stage: Stage) -> StageSettings<'_> {
        let Self { stage1, stage2, .. } = self;
        let settings = StageSettings {
            stage,
            steps: stage1.steps,
            batch_size: stage1.batch_size,
            accumulate: stage1.accumulate,
            optimizer: &stage1.optimizer,
            renderer_lr_factor: 1.0,
            trained: stage.trained(),
        };
        match stage {
            Stage::Stage1 => settings,
            // The encoder is frozen. The condenser learns at the full rate, the renderer at 0.1 of it by default.
            Stage::Stage2 => StageSettings {
                steps: stage2.steps,
                batch_size: stage2.batch_size,
                accumulate: stage2.accumulate,
                optimizer: &stage2.optimizer,
                renderer_lr_factor: stage2.renderer_lr_factor,
                ..settings
            },
            Stage::Clusters | Stage::Eval => StageSettings { steps: 0, batch_size: 1, accumulate: 1, ..settings },
        }
    }

    /// Sets the number of micro-batches per update of a training stage.
    pub fn set_accumulate(&mut self, stage: Stage, parts: usize) {
        match stage {
            Stage::Stage1 => self.stage1.accumulate = parts,
            Stage::Stage2 => self.stage2.accumulate = parts,
            Stage::Clusters | Stage::Eval => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stage_2_freezes_the_encoder_and_slows_the_renderer() {
        let mut config = Config::default();
        let [one, two] = [Stage::Stage1, Stage::Stage2].map(|stage| config.stage(stage));
        assert_eq!((one.steps, one.batch_size, one.renderer_lr_factor), (90_000, 64, 1.0));
        assert_eq!((two.steps, two.batch_size, two.renderer_lr_factor), (50_000, 80, 0.1));
        assert!(one.trained.contains(&TapeSegment::Encoder) && !one.trained.contains(&TapeSegment::Condenser));
        assert!(two.trained.contains(&TapeSegment::Condenser) && !two.trained.contains(&TapeSegment::Encoder));
        config.set_accumulate(Stage::Stage2, 5);
        assert_eq!((config.stage(Stage::Stage1).accumulate, config.stage(Stage::Stage2).accumulate), (1, 5));
    }
}
