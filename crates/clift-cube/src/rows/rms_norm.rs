//! RMS norms of heads, forward and backward.

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::cube_count;
use crate::buffers::reduce::{RowSizes, Term, row_of_unit, sum_of_row, sum_of_vector, sum_over_rows};

/// Units of a head, and heads of a cube.
const LANES: usize = 8;
const HEADS: usize = 32;

/// Rows of heads: queries, keys and values side by side, or fewer of them.
#[derive(Clone, Copy, Debug)]
pub struct NormHeads {
    /// Parts of a row.
    pub num_parts: usize,
    /// Heads of a part.
    pub num_heads: usize,
    /// Channels of a head.
    pub head_width: usize,
    /// Added to the mean square.
    pub epsilon: f32,
}

/// Normalizes heads, or computes the gradient: `dx = r (g - y mean(g y))` with `g = dO gamma`. Heads without a norm are copied.
#[cube(launch_unchecked)]
fn norm<V: Size>(
    x: &[Vector<f32, V>],
    gammas: &[Vector<f32, V>],
    grad: &[Vector<f32, V>],
    output: &mut [Vector<f32, V>],
    inverses: &mut [f32],
    rows: usize,
    num_parts: usize,
    norm_parts: usize,
    num_heads: usize,
    epsilon: f32,
    #[comptime] width: usize,
    #[comptime] is_gradient: bool,
) {
    let mut stage = Shared::<[f32]>::new_slice(HEADS * LANES);
    let vector = V::value().comptime();
    let vectors = comptime!(width / vector);
    let lane = UNIT_POS as usize % LANES;
    let head = row_of_unit(rows * num_parts * num_heads, HEADS, LANES);
    let part = head / num_heads % num_parts;
    let has_norm = part < norm_parts;
    let start = head * vectors;
    let gamma = min(part, norm_parts - 1) * vectors;

    let mut square = Vector::<f32, V>::new(0.0);
    let mut i = lane;
    while i < vectors {
        square += x[start + i] * x[start + i];
        i += LANES;
    }
    let mean = sum_of_row(sum_of_vector(square), &mut stage, LANES) / width as f32;
    let inverse = 1.0 / (mean + epsilon).sqrt();
    let scale = Vector::<f32, V>::new(inverse);
    let mut along = Vector::<f32, V>::new(0.0);
    if comptime!(is_gradient) {
        i = lane;
        while i < vectors {
            along += grad[start + i] * gammas[gamma + i] * x[start + i] * scale;
            i += LANES;
        }
        along = Vector::<f32, V>::new(sum_of_row(sum_of_vector(along), &mut stage, LANES) / width as f32);
    }
    i = lane;
    while i < vectors {
        let normal = x[start + i] * scale;
        if comptime!(is_gradient) {
            let slope = (grad[start + i] * gammas[gamma + i] - normal * along) * scale;
            output[start + i] = select(has_norm, slope, grad[start + i]);
        } else {
            output[start + i] = select(has_norm, normal * gammas[gamma + i], x[start + i]);
        }
        i += LANES;
    }
    if comptime!(is_gradient) {
        if has_norm && lane == 0 {
            let row = head / (num_heads * num_parts);
            inverses[row * norm_parts * num_heads + head % (num_heads * num_parts)] = inverse;
        }
    }
}

fn launch(client: &Client, [x, gammas, grad]: [&Buffer; 3], heads: NormHeads, is_gradient: bool) -> [Buffer; 2] {
    let NormHeads { num_parts, num_heads, head_width, epsilon } = heads;
    let rows = x.len / (num_parts * num_heads * head_width);
    let norm_parts = gammas.len / head_width;
    let vector = if head_width.is_multiple_of(4) { 4 } else { 1 };
    let output = Buffer::empty(client, x.len, Values::F32);
    let inverses = Buffer::empty(client, if is_gradient { rows * norm_parts * num_heads } else { 1 }, Values::F32);
    // SAFETY: the kernel reads and writes inside the heads.
    unsafe {
        norm::launch_unchecked(
            client,
            cube_count((rows * num_parts * num_heads).div_ceil(HEADS)),
            CubeDim::new_1d((HEADS * LANES) as u32),
            vector,
            x.arg(vector),
            gammas.arg(vector),
            grad.arg(vector),
            output.arg(vector),
            inverses.arg(1),
            rows,
            num_parts,
            norm_parts,
            num_heads,
            epsilon,
            head_width,
            is_gradient,
        );
    }
    [output, inverses]
}

/// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of the heads of the first parts of every row; there are
/// `gammas.len / head_width` such parts, and the others stay.
pub fn rms_norm_forward(client: &Client, [x, gammas]: [&Buffer; 2], heads: NormHeads) -> Buffer {
    let [output, _] = launch(client, [x, gammas, x], heads, false);
    output
}

/// Computes the gradients of `x` and the gammas.
pub fn rms_norm_backward(client: &Client, [x, gammas]: [&Buffer; 2], grad: &Buffer, heads: NormHeads) -> [Buffer; 2] {
    let NormHeads { num_parts, num_heads, head_width, .. } = heads;
    let [grad_x, inverses] = launch(client, [x, gammas, grad], heads, true);
    let stride = num_parts * num_heads * head_width;
    let sizes = RowSizes { rows: x.len / stride, columns: gammas.len * num_heads, stride };
    let term = Term::Head { width: head_width };
    let mut sums = sum_over_rows(client, sizes, grad, [x, &inverses], term, [num_heads, head_width]);
    [grad_x, sums.remove(0)]
}

#[cfg(test)]
mod tests {
    use crate::testing::row_cases::rms_norm;
    use crate::testing::{check, client};

    #[test]
    fn norms_of_heads_and_their_gradients_equal_f64() {
        let Some(client) = client() else { return };
        for (rows, num_heads, width, norm_parts) in [(70, 2, 12, 2), (3, 1, 96, 1), (5, 3, 37, 3)] {
            for is_backward in [false, true] {
                check(&client, &rms_norm(rows, [num_heads, width], norm_parts, is_backward), 3e-6);
            }
        }
    }
}
