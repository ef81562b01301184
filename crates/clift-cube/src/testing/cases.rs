//! Products and attention on random inputs, and the same in f64: the tests compare them, `examples/sweep` times them, too.
// B scenes, H heads, E width of a head

use std::cell::OnceCell;

use cubecl::prelude::Client;
use half::f16;

use crate::{
    AttentionGradients, AttentionSizes, Buffer, HeadRows, Matrices, Product, ProductTile, Values, attention_backward,
    attention_forward,
};

/// A computation of kernels, and the same in f64.
pub struct Case {
    /// Makes the values of the inputs.
    pub inputs: Box<dyn Fn() -> Vec<Vec<f32>>>,
    /// Types of their buffers; f32 for the others.
    pub formats: Vec<Values>,
    /// Launches the kernels.
    pub run: Box<Run>,
    /// Computes the results from the values in the buffers.
    pub expected: Box<Expected>,
}

type Run = dyn Fn(&Client, &[Buffer]) -> Vec<Buffer>;
type Expected = dyn Fn(&[Vec<f64>]) -> Vec<Vec<f64>>;

impl Case {
    /// Makes a computation on inputs in f32.
    pub fn new<const COUNT: usize>(
        inputs: impl Fn() -> [Vec<f32>; COUNT] + 'static,
        run: impl Fn(&Client, &[Buffer]) -> Vec<Buffer> + 'static,
        expected: impl Fn(&[Vec<f64>]) -> Vec<Vec<f64>> + 'static,
    ) -> Self {
        let inputs = Box::new(move || inputs().into());
        Self { inputs, formats: Vec::new(), run: Box::new(run), expected: Box::new(expected) }
    }

    /// Returns the values of the inputs and the types of their buffers.
    fn inputs(&self) -> impl Iterator<Item = (Vec<f32>, Values)> {
        (self.inputs)().into_iter().zip(self.formats.iter().copied().chain(std::iter::repeat(Values::F32)))
    }

    pub fn upload(&self, client: &Client) -> Vec<Buffer> {
        self.inputs().map(|(values, format)| upload(client, &values, format)).collect()
    }

    /// Returns the largest difference of each result over its largest value, infinite where a value is not finite. The error of
    /// a refused launch appears here.
    pub fn errors(&self, client: &Client, results: &[Buffer]) -> Result<Vec<f64>, String> {
        let stored = |(values, format): (Vec<f32>, Values)| {
            let value = |x| f64::from(if format == Values::F16 { rounded(x) } else { x });
            values.into_iter().map(value).collect()
        };
        let expected = (self.expected)(&self.inputs().map(stored).collect::<Vec<_>>());
        assert_eq!(results.len(), expected.len());
        let error = |(result, expected): (&Buffer, &Vec<f64>)| {
            let computed = read(client, result)?;
            assert_eq!(computed.len(), expected.len());
            let size = expected.iter().map(|x| x.abs()).fold(1e-3, f64::max);
            let difference = |(&x, y): (&f32, &f64)| (f64::from(x) - y).abs() / size;
            let differences = computed.iter().zip(expected).map(difference);
            Ok(differences.fold(0.0, |most, x| if x.is_nan() { f64::INFINITY } else { x.max(most) }))
        };
        results.iter().zip(&expected).map(error).collect()
    }
}

/// Returns values in [-scale, scale].
pub fn random(len: usize, seed: u64, scale: f32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x1234_5678_9abc_def1);
    let next = |_| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        scale * ((state >> 40) as f32 / (1 << 23) as f32 - 1.0)
    };
    (0..len).map(next).collect()
}

fn operand(len: usize, seed: u64, scale: f32, is_rounded: bool) -> Vec<f32> {
    random(len, seed, scale).into_iter().map(|x| if is_rounded { rounded(x) } else { x }).collect()
}

/// Rounds to f16.
fn rounded(x: f32) -> f32 {
    f16::from_f32(x).to_f32()
}

/// Copies values to a device.
pub fn upload(client: &Client, x: &[f32], values: Values) -> Buffer {
    let bytes: Vec<u8> = match values {
        Values::F32 => x.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Values::F16 => x.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect(),
    };
    Buffer { handle: client.create_from_slice(&bytes), len: x.len(), values }
}

/// Copies values from a device.
pub fn read(client: &Client, x: &Buffer) -> Result<Vec<f32>, String> {
    let bytes = client.read_one(x.handle.clone()).map_err(|error| error.to_string())?;
    let values: Vec<f32> = match x.values {
        Values::F32 => bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
        Values::F16 => bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
    };
    Ok(values[..x.len].to_vec())
}

/// A product of batches of `[M, K]` and `[K, N]`, transposed or not, of operands and an output of some types; with bias, GELU and
/// residual, or plain.
pub fn product(
    tile: ProductTile,
    sizes: [usize; 3],
    batch: usize,
    transposed: [bool; 2],
    types: [Values; 3],
    is_plain: bool,
) -> Case {
    let [m, n, k] = sizes;
    // Kernels of cooperative matrices round their operands.
    let is_rounded = matches!(tile, ProductTile::Matrix(_));
    let lens = if is_plain { [1, 1] } else { [n, batch * m * n] };
    let inputs = move || {
        let [a, b] = [(batch * m * k, 1), (batch * k * n, 2)].map(|(len, seed)| operand(len, seed, 1.0, is_rounded));
        [a, b, random(lens[0], 3, 1.0), random(lens[1], 4, 1.0)]
    };
    let run = move |client: &Client, inputs: &[Buffer]| {
        let view = |i: usize, rows, columns| {
            let stride = if transposed[i] { rows } else { columns };
            let batch_stride = rows * columns;
            Matrices { buffer: &inputs[i], start: 0, batch_stride, stride, transposed: transposed[i] }
        };
        let mut product = Product { batch, output: types[2], ..Product::new(view(0, m, k), view(1, k, n), sizes) };
        if !is_plain {
            (product.bias, product.gelu, product.residual) = (Some(&inputs[2]), true, Some(&inputs[3]));
        }
        vec![product.run_tile(client, tile)]
    };
    let mut case = Case::new(inputs, run, move |inputs| {
        let [a, b, bias, residual] = inputs else { panic!("four inputs") };
        let value = |index: usize| {
            let (z, i, j) = (index / (m * n), index / n % m, index % n);
            let term = |t: usize| {
                let x = a[z * m * k + if transposed[0] { t * m + i } else { i * k + t }];
                x * b[z * k * n + if transposed[1] { j * k + t } else { t * n + j }]
            };
            let sum: f64 = (0..k).map(term).sum();
            if is_plain { sum } else { gelu_and_slope(sum + bias[j])[0] + residual[index] }
        };
        vec![(0..batch * m * n).map(value).collect()]
    });
    case.formats = types[..2].into();
    case
}

/// Kernels of an attention.
#[derive(Clone, Copy)]
pub enum AttentionPart {
    Forward,
    /// After a forward, which is launched once.
    Backward(AttentionGradients),
}

/// Queries of a row, keys and values side by side in a row of another buffer.
fn heads<'a>(query: &'a Buffer, key_value: &'a Buffer, dim: usize) -> [HeadRows<'a>; 3] {
    let rows = |buffer, column, stride| HeadRows { buffer, column, stride };
    [rows(query, 0, dim), rows(key_value, 0, 2 * dim), rows(key_value, dim, 2 * dim)]
}

/// An attention; keys and values, and their gradients, share a buffer.
pub fn attention(sizes: AttentionSizes, part: AttentionPart) -> Case {
    let AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, tiles } = sizes;
    let (dim, is_rounded) = (num_heads * head_width, tiles[0].is_some());
    let inputs = move || {
        [(0, num_queries), (1, 2 * num_keys), (2, num_queries)]
            .map(|(seed, len)| operand(batch * len * dim, seed, 2.0, is_rounded))
    };
    let saved = OnceCell::new();
    let run = move |client: &Client, inputs: &[Buffer]| {
        let [query, key_value, grad_output] = inputs else { panic!("three inputs") };
        let inputs = heads(query, key_value, dim);
        let AttentionPart::Backward(gradients) = part else {
            return attention_forward(client, sizes, inputs).into();
        };
        let [output, log_sum] = saved.get_or_init(|| attention_forward(client, sizes, inputs));
        let grads = [query, key_value].map(|x| Buffer::empty(client, x.len, Values::F32));
        let to = heads(&grads[0], &grads[1], dim);
        attention_backward(client, sizes, inputs, [output, log_sum, grad_output], to, gradients);
        chosen(grads, gradients)
    };
    Case::new(inputs, run, move |inputs| {
        let keys_of = |row: usize| (row / num_queries * num_keys..(row / num_queries + 1) * num_keys).collect();
        let [grad_query, grad_key_value, output, of_rows] = attention_f64(inputs, [num_heads, head_width], keys_of);
        // Of rows and heads, to scenes, heads and queries.
        let log_sum = |i: usize| {
            let (scene, head, query) = (i / (num_heads * num_queries), i / num_queries % num_heads, i % num_queries);
            of_rows[(scene * num_queries + query) * num_heads + head]
        };
        let log_sums = (0..of_rows.len()).map(log_sum).collect();
        match part {
            AttentionPart::Forward => vec![output, log_sums],
            AttentionPart::Backward(gradients) => chosen([grad_query, grad_key_value], gradients),
        }
    })
}

fn chosen<T>([query, key_value]: [T; 2], gradients: AttentionGradients) -> Vec<T> {
    match gradients {
        AttentionGradients::Queries => vec![query],
        AttentionGradients::KeysAndValues => vec![key_value],
        AttentionGradients::All => vec![query, key_value],
    }
}

/// Gradients of queries and of keys with values, output, and log sums `[rows, H]` of an attention of every query row to some
/// rows of keys and values, `[rows, 2, H, E]`.
pub fn attention_f64(
    inputs: &[Vec<f64>],
    [num_heads, width]: [usize; 2],
    keys_of: impl Fn(usize) -> Vec<usize>,
) -> [Vec<f64>; 4] {
    let [query, key_value, grad] = [0, 1, 2].map(|i| &inputs[i]);
    let (dim, scale) = (num_heads * width, 1.0 / (width as f64).sqrt());
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let add = |to: &mut [f64], factor: f64, x: &[f64]| to.iter_mut().zip(x).for_each(|(to, x)| *to += factor * x);
    let [mut output, mut grad_query] = [vec![0.0; query.len()], vec![0.0; query.len()]];
    let (mut grad_key_value, mut log_sums) = (vec![0.0; key_value.len()], Vec::new());
    for row in 0..query.len() / dim {
        let rows = keys_of(row);
        for head in 0..num_heads {
            let own = row * dim + head * width..row * dim + (head + 1) * width;
            let of = |row: usize, part: usize| {
                let first = (2 * row + part) * dim + head * width;
                first..first + width
            };
            let (q, g) = (&query[own.clone()], &grad[own.clone()]);
            let scores: Vec<f64> = rows.iter().map(|&key| scale * dot(q, &key_value[of(key, 0)])).collect();
            let largest = scores.iter().copied().fold(f64::MIN, f64::max);
            let log_sum = largest + scores.iter().map(|score| (score - largest).exp()).sum::<f64>().ln();
            log_sums.push(log_sum);
            let weights: Vec<f64> = scores.iter().map(|score| (score - log_sum).exp()).collect();
            for (&key, &weight) in rows.iter().zip(&weights) {
                add(&mut output[own.clone()], weight, &key_value[of(key, 1)]);
            }
            let delta = dot(g, &output[own.clone()]);
            for (&key, &weight) in rows.iter().zip(&weights) {
                let slope = scale * weight * (dot(g, &key_value[of(key, 1)]) - delta);
                add(&mut grad_query[own.clone()], slope, &key_value[of(key, 0)]);
                add(&mut grad_key_value[of(key, 0)], slope, q);
                add(&mut grad_key_value[of(key, 1)], weight, g);
            }
        }
    }
    [grad_query, grad_key_value, output, log_sums]
}

/// GELU and its derivative.
pub fn gelu_and_slope(x: f64) -> [f64; 2] {
    let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
    // The distribution function, by Simpson's rule.
    let (steps, step) = (500, x / 500.0);
    let term = |i: i32| {
        let x = f64::from(i) * step;
        density(x) + 4.0 * density(x + 0.5 * step) + density(x + step)
    };
    let normal = 0.5 + step / 6.0 * (0..steps).map(term).sum::<f64>();
    [x * normal, normal + x * density(x)]
}
