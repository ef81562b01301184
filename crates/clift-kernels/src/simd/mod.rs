//! Vectors of f32: one trait, one implementation per instruction set.
//!
//! - `vector`: the trait `Simd` and the register tile of matrix products
//! - `portable`: vectors in plain Rust
//! - `avx2`: AVX2 and FMA
//! - `avx512`: AVX-512, with and without bf16
//! - `amx`: products of tiles of bf16 values
//! - `peak`: the most that the processor computes
//! - `dispatch`: the choice of the instruction set, and running a kernel with it

#[cfg(target_arch = "x86_64")]
pub(crate) mod amx;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod dispatch;
pub(crate) mod peak;
pub(crate) mod portable;
pub(crate) mod vector;
