//! AdamW, one launch a tensor, and the norm of gradients.

use cubecl::prelude::*;

use crate::buffer::{Buffer, Values};
use crate::elementwise::{UNITS, elementwise};
use crate::reduce::{sum_of_row, sum_of_vector};

/// Vectors that a unit adds.
const VECTORS: usize = 16;

/// Factors of an update.
#[derive(CubeType, CubeLaunch, Clone, Copy, Debug)]
pub struct AdamW {
    /// Learning rate.
    pub learning_rate: f32,
    /// Decay of the parameters, per learning rate.
    pub weight_decay: f32,
    /// Decays of the means of gradients and of their squares.
    pub beta_1: f32,
    /// As `beta_1`, of the squares.
    pub beta_2: f32,
    /// `1 - beta_1^t` and `1 - beta_2^t` at update `t`.
    pub correction_1: f32,
    /// As `correction_1`, of the squares.
    pub correction_2: f32,
    /// Added to the root of the mean square.
    pub epsilon: f32,
}

#[cube(launch_unchecked)]
fn update<V: Size>(
    parameter: &mut [Vector<f32, V>],
    mean: &mut [Vector<f32, V>],
    square: &mut [Vector<f32, V>],
    grad: &[Vector<f32, V>],
    factor: &[f32],
    rates: AdamW,
) {
    let index = ABSOLUTE_POS;
    if index < grad.len() {
        let grad = grad[index] * Vector::<f32, V>::new(factor[0]);
        let old = Vector::<f32, V>::new(rates.beta_1);
        let new_mean = old * mean[index] + (Vector::<f32, V>::new(1.0) - old) * grad;
        let old = Vector::<f32, V>::new(rates.beta_2);
        let new_square = old * square[index] + (Vector::<f32, V>::new(1.0) - old) * grad * grad;
        let root = (new_square / Vector::<f32, V>::new(rates.correction_2)).sqrt();
        let step = new_mean / Vector::<f32, V>::new(rates.correction_1) / (root + Vector::<f32, V>::new(rates.epsilon));
        let kept = Vector::<f32, V>::new(1.0 - rates.learning_rate * rates.weight_decay);
        parameter[index] = parameter[index] * kept - step * Vector::<f32, V>::new(rates.learning_rate);
        mean[index] = new_mean;
        square[index] = new_square;
    }
}

/// Updates a parameter, the mean of its gradients and the mean of their squares by a gradient, multiplied by `factor: [1]`.
pub fn adamw(
    client: &Client,
    settings: AdamW,
    [parameter, mean, square]: [&Buffer; 3],
    grad: &Buffer,
    factor: &Buffer,
) {
    let (vector, count) = elementwise(grad.len);
    let AdamW { learning_rate, weight_decay, beta_1, beta_2, correction_1, correction_2, epsilon } = settings;
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        update::launch_unchecked(
            client,
            count,
            CubeDim::new_1d(UNITS as u32),
            vector,
            parameter.arg(vector),
            mean.arg(vector),
            square.arg(vector),
            grad.arg(vector),
            factor.arg(1),
            AdamWLaunch::new(learning_rate, weight_decay, beta_1, beta_2, correction_1, correction_2, epsilon),
        );
    }
}

/// Writes the sum of the squares of a part of the values to `sums[first + cube]`.
#[cube(launch_unchecked)]
fn add_squares<V: Size>(x: &[Vector<f32, V>], sums: &mut [f32], first: usize) {
    let mut stage = Shared::<[f32]>::new_slice(UNITS);
    let mut sum = Vector::<f32, V>::new(0.0);
    for i in 0..VECTORS {
        let index = (CUBE_POS_X as usize * VECTORS + i) * UNITS + UNIT_POS as usize;
        if index < x.len() {
            sum += x[index] * x[index];
        }
    }
    let sum = sum_of_row(sum_of_vector(sum), &mut stage, UNITS);
    if UNIT_POS == 0 {
        sums[first + CUBE_POS_X as usize] = sum;
    }
}

/// Writes the root of the sum of `sums`, and the factor that limits it.
#[cube(launch_unchecked)]
fn finish_norm(sums: &[f32], norm: &mut [f32], limit: f32) {
    let mut stage = Shared::<[f32]>::new_slice(UNITS);
    let mut sum = 0.0f32;
    let mut i = UNIT_POS as usize;
    while i < sums.len() {
        sum += sums[i];
        i += UNITS;
    }
    let root = sum_of_row(sum, &mut stage, UNITS).sqrt();
    if UNIT_POS == 0 {
        norm[0] = root;
        norm[1] = min(1.0f32, limit / (root + 1e-6f32));
    }
}

/// Computes the norm of all gradients together and the factor, at most one, by which they have a norm of at most `limit`: `[2]`.
pub fn gradient_norm(client: &Client, grads: &[&Buffer], limit: f32) -> Buffer {
    let parts = |x: &Buffer| {
        let vector = if x.len.is_multiple_of(4) { 4 } else { 1 };
        (vector, (x.len / vector).div_ceil(UNITS * VECTORS))
    };
    let sums = Buffer::empty(client, grads.iter().map(|x| parts(x).1).sum(), Values::F32);
    let norm = Buffer::empty(client, 2, Values::F32);
    let mut first = 0;
    // SAFETY: the kernels compare their indices with the lengths.
    unsafe {
        for x in grads {
            let (vector, cubes) = parts(x);
            let (count, dim) = (CubeCount::Static(cubes as u32, 1, 1), CubeDim::new_1d(UNITS as u32));
            add_squares::launch_unchecked(client, count, dim, vector, x.arg(vector), sums.arg(1), first);
            first += cubes;
        }
        let (count, dim) = (CubeCount::Static(1, 1, 1), CubeDim::new_1d(UNITS as u32));
        finish_norm::launch_unchecked(client, count, dim, sums.arg(1), norm.arg(1), limit);
    }
    norm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{client, random, read, upload, worst};

    #[test]
    fn updates_equal_f64() {
        let Some(client) = client() else { return };
        let settings = AdamW {
            learning_rate: 1e-2,
            weight_decay: 0.05,
            beta_1: 0.9,
            beta_2: 0.95,
            correction_1: 0.1,
            correction_2: 0.05,
            epsilon: 1e-8,
        };
        for len in [1, 37, 5000] {
            let values = [1, 2, 3, 4].map(|seed| random(len, seed));
            let square: Vec<f32> = values[2].iter().map(|x| x * x).collect();
            let [parameter, mean, square_, grad] =
                [&values[0], &values[1], &square, &values[3]].map(|x| upload(&client, x, Values::F32));
            adamw(&client, settings, [&parameter, &mean, &square_], &grad, &upload(&client, &[0.5], Values::F32));
            let expected = (0..len).map(|i| {
                let [p, m, s, g] = [values[0][i], values[1][i], square[i], 0.5 * values[3][i]].map(f64::from);
                let (m, s) = (0.9 * m + 0.1 * g, 0.95 * s + 0.05 * g * g);
                (p * (1.0 - 1e-2 * 0.05) - 1e-2 * (m / 0.1) / ((s / 0.05).sqrt() + 1e-8), m, s)
            });
            let expected: Vec<_> = expected.collect();
            assert!(worst(&read(&client, &parameter), &expected.iter().map(|x| x.0).collect::<Vec<_>>()) < 1e-6);
            assert!(worst(&read(&client, &mean), &expected.iter().map(|x| x.1).collect::<Vec<_>>()) < 1e-6);
            assert!(worst(&read(&client, &square_), &expected.iter().map(|x| x.2).collect::<Vec<_>>()) < 1e-6);
        }
    }

    #[test]
    fn the_norm_is_that_of_all_gradients() {
        let Some(client) = client() else { return };
        let grads = [(5, 1), (40_000, 2), (37, 3)].map(|(len, seed)| random(len, seed));
        let buffers = grads.each_ref().map(|x| upload(&client, x, Values::F32));
        let norm = grads.iter().flatten().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
        for limit in [1.0, 1000.0] {
            let computed = read(&client, &gradient_norm(&client, &buffers.each_ref(), limit));
            assert!(worst(&computed, &[norm, (f64::from(limit) / norm).min(1.0)]) < 1e-6);
        }
    }
}
