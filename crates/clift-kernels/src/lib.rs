//! CPU kernels of clift: slices in, slices out, without Burn.
//!
//! Each kernel is written once over `simd::Simd` and compiled for every [`InstructionSet`]; the one
//! to use is chosen at run time. Work is split by shape and never by the number of threads, so a
//! result does not depend on how many there are.
//!
//! All values are f32: other types take the composed operations of `clift-model`.

#![expect(clippy::inline_always, reason = "only what is inlined into a kernel is compiled with its instructions")]

mod attention;
mod cluster_attention;
mod gelu;
mod layer_norm;
mod linear;
mod primitives;
mod simd;
#[cfg(test)]
mod testing;

pub use attention::backward::{BackwardInputs, backward as attention_backward};
pub use attention::forward::forward as attention_forward;
pub use attention::shapes::{Gradients, Sizes, StridedRows};
pub use cluster_attention::{Segments, backward as cluster_attention_backward, forward as cluster_attention_forward};
pub use gelu::{backward as gelu_backward, forward as gelu_forward};
pub use layer_norm::{backward as layer_norm_backward, forward as layer_norm_forward, sum_rows};
pub use linear::forward as linear_forward;
pub use simd::dispatch::{InstructionSet, InstructionSetError};
