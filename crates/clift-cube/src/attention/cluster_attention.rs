//! Attention of every centroid to the members of its segment, without atomics: a unit has a segment and a head, and reads its
//! members in their order.
// B scenes, S segments of a scene, M members of a scene, H heads, E width of a head

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};

const UNITS: usize = 64;

/// Sizes of an attention inside clusters.
#[derive(Clone, Copy, Debug)]
pub struct ClusterSizes {
    /// B.
    pub batch: usize,
    /// S.
    pub num_segments: usize,
    /// M.
    pub num_members: usize,
    /// H.
    pub num_heads: usize,
    /// E.
    pub head_width: usize,
}

impl ClusterSizes {
    fn vector(self) -> usize {
        if self.head_width.is_multiple_of(4) { 4 } else { 1 }
    }

    fn cubes(self, units: usize) -> CubeCount {
        CubeCount::Static((self.batch * units).div_ceil(UNITS) as u32, 1, 1)
    }
}

/// Sorts the members of a scene by segment: counts the members before each.
#[cube(launch_unchecked)]
fn group(segment: &[i32], order: &mut [u32], first: &mut [u32], batch: usize, num_segments: usize, num_members: usize) {
    let index = ABSOLUTE_POS;
    let units = num_members + num_segments;
    if index < batch * units {
        let scene = index / units;
        let unit = index % units;
        let start = scene * num_members;
        let mut count = 0u32;
        if unit < num_members {
            let cluster = segment[start + unit];
            for i in 0..num_members {
                let other = segment[start + i];
                if other < cluster || (other == cluster && i < unit) {
                    count += 1;
                }
            }
            order[start + count as usize] = (start + unit) as u32;
        } else {
            let cluster = (scene * num_segments + unit - num_members) as i32;
            for i in 0..num_members {
                if segment[start + i] < cluster {
                    count += 1;
                }
            }
            first[scene * num_segments + unit - num_members] = start as u32 + count;
        }
    }
}

/// Returns members grouped by segment: their order, and the first of every segment.
fn groups(client: &Client, sizes: ClusterSizes, segment: &Buffer) -> [Buffer; 2] {
    let ClusterSizes { batch, num_segments, num_members, .. } = sizes;
    // Indices have the size of f32 values.
    let order = Buffer::empty(client, batch * num_members, Values::F32);
    let first = Buffer::empty(client, batch * num_segments, Values::F32);
    // SAFETY: the kernel compares its index with the sizes.
    unsafe {
        group::launch_unchecked(
            client,
            sizes.cubes(num_members + num_segments),
            CubeDim::new_1d(UNITS as u32),
            segment.arg(1),
            order.arg(1),
            first.arg(1),
            batch,
            num_segments,
            num_members,
        );
    }
    [order, first]
}

/// Returns the end of a segment's members.
#[cube]
fn end_of(first: &[u32], segment: usize, num_segments: usize, num_members: usize) -> usize {
    let mut end = (segment / num_segments + 1) * num_members;
    if segment % num_segments + 1 < num_segments {
        end = first[segment + 1] as usize;
    }
    end
}

/// Returns the dot product of a vector array and a row of a buffer.
#[cube]
fn dot<V: Size>(a: &Array<Vector<f32, V>>, b: &[Vector<f32, V>], start: usize, #[comptime] vectors: usize) -> f32 {
    let mut sum = Vector::<f32, V>::new(0.0);
    #[unroll]
    for i in 0..vectors {
        sum = fma(a[i], b[start + i], sum);
    }
    crate::buffers::reduce::sum_of_vector(sum)
}

#[cube(launch_unchecked)]
fn forward<V: Size>(
    query: &[Vector<f32, V>],
    key_value: &[Vector<f32, V>],
    order: &[u32],
    first: &[u32],
    output: &mut [Vector<f32, V>],
    weights: &mut [f32],
    batch: usize,
    num_segments: usize,
    num_members: usize,
    num_heads: usize,
    scale: f32,
    #[comptime] width: usize,
) {
    let index = ABSOLUTE_POS;
    if index < batch * num_segments * num_heads {
        let segment = index / num_heads;
        let head = index % num_heads;
        let vector = V::value().comptime();
        let vectors = comptime!(width / vector);
        let mut query_ = Array::<Vector<f32, V>>::new(vectors);
        let mut sums = Array::<Vector<f32, V>>::new(vectors);
        #[unroll]
        for i in 0..vectors {
            query_[i] = query[index * vectors + i] * Vector::<f32, V>::new(scale);
            sums[i] = Vector::<f32, V>::new(0.0);
        }
        let begin = first[segment] as usize;
        let end = end_of(first, segment, num_segments, num_members);
        let mut maximum = f32::new(f32::MIN);
        for i in begin..end {
            let member = order[i] as usize;
            let score = dot(&query_, key_value, (member * 2 * num_heads + head) * vectors, vectors);
            weights[member * num_heads + head] = score;
            maximum = max(maximum, score);
        }
        let mut total = 0.0f32;
        for i in begin..end {
            let member = order[i] as usize;
            let weight = (weights[member * num_heads + head] - maximum).exp();
            weights[member * num_heads + head] = weight;
            total += weight;
            let value = ((member * 2 + 1) * num_heads + head) * vectors;
            #[unroll]
            for e in 0..vectors {
                sums[e] = fma(Vector::<f32, V>::new(weight), key_value[value + e], sums[e]);
            }
        }
        // Every total that is read is at least one.
        let factor = 1.0 / max(total, f32::new(1.0));
        for i in begin..end {
            let at = order[i] as usize * num_heads + head;
            weights[at] *= factor;
        }
        #[unroll]
        for e in 0..vectors {
            output[index * vectors + e] = sums[e] * Vector::<f32, V>::new(factor);
        }
    }
}

#[cube(launch_unchecked)]
fn backward<V: Size>(
    query: &[Vector<f32, V>],
    key_value: &[Vector<f32, V>],
    order: &[u32],
    first: &[u32],
    output: &[Vector<f32, V>],
    weights: &[f32],
    grad_output: &[Vector<f32, V>],
    grad_query: &mut [Vector<f32, V>],
    grad_key_value: &mut [Vector<f32, V>],
    batch: usize,
    num_segments: usize,
    num_members: usize,
    num_heads: usize,
    scale: f32,
    #[comptime] width: usize,
) {
    let index = ABSOLUTE_POS;
    if index < batch * num_segments * num_heads {
        let segment = index / num_heads;
        let head = index % num_heads;
        let vector = V::value().comptime();
        let vectors = comptime!(width / vector);
        let mut query_ = Array::<Vector<f32, V>>::new(vectors);
        let mut grad = Array::<Vector<f32, V>>::new(vectors);
        let mut sums = Array::<Vector<f32, V>>::new(vectors);
        #[unroll]
        for i in 0..vectors {
            query_[i] = query[index * vectors + i] * Vector::<f32, V>::new(scale);
            grad[i] = grad_output[index * vectors + i];
            sums[i] = Vector::<f32, V>::new(0.0);
        }
        let delta = dot(&grad, output, index * vectors, vectors);
        let begin = first[segment] as usize;
        let end = end_of(first, segment, num_segments, num_members);
        for i in begin..end {
            let member = order[i] as usize;
            let key = (member * 2 * num_heads + head) * vectors;
            let value = key + num_heads * vectors;
            let weight = weights[member * num_heads + head];
            let slope = weight * (dot(&grad, key_value, value, vectors) - delta);
            #[unroll]
            for e in 0..vectors {
                sums[e] = fma(Vector::<f32, V>::new(slope), key_value[key + e], sums[e]);
                grad_key_value[key + e] = query_[e] * Vector::<f32, V>::new(slope);
                grad_key_value[value + e] = grad[e] * Vector::<f32, V>::new(weight);
            }
        }
        #[unroll]
        for e in 0..vectors {
            grad_query[index * vectors + e] = sums[e] * Vector::<f32, V>::new(scale);
        }
    }
}

fn scale(width: usize) -> f32 {
    (1.0 / (width as f64).sqrt()) as f32
}

/// Computes `o_s = sum_i softmax_i(q_s k_i / sqrt(E)) v_i` over the members of every segment, zeros without members, and the
/// weights `[B M, H]`. `query: [B S, H E]`, `key_value: [B M, 2 H E]`, all f32; `segment: [B M]` in i32, `scene * S + cluster`.
pub fn cluster_attention_forward(
    client: &Client,
    sizes: ClusterSizes,
    [query, key_value, segment]: [&Buffer; 3],
) -> [Buffer; 2] {
    let ClusterSizes { batch, num_segments, num_members, num_heads, head_width } = sizes;
    let [order, first] = groups(client, sizes, segment);
    let output = Buffer::empty(client, query.len, Values::F32);
    let weights = Buffer::empty(client, batch * num_members * num_heads, Values::F32);
    let vector = sizes.vector();
    // SAFETY: the kernel compares its index with the sizes; the order has members of the scene.
    unsafe {
        forward::launch_unchecked(
            client,
            sizes.cubes(num_segments * num_heads),
            CubeDim::new_1d(UNITS as u32),
            vector,
            query.arg(vector),
            key_value.arg(vector),
            order.arg(1),
            first.arg(1),
            output.arg(vector),
            weights.arg(1),
            batch,
            num_segments,
            num_members,
            num_heads,
            scale(head_width),
            head_width,
        );
    }
    [output, weights]
}

/// Computes the gradients of `query` and `key_value` from output and weights of the forward and the gradient of the output.
pub fn cluster_attention_backward(
    client: &Client,
    sizes: ClusterSizes,
    [query, key_value, segment]: [&Buffer; 3],
    [output, weights]: [&Buffer; 2],
    grad_output: &Buffer,
) -> [Buffer; 2] {
    let ClusterSizes { batch, num_segments, num_members, num_heads, head_width } = sizes;
    let [order, first] = groups(client, sizes, segment);
    let [grad_query, grad_key_value] = [query, key_value].map(|x| Buffer::empty(client, x.len, Values::F32));
    let vector = sizes.vector();
    // SAFETY: as in the forward.
    unsafe {
        backward::launch_unchecked(
            client,
            sizes.cubes(num_segments * num_heads),
            CubeDim::new_1d(UNITS as u32),
            vector,
            query.arg(vector),
            key_value.arg(vector),
            order.arg(1),
            first.arg(1),
            output.arg(vector),
            weights.arg(1),
            grad_output.arg(vector),
            grad_query.arg(vector),
            grad_key_value.arg(vector),
            batch,
            num_segments,
            num_members,
            num_heads,
            scale(head_width),
            head_width,
        );
    }
    [grad_query, grad_key_value]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::row_cases::cluster_attention;
    use crate::testing::{check, client};

    /// Uneven segments, one of one member, one without; two scenes.
    const SEGMENTS: [i32; 14] = [0, 0, 2, 0, 1, 2, 0, 5, 7, 7, 5, 4, 5, 4];

    #[test]
    fn outputs_and_gradients_equal_f64() {
        let Some(client) = client() else { return };
        for (num_heads, head_width) in [(2, 12), (1, 5)] {
            let sizes = ClusterSizes { batch: 2, num_segments: 4, num_members: 7, num_heads, head_width };
            for is_backward in [false, true] {
                check(&client, &cluster_attention(sizes, SEGMENTS.into(), is_backward), 1e-5);
            }
        }
    }
}
