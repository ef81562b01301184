//! Linear layers, `y = x W + b`, and their gradients, on the `gemm` crate.
// N rows, I inputs, O outputs

use gemm::Parallelism;
use rayon::prelude::*;

use crate::elementwise::PIECE;

/// A matrix inside a slice, from the slice's first value on.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    /// The values.
    pub values: &'a [f32],
    /// Distance of two rows.
    pub row_stride: usize,
    /// Distance of two columns.
    pub column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// A matrix whose rows follow each other.
    pub fn contiguous(values: &'a [f32], columns: usize) -> Self {
        Self { values, row_stride: columns, column_stride: 1 }
    }

    /// The same with rows and columns exchanged.
    #[must_use]
    pub fn transposed(self) -> Self {
        Self { row_stride: self.column_stride, column_stride: self.row_stride, ..self }
    }

    fn holds(&self, rows: usize, columns: usize) -> bool {
        rows == 0
            || columns == 0
            || (rows - 1) * self.row_stride + (columns - 1) * self.column_stride < self.values.len()
    }
}

/// `output[N, O] = x[N, I] weight[I, O] + bias`.
pub fn forward(
    [rows, inputs, outputs]: [usize; 3],
    x: Matrix<'_>,
    weight: Matrix<'_>,
    bias: Option<&[f32]>,
    output: &mut [f32],
) {
    if let Some(bias) = bias {
        assert_eq!(bias.len(), outputs, "a value of bias for every output");
        let piece = PIECE.div_ceil(outputs.max(1)) * outputs.max(1);
        output.par_chunks_mut(piece).for_each(|piece| {
            piece.chunks_exact_mut(outputs).for_each(|row| row.copy_from_slice(bias));
        });
    }
    multiply([rows, inputs, outputs], x, weight, output, bias.is_some());
}

/// `to[M, N] = a[M, K] b[K, N]`, or added to what is there; `to` is contiguous.
pub fn multiply([m, k, n]: [usize; 3], a: Matrix<'_>, b: Matrix<'_>, to: &mut [f32], accumulate: bool) {
    /// Below so many products threads cost more than they bring.
    const PARALLEL: usize = 1 << 20;
    assert!(a.holds(m, k), "the left factor has its values");
    assert!(b.holds(k, n), "the right factor has its values");
    assert_eq!(to.len(), m * n, "the product has its place");
    let parallelism = if m * k * n < PARALLEL { Parallelism::None } else { Parallelism::Rayon(0) };
    // SAFETY: the assertions above cover every address; `to` is the only mutable slice.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            to.as_mut_ptr(),
            1,
            n as isize,
            accumulate,
            a.values.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.values.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    #[test]
    fn products_equal_f64_with_any_strides() {
        for [m, k, n] in [[1, 1, 1], [3, 5, 7], [70, 33, 129], [1, 768, 5]] {
            let (a, b, bias) = (random(m * k, 1), random(k * n, 2), random(n, 3));
            let expected: Vec<f64> = (0..m * n)
                .map(|i| {
                    let (row, column) = (i / n, i % n);
                    let product = |j: usize| f64::from(a[row * k + j]) * f64::from(b[j * n + column]);
                    f64::from(bias[column]) + (0..k).map(product).sum::<f64>()
                })
                .collect();
            let mut output = vec![f32::NAN; m * n];
            forward([m, k, n], Matrix::contiguous(&a, k), Matrix::contiguous(&b, n), Some(&bias), &mut output);
            assert_close(&output, &expected, 1e-5);
            let columns: Vec<f32> = (0..n * k).map(|i| b[i % k * n + i / k]).collect();
            let right = Matrix::contiguous(&columns, k).transposed();
            forward([m, k, n], Matrix::contiguous(&a, k), right, Some(&bias), &mut output);
            assert_close(&output, &expected, 1e-5);
        }
    }
}
