//! Transforms of the heads of tokens by their cameras and patch positions (camera-relative attention).
// N tokens, H heads, E width of a head

use rayon::prelude::*;

use crate::primitives::partition::rows_per_task;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Operands, Simd};

/// The transform `rho` of a token is block-diagonal. On the first half of a head it is the 4 x 4 matrix `g` of the token's
/// camera: channel `j * E / 8 + k` is coordinate `j` of vector `k`. On the second half it rotates channels `E / 2 + p` and
/// `3 E / 4 + p` by the angle `p` of the token's patch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeadTransform {
    /// Whether the transform uses the inverse of `g`.
    pub inverse: bool,
    /// Whether the transform uses the transpose of `g` or of its inverse.
    pub transposed: bool,
}

impl HeadTransform {
    /// `rho^T`, of queries.
    pub const QUERY: Self = Self { inverse: false, transposed: true };
    /// `rho^-1`, of keys and values.
    pub const KEY: Self = Self { inverse: true, transposed: false };
    /// `rho`, of the output of attention.
    pub const OUTPUT: Self = Self { inverse: false, transposed: false };

    /// Returns the transposed transform, which maps the gradient of the result to the gradient of the input.
    #[must_use]
    pub const fn of_gradient(self) -> Self {
        Self { transposed: !self.transposed, ..self }
    }

    /// Returns the sign of the angles of patches: the inverse of a rotation is its transpose.
    pub const fn sign(self) -> f32 {
        if self.inverse == self.transposed { 1.0 } else { -1.0 }
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
/// - `transforms`: `[num_tokens, transform_len(head_width)]`, `head_width` a multiple of eight
/// - `x`: `[num_tokens, parts, num_heads, head_width]`
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
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, _simd: S) {
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
    /// Transforms all rows, `GROUP` channels at a time.
    #[inline(always)]
    fn transform<const GROUP: usize>(self) {
        let Self { parts, num_heads, head_width, transforms, x } = self;
        let part_len = num_heads * head_width;
        let rows = x.chunks_exact_mut(parts.len() * part_len);
        for (row, transform) in rows.zip(transforms.chunks_exact(transform_len(head_width))) {
            let (matrices, angles) = transform.split_at(32);
            let (cosines, sines) = angles.split_at(head_width / 4);
            let [(cosines, _), (sines, _)] = [cosines.as_chunks(), sines.as_chunks()];
            for (part, kind) in row.chunks_exact_mut(part_len).zip(parts) {
                let matrix = matrix_of(*kind, matrices);
                for head in part.chunks_exact_mut(head_width) {
                    let (groups, _) = head.as_chunks_mut::<GROUP>();
                    let (vectors, pairs) = groups.split_at_mut(groups.len() / 2);
                    multiply(&matrix, vectors);
                    rotate(kind.sign(), cosines, sines, pairs);
                }
            }
        }
    }
}

/// Returns the 4 x 4 matrix of a transform, row-major.
#[inline(always)]
fn matrix_of(kind: HeadTransform, matrices: &[f32]) -> [f32; 16] {
    let matrix = if kind.inverse { &matrices[16..32] } else { &matrices[..16] };
    std::array::from_fn(|i| if kind.transposed { matrix[i % 4 * 4 + i / 4] } else { matrix[i] })
}

/// Multiplies 4-vectors by a matrix; `x` holds their first coordinates, then their second and so on.
#[inline(always)]
fn multiply<const GROUP: usize>(matrix: &[f32; 16], x: &mut [[f32; GROUP]]) {
    let count = x.len() / 4;
    for group in 0..count {
        let vectors: [[f32; GROUP]; 4] = std::array::from_fn(|j| x[j * count + group]);
        for i in 0..4 {
            let mut sum = [0.0; GROUP];
            for (j, vector) in vectors.iter().enumerate() {
                for (sum, value) in sum.iter_mut().zip(vector) {
                    *sum += matrix[4 * i + j] * value;
                }
            }
            x[i * count + group] = sum;
        }
    }
}

/// Rotates pairs; `x` holds their first coordinates, then their second.
#[inline(always)]
fn rotate<const GROUP: usize>(sign: f32, cosines: &[[f32; GROUP]], sines: &[[f32; GROUP]], x: &mut [[f32; GROUP]]) {
    let (first, second) = x.split_at_mut(cosines.len());
    for ((first, second), (cosines, sines)) in first.iter_mut().zip(second).zip(cosines.iter().zip(sines)) {
        let (a, b) = (*first, *second);
        for k in 0..GROUP {
            let (cosine, sine) = (cosines[k], sign * sines[k]);
            first[k] = cosine * a[k] - sine * b[k];
            second[k] = sine * a[k] + cosine * b[k];
        }
    }
}
