//! Attention of the query of every segment to the members of that segment: one score per member and head.
// S segments, M members, H heads, E width of a head, D = HE

use rayon::prelude::*;

use crate::primitives::shared_slice::SharedSlice;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Operands, Simd, dot};

/// Sizes of a cluster attention, and the members of every segment.
#[derive(Clone, Debug)]
pub struct ClusterSegments {
    num_heads: usize,
    head_width: usize,
    /// Members of segment `s` are `order[bounds[s]..bounds[s + 1]]`.
    bounds: Vec<usize>,
    order: Vec<usize>,
}

impl ClusterSegments {
    /// Groups members by segment; `segment` yields the segment of every member, in `0..num_segments`.
    pub fn new(
        [num_segments, num_heads, head_width]: [usize; 3],
        segment: impl Iterator<Item = usize> + Clone,
    ) -> Self {
        let mut bounds = vec![0; num_segments + 1];
        let mut num_members = 0;
        for segment in segment.clone() {
            bounds[segment + 1] += 1;
            num_members += 1;
        }
        for s in 0..num_segments {
            bounds[s + 1] += bounds[s];
        }
        let mut next = bounds.clone();
        let mut order = vec![0; num_members];
        for (member, segment) in segment.enumerate() {
            order[next[segment]] = member;
            next[segment] += 1;
        }
        Self { num_heads, head_width, bounds, order }
    }

    fn dim(&self) -> usize {
        self.num_heads * self.head_width
    }

    fn len(&self) -> usize {
        self.bounds.len() - 1
    }

    fn members(&self, segment: usize) -> &[usize] {
        &self.order[self.bounds[segment]..self.bounds[segment + 1]]
    }

    fn scale(&self) -> f32 {
        (1.0 / (self.head_width as f64).sqrt()) as f32
    }
}

const SEGMENTS_PER_TASK: usize = 16;

/// Computes `sum_i softmax_i(q_s k_i / sqrt(head width)) v_i` per head over the members of every segment; zeros for a
/// segment without members.
///
/// # Shapes
/// - `query` and `output`: `[segments, dim]`, `key_value`: `[members, 2 dim]`
/// - `weights`: `[members, num_heads]`, receives the softmax, an input of [`cluster_attention_backward`]
pub fn cluster_attention_forward(
    set: InstructionSet,
    segments: &ClusterSegments,
    [query, key_value]: [&[f32]; 2],
    output: &mut [f32],
    weights: &mut [f32],
) {
    let (dim, members) = (segments.dim(), segments.order.len());
    assert!(query.len() == segments.len() * dim && output.len() == query.len(), "query and output are [segments, dim]");
    assert!(
        key_value.len() == members * 2 * dim && weights.len() == members * segments.num_heads,
        "rows of all members"
    );
    let weights = SharedSlice::new(weights);
    output.par_chunks_mut(SEGMENTS_PER_TASK * dim).enumerate().for_each(|(task, output)| {
        let first = task * SEGMENTS_PER_TASK;
        set.run(Forward { segments, inputs: [query, key_value], first, output, weights: &weights });
    });
}

struct Forward<'a> {
    segments: &'a ClusterSegments,
    inputs: [&'a [f32]; 2],
    first: usize,
    output: &'a mut [f32],
    weights: &'a SharedSlice<'a>,
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { segments, inputs: [query, key_value], first, output, weights } = self;
        let (dim, heads, width) = (segments.dim(), segments.num_heads, segments.head_width);
        let mut scores = Vec::new();
        for (i, output) in output.chunks_exact_mut(dim).enumerate() {
            output.fill(0.0);
            let members = segments.members(first + i);
            let query = &query[(first + i) * dim..][..dim];
            scores.clear();
            for &member in members {
                let key = &key_value[member * 2 * dim..][..dim];
                for (query, key) in query.chunks_exact(width).zip(key.chunks_exact(width)) {
                    scores.push(dot(simd, query, key) * segments.scale());
                }
            }
            for head in 0..heads {
                softmax(&mut scores, head, heads);
            }
            for (&member, scores) in members.iter().zip(scores.chunks_exact(heads)) {
                let value = &key_value[member * 2 * dim + dim..][..dim];
                for ((value, output), &weight) in
                    value.chunks_exact(width).zip(output.chunks_exact_mut(width)).zip(scores)
                {
                    add_scaled(simd, value, weight, output);
                }
                // SAFETY: a member belongs to one segment, a segment to one task.
                unsafe { weights.part(member * heads, heads) }.copy_from_slice(scores);
            }
        }
    }
}

/// Applies softmax to every `step`th value, starting with `start`.
fn softmax(values: &mut [f32], start: usize, step: usize) {
    let values = values.get_mut(start..).unwrap_or_default();
    let highest = values.iter().step_by(step).fold(f32::NEG_INFINITY, |a, &b| if a > b { a } else { b });
    let mut total = 0.0;
    for value in values.iter_mut().step_by(step) {
        *value = (*value - highest).exp();
        total += *value;
    }
    values.iter_mut().step_by(step).for_each(|value| *value /= total);
}

/// Computes the gradients of `query` and `key_value` from the gradient of the output.
///
/// With `g` the output gradient of the member's segment: `dV_i = p_i g`,
/// `dS_i = p_i (g v_i - sum_j p_j g v_j)`, `dK_i = s dS_i q`, `dQ = s sum_i dS_i k_i`.
pub fn cluster_attention_backward(
    set: InstructionSet,
    segments: &ClusterSegments,
    [query, key_value, weights, grad]: [&[f32]; 4],
    [grad_query, grad_key_value]: [&mut [f32]; 2],
) {
    let (dim, members) = (segments.dim(), segments.order.len());
    assert!(query.len() == segments.len() * dim && grad.len() == query.len() && grad_query.len() == query.len());
    assert!(key_value.len() == members * 2 * dim && weights.len() == members * segments.num_heads);
    assert_eq!(grad_key_value.len(), key_value.len(), "rows of all members");
    let grad_key_value = SharedSlice::new(grad_key_value);
    grad_query.par_chunks_mut(SEGMENTS_PER_TASK * dim).enumerate().for_each(|(task, grad_query)| {
        let (inputs, first) = ([query, key_value, weights, grad], task * SEGMENTS_PER_TASK);
        set.run(Backward { segments, inputs, first, grad_query, grad_key_value: &grad_key_value });
    });
}

struct Backward<'a> {
    segments: &'a ClusterSegments,
    inputs: [&'a [f32]; 4],
    first: usize,
    grad_query: &'a mut [f32],
    grad_key_value: &'a SharedSlice<'a>,
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { segments, inputs: [query, key_value, weights, grad], first, grad_query, grad_key_value } = self;
        let (dim, heads, width) = (segments.dim(), segments.num_heads, segments.head_width);
        let mut slopes: Vec<f32> = Vec::new();
        for (i, grad_query) in grad_query.chunks_exact_mut(dim).enumerate() {
            grad_query.fill(0.0);
            let members = segments.members(first + i);
            let query = &query[(first + i) * dim..][..dim];
            let grad = &grad[(first + i) * dim..][..dim];
            slopes.clear();
            for &member in members {
                let value = &key_value[member * 2 * dim + dim..][..dim];
                for (grad, value) in grad.chunks_exact(width).zip(value.chunks_exact(width)) {
                    slopes.push(dot(simd, grad, value));
                }
            }
            for head in 0..heads {
                let weight = |i: usize| weights[members[i] * heads + head];
                let mean: f32 = (0..members.len()).map(|i| weight(i) * slopes[i * heads + head]).sum();
                for i in 0..members.len() {
                    let slope = &mut slopes[i * heads + head];
                    *slope = weight(i) * (*slope - mean) * segments.scale();
                }
            }
            for (&member, slopes) in members.iter().zip(slopes.chunks_exact(heads)) {
                let key = &key_value[member * 2 * dim..][..dim];
                // SAFETY: a member belongs to one segment, a segment to one task.
                let (grad_key, grad_value) =
                    unsafe { grad_key_value.part(member * 2 * dim, 2 * dim) }.split_at_mut(dim);
                for head in 0..heads {
                    let columns = head * width..(head + 1) * width;
                    let slope = slopes[head];
                    add_scaled(simd, &key[columns.clone()], slope, &mut grad_query[columns.clone()]);
                    set_scaled(simd, &query[columns.clone()], slope, &mut grad_key[columns.clone()]);
                    let weight = weights[member * heads + head];
                    set_scaled(simd, &grad[columns.clone()], weight, &mut grad_value[columns]);
                }
            }
        }
    }
}

/// Computes `to += factor * from`.
#[inline(always)]
fn add_scaled<S: Simd>(simd: S, from: &[f32], factor: f32, to: &mut [f32]) {
    let factor = simd.splat(factor);
    for (from, to) in from.chunks(S::LANES).zip(to.chunks_mut(S::LANES)) {
        simd.write(to, simd.mul_add(simd.read(from), factor, simd.read(to)));
    }
}

/// Computes `to = factor * from`.
#[inline(always)]
fn set_scaled<S: Simd>(simd: S, from: &[f32], factor: f32, to: &mut [f32]) {
    let factor = simd.splat(factor);
    for (from, to) in from.chunks(S::LANES).zip(to.chunks_mut(S::LANES)) {
        simd.write(to, simd.mul(simd.read(from), factor));
    }
}
