//! GPUs through `CubeCL`.

use burn::backend::Cube;
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::kernel::matmul::{MatmulStrategy, matmul};

use crate::ops::kernels::Kernels;

impl Kernels for Cube {
    /// The kernels accumulate in f32 and write f32.
    fn matmul_f16(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        matmul(lhs, rhs, None, MatmulStrategy::default(), DType::F32).expect("f32 operands of these shapes multiply")
    }
}
