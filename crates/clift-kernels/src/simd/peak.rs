//! The most that the processor computes: products that stay in registers.

use std::hint::black_box;
use std::time::Instant;

use crate::simd::dispatch::{InstructionSet, OperandType, ProductKernel};
use crate::simd::vector::{Operands, Simd};

/// Independent sums, enough to hide the latency of a multiply-add.
const SUMS: usize = 12;
const ROUNDS: usize = 1 << 20;

/// Measures floating-point operations per second of all threads: multiply-adds of registers, two operations per value.
pub fn peak_flops(set: InstructionSet, operands: OperandType) -> f64 {
    let run = || rayon::broadcast(|_| set.run_product(operands, Rounds)).into_iter().sum::<f64>();
    run();
    let started = Instant::now();
    run() / started.elapsed().as_secs_f64()
}

struct Rounds;

impl ProductKernel for Rounds {
    /// Floating-point operations.
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) -> f64 {
        let (a, b) = (black_box(simd.splat(1.0)), black_box(simd.splat(0.5)));
        let mut sums = [simd.splat(0.0); SUMS];
        for _ in 0..ROUNDS {
            for sum in &mut sums {
                *sum = O::multiply_add(simd, a, b, *sum);
            }
        }
        black_box(sums);
        (2 * ROUNDS * SUMS * S::LANES * O::PER_LANE) as f64
    }
}
