//! Attention of heads, forward and backward, without score matrices in global memory.

use cubecl::prelude::*;

use crate::attention::head_rows::{AttentionLaunch, RowsLaunch};
use crate::attention::matrix_attention as matrix;
use crate::attention::matrix_scores::AttentionTile;
use crate::attention::register_attention as register;
use crate::attention::register_scores::{ROWS, UNITS};
use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::cast;
use crate::ledger::count_products;

/// Sizes of an attention.
#[derive(Clone, Copy, Debug)]
pub struct AttentionSizes {
    /// Number of scenes.
    pub batch: usize,
    /// Heads of a scene.
    pub num_heads: usize,
    /// Queries of a scene.
    pub num_queries: usize,
    /// Keys of a scene.
    pub num_keys: usize,
    /// Channels of a head, at most 128.
    pub head_width: usize,
    /// Tiles of cooperative matrices, forward and backward; `None` stands for register tiles.
    pub tiles: [Option<AttentionTile>; 2],
}

/// Rows of a buffer, one a token, with its heads from column `column` of `stride` columns; scene after scene.
#[derive(Clone, Copy, Debug)]
pub struct HeadRows<'a> {
    /// The values.
    pub buffer: &'a Buffer,
    /// Column of the first head.
    pub column: usize,
    /// Columns of a row.
    pub stride: usize,
}

impl AttentionSizes {
    fn dim(self) -> usize {
        self.num_heads * self.head_width
    }

    fn cubes(self, count: usize, rows: usize) -> CubeCount {
        CubeCount::Static(count.div_ceil(rows) as u32, (self.batch * self.num_heads) as u32, 1)
    }

    /// Counts products of the size of the scores in the next launch.
    fn count_products(self, count: usize) {
        count_products(count * self.batch * self.num_heads, [self.num_queries, self.num_keys, self.head_width]);
    }

    /// Returns the width of vectors, 4 if it divides heads and rows, and 1 otherwise.
    fn vector(self, rows: &[HeadRows]) -> usize {
        let aligned = |x: usize| x.is_multiple_of(4);
        let all = rows.iter().all(|rows| aligned(rows.column) && aligned(rows.stride) && aligned(rows.buffer.len));
        if all && aligned(self.head_width) { 4 } else { 1 }
    }
}

fn rows(rows: HeadRows, count: usize) -> RowsLaunch {
    RowsLaunch::new(rows.column, rows.stride, count)
}

/// Returns the rows of queries, keys, values and outputs.
fn attention(sizes: AttentionSizes, [query, key, value, output]: [HeadRows; 4]) -> AttentionLaunch {
    let [query, output] = [query, output].map(|x| rows(x, sizes.num_queries));
    let [key, value] = [key, value].map(|x| rows(x, sizes.num_keys));
    let scale = (1.0 / (sizes.head_width as f64).sqrt()) as f32;
    AttentionLaunch::new(query, key, value, output, sizes.num_heads, scale)
}

/// Launches a kernel on cooperative matrices if a tile is given, and on register tiles otherwise.
macro_rules! launch {
    ($tile:expr, $kernel:ident, $client:expr, $sizes:expr, $count:expr, $vector:expr, [$($argument:expr),+], $elem:expr) => {
        if let Some(tile) = $tile {
            let (count, dim) = ($sizes.cubes($count, tile.rows()), CubeDim::new_1d(tile.units() as u32));
            matrix::$kernel::launch_unchecked($client, count, dim, $vector, $($argument),+, tile, $elem);
        } else {
            let (count, dim) = ($sizes.cubes($count, ROWS), CubeDim::new_1d(UNITS as u32));
            register::$kernel::launch_unchecked($client, count, dim, $vector, $($argument),+, $sizes.head_width, $elem);
        }
    };
}

/// Copies the buffers of queries, keys and values to f16, each once.
fn in_f16(client: &Client, [query, key, value]: [HeadRows; 3]) -> [Buffer; 3] {
    let first = cast(client, query.buffer, Values::F16);
    let same = |a: HeadRows, b: HeadRows| std::ptr::eq(a.buffer, b.buffer);
    let second = if same(key, query) { first.clone() } else { cast(client, key.buffer, Values::F16) };
    let third = if same(value, key) { second.clone() } else { cast(client, value.buffer, Values::F16) };
    [first, second, third]
}

/// Returns rows with `buffers` in place of their own if given.
fn with<'a>(inputs: [HeadRows<'a>; 3], buffers: Option<&'a [Buffer; 3]>) -> [HeadRows<'a>; 3] {
    [0, 1, 2].map(|i| HeadRows { buffer: buffers.map_or(inputs[i].buffer, |buffers| &buffers[i]), ..inputs[i] })
}

/// Computes `softmax(q k^T / sqrt(E)) v` of every head, `[batch, queries, heads E]` in f32, and the log sums of the scores,
/// `[batch, heads, queries]`, from queries, keys and values.
pub fn attention_forward(client: &Client, sizes: AttentionSizes, inputs: [HeadRows; 3]) -> [Buffer; 2] {
    let AttentionSizes { batch, num_heads, num_queries, tiles: [tile, _], .. } = sizes;
    let output = Buffer::empty(client, batch * num_queries * sizes.dim(), Values::F32);
    let log_sum = Buffer::empty(client, batch * num_heads * num_queries, Values::F32);
    // Every block of rows reads all keys and values: half the bytes for one more pass.
    let halves = tile.map(|_| in_f16(client, inputs));
    let [query, key, value] = with(inputs, halves.as_ref());
    let to = HeadRows { buffer: &output, column: 0, stride: sizes.dim() };
    let (vector, elem) = (sizes.vector(&[query, key, value, to]), query.buffer.values.elem());
    let [q, k, v, out] = [query, key, value, to].map(|rows| rows.buffer.arg(vector));
    let (logs, at) = (log_sum.arg(1), attention(sizes, [query, key, value, to]));
    sizes.count_products(2);
    // SAFETY: the kernels read and write inside the counts of the rows.
    unsafe {
        launch!(tile, forward, client, sizes, num_queries, vector, [q, k, v, out, logs, at], elem);
    }
    [output, log_sum]
}

/// Gradients that a backward writes, each by a kernel of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttentionGradients {
    /// Gradients of the queries.
    Queries,
    /// Gradients of keys and values.
    KeysAndValues,
    /// Both.
    All,
}

/// Writes gradients of queries, keys and values to the rows of `grads`, in f32; keys and values share a buffer. `results` are
/// output and log sums of the forward, and the gradient of the output in f32 and in its layout.
pub fn attention_backward(
    client: &Client,
    sizes: AttentionSizes,
    inputs: [HeadRows; 3],
    [output, log_sum, grad_output]: [&Buffer; 3],
    grads: [HeadRows; 3],
    gradients: AttentionGradients,
) {
    let AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, tiles: [_, tile] } = sizes;
    let halves = tile.map(|_| in_f16(client, inputs));
    let [query, key, value] = with(inputs, halves.as_ref());
    let delta = Buffer::empty(client, batch * num_heads * num_queries, Values::F32);
    let units = 64;
    // SAFETY: the kernel reads and writes inside the number of rows.
    unsafe {
        delta_kernel::launch_unchecked(
            client,
            CubeCount::Static((batch * num_queries * num_heads).div_ceil(units) as u32, 1, 1),
            CubeDim::new_1d(units as u32),
            output.arg(1),
            grad_output.arg(1),
            delta.arg(1),
            num_queries,
            num_heads,
            head_width,
        );
    }
    let half = tile.map(|_| cast(client, grad_output, Values::F16));
    let buffer = half.as_ref().unwrap_or(grad_output);
    let grad = HeadRows { buffer, column: 0, stride: sizes.dim() };
    let vector = sizes.vector(&[query, key, value, grad, grads[0], grads[1], grads[2]]);
    let elems = [query.buffer, grad.buffer].map(|x| x.values.elem());
    for (of_keys, other) in [(false, AttentionGradients::KeysAndValues), (true, AttentionGradients::Queries)] {
        if gradients == other {
            continue;
        }
        let [q, k, v, g] = [query, key, value, grad].map(|rows| rows.buffer.arg(vector));
        let [logs, deltas] = [log_sum, &delta].map(|x| x.arg(1));
        let at = attention(sizes, [query, key, value, grad]);
        // Two products give the scores and the gradients of the weights. Another gives the gradients of the queries, or two
        // give those of keys and values.
        sizes.count_products(if of_keys { 4 } else { 3 });
        // SAFETY: the kernels read and write inside the counts of the rows.
        unsafe {
            if of_keys {
                let (dkv, [dk_at, dv_at]) =
                    (grads[1].buffer.arg(vector), [grads[1], grads[2]].map(|x| rows(x, num_keys)));
                launch!(
                    tile,
                    backward_by_keys,
                    client,
                    sizes,
                    num_keys,
                    vector,
                    [q, k, v, g, logs, deltas, dkv, at, dk_at, dv_at],
                    elems
                );
            } else {
                let (dq, dq_at) = (grads[0].buffer.arg(vector), rows(grads[0], num_queries));
                launch!(
                    tile,
                    backward_by_queries,
                    client,
                    sizes,
                    num_queries,
                    vector,
                    [q, k, v, g, logs, deltas, dq, at, dq_at],
                    elems
                );
            }
        }
    }
}

/// Computes the sums `dO O` of the channels of every head, `[batch, heads, queries]`.
#[cube(launch_unchecked)]
fn delta_kernel(
    output: &[f32],
    grad_output: &[f32],
    delta: &mut [f32],
    num_queries: usize,
    num_heads: usize,
    #[comptime] width: usize,
) {
    let index = ABSOLUTE_POS;
    if index < delta.len() {
        // The heads of a row lie side by side.
        let row = index / num_heads;
        let head = index % num_heads;
        let mut sum = 0.0f32;
        for e in 0..width {
            sum = fma(output[index * width + e], grad_output[index * width + e], sum);
        }
        delta[(row / num_queries * num_heads + head) * num_queries + row % num_queries] = sum;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::attention::tiles::attention_tiles;
    use crate::testing::cases::{AttentionPart, attention};
    use crate::testing::{check, client, matrix_client};

    fn check_all(client: &Client, all: &[[usize; 4]], operands: Values, tolerance: f64) {
        for &[num_queries, num_keys, num_heads, head_width] in all {
            let tiles = attention_tiles(client, operands, head_width);
            let sizes = AttentionSizes { batch: 2, num_heads, num_queries, num_keys, head_width, tiles };
            for part in [AttentionPart::Forward, AttentionPart::Backward(AttentionGradients::All)] {
                check(client, &attention(sizes, part), tolerance);
            }
        }
    }

    #[test]
    fn attention_in_f32_equals_f64() {
        let sizes = [
            [1, 1, 2, 12],
            [70, 33, 1, 96],
            [65, 130, 2, 24],
            [7, 64, 1, 128],
            [5, 9, 2, 18],
            [4097, 300, 1, 12],
            [31, 4097, 1, 40],
        ];
        let Some(client) = client() else { return };
        check_all(&client, &sizes, Values::F32, 1e-5);
    }

    #[test]
    fn attention_of_f16_operands_equals_f64() {
        let Some((client, _)) = matrix_client() else { return };
        // The weights and the slopes of scores are rounded, too.
        check_all(&client, &[[1, 1, 2, 12], [35, 50, 2, 12], [33, 17, 1, 18]], Values::F16, 2e-3);
    }

    #[test]
    #[ignore = "software Vulkan compiles wide cooperative matrices for minutes"]
    fn attention_of_wide_f16_operands_equals_f64() {
        let Some((client, _)) = matrix_client() else { return };
        check_all(&client, &[[35, 50, 1, 96], [9, 33, 1, 128]], Values::F16, 2e-3);
    }
}
