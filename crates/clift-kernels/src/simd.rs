//! Vectors of f32 of one instruction set, behind one trait.
//!
//! A value of a type that implements [`Simd`] is the proof that the processor has its instructions,
//! which makes the arithmetic safe to call. Everything that is generic over [`Simd`] must be
//! `#[inline(always)]`: only code inlined into `InstructionSet::run` is compiled with the instructions.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub use avx512::Avx512;
pub use portable::Portable;

use crate::matmul::Tile;

/// Arithmetic on vectors of [`Simd::LANES`] values.
pub trait Simd: Copy + Send + Sync + 'static {
    /// Values in a vector.
    const LANES: usize;
    /// Rows of the register tile of a matrix product.
    const TILE_ROWS: usize;
    /// Vectors side by side in the register tile of a matrix product.
    const TILE_VECTORS: usize;
    /// A vector.
    type V: Copy;

    /// The same value in every lane.
    fn splat(self, value: f32) -> Self::V;
    /// Reads [`Simd::LANES`] values.
    ///
    /// # Safety
    /// They must be readable at `from`.
    unsafe fn load(self, from: *const f32) -> Self::V;
    /// Writes [`Simd::LANES`] values.
    ///
    /// # Safety
    /// They must be writable at `to`.
    unsafe fn store(self, to: *mut f32, value: Self::V);
    /// `a + b`
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a - b`
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b`
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a / b`
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, in one rounding where the processor can.
    fn mul_add(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The larger value; `b` where one of the two is NaN.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// The smaller value; `b` where one of the two is NaN.
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    /// `yes` where `condition` is less than zero, `no` elsewhere.
    fn select_negative(self, condition: Self::V, yes: Self::V, no: Self::V) -> Self::V;
    /// The nearest integer, ties to even.
    fn round(self, a: Self::V) -> Self::V;
    /// `a * 2^n` for integers `n` in `-126..=127`; zero or as it should be for -127.
    fn scale_by_power(self, a: Self::V, n: Self::V) -> Self::V;
    /// The sum of all lanes.
    fn sum(self, a: Self::V) -> f32;
    /// The largest lane.
    fn largest(self, a: Self::V) -> f32;
    /// The full register tile of a matrix product: [`Simd::TILE_ROWS`] rows of
    /// [`Simd::TILE_VECTORS`] vectors.
    ///
    /// # Safety
    /// As [`Tile::run`].
    unsafe fn full_tile(self, tile: Tile);

    /// Reads a full vector from the front of a slice, or what there is and zeros.
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

    /// Writes a full vector to the front of a slice, or as much of it as fits.
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

    /// `2^a`, to 2e-7. Below `2^-126` it is no more than that, and not always zero; at most `2^127`. NaN stays NaN.
    #[inline(always)]
    fn exp2(self, a: Self::V) -> Self::V {
        // Coefficients of Cephes' exp2f.
        const COEFFICIENTS: [f32; 6] =
            [1.535_336_2e-4, 1.339_887_5e-3, 9.618_437e-3, 5.550_332_5e-2, 2.402_264_8e-1, std::f32::consts::LN_2];
        let bounded = self.min(self.splat(127.0), self.max(self.splat(-127.0), a));
        let whole = self.round(bounded);
        let rest = self.sub(bounded, whole);
        let mut power = self.splat(COEFFICIENTS[0]);
        for coefficient in &COEFFICIENTS[1..] {
            power = self.mul_add(power, rest, self.splat(*coefficient));
        }
        power = self.mul_add(power, rest, self.splat(1.0));
        self.scale_by_power(power, whole)
    }
}

/// The longest vector of any instruction set.
pub(crate) const MAX_LANES: usize = 16;
