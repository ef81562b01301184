//! Attention of heads, forward and backward, without score matrices in global memory.

use cubecl::prelude::*;

use crate::attention::head_rows::RowsLaunch;
use crate::attention::matrix_attention as matrix;
use crate::attention::matrix_scores::AttentionTile;
use crate::attention::register_attention as register;
use crate::attention::register_scores::{ROWS, UNITS};
use crate::attention::tiles::attention_tiles;
use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::cast;

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
    /// Type to which operands of products are rounded, on adapters with cooperative matrices.
    pub operands: Values,
}

/// Rows of a buffer, one a token, with its heads from column `column` of `stride` columns; scene after scene.
#[derive(Clone, Debug)]
pub struct HeadRows<'a> {
    /// The values.
    pub buffer: &'a Buffer,
    /// Column of the first head.
    pub column: usize,
    /// Columns of a row.
    pub stride: usize,
}

/// Queries, keys and values.
#[derive(Clone, Debug)]
pub struct AttentionInputs<'a> {
    /// Queries.
    pub query: HeadRows<'a>,
    /// Keys.
    pub key: HeadRows<'a>,
    /// Values.
    pub value: HeadRows<'a>,
}

impl<'a> AttentionInputs<'a> {
    fn buffers(&self) -> [&'a Buffer; 3] {
        [self.query.buffer, self.key.buffer, self.value.buffer]
    }

    /// Returns the inputs, with `buffers` in place of their own if given.
    fn with<'b>(&self, buffers: Option<&'b [Buffer; 3]>) -> AttentionInputs<'b>
    where
        'a: 'b,
    {
        let [query, key, value] = buffers.map_or(self.buffers(), <[Buffer; 3]>::each_ref);
        AttentionInputs {
            query: HeadRows { buffer: query, ..self.query },
            key: HeadRows { buffer: key, ..self.key },
            value: HeadRows { buffer: value, ..self.value },
        }
    }
}

impl AttentionSizes {
    fn dim(self) -> usize {
        self.num_heads * self.head_width
    }

    fn scale(self) -> f32 {
        (1.0 / (self.head_width as f64).sqrt()) as f32
    }

    fn cubes(self, count: usize, rows: usize) -> CubeCount {
        CubeCount::Static(count.div_ceil(rows) as u32, (self.batch * self.num_heads) as u32, 1)
    }

    /// Returns the width of vectors, 4 if it divides heads and rows, and 1 otherwise.
    fn vector(self, rows: &[&HeadRows]) -> usize {
        let aligned = |x: usize| x.is_multiple_of(4);
        let all = rows.iter().all(|rows| aligned(rows.column) && aligned(rows.stride) && aligned(rows.buffer.len));
        if all && aligned(self.head_width) { 4 } else { 1 }
    }
}

fn rows(rows: &HeadRows, count: usize) -> RowsLaunch {
    RowsLaunch::new(rows.column, rows.stride, count)
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

/// Copies buffers to f16, each once.
fn in_f16(client: &Client, buffers: [&Buffer; 3]) -> [Buffer; 3] {
    let first = cast(client, buffers[0], Values::F16);
    let second =
        if std::ptr::eq(buffers[1], buffers[0]) { first.clone() } else { cast(client, buffers[1], Values::F16) };
    let third =
        if std::ptr::eq(buffers[2], buffers[1]) { second.clone() } else { cast(client, buffers[2], Values::F16) };
    [first, second, third]
}

/// Computes `softmax(q k^T / sqrt(E)) v` of every head, `[batch, queries, heads E]` in f32, and the log sums of the scores,
/// `[batch, heads, queries]`.
pub fn attention_forward(client: &Client, sizes: AttentionSizes, inputs: &AttentionInputs) -> [Buffer; 2] {
    let [forward, _] = attention_tiles(client, sizes.operands, sizes.head_width);
    attention_forward_tile(client, sizes, inputs, forward)
}

/// Computes [`attention_forward`] with a tile of cooperative matrices, or with register tiles.
pub fn attention_forward_tile(
    client: &Client,
    sizes: AttentionSizes,
    inputs: &AttentionInputs,
    tile: Option<AttentionTile>,
) -> [Buffer; 2] {
    let AttentionSizes { batch, num_heads, num_queries, num_keys, .. } = sizes;
    let output = Buffer::empty(client, batch * num_queries * sizes.dim(), Values::F32);
    let log_sum = Buffer::empty(client, batch * num_heads * num_queries, Values::F32);
    // Every block of rows reads all keys and values: half the bytes for one more pass.
    let halves = tile.map(|_| in_f16(client, inputs.buffers()));
    let AttentionInputs { query, key, value } = &inputs.with(halves.as_ref());
    let to = HeadRows { buffer: &output, column: 0, stride: sizes.dim() };
    let vector = sizes.vector(&[query, key, value, &to]);
    let (scale, elem) = (sizes.scale(), query.buffer.values.elem());
    // SAFETY: the kernels read and write inside the counts of the rows.
    unsafe {
        launch!(
            tile,
            forward,
            client,
            sizes,
            num_queries,
            vector,
            [
                query.buffer.arg(vector),
                key.buffer.arg(vector),
                value.buffer.arg(vector),
                output.arg(vector),
                log_sum.arg(1),
                rows(query, num_queries),
                rows(key, num_keys),
                rows(value, num_keys),
                rows(&to, num_queries),
                num_heads,
                scale
            ],
            elem
        );
    }
    [output, log_sum]
}

/// Results of the forward, and the gradient of the output.
#[derive(Clone, Copy, Debug)]
pub struct AttentionResults<'a> {
    /// Output of the forward.
    pub output: &'a Buffer,
    /// Log sums of the forward.
    pub log_sum: &'a Buffer,
    /// Gradient of the output, in f32 and in its layout.
    pub grad_output: &'a Buffer,
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

/// Writes the gradients of queries, keys and values to the rows of `grads`, in f32; keys and values share a buffer.
pub fn attention_backward(
    client: &Client,
    sizes: AttentionSizes,
    inputs: &AttentionInputs,
    results: AttentionResults,
    grads: &AttentionInputs,
) {
    let [_, backward] = attention_tiles(client, sizes.operands, sizes.head_width);
    attention_backward_tile(client, sizes, inputs, results, grads, backward, AttentionGradients::All);
}

/// Computes some gradients of [`attention_backward`] with a tile of cooperative matrices, or with register tiles.
pub fn attention_backward_tile(
    client: &Client,
    sizes: AttentionSizes,
    inputs: &AttentionInputs,
    results: AttentionResults,
    grads: &AttentionInputs,
    tile: Option<AttentionTile>,
    gradients: AttentionGradients,
) {
    let AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, .. } = sizes;
    let halves = tile.map(|_| in_f16(client, inputs.buffers()));
    let AttentionInputs { query, key, value } = &inputs.with(halves.as_ref());
    let delta = Buffer::empty(client, batch * num_heads * num_queries, Values::F32);
    let units = 64;
    // SAFETY: the kernel reads and writes inside the number of rows.
    unsafe {
        delta_kernel::launch_unchecked(
            client,
            CubeCount::Static((batch * num_queries * num_heads).div_ceil(units) as u32, 1, 1),
            CubeDim::new_1d(units as u32),
            results.output.arg(1),
            results.grad_output.arg(1),
            delta.arg(1),
            num_queries,
            num_heads,
            head_width,
        );
    }
    let half = tile.map(|_| cast(client, results.grad_output, Values::F16));
    let buffer = half.as_ref().unwrap_or(results.grad_output);
    let grad_output = HeadRows { buffer, column: 0, stride: sizes.dim() };
    let vector = sizes.vector(&[query, key, value, &grad_output, &grads.query, &grads.key, &grads.value]);
    let (scale, elems) = (sizes.scale(), [query.buffer, grad_output.buffer].map(|x| x.values.elem()));
    // SAFETY: the kernels read and write inside the counts of the rows.
    unsafe {
        if gradients != AttentionGradients::KeysAndValues {
            launch!(
                tile,
                backward_by_queries,
                client,
                sizes,
                num_queries,
                vector,
                [
                    query.buffer.arg(vector),
                    key.buffer.arg(vector),
                    value.buffer.arg(vector),
                    grad_output.buffer.arg(vector),
                    results.log_sum.arg(1),
                    delta.arg(1),
                    grads.query.buffer.arg(vector),
                    rows(query, num_queries),
                    rows(key, num_keys),
                    rows(value, num_keys),
                    rows(&grad_output, num_queries),
                    rows(&grads.query, num_queries),
                    num_heads,
                    scale
                ],
                elems
            );
        }
        if gradients != AttentionGradients::Queries {
            launch!(
                tile,
                backward_by_keys,
                client,
                sizes,
                num_keys,
                vector,
                [
                    query.buffer.arg(vector),
                    key.buffer.arg(vector),
                    value.buffer.arg(vector),
                    grad_output.buffer.arg(vector),
                    results.log_sum.arg(1),
                    delta.arg(1),
                    grads.key.buffer.arg(vector),
                    rows(query, num_queries),
                    rows(key, num_keys),
                    rows(value, num_keys),
                    rows(&grad_output, num_queries),
                    rows(&grads.key, num_keys),
                    rows(&grads.value, num_keys),
                    num_heads,
                    scale
                ],
                elems
            );
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
    use crate::testing::{client, matrix_client, random, read, rounded, upload};

    /// Output, log sums, and gradients of queries, keys and values, of one head in f64.
    fn reference(q: &[f64], k: &[f64], v: &[f64], grad: &[f64], width: usize) -> [Vec<f64>; 5] {
        let (nq, nk) = (q.len() / width, k.len() / width);
        let scale = 1.0 / (width as f64).sqrt();
        let dot = |a: &[f64], i: usize, b: &[f64], j: usize| -> f64 {
            a[i * width..][..width].iter().zip(&b[j * width..][..width]).map(|(a, b)| a * b).sum()
        };
        let add = |to: &mut [f64], i: usize, factor: f64, from: &[f64], j: usize| {
            let pairs = to[i * width..][..width].iter_mut().zip(&from[j * width..][..width]);
            pairs.for_each(|(to, from)| *to += factor * from);
        };
        let [mut out, mut dq] = [vec![0.0; q.len()], vec![0.0; q.len()]];
        let [mut dk, mut dv] = [vec![0.0; k.len()], vec![0.0; k.len()]];
        let mut logs = vec![0.0; nq];
        for i in 0..nq {
            let scores: Vec<f64> = (0..nk).map(|j| scale * dot(q, i, k, j)).collect();
            let largest = scores.iter().copied().fold(f64::MIN, f64::max);
            logs[i] = largest + scores.iter().map(|s| (s - largest).exp()).sum::<f64>().ln();
            let weights: Vec<f64> = scores.iter().map(|s| (s - logs[i]).exp()).collect();
            (0..nk).for_each(|j| add(&mut out, i, weights[j], v, j));
            let delta = dot(grad, i, &out, i);
            for j in 0..nk {
                let slope = scale * weights[j] * (dot(grad, i, v, j) - delta);
                add(&mut dv, j, weights[j], grad, i);
                add(&mut dq, i, slope, k, j);
                add(&mut dk, j, slope, q, i);
            }
        }
        [out, logs, dq, dk, dv]
    }

    /// Checks output and gradients against f64, relative to the largest value of each.
    fn check(client: &Client, sizes: AttentionSizes, tolerance: f64) {
        let AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, operands } = sizes;
        let dim = sizes.dim();
        let lens = [num_queries * dim, num_keys * 2 * dim, num_queries * dim].map(|len| batch * len);
        let [query, key_value, grad] = [0, 1, 2].map(|i| {
            let scaled = random(lens[i], i as u64).into_iter().map(|x| 2.0 * x);
            if operands == Values::F16 { scaled.map(rounded).collect::<Vec<f32>>() } else { scaled.collect() }
        });
        let [q, kv, g] = [&query, &key_value, &grad].map(|x| upload(client, x, Values::F32));
        let inputs = AttentionInputs {
            query: HeadRows { buffer: &q, column: 0, stride: dim },
            key: HeadRows { buffer: &kv, column: 0, stride: 2 * dim },
            value: HeadRows { buffer: &kv, column: dim, stride: 2 * dim },
        };
        let [output, log_sum] = attention_forward(client, sizes, &inputs);
        let [grad_q, grad_kv] = [&q, &kv].map(|x| Buffer::empty(client, x.len, Values::F32));
        let grads = AttentionInputs {
            query: HeadRows { buffer: &grad_q, ..inputs.query },
            key: HeadRows { buffer: &grad_kv, ..inputs.key },
            value: HeadRows { buffer: &grad_kv, ..inputs.value },
        };
        let results = AttentionResults { output: &output, log_sum: &log_sum, grad_output: &g };
        attention_backward(client, sizes, &inputs, results, &grads);
        let again = Buffer::empty(client, kv.len, Values::F32);
        let grads = AttentionInputs {
            query: grads.query,
            key: HeadRows { buffer: &again, ..inputs.key },
            value: HeadRows { buffer: &again, ..inputs.value },
        };
        attention_backward(client, sizes, &inputs, results, &grads);
        let again = read(client, &again);
        let [output, log_sum, grad_q, grad_kv] = [output, log_sum, grad_q, grad_kv].map(|x| read(client, &x));
        assert!(again == grad_kv, "{sizes:?}: other gradients at a second run");
        for scene in 0..batch {
            for h in 0..num_heads {
                let head = |x: &[f32], count: usize, stride: usize, column: usize| -> Vec<f64> {
                    let rows = (0..count).map(|i| (scene * count + i) * stride + column + h * head_width);
                    rows.flat_map(|row| x[row..row + head_width].iter().map(|&x| f64::from(x))).collect()
                };
                let expected = reference(
                    &head(&query, num_queries, dim, 0),
                    &head(&key_value, num_keys, 2 * dim, 0),
                    &head(&key_value, num_keys, 2 * dim, dim),
                    &head(&grad, num_queries, dim, 0),
                    head_width,
                );
                let first = (scene * num_heads + h) * num_queries;
                let computed = [
                    head(&output, num_queries, dim, 0),
                    log_sum[first..first + num_queries].iter().map(|&x| f64::from(x)).collect(),
                    head(&grad_q, num_queries, dim, 0),
                    head(&grad_kv, num_keys, 2 * dim, 0),
                    head(&grad_kv, num_keys, 2 * dim, dim),
                ];
                for (i, (computed, expected)) in computed.iter().zip(&expected).enumerate() {
                    let size = expected.iter().map(|x| x.abs()).fold(1e-3, f64::max);
                    let error = |(a, b): (&f64, &f64)| if a.is_finite() { (a - b).abs() } else { f64::INFINITY };
                    let worst = computed.iter().zip(expected).map(error).fold(0.0, f64::max);
                    assert!(worst < tolerance * size, "{sizes:?}, result {i}: {worst} of {size}");
                }
            }
        }
    }

    fn check_all(client: &Client, all: &[[usize; 4]], operands: Values, tolerance: f64) {
        for &[num_queries, num_keys, num_heads, head_width] in all {
            check(
                client,
                AttentionSizes { batch: 2, num_heads, num_queries, num_keys, head_width, operands },
                tolerance,
            );
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

    #[test]
    fn rows_whose_maximum_grows_are_scaled_again() {
        let Some(client) = client() else { return };
        let (count, width) = (40, 16);
        for operands in [Values::F32, Values::F16] {
            // Scores of 8 j: each key outweighs all before it.
            let query = upload(&client, &vec![1.0; width], Values::F32);
            let keys: Vec<f32> = (0..count * width).map(|i| 2.0 * (i / width) as f32).collect();
            let values: Vec<f32> = (0..count * width).map(|i| (i / width) as f32).collect();
            let [key, value] = [&keys, &values].map(|x| upload(&client, x, Values::F32));
            let [query, key, value] =
                [&query, &key, &value].map(|buffer| HeadRows { buffer, column: 0, stride: width });
            let sizes =
                AttentionSizes { batch: 1, num_heads: 1, num_queries: 1, num_keys: count, head_width: width, operands };
            let [output, log_sum] = attention_forward(&client, sizes, &AttentionInputs { query, key, value });
            let last = (count - 1) as f32;
            assert!(read(&client, &output).iter().all(|x| (x - last).abs() < 1e-3));
            assert!((read(&client, &log_sum)[0] - 8.0 * last).abs() < 1e-3);
        }
    }
}
