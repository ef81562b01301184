//! AdamW, a launch a tensor, and the norm of gradients, a launch for several tensors.

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::{UNITS, elementwise};
use crate::buffers::reduce::{sum_of_row, sum_of_vector};

/// Vectors that a unit adds.
const VECTORS: usize = 16;

/// Factors of an update.
#[derive(CubeType, CubeLaunch, Clone, Copy, Debug)]
pub struct AdamW {
    /// Learning rate.
    pub learning_rate: f32,
    /// Decay of the parameters, per learning rate.
    pub weight_decay: f32,
    /// Decay of the mean of the gradients.
    pub beta_1: f32,
    /// Decay of the mean of their squares.
    pub beta_2: f32,
    /// `1 - beta_1^t` at update `t`.
    pub correction_1: f32,
    /// `1 - beta_2^t` at update `t`.
    pub correction_2: f32,
    /// Added to the root of the mean square.
    pub epsilon: f32,
    /// Factor of the gradient.
    pub grad_factor: f32,
}

#[cube(launch_unchecked)]
fn update<V: Size>(
    parameter: &[Vector<f32, V>],
    mean: &[Vector<f32, V>],
    square: &[Vector<f32, V>],
    grad: &[Vector<f32, V>],
    new_parameter: &mut [Vector<f32, V>],
    new_mean: &mut [Vector<f32, V>],
    new_square: &mut [Vector<f32, V>],
    rates: AdamW,
) {
    let index = ABSOLUTE_POS;
    if index < grad.len() {
        let one = Vector::<f32, V>::new(1.0);
        let grad = grad[index] * Vector::<f32, V>::new(rates.grad_factor);
        let old = Vector::<f32, V>::new(rates.beta_1);
        let mean = old * mean[index] + (one - old) * grad;
        let old = Vector::<f32, V>::new(rates.beta_2);
        let square = old * square[index] + (one - old) * grad * grad;
        let root = (square / Vector::<f32, V>::new(rates.correction_2)).sqrt();
        let step = mean / Vector::<f32, V>::new(rates.correction_1) / (root + Vector::<f32, V>::new(rates.epsilon));
        let kept = Vector::<f32, V>::new(1.0 - rates.learning_rate * rates.weight_decay);
        new_parameter[index] = parameter[index] * kept - step * Vector::<f32, V>::new(rates.learning_rate);
        new_mean[index] = mean;
        new_square[index] = square;
    }
}

/// Returns the parameter, the mean of its gradients and the mean of their squares after an update by a gradient.
pub fn adamw(client: &Client, settings: AdamW, inputs: [&Buffer; 3], grad: &Buffer) -> [Buffer; 3] {
    let outputs = inputs.map(|input| Buffer::empty(client, input.len, Values::F32));
    let ([parameter, mean, square], [new_parameter, new_mean, new_square]) = (inputs, &outputs);
    let (vector, count, dim) = elementwise(grad.len);
    let AdamW { learning_rate, weight_decay, beta_1, beta_2, correction_1, correction_2, epsilon, grad_factor } =
        settings;
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        update::launch_unchecked(
            client,
            count,
            dim,
            vector,
            parameter.arg(vector),
            mean.arg(vector),
            square.arg(vector),
            grad.arg(vector),
            new_parameter.arg(vector),
            new_mean.arg(vector),
            new_square.arg(vector),
            AdamWLaunch::new(
                learning_rate,
                weight_decay,
                beta_1,
                beta_2,
                correction_1,
                correction_2,
                epsilon,
                grad_factor,
            ),
        );
    }
    outputs
}

/// Tensors of a launch.
const GROUP: usize = 8;

/// Returns the sum of the squares of a chunk of the values, in unit 0 of the cube.
#[cube]
fn squares<V: Size>(x: &[Vector<f32, V>], stage: &mut Shared<[f32]>) -> f32 {
    let mut sum = Vector::<f32, V>::new(0.0);
    for i in 0..VECTORS {
        let index = (CUBE_POS_X as usize * VECTORS + i) * UNITS + UNIT_POS as usize;
        if index < x.len() {
            sum += x[index] * x[index];
        }
    }
    sum_of_row(sum_of_vector(sum), stage, UNITS)
}

/// Writes the sum of the squares of a chunk of a tensor to `sums[first + cube]`; a row of cubes has a tensor.
#[cube(launch_unchecked)]
fn add_squares<V: Size>(
    a: &[Vector<f32, V>],
    b: &[Vector<f32, V>],
    c: &[Vector<f32, V>],
    d: &[Vector<f32, V>],
    e: &[Vector<f32, V>],
    f: &[Vector<f32, V>],
    g: &[Vector<f32, V>],
    h: &[Vector<f32, V>],
    sums: &mut [f32],
    first: usize,
) {
    let mut stage = Shared::<[f32]>::new_slice(UNITS);
    let sum = match CUBE_POS_Y {
        0 => squares(a, &mut stage),
        1 => squares(b, &mut stage),
        2 => squares(c, &mut stage),
        3 => squares(d, &mut stage),
        4 => squares(e, &mut stage),
        5 => squares(f, &mut stage),
        6 => squares(g, &mut stage),
        _ => squares(h, &mut stage),
    };
    if UNIT_POS == 0 {
        sums[first + (CUBE_POS_Y * CUBE_COUNT_X + CUBE_POS_X) as usize] = sum;
    }
}

/// Writes the root of the sum of `sums`.
#[cube(launch_unchecked)]
fn finish_norm(sums: &[f32], norm: &mut [f32]) {
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
    }
}

/// Computes the norm of all gradients together, `[1]`.
pub fn gradient_norm(client: &Client, grads: &[Buffer]) -> Buffer {
    let vector = |x: &Buffer| if x.len.is_multiple_of(4) { 4 } else { 1 };
    // Tensors of a launch have similar lengths.
    let mut grads: Vec<&Buffer> = grads.iter().collect();
    grads.sort_by_key(|x| (vector(x), x.len));
    let groups: Vec<&[&Buffer]> =
        grads.chunk_by(|a, b| vector(a) == vector(b)).flat_map(|all| all.chunks(GROUP)).collect();
    let chunks = |group: &[&Buffer]| {
        let longest = group.iter().map(|x| x.len).max().unwrap_or(0);
        (longest / vector(group[0])).div_ceil(UNITS * VECTORS).max(1)
    };
    let counts: Vec<usize> = groups.iter().map(|group| chunks(group)).collect();
    let len = groups.iter().zip(&counts).map(|(group, count)| group.len() * count).sum();
    let (sums, norm) = (Buffer::empty(client, len, Values::F32), Buffer::empty(client, 1, Values::F32));
    let dim = CubeDim::new_1d(UNITS as u32);
    let mut first = 0;
    // SAFETY: the kernels compare their indices with the lengths.
    unsafe {
        for (group, count) in groups.iter().zip(counts) {
            let vector = vector(group[0]);
            // Rows of cubes stand only for the tensors of the group; the last one fills the other arguments.
            let arg = |i: usize| group[i.min(group.len() - 1)].arg(vector);
            add_squares::launch_unchecked(
                client,
                CubeCount::Static(count as u32, group.len() as u32, 1),
                dim,
                vector,
                arg(0),
                arg(1),
                arg(2),
                arg(3),
                arg(4),
                arg(5),
                arg(6),
                arg(7),
                sums.arg(1),
                first,
            );
            first += group.len() * count;
        }
        finish_norm::launch_unchecked(client, CubeCount::Static(1, 1, 1), dim, sums.arg(1), norm.arg(1));
    }
    norm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::cases::{Case, random};
    use crate::testing::{check, client};

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
            grad_factor: 0.5,
        };
        for len in [1, 37, 5000] {
            let inputs = move || {
                let square = random(len, 3, 1.0).iter().map(|x| x * x).collect();
                [random(len, 1, 1.0), random(len, 2, 1.0), square, random(len, 4, 1.0)]
            };
            let run = move |client: &Client, inputs: &[Buffer]| {
                adamw(client, settings, [&inputs[0], &inputs[1], &inputs[2]], &inputs[3]).into()
            };
            let case = Case::new(inputs, run, move |inputs| {
                let updated = (0..len).map(|i| {
                    let [p, m, s, g] = [0, 1, 2, 3].map(|input| inputs[input][i]);
                    let (m, s) = (0.9 * m + 0.1 * 0.5 * g, 0.95 * s + 0.05 * (0.5 * g).powi(2));
                    [p * (1.0 - 1e-2 * 0.05) - 1e-2 * (m / 0.1) / ((s / 0.05).sqrt() + 1e-8), m, s]
                });
                let updated: Vec<[f64; 3]> = updated.collect();
                [0, 1, 2].map(|result| updated.iter().map(|values| values[result]).collect()).into()
            });
            // Also compares a second run: the inputs stay.
            check(&client, &case, 1e-6);
        }
    }

    #[test]
    fn the_norm_is_that_of_all_gradients() {
        let Some(client) = client() else { return };
        let lens = [5, 40_000, 37, 8, 12, 400, 16, 70_000, 20, 24, 28, 32];
        let grads = move || lens.map(|len| random(len, len as u64, 1.0));
        let run = |client: &Client, inputs: &[Buffer]| vec![gradient_norm(client, inputs)];
        let case = Case::new(grads, run, |grads| vec![vec![grads.iter().flatten().map(|x| x * x).sum::<f64>().sqrt()]]);
        check(&client, &case, 1e-6);
    }
}
