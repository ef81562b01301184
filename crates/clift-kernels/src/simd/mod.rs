//! One trait for vectors, four instruction sets.
//!
//! - `vector`: Simd trait and its register tile
//! - `portable`: plain Rust vectors
//! - `avx2`: AVX2 and FMA vectors
//! - `avx512`: AVX-512 vectors
//! - `dispatch`: choose the instruction set, run a kernel

#[cfg(target_arch = "x86_64")]
pub(crate) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(crate) mod avx512;
pub(crate) mod dispatch;
pub(crate) mod portable;
pub(crate) mod vector;
