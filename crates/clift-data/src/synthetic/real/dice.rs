//! Random choices and colours of one scene: few hues, mostly muted, as in photos.

use clift_core::{uniform_01, uniform_below};
use glam::Vec3;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::tracing::surface::linear_color;

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

    pub fn chance(&mut self, probability: f32) -> bool {
        self.between(0.0, 1.0) < probability
    }

    /// Samples uniformly from `low..=high`.
    pub fn count(&mut self, low: usize, high: usize) -> usize {
        low + uniform_below(&mut self.0, high - low + 1)
    }

    pub fn pick<T: Copy>(&mut self, values: &[T]) -> T {
        values[uniform_below(&mut self.0, values.len())]
    }

    pub fn bits(&mut self) -> u32 {
        self.count(0, u32::MAX as usize) as u32
    }
}

/// The hues that the surfaces of one scene share.
pub(crate) struct Palette {
    hues: [f32; 3],
    /// Mean saturation of the scene.
    strength: f32,
}

impl Palette {
    pub fn sample(dice: &mut Dice) -> Self {
        let hues = [(); 3].map(|()| hue(dice));
        Self { hues, strength: dice.between(0.3, 1.0) }
    }

    /// Samples a colour of any brightness: usually muted, sometimes saturated.
    pub fn any(&self, dice: &mut Dice) -> Vec3 {
        let vivid = dice.chance(0.28);
        let value = dice.between(0.12, 0.95);
        let saturation = if vivid { dice.between(0.45, 0.95) } else { self.strength * dice.between(0.05, 0.8) };
        self.shade(dice, saturation, value)
    }

    /// Samples a colour of about this brightness (display value) that is muted.
    pub fn muted(&self, dice: &mut Dice, value: [f32; 2]) -> Vec3 {
        let saturation = self.strength * dice.between(0.0, 0.6);
        let value = dice.between(value[0], value[1]);
        self.shade(dice, saturation, value)
    }

    /// Samples a colour of a wall: pale, grey or beige, seldom of a strong colour.
    pub fn wall(&self, dice: &mut Dice) -> Vec3 {
        let value = if dice.chance(0.75) { dice.between(0.68, 0.97) } else { dice.between(0.25, 0.75) };
        let saturation = if dice.chance(0.15) { dice.between(0.3, 0.75) } else { dice.between(0.0, 0.22) };
        self.shade(dice, saturation, value)
    }

    fn shade(&self, dice: &mut Dice, saturation: f32, value: f32) -> Vec3 {
        let hue = if dice.chance(0.8) { dice.pick(&self.hues) + dice.swing(0.03) } else { hue(dice) };
        color(hue, saturation, value)
    }
}

pub(crate) fn wood(dice: &mut Dice) -> Vec3 {
    color(dice.between(0.035, 0.11), dice.between(0.25, 0.85), dice.between(0.2, 0.9))
}

pub(crate) fn leaf(dice: &mut Dice) -> Vec3 {
    color(dice.between(0.16, 0.34), dice.between(0.15, 0.55), dice.between(0.2, 0.7))
}

pub(crate) fn stone(dice: &mut Dice) -> Vec3 {
    color(dice.between(0.05, 0.14), dice.between(0.02, 0.35), dice.between(0.3, 0.85))
}

/// Converts hue (in turns), saturation and display value to a linear colour.
pub(crate) fn color(hue: f32, saturation: f32, value: f32) -> Vec3 {
    linear_color(hue.into(), saturation.into(), value.into())
}

/// Samples a hue: warm ones and blue are the most frequent in photos.
fn hue(dice: &mut Dice) -> f32 {
    match dice.count(0, 9) {
        0..=4 => dice.between(0.02, 0.14),
        5..=6 => dice.between(0.54, 0.66),
        7 => dice.between(0.2, 0.4),
        _ => dice.between(0.0, 1.0),
    }
}
