//! The distribution of every coefficient around its expected value, in units of its standard deviation there.
// D width, K knots

use crate::codec::prediction::{Places, Prediction};
use crate::codec::transform::Transform;

/// Knots of one sign: from 1/32 to 32 standard deviations, four per octave.
const KNOTS_PER_SIDE: usize = 41;
/// Share of an even distribution over the bins: a value of no training scene has a probability, too.
const EVEN_SHARE: f64 = 1e-4;

#[derive(Clone, Debug, PartialEq)]
pub struct Distributions {
    /// Ascending, in standard deviations, `[K]`.
    pub knots: Vec<f32>,
    /// Probability below every knot, from 0 to 1, `[D, K]`.
    pub cumulative: Vec<f32>,
}

/// Counts of coefficients between the knots, weighted by scene.
#[derive(Clone, Debug)]
pub struct Histograms {
    knots: Vec<f32>,
    /// `[D, K - 1]`
    weights: Vec<f64>,
}

impl Histograms {
    pub fn new(dim: usize) -> Self {
        let side = |k: usize| (k as f64 / 4.0 - 5.0).exp2() as f32;
        let knots: Vec<f32> =
            (0..KNOTS_PER_SIDE).rev().map(|k| -side(k)).chain((0..KNOTS_PER_SIDE).map(side)).collect();
        Self { weights: vec![0.0; dim * (knots.len() - 1)], knots }
    }

    /// Adds the tokens of a scene, `[S, D]`. Values beyond the last knots count in the last bins.
    pub fn add(&mut self, transform: &Transform, prediction: &Prediction, tokens: &[f32], places: Places<'_>) {
        let (dim, bins) = (transform.mean.len(), self.knots.len() - 1);
        let weight = dim as f64 / tokens.len() as f64;
        let (values, neighbours) = places.sorted(&transform.forward(tokens), dim);
        for (token, (class, nearest)) in neighbours.into_iter().enumerate() {
            for (d, &deviation) in transform.deviations.iter().enumerate() {
                let [first, second] = nearest.map(|token| f64::from(values[token * dim + d]));
                let expected = prediction.value(class, d, [first, second]);
                let scale = f64::from(deviation) * prediction.deviation(class, d, 0.0);
                let value = (f64::from(values[token * dim + d]) - expected) / scale;
                let above = self.knots.partition_point(|knot| f64::from(*knot) <= value);
                self.weights[d * bins + above.clamp(1, bins) - 1] += weight;
            }
        }
    }

    pub fn distributions(&self) -> Distributions {
        let bins = self.knots.len() - 1;
        let mut cumulative = Vec::with_capacity(self.weights.len() / bins * self.knots.len());
        for weights in self.weights.chunks_exact(bins) {
            let total: f64 = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
            let mut below = 0.0;
            cumulative.push(0.0);
            for weight in &weights[..bins - 1] {
                below += (1.0 - EVEN_SHARE) * weight / total + EVEN_SHARE / bins as f64;
                cumulative.push((below as f32).min(1.0));
            }
            cumulative.push(1.0);
        }
        Distributions { knots: self.knots.clone(), cumulative }
    }
}
