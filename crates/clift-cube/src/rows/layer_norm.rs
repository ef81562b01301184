//! Layer norm, forward and backward.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::cube_count;
use crate::buffers::reduce::{RowSizes, Term, sum_of_row, sum_of_vector, sum_over_rows};

/// Units of a row, and rows of a cube.
const LANES: usize = 32;
const ROWS: usize = 8;

/// Computes `(x - mean) inverse gamma + beta`, and mean and inverse of every row.
#[cube(launch_unchecked)]
fn forward<O: Float, V: Size>(
    x: &[Vector<f32, V>],
    gamma: &[Vector<f32, V>],
    beta: &[Vector<f32, V>],
    output: &mut [Vector<O, V>],
    statistics: &mut [f32],
    rows: usize,
    columns: usize,
    epsilon: f32,
    #[define(O)] _values: ElemType,
) {
    let mut stage = Shared::<[f32]>::new_slice(ROWS * LANES);
    let vectors = columns / V::value().comptime();
    let lane = UNIT_POS as usize % LANES;
    // Units beyond the last row compute that row too.
    let row = min(
        (CUBE_POS_Y as usize * CUBE_COUNT_X as usize + CUBE_POS_X as usize) * ROWS + UNIT_POS as usize / LANES,
        rows - 1,
    );
    let start = row * vectors;

    let mut sum = Vector::<f32, V>::new(0.0);
    let mut i = lane;
    while i < vectors {
        sum += x[start + i];
        i += LANES;
    }
    let mean = sum_of_row(sum_of_vector(sum), &mut stage, LANES) / columns as f32;
    let mut square = Vector::<f32, V>::new(0.0);
    i = lane;
    while i < vectors {
        let value = x[start + i] - Vector::<f32, V>::new(mean);
        square += value * value;
        i += LANES;
    }
    let variance = sum_of_row(sum_of_vector(square), &mut stage, LANES) / columns as f32;
    let inverse = 1.0 / (variance + epsilon).sqrt();
    i = lane;
    while i < vectors {
        let normal = (x[start + i] - Vector::<f32, V>::new(mean)) * Vector::<f32, V>::new(inverse);
        output[start + i] = Vector::cast_from(normal * gamma[i] + beta[i]);
        i += LANES;
    }
    if lane == 0 {
        statistics[row * 2] = mean;
        statistics[row * 2 + 1] = inverse;
    }
}

/// Computes `dx = (g - mean(g) - y mean(g y)) inverse` with `g = dO gamma` and `y` the normalized row.
#[cube(launch_unchecked)]
fn backward<V: Size>(
    x: &[Vector<f32, V>],
    gamma: &[Vector<f32, V>],
    grad: &[Vector<f32, V>],
    statistics: &[f32],
    grad_x: &mut [Vector<f32, V>],
    rows: usize,
    columns: usize,
) {
    let mut stage = Shared::<[f32]>::new_slice(ROWS * LANES);
    let vectors = columns / V::value().comptime();
    let lane = UNIT_POS as usize % LANES;
    let row = min(
        (CUBE_POS_Y as usize * CUBE_COUNT_X as usize + CUBE_POS_X as usize) * ROWS + UNIT_POS as usize / LANES,
        rows - 1,
    );
    let start = row * vectors;
    let mean = Vector::<f32, V>::new(statistics[row * 2]);
    let inverse = Vector::<f32, V>::new(statistics[row * 2 + 1]);

    let mut sum = Vector::<f32, V>::new(0.0);
    let mut along = Vector::<f32, V>::new(0.0);
    let mut i = lane;
    while i < vectors {
        let slope = grad[start + i] * gamma[i];
        sum += slope;
        along += slope * (x[start + i] - mean) * inverse;
        i += LANES;
    }
    let sum = Vector::<f32, V>::new(sum_of_row(sum_of_vector(sum), &mut stage, LANES) / columns as f32);
    let along = Vector::<f32, V>::new(sum_of_row(sum_of_vector(along), &mut stage, LANES) / columns as f32);
    i = lane;
    while i < vectors {
        let normal = (x[start + i] - mean) * inverse;
        grad_x[start + i] = (grad[start + i] * gamma[i] - sum - normal * along) * inverse;
        i += LANES;
    }
}

fn vector(columns: usize) -> usize {
    if columns.is_multiple_of(4) { 4 } else { 1 }
}

/// Computes `(x - mean) / sqrt(variance + epsilon) * gamma + beta` over rows of `gamma.len` values, in type `output`, and mean
/// and inverse deviation of every row.
pub fn layer_norm_forward(
    client: &Client,
    [x, gamma, beta]: [&Buffer; 3],
    epsilon: f32,
    output: Values,
) -> [Buffer; 2] {
    let columns = gamma.len;
    let rows = x.len / columns;
    let vector = vector(columns);
    let output = Buffer::empty(client, x.len, output);
    let statistics = Buffer::empty(client, rows * 2, Values::F32);
    // SAFETY: the kernel reads and writes inside rows and columns.
    unsafe {
        forward::launch_unchecked(
            client,
            cube_count(rows.div_ceil(ROWS)),
            CubeDim::new_1d((ROWS * LANES) as u32),
            vector,
            x.arg(vector),
            gamma.arg(vector),
            beta.arg(vector),
            output.arg(vector),
            statistics.arg(1),
            rows,
            columns,
            epsilon,
            output.values.elem(),
        );
    }
    [output, statistics]
}

/// Computes the gradients of `x`, gamma and beta.
pub fn layer_norm_backward(client: &Client, [x, gamma, statistics]: [&Buffer; 3], grad: &Buffer) -> [Buffer; 3] {
    let columns = gamma.len;
    let rows = x.len / columns;
    let vector = vector(columns);
    let grad_x = Buffer::empty(client, x.len, Values::F32);
    // SAFETY: the kernel reads and writes inside rows and columns.
    unsafe {
        backward::launch_unchecked(
            client,
            cube_count(rows.div_ceil(ROWS)),
            CubeDim::new_1d((ROWS * LANES) as u32),
            vector,
            x.arg(vector),
            gamma.arg(vector),
            grad.arg(vector),
            statistics.arg(1),
            grad_x.arg(vector),
            rows,
            columns,
        );
    }
    let sizes = RowSizes { rows, columns, stride: columns };
    let mut sums = sum_over_rows(client, sizes, grad, [x, statistics], Term::Normal, [1, columns]);
    let grad_beta = sums.remove(1);
    [grad_x, sums.remove(0), grad_beta]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffers::reduce::sum_rows;
    use crate::testing::{client, random, read, upload, worst};

    #[test]
    fn norms_and_their_gradients_equal_f64() {
        let Some(client) = client() else { return };
        for (rows, columns) in [(1, 4), (70, 37), (9, 768)] {
            let [x, gamma, beta, grad] = [(rows * columns, 1), (columns, 2), (columns, 3), (rows * columns, 4)]
                .map(|(len, seed)| random(len, seed));
            let [x_, gamma_, beta_, grad_] = [&x, &gamma, &beta, &grad].map(|x| upload(&client, x, Values::F32));
            let [output, statistics] = layer_norm_forward(&client, [&x_, &gamma_, &beta_], 1e-5, Values::F32);
            let [grad_x, grad_gamma, grad_beta] = layer_norm_backward(&client, [&x_, &gamma_, &statistics], &grad_);

            let [mut expected, mut expected_x] = [Vec::new(), Vec::new()];
            let mut expected_sums = vec![0.0; 2 * columns];
            let n = columns as f64;
            for row in 0..rows {
                let line =
                    |x: &[f32]| -> Vec<f64> { x[row * columns..][..columns].iter().map(|&x| f64::from(x)).collect() };
                let (x, grad) = (line(&x), line(&grad));
                let mean = x.iter().sum::<f64>() / n;
                let inverse = 1.0 / (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n + 1e-5).sqrt();
                let y: Vec<f64> = x.iter().map(|x| (x - mean) * inverse).collect();
                let slope: Vec<f64> = (0..columns).map(|i| grad[i] * f64::from(gamma[i])).collect();
                let along = (0..columns).map(|i| slope[i] * y[i]).sum::<f64>() / n;
                let center = slope.iter().sum::<f64>() / n;
                for i in 0..columns {
                    expected.push(y[i] * f64::from(gamma[i]) + f64::from(beta[i]));
                    expected_x.push((slope[i] - center - y[i] * along) * inverse);
                    expected_sums[i] += grad[i] * y[i];
                    expected_sums[columns + i] += grad[i];
                }
            }
            assert!(worst(&read(&client, &output), &expected) < 3e-6);
            assert!(worst(&read(&client, &grad_x), &expected_x) < 3e-6);
            assert!(worst(&read(&client, &grad_gamma), &expected_sums[..columns]) < 3e-6);
            assert!(worst(&read(&client, &grad_beta), &expected_sums[columns..]) < 3e-6);
            assert!(worst(&read(&client, &sum_rows(&client, &grad_, columns)), &expected_sums[columns..]) < 3e-6);
            let [output, _] = layer_norm_forward(&client, [&x_, &gamma_, &beta_], 1e-5, Values::F16);
            assert!(worst(&read(&client, &output), &expected) < 6e-4);
        }
    }
}
