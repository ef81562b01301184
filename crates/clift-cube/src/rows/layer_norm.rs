//! Layer norm, forward and backward.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::cube_count;
use crate::buffers::reduce::{RowSizes, Term, row_of_unit, sum_of_row, sum_of_vector, sum_over_rows};

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
    let row = row_of_unit(rows, ROWS, LANES);
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
    let row = row_of_unit(rows, ROWS, LANES);
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
    use crate::testing::row_cases::{layer_norm, row_sums};
    use crate::testing::{check, client};

    #[test]
    fn norms_and_their_gradients_equal_f64() {
        let Some(client) = client() else { return };
        for (rows, columns) in [(1, 4), (70, 37), (9, 768)] {
            for (output, tolerance) in [(Some(Values::F32), 3e-6), (Some(Values::F16), 6e-4), (None, 3e-6)] {
                check(&client, &layer_norm(rows, columns, output), tolerance);
            }
            check(&client, &row_sums(rows, columns), 3e-6);
        }
    }
}
