//! Procedural surface colours: two colours mixed by a pattern.

use std::f32::consts::TAU;

use clift_core::{uniform_01, uniform_below};
use glam::Vec3;
use rand::Rng;

use crate::synthetic::tracing::noise::smooth;

/// Pattern in which the two colours alternate.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Pattern {
    Gradient,
    Stripes,
    Checkers,
    Waves,
}

/// Colour of a surface as a function of two coordinates along it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Texture {
    pattern: Pattern,
    colors: [Vec3; 2],
    /// Unit direction of the pattern's first axis in surface coordinates.
    axis: [f32; 2],
    /// Radians per unit of length.
    rate: f32,
    phase: f32,
}

impl Texture {
    /// Samples a texture around `hue` (in turns), with about `frequency` cycles per unit of length. `saturation` and
    /// `value` describe the brighter colour.
    pub fn sample(rng: &mut impl Rng, hue: f64, saturation: f64, value: f64, frequency: f64) -> Self {
        let pattern = [Pattern::Gradient, Pattern::Stripes, Pattern::Checkers, Pattern::Waves][uniform_below(rng, 4)];
        let turn = uniform_01(rng) * std::f64::consts::TAU;
        let shift = 0.12 + 0.3 * uniform_01(rng);
        let darker = value * (0.25 + 0.15 * uniform_01(rng));
        Self {
            pattern,
            colors: [linear_color(hue, saturation, value), linear_color(hue + shift, saturation, darker)],
            axis: [turn.cos() as f32, turn.sin() as f32],
            rate: TAU * (frequency * (0.7 + 0.6 * uniform_01(rng))) as f32,
            phase: uniform_01(rng) as f32 * TAU,
        }
    }

    #[cfg(test)]
    pub fn plain(color: Vec3) -> Self {
        Self { pattern: Pattern::Gradient, colors: [color; 2], axis: [1.0, 0.0], rate: 0.0, phase: 0.0 }
    }

    /// Returns the linear colour at the surface coordinates `u`, `v`.
    pub fn color(&self, u: f32, v: f32) -> Vec3 {
        let along = (u * self.axis[0] + v * self.axis[1]) * self.rate + self.phase;
        let across = (v * self.axis[0] - u * self.axis[1]) * self.rate;
        let share = match self.pattern {
            Pattern::Gradient => 0.5 + 0.5 * (0.5 * along).sin(),
            Pattern::Stripes => soft_edge(along.sin()),
            Pattern::Checkers => soft_edge(2.0 * (0.7 * along).sin() * (0.7 * across).sin()),
            Pattern::Waves => 0.5 + 0.25 * (along.sin() + (across + along.cos()).sin()),
        };
        self.colors[0].lerp_monotonic(self.colors[1], share)
    }
}

/// Maps a wave in `[-1, 1]` to plateaus at 0 and 1 with edges wider than a pixel.
fn soft_edge(wave: f32) -> f32 {
    smooth(0.5 + 1.2 * wave)
}

/// Converts hue (in turns), saturation and value to a linear colour, for a display gamma of 2.
pub(crate) fn linear_color(hue: f64, saturation: f64, value: f64) -> Vec3 {
    let channels = [0.0, 2.0 / 3.0, 1.0 / 3.0].map(|offset: f64| {
        let distance = ((hue + offset).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        let shade = value * (1.0 - saturation * (1.0 - distance.clamp(0.0, 1.0)));
        (shade * shade) as f32
    });
    channels.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hues_a_third_apart_are_red_green_and_blue() {
        assert_eq!(linear_color(0.0, 1.0, 1.0), Vec3::new(1.0, 0.0, 0.0));
        assert_eq!(linear_color(1.0 / 3.0, 1.0, 1.0), Vec3::new(0.0, 1.0, 0.0));
        assert_eq!(linear_color(-1.0 / 3.0, 1.0, 0.5), Vec3::new(0.0, 0.0, 0.25));
        assert_eq!(linear_color(0.4, 0.0, 1.0), Vec3::ONE);
    }
}
