//! Attention, forward and backward.

use std::cell::OnceCell;

use clift_cube::{
    AttentionGradients, AttentionInputs, AttentionResults, AttentionSizes, AttentionTile, Buffer, HeadRows, Values,
    attention_backward_tile, attention_forward_tile,
};
use cubecl::prelude::Client;

use crate::Sizes;
use crate::inputs::{Input, read, samples};
use crate::measure::{Pairs, Sweep, Work};

#[derive(Clone, Copy, PartialEq)]
pub enum Direction {
    Forward,
    ByQueries,
    ByKeys,
}

impl Direction {
    pub const ALL: [Self; 3] = [Self::Forward, Self::ByQueries, Self::ByKeys];
}

pub struct Attention {
    sizes: AttentionSizes,
    query: Input,
    /// Keys and values.
    key_value: Input,
    grad_output: Input,
    /// Output and log sums, by register tiles.
    results: OnceCell<[Buffer; 2]>,
}

impl Attention {
    pub fn new(sizes: Sizes, [num_queries, num_keys]: [usize; 2]) -> Self {
        let Sizes { batch, num_heads, head_width, .. } = sizes;
        // Values of f16: the kernels round their operands.
        let input = |seed, len| Input::new(seed, batch * len * sizes.dim()).scaled(2.0).rounded(Values::F32);
        Self {
            sizes: AttentionSizes { batch, num_heads, num_queries, num_keys, head_width, operands: Values::F32 },
            query: input(3, num_queries),
            key_value: input(4, 2 * num_keys),
            grad_output: input(5, num_queries),
            results: OnceCell::new(),
        }
    }

    fn dim(&self) -> usize {
        self.sizes.num_heads * self.sizes.head_width
    }

    fn inputs<'b>(&self, query: &'b Buffer, key_value: &'b Buffer) -> AttentionInputs<'b> {
        let dim = self.dim();
        let rows = |buffer, column, stride| HeadRows { buffer, column, stride };
        AttentionInputs {
            query: rows(query, 0, dim),
            key: rows(key_value, 0, 2 * dim),
            value: rows(key_value, dim, 2 * dim),
        }
    }

    fn forward(&self, client: &Client, tile: Option<AttentionTile>) -> [Buffer; 2] {
        let inputs = self.inputs(self.query.buffer(client), self.key_value.buffer(client));
        attention_forward_tile(client, self.sizes, &inputs, tile)
    }

    pub fn run(&self, sweep: &mut Sweep, tiles: &[Option<AttentionTile>], direction: Direction) {
        let AttentionSizes { batch, num_queries, num_keys, .. } = self.sizes;
        let client = sweep.client;
        let grads = OnceCell::new();
        let results = || self.results.get_or_init(|| self.forward(client, None));
        let backward = |tile, gradients| {
            let grads: &[Buffer; 2] = grads.get_or_init(|| {
                [&self.query, &self.key_value].map(|x| Buffer::empty(client, x.buffer(client).len, Values::F32))
            });
            let inputs = self.inputs(self.query.buffer(client), self.key_value.buffer(client));
            let [output, log_sum] = results();
            let results = AttentionResults { output, log_sum, grad_output: self.grad_output.buffer(client) };
            let to = self.inputs(&grads[0], &grads[1]);
            attention_backward_tile(client, self.sizes, &inputs, results, &to, tile, gradients);
            vec![grads[usize::from(gradients == AttentionGradients::KeysAndValues)].clone()]
        };
        // Products of scores that a direction computes.
        let (kernel, products) = match direction {
            Direction::Forward => ("attention forward", 2),
            Direction::ByQueries => ("attention backward by queries", 3),
            Direction::ByKeys => ("attention backward by keys", 4),
        };
        let work = Work::Flops(2.0 * (products * batch * num_queries * num_keys * self.dim()) as f64);
        let shared_bytes = client.properties().hardware.max_shared_memory_size;
        let fits = |tile: &AttentionTile| tile.shared_bytes() <= shared_bytes;
        for &tile in tiles.iter().filter(|tile| tile.as_ref().is_none_or(fits)) {
            let launch = || match direction {
                Direction::Forward => self.forward(client, tile).into(),
                Direction::ByQueries => backward(tile, AttentionGradients::Queries),
                Direction::ByKeys => backward(tile, AttentionGradients::KeysAndValues),
            };
            let name =
                tile.map_or("registers".into(), |tile| format!("planes {}, columns {}", tile.planes, tile.columns));
            sweep.run(kernel, &format!("{num_queries} queries, {num_keys} keys"), &name, work, launch, |computed| {
                match direction {
                    Direction::Forward => self.check_forward(client, computed),
                    Direction::ByQueries => self.check_queries(client, &computed[0]),
                    Direction::ByKeys => self.check_keys(client, &computed[0], &results()[0]),
                }
            });
        }
    }

    /// Returns the first, a middle and the last query or key: scene, head and number.
    fn samples(&self, count: usize) -> Vec<[usize; 3]> {
        let AttentionSizes { batch, num_heads, .. } = self.sizes;
        samples(batch * num_heads * count, 3)
            .iter()
            .map(|i| [i / (num_heads * count), i / count % num_heads, i % count])
            .collect()
    }

    fn query(&self, [scene, head, i]: [usize; 3], input: &Input) -> Vec<f64> {
        let AttentionSizes { num_queries, head_width, .. } = self.sizes;
        input.line((scene * num_queries + i) * self.dim() + head * head_width, head_width)
    }

    /// Returns a key (`part` 0) or a value (1).
    fn key(&self, [scene, head, j]: [usize; 3], part: usize) -> Vec<f64> {
        let AttentionSizes { num_keys, head_width, .. } = self.sizes;
        self.key_value.line(((scene * num_keys + j) * 2 + part) * self.dim() + head * head_width, head_width)
    }

    /// Returns the scores of a query.
    fn scores(&self, at: [usize; 3]) -> Vec<f64> {
        let ([scene, head, _], query) = (at, self.query(at, &self.query));
        (0..self.sizes.num_keys).map(|j| self.score(&query, &self.key([scene, head, j], 0))).collect()
    }

    fn score(&self, query: &[f64], key: &[f64]) -> f64 {
        dot(query, key) / (self.sizes.head_width as f64).sqrt()
    }

    /// Returns the output and the weights of a query.
    fn output(&self, at: [usize; 3]) -> (Vec<f64>, Vec<f64>, f64) {
        let [scene, head, _] = at;
        let scores = self.scores(at);
        let log_sum = log_sum(&scores);
        let weights: Vec<f64> = scores.iter().map(|score| (score - log_sum).exp()).collect();
        let mut output = vec![0.0; self.sizes.head_width];
        for (j, weight) in weights.iter().enumerate() {
            add(&mut output, *weight, &self.key([scene, head, j], 1));
        }
        (output, weights, log_sum)
    }

    fn read_query(&self, client: &Client, buffer: &Buffer, [scene, head, i]: [usize; 3]) -> Result<Vec<f64>, String> {
        let AttentionSizes { num_queries, head_width, .. } = self.sizes;
        read(client, buffer, (scene * num_queries + i) * self.dim() + head * head_width, head_width)
    }

    fn check_forward(&self, client: &Client, computed: &[Buffer]) -> Result<Vec<Pairs>, String> {
        let AttentionSizes { num_heads, num_queries, .. } = self.sizes;
        let [mut outputs, mut log_sums] = [Pairs::new(), Pairs::new()];
        for at in self.samples(num_queries) {
            let (expected, _, log_sum) = self.output(at);
            outputs.extend(self.read_query(client, &computed[0], at)?.into_iter().zip(expected));
            let [scene, head, i] = at;
            log_sums.push((read(client, &computed[1], (scene * num_heads + head) * num_queries + i, 1)?[0], log_sum));
        }
        Ok(vec![outputs, log_sums])
    }

    fn check_queries(&self, client: &Client, computed: &Buffer) -> Result<Vec<Pairs>, String> {
        let mut pairs = Pairs::new();
        for at in self.samples(self.sizes.num_queries) {
            let [scene, head, _] = at;
            let (output, weights, _) = self.output(at);
            let grad = self.query(at, &self.grad_output);
            let delta = dot(&grad, &output);
            let mut expected = vec![0.0; output.len()];
            for (j, weight) in weights.iter().enumerate() {
                let slope = weight * (dot(&grad, &self.key([scene, head, j], 1)) - delta);
                add(&mut expected, slope / (output.len() as f64).sqrt(), &self.key([scene, head, j], 0));
            }
            pairs.extend(self.read_query(client, computed, at)?.into_iter().zip(expected));
        }
        Ok(vec![pairs])
    }

    /// Uses the output of the forward on the device, which [`Attention::check_forward`] checks.
    fn check_keys(&self, client: &Client, computed: &Buffer, output: &Buffer) -> Result<Vec<Pairs>, String> {
        let AttentionSizes { num_heads, num_queries, num_keys, head_width, .. } = self.sizes;
        let ([mut keys, mut values], dim) = ([Pairs::new(), Pairs::new()], self.dim());
        for at in self.samples(num_keys) {
            let [scene, head, j] = at;
            let outputs = read(client, output, scene * num_queries * dim, num_queries * dim)?;
            let first = (scene * num_heads + head) * num_queries;
            let log_sums = read(client, &self.results.get().expect("a forward")[1], first, num_queries)?;
            let (key, value) = (self.key(at, 0), self.key(at, 1));
            let mut expected = [vec![0.0; head_width], vec![0.0; head_width]];
            for i in 0..num_queries {
                let [query, grad] = [&self.query, &self.grad_output].map(|x| self.query([scene, head, i], x));
                let weight = (self.score(&query, &key) - log_sums[i]).exp();
                let delta = dot(&grad, &outputs[i * dim + head * head_width..][..head_width]);
                let slope = weight * (dot(&grad, &value) - delta);
                add(&mut expected[0], slope / (head_width as f64).sqrt(), &query);
                add(&mut expected[1], weight, &grad);
            }
            for (part, (pairs, expected)) in [&mut keys, &mut values].into_iter().zip(expected).enumerate() {
                let start = ((scene * num_keys + j) * 2 + part) * dim + head * head_width;
                pairs.extend(read(client, computed, start, head_width)?.into_iter().zip(expected));
            }
        }
        Ok(vec![keys, values])
    }
}

pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Adds `factor x` to `to`.
pub fn add(to: &mut [f64], factor: f64, x: &[f64]) {
    to.iter_mut().zip(x).for_each(|(to, x)| *to += factor * x);
}

pub fn log_sum(scores: &[f64]) -> f64 {
    let largest = scores.iter().copied().fold(f64::MIN, f64::max);
    largest + scores.iter().map(|score| (score - largest).exp()).sum::<f64>().ln()
}
