//! Norms, GELU, conversions and sums of rows.

use clift_cube::{
    Buffer, NormHeads, Values, cast, gelu_backward, gelu_forward, layer_norm_backward, layer_norm_forward,
    rms_norm_backward, rms_norm_forward, sum_rows,
};
use cubecl::prelude::Client;

use crate::Sizes;
use crate::attention::dot;
use crate::inputs::{Input, read, samples};
use crate::measure::{Pairs, Sweep, Work};

const EPSILON: f32 = 1e-5;
/// Parts of a row of heads: queries, keys, values. The first two have a norm.
const PARTS: usize = 3;
const NORM_PARTS: usize = 2;

pub fn run(sweep: &mut Sweep, sizes: Sizes) {
    let rows = sizes.batch * sizes.tokens;
    layer_norm(sweep, rows, sizes.dim());
    rms_norm(sweep, rows, sizes);
    gelu(sweep, rows * sizes.feed_forward);
    convert_and_sum(sweep, rows, PARTS * sizes.dim());
}

fn layer_norm(sweep: &mut Sweep, rows: usize, columns: usize) {
    let client = sweep.client;
    let [x, grad] = [1, 2].map(|seed| Input::new(seed, rows * columns));
    let [gamma, beta] = [3, 4].map(|seed| Input::new(seed, columns));
    let inputs = || [&x, &gamma, &beta].map(|input| input.buffer(client));
    let case = format!("{rows}x{columns}");
    let values = (rows * columns) as f64;
    // Mean and inverse deviation.
    let statistics = |row: usize| {
        let x = x.line(row * columns, columns);
        let mean = x.iter().sum::<f64>() / columns as f64;
        let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / columns as f64;
        [mean, 1.0 / (variance + f64::from(EPSILON)).sqrt()]
    };
    let normal = |row: usize, [mean, inverse]: [f64; 2], i: usize| (x.at(row * columns + i) - mean) * inverse;
    let forward = || layer_norm_forward(client, inputs(), EPSILON, Values::F32);
    sweep.run(
        "layer norm forward",
        &case,
        "",
        Work::Values(2.0 * values),
        || forward().into(),
        |computed| {
            let mut pairs = Pairs::new();
            for row in samples(rows, 4) {
                let statistics = statistics(row);
                let expected = (0..columns).map(|i| normal(row, statistics, i) * gamma.at(i) + beta.at(i));
                pairs.extend(read(client, &computed[0], row * columns, columns)?.into_iter().zip(expected));
            }
            Ok(vec![pairs])
        },
    );
    let backward = || {
        let [x, gamma, _] = inputs();
        layer_norm_backward(client, [x, gamma, &forward()[1]], grad.buffer(client)).into()
    };
    // The forward is part of the time.
    sweep.run("layer norm forward and backward", &case, "", Work::Values(5.0 * values), backward, |computed| {
        let mut pairs = [Pairs::new(), Pairs::new(), Pairs::new()];
        for row in samples(rows, 4) {
            let statistics = statistics(row);
            let y: Vec<f64> = (0..columns).map(|i| normal(row, statistics, i)).collect();
            let slope: Vec<f64> = (0..columns).map(|i| grad.at(row * columns + i) * gamma.at(i)).collect();
            let [center, along] = [slope.iter().sum(), dot(&slope, &y)].map(|sum: f64| sum / columns as f64);
            let expected = (0..columns).map(|i| (slope[i] - center - y[i] * along) * statistics[1]);
            pairs[0].extend(read(client, &computed[0], row * columns, columns)?.into_iter().zip(expected));
        }
        let statistics: Vec<[f64; 2]> = (0..rows).map(statistics).collect();
        for i in samples(columns, 4) {
            let at = |row: usize| grad.at(row * columns + i);
            let gamma = (0..rows).map(|row| at(row) * normal(row, statistics[row], i)).sum();
            pairs[1].push((read(client, &computed[1], i, 1)?[0], gamma));
            pairs[2].push((read(client, &computed[2], i, 1)?[0], (0..rows).map(at).sum()));
        }
        Ok(pairs.into())
    });
}

fn rms_norm(sweep: &mut Sweep, rows: usize, Sizes { num_heads, head_width: width, .. }: Sizes) {
    let client = sweep.client;
    let heads = NormHeads { num_parts: PARTS, num_heads, head_width: width, epsilon: EPSILON };
    let stride = PARTS * num_heads * width;
    let [x, grad] = [1, 2].map(|seed| Input::new(seed, rows * stride));
    let gammas = Input::new(3, NORM_PARTS * width);
    let inputs = || [x.buffer(client), gammas.buffer(client)];
    let case = format!("{rows}x{PARTS}x{num_heads}x{width}");
    let values = (rows * stride) as f64;
    let inverse = |head: usize| {
        let x = x.line(head * width, width);
        1.0 / (dot(&x, &x) / width as f64 + f64::from(EPSILON)).sqrt()
    };
    let part = |head: usize| head / num_heads % PARTS;
    let gamma = |head: usize, i: usize| gammas.at(part(head) * width + i);
    let has_norm = |head: usize| part(head) < NORM_PARTS;
    let chosen = || samples(rows * PARTS * num_heads, 9);
    let forward = || vec![rms_norm_forward(client, inputs(), heads)];
    sweep.run("RMS norm forward", &case, "", Work::Values(2.0 * values), forward, |computed| {
        let mut pairs = Pairs::new();
        for head in chosen() {
            let (x, inverse) = (x.line(head * width, width), inverse(head));
            let expected = (0..width).map(|i| if has_norm(head) { x[i] * inverse * gamma(head, i) } else { x[i] });
            pairs.extend(read(client, &computed[0], head * width, width)?.into_iter().zip(expected));
        }
        Ok(vec![pairs])
    });
    let backward = || rms_norm_backward(client, inputs(), grad.buffer(client), heads).into();
    sweep.run("RMS norm backward", &case, "", Work::Values(3.0 * values), backward, |computed| {
        let [mut pairs, mut sums] = [Pairs::new(), Pairs::new()];
        for head in chosen() {
            let [x, grad] = [&x, &grad].map(|input| input.line(head * width, width));
            let inverse = inverse(head);
            let along = |i: usize| grad[i] * gamma(head, i) * x[i] * inverse / width as f64;
            let along: f64 = if has_norm(head) { (0..width).map(along).sum() } else { 0.0 };
            let slope = |i: usize| (grad[i] * gamma(head, i) - x[i] * inverse * along) * inverse;
            let expected = (0..width).map(|i| if has_norm(head) { slope(i) } else { grad[i] });
            pairs.extend(read(client, &computed[0], head * width, width)?.into_iter().zip(expected));
        }
        let first_heads = (0..rows).flat_map(|row| (0..num_heads).map(move |head| row * PARTS * num_heads + head));
        let mut expected = vec![0.0; width];
        for head in first_heads {
            let inverse = inverse(head);
            (0..width).for_each(|i| expected[i] += grad.at(head * width + i) * x.at(head * width + i) * inverse);
        }
        sums.extend(read(client, &computed[1], 0, width)?.into_iter().zip(expected));
        Ok(vec![pairs, sums])
    });
}

fn gelu(sweep: &mut Sweep, len: usize) {
    let client = sweep.client;
    let (x, grad) = (Input::new(1, len).scaled(4.0), Input::new(2, len));
    let (case, values) = (format!("{len}"), len as f64);
    let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
    let slope = |i: usize| grad.at(i) * (normal(x.at(i)) + x.at(i) * density(x.at(i)));
    let forward = || vec![gelu_forward(client, x.buffer(client), Values::F32)];
    let check = |computed: &[Buffer]| compare(client, &computed[0], |i| x.at(i) * normal(x.at(i)));
    sweep.run("GELU forward", &case, "", Work::Values(2.0 * values), forward, check);
    let backward = || vec![gelu_backward(client, x.buffer(client), grad.buffer(client))];
    let check = |computed: &[Buffer]| compare(client, &computed[0], slope);
    sweep.run("GELU backward", &case, "", Work::Values(3.0 * values), backward, check);
}

fn convert_and_sum(sweep: &mut Sweep, rows: usize, columns: usize) {
    let client = sweep.client;
    let x = Input::new(1, rows * columns);
    let (case, values) = (format!("{rows}x{columns}"), (rows * columns) as f64);
    let to_f16 = || vec![cast(client, x.buffer(client), Values::F16)];
    let check = |computed: &[Buffer]| compare(client, &computed[0], |i| x.at(i));
    sweep.run("conversion to f16", &case, "", Work::Values(1.5 * values), to_f16, check);
    let sum = || vec![sum_rows(client, x.buffer(client), columns)];
    let check =
        |computed: &[Buffer]| compare(client, &computed[0], |i| (0..rows).map(|row| x.at(row * columns + i)).sum());
    sweep.run("sum of rows", &case, "", Work::Values(values), sum, check);
}

/// Compares samples of a result.
fn compare(client: &Client, computed: &Buffer, expected: impl Fn(usize) -> f64) -> Result<Vec<Pairs>, String> {
    // Reads begin at a multiple of four bytes.
    let at = |i: usize| Ok((read(client, computed, i / 2 * 2, 2)?[i % 2], expected(i)));
    Ok(vec![samples(computed.len, 100).into_iter().map(at).collect::<Result<_, String>>()?])
}

/// Returns the normal distribution function at |x| of at most 4, by its series.
fn normal(x: f64) -> f64 {
    let (mut term, mut sum) = (x, x);
    for n in 1..100 {
        term *= -0.5 * x * x / f64::from(n);
        sum += term / f64::from(2 * n + 1);
    }
    0.5 + sum / (2.0 * std::f64::consts::PI).sqrt()
}
