//! Linear layers, `y = x W + b`, on the `gemm` crate.
// N rows, I inputs, O outputs

use gemm::Parallelism;
use rayon::prelude::*;

use crate::primitives::elementwise::PIECE;

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
    output.par_chunks_mut(PIECE.div_ceil(outputs) * outputs).for_each(|piece| {
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
}
