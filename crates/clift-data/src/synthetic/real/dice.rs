//! Random choices of one scene.

use clift_core::{uniform_01, uniform_below};
use rand_chacha::ChaCha8Rng;

/// The random stream of one scene, with the distributions that the scene needs.
pub(crate) struct Dice(pub ChaCha8Rng);

impl Dice {
    /// Samples uniformly from `[low, high)`.
    pub fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * uniform_01(&mut self.0) as f32
    }

    /// Samples from `[low, high)`, uniformly in the logarithm.
    pub fn scale(&mut self, low: f32, high: f32) -> f32 {
        (self.between(low.ln(), high.ln())).exp()
    }

    /// Samples uniformly from `[-size, size)`.
    pub fn swing(&mut self, size: f32) -> f32 {
        self.between(-size, size)
    }

    /// Returns true with this probability.
    pub fn chance(&mut self, probability: f32) -> bool {
        self.between(0.0, 1.0) < probability
    }

    /// Samples uniformly from `low..=high`.
    pub fn count(&mut self, low: usize, high: usize) -> usize {
        low + uniform_below(&mut self.0, high - low + 1)
    }

    /// Samples one of `values`.
    pub fn pick<T: Copy>(&mut self, values: &[T]) -> T {
        values[uniform_below(&mut self.0, values.len())]
    }

    /// Samples 32 bits.
    pub fn bits(&mut self) -> u32 {
        self.count(0, u32::MAX as usize) as u32
    }
}
