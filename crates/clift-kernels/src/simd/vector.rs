//! The trait [`Simd`] and the register tile of matrix products.
//!
//! A value of a type that implements [`Simd`] proves that the processor has the instructions, which makes the arithmetic
//! safe to call. Functions that are generic over [`Simd`] must be `#[inline(always)]`: only code inlined into
//! `InstructionSet::run` is compiled with the instructions.

use half::bf16;

/// Arithmetic on vectors of [`Simd::LANES`] values.
pub trait Simd: Copy + Send + Sync + 'static {
    const LANES: usize;
    /// Rows of the register tile of a matrix product.
    const TILE_ROWS: usize;
    /// Vectors side by side in the register tile of a matrix product.
    const TILE_VECTORS: usize;
    /// Whether products of bf16 values are computed by [`Simd::multiply_tile`].
    const HAS_MATRIX_TILES: bool = false;
    type V: Copy;

    fn splat(self, value: f32) -> Self::V;
    /// Reads [`Simd::LANES`] values, which must be readable.
    unsafe fn load(self, from: *const f32) -> Self::V;
    /// Writes [`Simd::LANES`] values, which must be writable.
    unsafe fn store(self, to: *mut f32, value: Self::V);
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, with a single rounding if the processor has FMA.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The larger value; `b` where one of the two is NaN.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// The smaller value; `b` where one of the two is NaN.
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    /// `yes` where `condition` is less than zero, `no` elsewhere.
    fn select_negative(self, condition: Self::V, yes: Self::V, no: Self::V) -> Self::V;
    /// The nearest integer, ties to even.
    fn round(self, a: Self::V) -> Self::V;
    /// `a * 2^n` for integers `n` in `-126..=127`; for -127 zero or the exact result.
    fn scale_by_power(self, a: Self::V, n: Self::V) -> Self::V;
    fn sum(self, a: Self::V) -> f32;
    fn largest(self, a: Self::V) -> f32;

    /// Rounds both vectors to bf16 and returns pairs: in every lane the value of `first` in the lower half of the bits,
    /// that of `second` in the upper half.
    #[inline(always)]
    fn pairs(self, first: Self::V, second: Self::V) -> Self::V {
        emulated_pairs(self, first, second)
    }

    /// Rounds the lanes of `first`, then those of `second`, to bf16 and returns them as pairs of neighbours.
    #[inline(always)]
    fn pairs_of_neighbours(self, first: Self::V, second: Self::V) -> Self::V {
        emulated_pairs_of_neighbours(self, first, second)
    }

    /// Adds the products of the two values of every pair to `sum`.
    #[inline(always)]
    fn dot_pairs(self, a: Self::V, b: Self::V, sum: Self::V) -> Self::V {
        emulated_dot_pairs(self, a, b, sum)
    }

    /// Runs a tile of pairs with [`MATRIX_ROWS`] rows and as many columns, as [`Tile::run`]. The inner dimension is a multiple
    /// of [`MATRIX_LANES`], the step of A is 1.
    ///
    /// # Safety
    /// That of [`Tile::run`].
    #[inline(always)]
    unsafe fn multiply_tile(self, _tile: Tile) {
        unreachable!("only with matrix tiles");
    }

    /// Transposes a matrix of [`Simd::LANES`] vectors, the first of the array.
    #[inline(always)]
    fn transpose(self, rows: &mut [Self::V; MAX_LANES]) {
        let values = rows.map(|row| array(self, row));
        for (i, row) in rows.iter_mut().enumerate().take(Self::LANES) {
            *row = self.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| values[lane][i]));
        }
    }

    /// Reads a vector from the start of a slice; missing values are zero.
    #[inline(always)]
    fn read(self, from: &[f32]) -> Self::V {
        if from.len() >= Self::LANES {
            // SAFETY: the slice is long enough.
            return unsafe { self.load(from.as_ptr()) };
        }
        let mut padded = [0.0; MAX_LANES];
        padded[..from.len()].copy_from_slice(from);
        // SAFETY: no vector is longer than the array.
        unsafe { self.load(padded.as_ptr()) }
    }

    /// Writes a vector to the start of a slice; values beyond its end are dropped.
    #[inline(always)]
    fn write(self, to: &mut [f32], value: Self::V) {
        if to.len() >= Self::LANES {
            // SAFETY: the slice is long enough.
            return unsafe { self.store(to.as_mut_ptr(), value) };
        }
        let mut padded = [0.0; MAX_LANES];
        // SAFETY: no vector is longer than the array.
        unsafe { self.store(padded.as_mut_ptr(), value) };
        let count = to.len();
        to.copy_from_slice(&padded[..count]);
    }
}

/// Returns the sum of the products of two rows.
#[inline(always)]
pub(crate) fn dot<S: Simd>(simd: S, a: &[f32], b: &[f32]) -> f32 {
    let mut total = simd.splat(0.0);
    for (a, b) in a.chunks(S::LANES).zip(b.chunks(S::LANES)) {
        total = simd.mul_add(simd.read(a), simd.read(b), total);
    }
    simd.sum(total)
}

/// `2^a` by a polynomial of the distance to the nearest integer, highest power first. Results below `2^-126` are between zero
/// and that value, results above `2^127` become `2^127`. NaN stays NaN.
#[inline(always)]
fn exp2_by<S: Simd, const COUNT: usize>(simd: S, a: S::V, coefficients: [f32; COUNT]) -> S::V {
    let bounded = simd.min(simd.splat(127.0), simd.max(simd.splat(-127.0), a));
    let whole = simd.round(bounded);
    let rest = simd.sub(bounded, whole);
    let mut power = simd.splat(coefficients[0]);
    for coefficient in &coefficients[1..] {
        power = simd.mul_add(power, rest, simd.splat(*coefficient));
    }
    simd.scale_by_power(power, whole)
}

pub(crate) const MAX_LANES: usize = 16;
/// Rows and columns of a matrix tile.
pub(crate) const MATRIX_ROWS: usize = 32;
/// The inner dimension of a matrix tile is a multiple of this number of lanes.
pub(crate) const MATRIX_LANES: usize = 16;

// Without instructions for bf16: slow, references for tests.

#[inline(always)]
pub(crate) fn emulated_pairs<S: Simd>(simd: S, first: S::V, second: S::V) -> S::V {
    let (first, second) = (array(simd, first), array(simd, second));
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| pair(first[lane], second[lane])))
}

#[inline(always)]
pub(crate) fn emulated_pairs_of_neighbours<S: Simd>(simd: S, first: S::V, second: S::V) -> S::V {
    let mut values = [0.0; 2 * MAX_LANES];
    values[..S::LANES].copy_from_slice(&array(simd, first)[..S::LANES]);
    values[S::LANES..2 * S::LANES].copy_from_slice(&array(simd, second)[..S::LANES]);
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| pair(values[2 * lane], values[2 * lane + 1])))
}

#[inline(always)]
pub(crate) fn emulated_dot_pairs<S: Simd>(simd: S, a: S::V, b: S::V, sum: S::V) -> S::V {
    let (a, b, sum) = (array(simd, a), array(simd, b), array(simd, sum));
    simd.read(&std::array::from_fn::<_, MAX_LANES, _>(|lane| {
        let ([a_first, a_second], [b_first, b_second]) = (values(a[lane]), values(b[lane]));
        sum[lane] + a_first * b_first + a_second * b_second
    }))
}

/// Rounds two values to bf16, ties to even, and packs their bits.
fn pair(first: f32, second: f32) -> f32 {
    let bits = |value| u32::from(bf16::from_f32(value).to_bits());
    f32::from_bits(bits(first) | bits(second) << 16)
}

fn values(pair: f32) -> [f32; 2] {
    [f32::from_bits(pair.to_bits() << 16), f32::from_bits(pair.to_bits() & 0xFFFF_0000)]
}

#[inline(always)]
fn array<S: Simd>(simd: S, vector: S::V) -> [f32; MAX_LANES] {
    let mut array = [0.0; MAX_LANES];
    // SAFETY: no vector is longer than the array.
    unsafe { simd.store(array.as_mut_ptr(), vector) };
    array
}

/// Whether products of these operands run on matrix tiles.
#[inline(always)]
pub(crate) fn has_matrix_tiles<S: Simd, O: Operands>() -> bool {
    S::HAS_MATRIX_TILES && O::PER_LANE == 2
}

/// Values in the lanes of the operands of a matrix product.
pub trait Operands: Copy + Send + Sync + 'static {
    /// Values per lane, neighbours along the inner dimension.
    const PER_LANE: usize;

    fn multiply_add<S: Simd>(simd: S, a: S::V, b: S::V, sum: S::V) -> S::V;
    /// `2^a` with an error far below that of an operand.
    fn exp2<S: Simd>(simd: S, a: S::V) -> S::V;
    /// Reads lanes `lane..` of a row along the inner dimension; missing values are zero.
    fn along<S: Simd>(simd: S, row: &[f32], lane: usize) -> S::V;
    /// Reads columns `column..` of one lane: of the next [`Operands::PER_LANE`] rows, which lie across the inner dimension.
    /// Missing values are zero.
    fn across<S: Simd>(simd: S, rows: [&[f32]; 2], column: usize) -> S::V;
}

/// A value of f32 in every lane.
#[derive(Clone, Copy, Debug)]
pub struct F32;

impl Operands for F32 {
    const PER_LANE: usize = 1;

    #[inline(always)]
    fn multiply_add<S: Simd>(simd: S, a: S::V, b: S::V, sum: S::V) -> S::V {
        simd.mul_add(a, b, sum)
    }
    #[inline(always)]
    fn exp2<S: Simd>(simd: S, a: S::V) -> S::V {
        // Coefficients of exp2f in Cephes: a relative error of 2e-7.
        const COEFFICIENTS: [f32; 7] =
            [1.535_336_2e-4, 1.339_887_5e-3, 9.618_437e-3, 5.550_332_5e-2, 2.402_264_8e-1, std::f32::consts::LN_2, 1.0];
        exp2_by(simd, a, COEFFICIENTS)
    }
    #[inline(always)]
    fn along<S: Simd>(simd: S, row: &[f32], lane: usize) -> S::V {
        simd.read(from(row, lane))
    }
    #[inline(always)]
    fn across<S: Simd>(simd: S, [row, _]: [&[f32]; 2], column: usize) -> S::V {
        simd.read(from(row, column))
    }
}

/// A pair of bf16 values in every lane, see [`Simd::pairs`].
#[derive(Clone, Copy, Debug)]
pub struct Bf16;

impl Operands for Bf16 {
    const PER_LANE: usize = 2;

    #[inline(always)]
    fn multiply_add<S: Simd>(simd: S, a: S::V, b: S::V, sum: S::V) -> S::V {
        simd.dot_pairs(a, b, sum)
    }
    #[inline(always)]
    fn exp2<S: Simd>(simd: S, a: S::V) -> S::V {
        // The cubic with the least largest relative error in -0.5..=0.5: 1e-4, exact for integers.
        exp2_by(simd, a, [0.055_008_93, 0.242_210_96, 0.693_282_9, 1.0])
    }
    #[inline(always)]
    fn along<S: Simd>(simd: S, row: &[f32], lane: usize) -> S::V {
        let [first, second] = [2 * lane, 2 * lane + S::LANES].map(|start| from(row, start));
        simd.pairs_of_neighbours(simd.read(first), simd.read(second))
    }
    #[inline(always)]
    fn across<S: Simd>(simd: S, rows: [&[f32]; 2], column: usize) -> S::V {
        let [first, second] = rows.map(|row| from(row, column));
        simd.pairs(simd.read(first), simd.read(second))
    }
}

#[inline(always)]
fn from(values: &[f32], start: usize) -> &[f32] {
    values.get(start..).unwrap_or_default()
}

/// A register tile: `C[M, N] = A[M, K] B[K, N]`, or `C += A B` if `accumulate`.
#[derive(Clone, Copy, Debug)]
pub struct Tile {
    /// Lanes along the inner dimension.
    pub inner: usize,
    /// First value of A.
    pub a: *const f32,
    /// Values from one row of A to the next.
    pub a_row: usize,
    /// Values from one column of A to the next.
    pub a_step: usize,
    /// First value of B; columns are contiguous.
    pub b: *const f32,
    /// Values from one row of B to the next.
    pub b_step: usize,
    /// First value of C; columns are contiguous.
    pub c: *mut f32,
    /// Values from one row of C to the next.
    pub c_row: usize,
    pub accumulate: bool,
}

impl Tile {
    /// Computes `ROWS` rows of `VECTORS` vectors, all in registers; returns `ROWS`.
    ///
    /// # Safety
    /// All values of A, B and C in the range of the sizes must be readable, those of C writable.
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "both loops unroll over constants")]
    pub unsafe fn run<S: Simd, O: Operands, const ROWS: usize, const VECTORS: usize>(self, simd: S) -> usize {
        let Self { inner, a, a_row, a_step, b, b_step, c, c_row, accumulate } = self;
        // SAFETY: the caller's promise covers every address below.
        unsafe {
            let mut sum = [[simd.splat(0.0); VECTORS]; ROWS];
            for k in 0..inner {
                let mut row_of_b = [simd.splat(0.0); VECTORS];
                for v in 0..VECTORS {
                    row_of_b[v] = simd.load(b.add(k * b_step + v * S::LANES));
                }
                for r in 0..ROWS {
                    let value = simd.splat(*a.add(r * a_row + k * a_step));
                    for v in 0..VECTORS {
                        sum[r][v] = O::multiply_add(simd, value, row_of_b[v], sum[r][v]);
                    }
                }
            }
            for r in 0..ROWS {
                for v in 0..VECTORS {
                    let place = c.add(r * c_row + v * S::LANES);
                    let value = if accumulate { simd.add(simd.load(place), sum[r][v]) } else { sum[r][v] };
                    simd.store(place, value);
                }
            }
        }
        ROWS
    }
}

/// Implements methods `fn name(self, a, b)` of [`Simd`] by intrinsics.
#[cfg(target_arch = "x86_64")]
macro_rules! binary_intrinsics {
    ($($name:ident = $intrinsic:ident),* $(,)?) => {$(
        #[inline(always)]
        fn $name(self, a: Self::V, b: Self::V) -> Self::V {
            unsafe { $intrinsic(a, b) }
        }
    )*};
}
#[cfg(target_arch = "x86_64")]
pub(crate) use binary_intrinsics;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::dispatch::{InstructionSet, Kernel, OperandType};

    struct Exponentials<'a>(&'a mut [f32]);

    impl Kernel for Exponentials<'_> {
        #[inline(always)]
        fn run<S: Simd, O: Operands>(self, simd: S) {
            for values in self.0.chunks_mut(S::LANES) {
                simd.write(values, O::exp2(simd, simd.read(values)));
            }
        }
    }

    #[test]
    fn exponentials_equal_f64() {
        let inputs: Vec<f32> = (-120_000..120_000).map(|i| i as f32 * 1e-3).collect();
        for set in InstructionSet::available() {
            for (operands, tolerance) in [(OperandType::F32, 2e-7), (OperandType::Bf16, 1.1e-4)] {
                let mut outputs = inputs.clone();
                set.run_product(operands, Exponentials(&mut outputs));
                for (&x, &found) in inputs.iter().zip(&outputs) {
                    let error = (f64::from(found) / f64::from(x).exp2() - 1.0).abs();
                    assert!(error <= tolerance, "{}, {operands:?}: 2^{x} is {found:e}, off by {error:e}", set.name());
                    assert!(x.fract() != 0.0 || error < 1e-7, "2^{x} is {found:e}");
                }
            }
        }
    }
}
