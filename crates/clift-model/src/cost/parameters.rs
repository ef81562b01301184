//! Number of parameters of each network.

use serde::Serialize;

use crate::network::config::ModelConfig;
use crate::network::layers::{Layer, Part};

/// Number of parameters of each network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Parameters {
    /// Parameters of the encoder.
    pub encoder: u64,
    /// Parameters of the token norm, 0 in variants without one.
    pub lift_norm: u64,
    /// Parameters of the condenser.
    pub condenser: u64,
    /// Parameters of the renderer.
    pub renderer: u64,
    /// Parameters of all networks.
    pub total: u64,
}

impl Parameters {
    /// Counts the parameters of a config.
    pub fn of(config: &ModelConfig) -> Self {
        let layers = config.layers();
        let count = |part| layers.iter().filter(|layer| layer.part == part).map(Layer::num_parameters).sum();
        Self {
            encoder: count(Part::Encoder),
            lift_norm: count(Part::TokenNorm),
            condenser: count(Part::Condenser),
            renderer: count(Part::Renderer),
            total: layers.iter().map(Layer::num_parameters).sum(),
        }
    }

    /// Returns the number of parameters of some networks together.
    pub fn of_parts(&self, parts: &[Part]) -> u64 {
        let count = |part: &Part| match part {
            Part::Encoder => self.encoder,
            Part::TokenNorm => self.lift_norm,
            Part::Condenser => self.condenser,
            Part::Renderer => self.renderer,
        };
        parts.iter().map(count).sum()
    }
}
