//! Kernels of rows, heads and clusters on random inputs, and the same in f64.
// B scenes, H heads, E width of a head

use cubecl::prelude::Client;

use crate::testing::cases::{Case, attention_f64, gelu_and_slope, random};
use crate::{
    Buffer, ClusterSizes, NormHeads, PartTransform, Values, cluster_attention_backward, cluster_attention_forward,
    gelu_backward, gelu_forward, layer_norm_backward, layer_norm_forward, rms_norm_backward, rms_norm_forward,
    sum_rows, transform_heads,
};

/// An attention inside clusters: its output, or the gradients of queries and of keys with values. `segments` has the segment of
/// every member.
pub fn cluster_attention(sizes: ClusterSizes, segments: Vec<i32>, is_backward: bool) -> Case {
    let ClusterSizes { batch, num_segments, num_members, num_heads, head_width } = sizes;
    let (dim, of_members) = (num_heads * head_width, segments.clone());
    let inputs = move || {
        let [query, grad] = [1, 3].map(|seed| random(batch * num_segments * dim, seed, 2.0));
        // The kernel reads the bits as i32.
        let segments = segments.iter().map(|&segment| f32::from_bits(segment as u32)).collect();
        [query, random(batch * num_members * 2 * dim, 2, 2.0), grad, segments]
    };
    let run = move |client: &Client, inputs: &[Buffer]| {
        let [query, key_value, grad, segments] = inputs else { panic!("four inputs") };
        let inputs = [query, key_value, segments];
        let [output, weights] = cluster_attention_forward(client, sizes, inputs);
        if is_backward {
            cluster_attention_backward(client, sizes, inputs, [&output, &weights], grad).into()
        } else {
            vec![output]
        }
    };
    Case::new(inputs, run, move |inputs| {
        let keys_of = |row: usize| (0..of_members.len()).filter(|&i| of_members[i] == row as i32).collect();
        let [grad_query, grad_key_value, output, _] = attention_f64(inputs, [num_heads, head_width], keys_of);
        if is_backward { vec![grad_query, grad_key_value] } else { vec![output] }
    })
}

/// Transforms of the heads of queries, keys and values, `[tokens, 3, H, E]`.
pub fn head_transform(tokens: usize, [num_heads, width]: [usize; 2]) -> Case {
    let parts = [(false, true, true), (true, false, true), (true, true, false)]
        .map(|(inverse, transposed, negative)| PartTransform { inverse, transposed, negative });
    let len = 32 + width / 2;
    let inputs = move || [random(tokens * 3 * num_heads * width, 1, 1.0), random(tokens * len, 2, 1.0)];
    let run = move |client: &Client, inputs: &[Buffer]| {
        vec![transform_heads(client, &parts, [num_heads, width], &inputs[1], &inputs[0])]
    };
    Case::new(inputs, run, move |inputs| {
        let mut expected = vec![0.0; inputs[0].len()];
        for (head, (expected, x)) in expected.chunks_exact_mut(width).zip(inputs[0].chunks_exact(width)).enumerate() {
            let part = parts[head / num_heads % 3];
            let values = &inputs[1][head / (3 * num_heads) * len..][..len];
            let matrix = &values[if part.inverse { 16 } else { 0 }..];
            for (k, j) in (0..width / 8).flat_map(|k| (0..4).map(move |j| (k, j))) {
                let entry = |i: usize| matrix[if part.transposed { i * 4 + j } else { j * 4 + i }];
                expected[j * width / 8 + k] = (0..4).map(|i| entry(i) * x[i * width / 8 + k]).sum();
            }
            let sign = if part.negative { -1.0 } else { 1.0 };
            for p in 0..width / 4 {
                let (cosine, sine) = (values[32 + p], sign * values[32 + width / 4 + p]);
                let (a, b) = (width / 2 + p, width / 2 + width / 4 + p);
                expected[a] = x[a] * cosine - x[b] * sine;
                expected[b] = x[a] * sine + x[b] * cosine;
            }
        }
        vec![expected]
    })
}

const EPSILON: f32 = 1e-5;

/// A layer norm in a type, or the gradients of its input, gamma and beta, which takes a forward.
pub fn layer_norm(rows: usize, columns: usize, output: Option<Values>) -> Case {
    let lens = [rows * columns, columns, columns, rows * columns];
    let inputs = move || [0, 1, 2, 3].map(|i| random(lens[i], i as u64, 1.0));
    let run = move |client: &Client, inputs: &[Buffer]| {
        let [x, gamma, beta, grad] = inputs else { panic!("four inputs") };
        let [normal, statistics] = layer_norm_forward(client, [x, gamma, beta], EPSILON, output.unwrap_or(Values::F32));
        if output.is_some() { vec![normal] } else { layer_norm_backward(client, [x, gamma, &statistics], grad).into() }
    };
    Case::new(inputs, run, move |inputs| {
        let [x, gamma, beta, grad] = inputs else { panic!("four inputs") };
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / columns as f64;
        let [mut normals, mut grad_x] = [Vec::new(), Vec::new()];
        let [mut grad_gamma, mut grad_beta] = [vec![0.0; columns], vec![0.0; columns]];
        for (x, grad) in x.chunks_exact(columns).zip(grad.chunks_exact(columns)) {
            let center = mean(&mut x.iter().copied());
            let inverse = 1.0 / (mean(&mut x.iter().map(|x| (x - center).powi(2))) + f64::from(EPSILON)).sqrt();
            let y = |i: usize| (x[i] - center) * inverse;
            let slope = |i: usize| grad[i] * gamma[i];
            let [sum, along] = [mean(&mut (0..columns).map(slope)), mean(&mut (0..columns).map(|i| slope(i) * y(i)))];
            for i in 0..columns {
                normals.push(y(i) * gamma[i] + beta[i]);
                grad_x.push((slope(i) - sum - y(i) * along) * inverse);
                grad_gamma[i] += grad[i] * y(i);
                grad_beta[i] += grad[i];
            }
        }
        if output.is_some() { vec![normals] } else { vec![grad_x, grad_gamma, grad_beta] }
    })
}

/// RMS norms of the heads of the first `norm_parts` of three parts, or the gradients of the input and of the gammas.
pub fn rms_norm(rows: usize, [num_heads, width]: [usize; 2], norm_parts: usize, is_backward: bool) -> Case {
    let heads = NormHeads { num_parts: 3, num_heads, head_width: width, epsilon: EPSILON };
    let lens = [rows * 3 * num_heads * width, norm_parts * width, rows * 3 * num_heads * width];
    let inputs = move || [0, 1, 2].map(|i| random(lens[i], i as u64, 1.0));
    let run = move |client: &Client, inputs: &[Buffer]| {
        let [x, gammas, grad] = inputs else { panic!("three inputs") };
        if is_backward {
            rms_norm_backward(client, [x, gammas], grad, heads).into()
        } else {
            vec![rms_norm_forward(client, [x, gammas], heads)]
        }
    };
    Case::new(inputs, run, move |inputs| {
        let [x, gammas, grad] = inputs else { panic!("three inputs") };
        let (mut normals, mut grad_x, mut grad_gammas) = (Vec::new(), Vec::new(), vec![0.0; norm_parts * width]);
        for (head, (x, grad)) in x.chunks_exact(width).zip(grad.chunks_exact(width)).enumerate() {
            let part = head / num_heads % 3;
            if part >= norm_parts {
                normals.extend(x);
                grad_x.extend(grad);
                continue;
            }
            let gamma = &gammas[part * width..];
            let square = x.iter().map(|x| x * x).sum::<f64>() / width as f64;
            let inverse = 1.0 / (square + f64::from(EPSILON)).sqrt();
            let along = (0..width).map(|i| grad[i] * gamma[i] * x[i] * inverse).sum::<f64>() / width as f64;
            for i in 0..width {
                normals.push(x[i] * inverse * gamma[i]);
                grad_x.push((grad[i] * gamma[i] - x[i] * inverse * along) * inverse);
                grad_gammas[part * width + i] += grad[i] * x[i] * inverse;
            }
        }
        if is_backward { vec![grad_x, grad_gammas] } else { vec![normals] }
    })
}

/// GELU in a type, or its gradient.
pub fn gelu(len: usize, output: Option<Values>) -> Case {
    let run = move |client: &Client, inputs: &[Buffer]| match output {
        Some(output) => vec![gelu_forward(client, &inputs[0], output)],
        None => vec![gelu_backward(client, &inputs[0], &inputs[1])],
    };
    Case::new(
        move || [random(len, 1, 7.5), random(len, 2, 1.0)],
        run,
        move |inputs| {
            let values = inputs[0].iter().zip(&inputs[1]).map(|(&x, grad)| {
                let [value, slope] = gelu_and_slope(x);
                if output.is_some() { value } else { grad * slope }
            });
            vec![values.collect()]
        },
    )
}

/// Sums of rows.
pub fn row_sums(rows: usize, columns: usize) -> Case {
    let run = move |client: &Client, inputs: &[Buffer]| vec![sum_rows(client, &inputs[0], columns)];
    Case::new(
        move || [random(rows * columns, 1, 1.0)],
        run,
        move |inputs| vec![(0..columns).map(|i| inputs[0].iter().skip(i).step_by(columns).sum()).collect()],
    )
}
