//! Transforms of the heads of tokens by their cameras and patch positions (camera-relative attention).
// T tokens, P parts of a row, H heads, E width of a head

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::{UNITS, cube_count};

/// Transform of a part of a row. The transform of a token is block-diagonal: a 4 x 4 matrix on the first half of a head,
/// rotations on the second half.
#[derive(Clone, Copy, Debug)]
pub struct PartTransform {
    /// Uses the inverse matrix.
    pub inverse: bool,
    /// Transposes the matrix.
    pub transposed: bool,
    /// Negates the angles.
    pub negative: bool,
}

/// Transforms vector `k` of a head's first half and two pairs of its second half. Bit `part` of `inverse`, `transposed` and
/// `negative` is the flag of that part.
#[cube(launch_unchecked)]
fn transform(
    x: &[f32],
    transforms: &[f32],
    output: &mut [f32],
    num_parts: usize,
    num_heads: usize,
    width: usize,
    inverse: usize,
    transposed: usize,
    negative: usize,
) {
    let eighth = width / 8;
    let index = ABSOLUTE_POS;
    if index < x.len() / 8 {
        let head = index / eighth;
        let k = index % eighth;
        let part = head / num_heads % num_parts;
        let token = head / (num_heads * num_parts);
        let first = head * width;
        let matrix = token * (32 + width / 2) + (inverse >> part) % 2 * 16;
        let is_transposed = (transposed >> part) % 2 == 1;
        for j in 0..4usize {
            let mut sum = 0.0f32;
            for i in 0..4usize {
                let entry = select(is_transposed, i * 4 + j, j * 4 + i);
                sum = fma(transforms[matrix + entry], x[first + i * eighth + k], sum);
            }
            output[first + j * eighth + k] = sum;
        }
        let sign = select((negative >> part) % 2 == 1, -1.0f32, 1.0f32);
        let angles = token * (32 + width / 2) + 32;
        for i in 0..2usize {
            let pair = k + i * eighth;
            let cosine = transforms[angles + pair];
            let sine = sign * transforms[angles + width / 4 + pair];
            let a = x[first + width / 2 + pair];
            let b = x[first + width / 2 + width / 4 + pair];
            output[first + width / 2 + pair] = a * cosine - b * sine;
            output[first + width / 2 + width / 4 + pair] = a * sine + b * cosine;
        }
    }
}

/// Transforms `x: [tokens, parts, heads, E]` by `transforms: [tokens, 32 + E / 2]`: per token a matrix, its inverse, and the
/// cosines and sines of `E / 4` angles. E is a multiple of eight.
pub fn transform_heads(
    client: &Client,
    parts: &[PartTransform],
    [num_heads, head_width]: [usize; 2],
    transforms: &Buffer,
    x: &Buffer,
) -> Buffer {
    let output = Buffer::empty(client, x.len, Values::F32);
    let bits = |flag: fn(&PartTransform) -> bool| {
        parts.iter().enumerate().map(|(i, part)| usize::from(flag(part)) << i).sum::<usize>()
    };
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        transform::launch_unchecked(
            client,
            cube_count((x.len / 8).div_ceil(UNITS)),
            CubeDim::new_1d(UNITS as u32),
            x.arg(1),
            transforms.arg(1),
            output.arg(1),
            parts.len(),
            num_heads,
            head_width,
            bits(|part| part.inverse),
            bits(|part| part.transposed),
            bits(|part| part.negative),
        );
    }
    output
}

#[cfg(test)]
mod tests {
    use crate::testing::row_cases::head_transform;
    use crate::testing::{check, client};

    #[test]
    fn transforms_equal_f64() {
        let Some(client) = client() else { return };
        for (tokens, num_heads, width) in [(1, 1, 8), (35, 2, 24)] {
            check(&client, &head_transform(tokens, [num_heads, width]), 1e-6);
        }
    }
}
