//! Attention inside clusters, and transforms of heads by cameras.

use clift_cube::{
    Buffer, ClusterSizes, PartTransform, Values, cluster_attention_backward, cluster_attention_forward, transform_heads,
};

use crate::Sizes;
use crate::attention::{add, dot, log_sum};
use crate::inputs::{Input, hash, read, samples};
use crate::measure::{Pairs, Sweep, Work};

pub fn run(sweep: &mut Sweep, sizes: Sizes) {
    head_transform(sweep, sizes);
    cluster_attention(sweep, sizes);
}

fn head_transform(sweep: &mut Sweep, sizes: Sizes) {
    let Sizes { num_heads, head_width: width, .. } = sizes;
    let (tokens, client) = (sizes.batch * sizes.tokens, sweep.client);
    let flags = [(false, true, true), (true, false, true), (true, false, false)];
    let parts = flags.map(|(inverse, transposed, negative)| PartTransform { inverse, transposed, negative });
    let len = 32 + width / 2;
    let (x, transforms) = (Input::new(1, tokens * 3 * num_heads * width), Input::new(2, tokens * len));
    let launch =
        || vec![transform_heads(client, &parts, [num_heads, width], transforms.buffer(client), x.buffer(client))];
    let case = format!("{tokens}x3x{num_heads}x{width}");
    let work = Work::Values((2 * tokens * 3 * num_heads * width) as f64);
    sweep.run("head transform", &case, "", work, launch, |computed| {
        let mut pairs = Pairs::new();
        for head in samples(tokens * 3 * num_heads, 9) {
            let part = parts[head / num_heads % 3];
            let token = head / (3 * num_heads) * len;
            let x = x.line(head * width, width);
            let first = token + if part.inverse { 16 } else { 0 };
            let entry = |i: usize, j: usize| transforms.at(first + if part.transposed { i * 4 + j } else { j * 4 + i });
            let mut expected = vec![0.0; width];
            for k in 0..width / 8 {
                for j in 0..4 {
                    expected[j * width / 8 + k] = (0..4).map(|i| entry(i, j) * x[i * width / 8 + k]).sum();
                }
            }
            for p in 0..width / 4 {
                let sign = if part.negative { -1.0 } else { 1.0 };
                let cosine = transforms.at(token + 32 + p);
                let sine = sign * transforms.at(token + 32 + width / 4 + p);
                let [a, b] = [width / 2 + p, width / 2 + width / 4 + p];
                expected[a] = x[a] * cosine - x[b] * sine;
                expected[b] = x[a] * sine + x[b] * cosine;
            }
            pairs.extend(read(client, &computed[0], head * width, width)?.into_iter().zip(expected));
        }
        Ok(vec![pairs])
    });
}

fn cluster_attention(sweep: &mut Sweep, sizes: Sizes) {
    let Sizes { batch, num_heads, head_width: width, .. } = sizes;
    let (dim, client) = (sizes.dim(), sweep.client);
    // A quarter of the tokens are centroids, the others are members.
    let num_segments = sizes.tokens / 4;
    let num_members = sizes.tokens - num_segments;
    let cluster = ClusterSizes { batch, num_segments, num_members, num_heads, head_width: width };
    let segment =
        |member: usize| member / num_members * num_segments + hash(6, member) as usize % 1024 * num_segments / 1024;
    let bytes: Vec<u8> = (0..batch * num_members).flat_map(|member| (segment(member) as i32).to_le_bytes()).collect();
    let segments = Buffer { handle: client.create_from_slice(&bytes), len: batch * num_members, values: Values::F32 };
    let [query, grad] = [1, 2].map(|seed| Input::new(seed, batch * num_segments * dim).scaled(2.0));
    let key_value = Input::new(3, batch * num_members * 2 * dim).scaled(2.0);
    let inputs = || [query.buffer(client), key_value.buffer(client), &segments];
    let forward = || cluster_attention_forward(client, cluster, inputs());
    let backward = || {
        let [output, weights] = forward();
        cluster_attention_backward(client, cluster, inputs(), [&output, &weights], grad.buffer(client))
    };

    let key = |member: usize, part: usize, head: usize| key_value.line((member * 2 + part) * dim + head * width, width);
    let members = |of: usize| (0..batch * num_members).filter(|&member| segment(member) == of).collect::<Vec<_>>();
    // Members, their weights, the output, and a query or a gradient.
    let attend = |of: usize, head: usize| {
        let members = members(of);
        let query = query.line(of * dim + head * width, width);
        let score = |&member: &usize| dot(&query, &key(member, 0, head)) / (width as f64).sqrt();
        let scores: Vec<f64> = members.iter().map(score).collect();
        let log_sum = log_sum(&scores);
        let weights: Vec<f64> = scores.iter().map(|score| (score - log_sum).exp()).collect();
        let mut output = vec![0.0; width];
        members.iter().zip(&weights).for_each(|(&member, &weight)| add(&mut output, weight, &key(member, 1, head)));
        (members, weights, query, output)
    };
    let chosen = || samples(batch * num_segments * num_heads, 5).into_iter().map(|i| (i / num_heads, i % num_heads));
    let case = format!("{batch}x{num_segments} segments of {num_members} members");
    let rows = (batch * num_members * 2 * dim, batch * num_segments * dim);
    let work = Work::Values((rows.0 + 2 * rows.1) as f64);
    sweep.run(
        "cluster attention forward",
        &case,
        "",
        work,
        || forward().into(),
        |computed| {
            let mut pairs = Pairs::new();
            for (of, head) in chosen() {
                let (.., expected) = attend(of, head);
                pairs.extend(read(client, &computed[0], of * dim + head * width, width)?.into_iter().zip(expected));
            }
            Ok(vec![pairs])
        },
    );
    // The forward is part of the time.
    let work = Work::Values((3 * rows.0 + 6 * rows.1) as f64);
    sweep.run(
        "cluster attention forward and backward",
        &case,
        "",
        work,
        || backward().into(),
        |computed| {
            let mut pairs = [Pairs::new(), Pairs::new(), Pairs::new()];
            let scale = 1.0 / (width as f64).sqrt();
            for (of, head) in chosen() {
                let (members, weights, query, output) = attend(of, head);
                let grad = grad.line(of * dim + head * width, width);
                let delta = dot(&grad, &output);
                let mut grad_query = vec![0.0; width];
                for (&member, weight) in members.iter().zip(weights) {
                    let slope = scale * weight * (dot(&grad, &key(member, 1, head)) - delta);
                    add(&mut grad_query, slope, &key(member, 0, head));
                    for (part, (factor, x)) in [(slope, &query), (weight, &grad)].into_iter().enumerate() {
                        let computed = read(client, &computed[1], (member * 2 + part) * dim + head * width, width)?;
                        pairs[1 + part].extend(computed.into_iter().zip(x.iter().map(|x| factor * x)));
                    }
                }
                pairs[0]
                    .extend(read(client, &computed[0], of * dim + head * width, width)?.into_iter().zip(grad_query));
            }
            Ok(pairs.into())
        },
    );
}
