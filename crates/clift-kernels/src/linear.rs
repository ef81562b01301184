//! Linear layers, `y = x W + b`, on the `gemm` crate, and the gradient of the bias.
// N rows, I inputs, O outputs

use gemm::Parallelism;
use rayon::prelude::*;

use crate::primitives::partition::{add, rows_per_sum, rows_per_task};
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

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
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        for x in self.x.chunks_exact(self.to.len()) {
            for (x, to) in x.chunks(S::LANES).zip(self.to.chunks_mut(S::LANES)) {
                simd.write(to, simd.add(simd.read(to), simd.read(x)));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    #[test]
    fn results_equal_f64() {
        for [rows, inputs, outputs] in [[1, 1, 1], [3, 5, 7], [70, 33, 129], [1, 768, 5], [130, 96, 90]] {
            let (x, weight, bias) = (random(rows * inputs, 1), random(inputs * outputs, 2), random(outputs, 3));
            let expected: Vec<f64> = (0..rows * outputs)
                .map(|i| {
                    let (row, column) = (i / outputs, i % outputs);
                    let product = |j: usize| f64::from(x[row * inputs + j]) * f64::from(weight[j * outputs + column]);
                    f64::from(bias[column]) + (0..inputs).map(product).sum::<f64>()
                })
                .collect();
            let mut output = vec![f32::NAN; rows * outputs];
            linear_forward([rows, inputs, outputs], [&x, &weight, &bias], &mut output);
            assert_close(&output, &expected, 1e-5);
        }
    }

    #[test]
    fn every_instruction_set_sums_rows_as_f64() {
        for [rows, dim] in [[1, 5], [3, 12], [777, 37], [500, 96], [65, 768]] {
            let x = random(rows * dim, 4);
            let column = |c: usize| x.iter().skip(c).step_by(dim).map(|&value| f64::from(value)).sum();
            let expected: Vec<f64> = (0..dim).map(column).collect();
            for set in InstructionSet::available() {
                let mut sums = vec![f32::NAN; dim];
                sum_rows(set, &x, &mut sums);
                assert_close(&sums, &expected, 1e-5);
            }
        }
    }
}
