//! CPU kernels of clift on f32 slices, forward and backward, without Burn.
//!
//! Every kernel is written once and compiled for every [`InstructionSet`]; the widest of the processor runs. Sums are
//! divided by shape alone, so that results do not depend on the number of threads. Tensors of other types than f32 take
//! the composed operations of `clift-model`.

#![expect(clippy::inline_always, reason = "only code inlined into a kernel is compiled with the kernel's instructions")]

mod attention;
mod bf16_values;
mod cluster_attention;
mod gelu;
mod head_transform;
mod layer_norm;
mod linear;
mod matmul_bf16;
mod primitives;
mod rms_norm;
mod simd;
#[cfg(test)]
mod testing;

// Choice of the instruction set
pub use simd::dispatch::{InstructionSet, OperandType};
// The bound of every product
pub use simd::peak::peak_flops;
// Values in bf16
pub use bf16_values::{pack_bf16, unpack_bf16};
// Softmax attention
pub use attention::backward::attention_backward;
pub use attention::forward::attention_forward;
pub use attention::shapes::{AttentionSizes, StridedRows};
// Attention inside clusters
pub use cluster_attention::{ClusterSegments, cluster_attention_backward, cluster_attention_forward};
// Camera-relative attention
pub use head_transform::{HeadTransform, transform_heads, transform_len};
// Layers
pub use gelu::{gelu_backward, gelu_forward};
pub use layer_norm::{layer_norm_backward, layer_norm_forward};
pub use linear::{linear_forward, sum_rows};
pub use matmul_bf16::{Matrix, matmul_bf16};
pub use rms_norm::{HeadRows, rms_norm_backward, rms_norm_forward};
