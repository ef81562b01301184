//! CPU kernels of clift: slices in, slices out, without Burn.
//!
//! Each kernel is written once over `simd::Simd` and compiled for every [`InstructionSet`]; the one
//! to use is chosen at run time. Work is split by shape and never by the number of threads, so a
//! result does not depend on how many there are.
//!
//! All values are f32: other types take the composed operations of `clift-model`.

#![expect(clippy::inline_always, reason = "only what is inlined into a kernel is compiled with its instructions")]

pub mod attention;
pub mod cluster_attention;
mod disjoint;
mod elementwise;
pub mod gelu;
mod instruction_set;
pub mod layer_norm;
pub mod linear;
mod matmul;
mod scratch;
mod simd;
#[cfg(test)]
mod testing;

pub use instruction_set::{BadInstructionSet, InstructionSet};
