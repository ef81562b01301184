//! Transforms of the heads of tokens by their cameras and patch positions (camera-relative attention).
// N tokens, H heads, E width of a head

use rayon::prelude::*;

use crate::primitives::partition::rows_per_task;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

/// The transform `rho` of a token is block-diagonal. On the first half of a head it is the 4 x 4 matrix `g` of the token's
/// camera: channel `j * E / 8 + k` is coordinate `j` of vector `k`. On the second half it rotates channels `E / 2 + p` and
/// `3 E / 4 + p` by the angle `p` of the token's patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeadTransform {
    /// `rho^T`, of queries.
    Query,
    /// `rho^-1`, of keys and values.
    Key,
    /// `rho`, of the output of attention.
    Output,
    /// `rho^-T`, of the gradients of keys and values.
    KeyGradient,
}

impl HeadTransform {
    /// Returns the transposed transform, which maps the gradient of the result to the gradient of the input.
    #[must_use]
    pub const fn transposed(self) -> Self {
        match self {
            Self::Query => Self::Output,
            Self::Key => Self::KeyGradient,
            Self::Output => Self::Query,
            Self::KeyGradient => Self::Key,
        }
    }

    /// Whether the transform uses the inverse of `g`.
    pub const fn is_inverse(self) -> bool {
        matches!(self, Self::Key | Self::KeyGradient)
    }

    /// Whether the transform uses the transpose of `g` or of its inverse.
    pub const fn is_transposed(self) -> bool {
        matches!(self, Self::Query | Self::KeyGradient)
    }

    /// Returns the sign of the angles of patches.
    pub const fn sign(self) -> f32 {
        if matches!(self, Self::Query | Self::Key) { -1.0 } else { 1.0 }
    }
}

/// Returns the values of a token's transform: `g` and its inverse, row-major, then cosine and sine of `E / 4` angles.
pub const fn transform_len(head_width: usize) -> usize {
    32 + head_width / 2
}

/// Transforms the heads of tokens in place. The tokens are rows of `parts.len() * num_heads * head_width` values, such as
/// queries, keys and values side by side.
///
/// # Shapes
/// - `transforms`: `[num_tokens, transform_len(head_width)]`
/// - `x`: `[num_tokens, parts, num_heads, head_width]`
///
/// # Panics
/// If `head_width` is not a multiple of eight, or the lengths differ from the shapes.
pub fn transform_heads(
    set: InstructionSet,
    parts: &[HeadTransform],
    [num_heads, head_width]: [usize; 2],
    transforms: &[f32],
    x: &mut [f32],
) {
    assert!(head_width.is_multiple_of(8), "a head of {head_width} channels");
    let (width, len) = (parts.len() * num_heads * head_width, transform_len(head_width));
    if width == 0 || x.is_empty() {
        return;
    }
    assert!(x.len() / width * len == transforms.len() && x.len().is_multiple_of(width), "a transform per token");
    let rows = rows_per_task(width);
    let pieces = x.par_chunks_mut(rows * width).zip(transforms.par_chunks(rows * len));
    pieces.for_each(|(x, transforms)| set.run(Rows { parts, num_heads, head_width, transforms, x }));
}

struct Rows<'a> {
    parts: &'a [HeadTransform],
    num_heads: usize,
    head_width: usize,
    transforms: &'a [f32],
    x: &'a mut [f32],
}

impl Kernel for Rows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _simd: S) {
        // Loops of a constant length compile to vector instructions.
        match self.head_width / 8 {
            4 => self.transform::<4>(),
            8 => self.transform::<8>(),
            12 => self.transform::<12>(),
            _ => self.transform::<1>(),
        }
    }
}

impl Rows<'_> {
    /// Transforms all rows, `GROUP` vectors at a time.
    #[inline(always)]
    fn transform<const GROUP: usize>(self) {
        let Self { parts, num_heads, head_width, transforms, x } = self;
        let part_len = num_heads * head_width;
        let rows = x.chunks_exact_mut(parts.len() * part_len);
        for (row, transform) in rows.zip(transforms.chunks_exact(transform_len(head_width))) {
            let (matrices, angles) = transform.split_at(32);
            let (cosines, sines) = angles.split_at(head_width / 4);
            for (part, kind) in row.chunks_exact_mut(part_len).zip(parts) {
                let matrix = matrix_of(*kind, matrices);
                for head in part.chunks_exact_mut(head_width) {
                    let (vectors, pairs) = head.split_at_mut(head_width / 2);
                    multiply::<GROUP>(&matrix, vectors);
                    rotate::<GROUP>(kind.sign(), cosines, sines, pairs);
                }
            }
        }
    }
}

/// Returns the 4 x 4 matrix of a transform, row-major.
#[inline(always)]
fn matrix_of(kind: HeadTransform, matrices: &[f32]) -> [f32; 16] {
    let matrix = if kind.is_inverse() { &matrices[16..32] } else { &matrices[..16] };
    std::array::from_fn(|i| if kind.is_transposed() { matrix[i % 4 * 4 + i / 4] } else { matrix[i] })
}

/// Multiplies 4-vectors by a matrix; `x` holds their first coordinates, then their second and so on.
#[inline(always)]
fn multiply<const GROUP: usize>(matrix: &[f32; 16], x: &mut [f32]) {
    let count = x.len() / 4;
    for start in (0..count).step_by(GROUP) {
        let read = |j: usize| -> [f32; GROUP] { std::array::from_fn(|k| x[j * count + start + k]) };
        let vectors = [read(0), read(1), read(2), read(3)];
        for i in 0..4 {
            let mut sum = [0.0; GROUP];
            for (j, vector) in vectors.iter().enumerate() {
                for (sum, value) in sum.iter_mut().zip(vector) {
                    *sum += matrix[4 * i + j] * value;
                }
            }
            x[i * count + start..i * count + start + GROUP].copy_from_slice(&sum);
        }
    }
}

/// Rotates pairs; `x` holds their first coordinates, then their second.
#[inline(always)]
fn rotate<const GROUP: usize>(sign: f32, cosines: &[f32], sines: &[f32], x: &mut [f32]) {
    let (first, second) = x.split_at_mut(cosines.len());
    let pairs = first.chunks_exact_mut(GROUP).zip(second.chunks_exact_mut(GROUP));
    let angles = cosines.chunks_exact(GROUP).zip(sines.chunks_exact(GROUP));
    for ((first, second), (cosines, sines)) in pairs.zip(angles) {
        let a: [f32; GROUP] = std::array::from_fn(|k| first[k]);
        let b: [f32; GROUP] = std::array::from_fn(|k| second[k]);
        for k in 0..GROUP {
            let (cosine, sine) = (cosines[k], sign * sines[k]);
            first[k] = cosine * a[k] - sine * b[k];
            second[k] = sine * a[k] + cosine * b[k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    const KINDS: [HeadTransform; 4] =
        [HeadTransform::Query, HeadTransform::Key, HeadTransform::Output, HeadTransform::KeyGradient];

    /// Returns the matrix of a transform, `[E, E]`, from its definition.
    fn dense(kind: HeadTransform, head_width: usize, transform: &[f32]) -> Vec<f64> {
        let mut dense = vec![0.0; head_width * head_width];
        let (count, quarter) = (head_width / 8, head_width / 4);
        for (i, j, k) in (0..4).flat_map(|i| (0..4).flat_map(move |j| (0..count).map(move |k| (i, j, k)))) {
            let (row, column) = if kind.is_transposed() { (j, i) } else { (i, j) };
            let offset = if kind.is_inverse() { 16 } else { 0 };
            dense[(i * count + k) * head_width + j * count + k] = f64::from(transform[offset + 4 * row + column]);
        }
        for p in 0..quarter {
            let [cosine, sine] = [transform[32 + p], kind.sign() * transform[32 + quarter + p]].map(f64::from);
            let (a, b) = (head_width / 2 + p, head_width / 2 + quarter + p);
            dense[a * head_width + a] = cosine;
            dense[a * head_width + b] = -sine;
            dense[b * head_width + a] = sine;
            dense[b * head_width + b] = cosine;
        }
        dense
    }

    #[test]
    fn every_instruction_set_equals_the_dense_matrices() {
        for (num_tokens, num_heads, head_width) in
            [(1, 1, 8), (5, 3, 16), (7, 2, 32), (3, 2, 64), (2, 2, 96), (600, 1, 40)]
        {
            let width = KINDS.len() * num_heads * head_width;
            let x = random(num_tokens * width, 1);
            let transforms = random(num_tokens * transform_len(head_width), 2);
            let mut expected = vec![0.0; x.len()];
            for (i, value) in expected.iter_mut().enumerate() {
                let (token, head, row) = (i / width, i / head_width, i % head_width);
                let kind = KINDS[i % width / (num_heads * head_width)];
                let dense = dense(kind, head_width, &transforms[token * transform_len(head_width)..]);
                let head = &x[head * head_width..(head + 1) * head_width];
                let terms = head.iter().zip(&dense[row * head_width..]);
                *value = terms.map(|(&value, entry)| f64::from(value) * entry).sum();
            }
            for set in InstructionSet::available() {
                let mut got = x.clone();
                transform_heads(set, &KINDS, [num_heads, head_width], &transforms, &mut got);
                assert_close(&got, &expected, 1e-6);
            }
        }
    }
}
