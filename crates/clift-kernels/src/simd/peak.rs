//! The most that the processor computes: products that stay in registers.

use std::hint::black_box;
use std::time::Instant;

use crate::simd::dispatch::{InstructionSet, Kernel, OperandType};
use crate::simd::vector::{MATRIX_LANES, MATRIX_ROWS, Operands, Simd, Tile, has_matrix_tiles};

/// Independent sums, enough to hide the latency of a multiply-add.
const SUMS: usize = 12;
const ROUNDS: usize = 1 << 20;

/// Measures floating-point operations per second of all threads: multiply-adds of registers, two operations per value.
pub fn peak_flops(set: InstructionSet, operands: OperandType) -> f64 {
    let of_thread = || {
        let mut operations = 0.0;
        set.run_product(operands, Rounds(&mut operations));
        operations
    };
    let run = || rayon::broadcast(|_| of_thread()).into_iter().sum::<f64>();
    run();
    let started = Instant::now();
    run() / started.elapsed().as_secs_f64()
}

/// Where the number of floating-point operations is written.
struct Rounds<'a>(&'a mut f64);

impl Kernel for Rounds<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        if has_matrix_tiles::<S, O>() {
            *self.0 = matrix_rounds(simd);
            return;
        }
        let (a, b) = (black_box(simd.splat(1.0)), black_box(simd.splat(0.5)));
        let mut sums = [simd.splat(0.0); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = O::multiply_add(simd, a, b, *sum);
            }
        }
        black_box(sums);
        *self.0 = (2 * ROUNDS * SUMS * S::LANES * O::PER_LANE) as f64;
    }
}

/// Multiplies tiles whose operands stay in the L1 cache; returns the number of operations.
#[inline(always)]
fn matrix_rounds<S: Simd>(simd: S) -> f64 {
    // Operands of 32 KB: most of the time goes to products, not to the sums.
    const INNER: usize = 16 * MATRIX_LANES;
    let (a, mut c) = (vec![0.0; MATRIX_ROWS * INNER], vec![0.0; MATRIX_ROWS * MATRIX_ROWS]);
    let (rows, accumulate) = (MATRIX_ROWS, true);
    for _ in 0..ROUNDS / INNER {
        let (a, c) = (black_box(a.as_ptr()), c.as_mut_ptr());
        // B has the size of A.
        let tile = Tile { inner: INNER, a, a_row: INNER, a_step: 1, b: a, b_step: rows, c, c_row: rows, accumulate };
        // SAFETY: both slices have the sizes of the tile.
        unsafe { simd.multiply_tile(tile) };
    }
    black_box(c);
    (ROUNDS / INNER * 2 * 2 * MATRIX_ROWS * MATRIX_ROWS * INNER) as f64
}
