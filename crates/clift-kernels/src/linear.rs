//! Linear layers, `y = x W + b`, on the `gemm` crate, and the gradient of the bias.
// N rows, I inputs, O outputs

use gemm::Parallelism;
use rayon::prelude::*;

use crate::primitives::partition::{add, rows_per_sum, rows_per_task};
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Operands, Simd};

/// Fewest multiply-accumulates that are divided among threads.
const PARALLEL: usize = 1 << 20;

/// Computes `output[N, O] = x[N, I] weight[I, O] + bias[O]`, all contiguous.
pub fn linear_forward([rows, inputs, outputs]: [usize; 3], [x, weight, bias]: [&[f32]; 3], output: &mut [f32]) {
    assert_eq!(x.len(), rows * inputs, "x is [rows, inputs]");
    assert_eq!(weight.len(), inputs * outputs, "weight is [inputs, outputs]");
    assert_eq!(bias.len(), outputs, "bias is [outputs]");
    assert_eq!(output.len(), rows * outputs, "output is [rows, outputs]");
    if output.is_empty() {
        return;
    }
    output.par_chunks_mut(rows_per_task(outputs) * outputs).for_each(|piece| {
        piece.chunks_exact_mut(outputs).for_each(|row| row.copy_from_slice(bias));
    });
    let parallelism = if rows * inputs * outputs < PARALLEL { Parallelism::None } else { Parallelism::Rayon(0) };
    // SAFETY: the assertions above cover every address; `output` is the only mutable slice.
    unsafe {
        gemm::gemm(
            rows,
            outputs,
            inputs,
            output.as_mut_ptr(),
            1,
            outputs as isize,
            true, // adds to the bias
            x.as_ptr(),
            1,
            inputs as isize,
            weight.as_ptr(),
            1,
            outputs as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// Sums the columns of `x`, `to[c] = sum over rows of x[.., c]`: the gradient of a bias.
pub fn sum_rows(set: InstructionSet, x: &[f32], to: &mut [f32]) {
    let dim = to.len();
    let count = x.len() / dim;
    assert!(dim > 0 && x.len() == count * dim, "x has whole rows");
    let rows = rows_per_sum(count, dim);
    let mut sums = vec![0.0; count.div_ceil(rows) * dim];
    x.par_chunks(rows * dim).zip(sums.par_chunks_mut(dim)).for_each(|(x, to)| set.run(SumRows { x, to }));
    to.fill(0.0);
    sums.chunks_exact(dim).for_each(|sums| add(sums, to));
}

struct SumRows<'a> {
    x: &'a [f32],
    to: &'a mut [f32],
}

impl Kernel for SumRows<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        for x in self.x.chunks_exact(self.to.len()) {
            for (x, to) in x.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
                simd.write(to, simd.add(simd.read(to), simd.read(x)));
            }
        }
    }
}
