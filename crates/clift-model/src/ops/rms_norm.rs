//! RMS norms of the heads of queries and keys.
// B scenes, N tokens, P parts of a row, K parts with a norm, H heads, E width of a head

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::nn::RmsNorm;
use burn::tensor::{Shape, Slice, Tensor};
use clift_kernels::{HeadRows, InstructionSet, rms_norm_backward, rms_norm_forward};

use crate::ops::autodiff::register;
use crate::ops::flex::{contiguous, is_native, tensor, values, values_mut};

/// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of every head of the first parts of rows, a norm for each of them; the
/// other parts stay. A row has queries, keys and values side by side, or fewer of them.
///
/// # Shapes
/// - `x` and the result: `[batch, count, num_parts * num_heads * head_width]`
/// - gamma of a norm: `[head_width]`
pub(crate) fn rms_norm_heads<const K: usize>(x: Tensor<3>, norms: [&RmsNorm; K], num_parts: usize) -> Tensor<3> {
    let [_batch, _count, width] = x.dims();
    let [head_width] = norms[0].gamma.dims();
    let num_heads = width / num_parts / head_width;
    let epsilon = norms[0].epsilon;
    let gammas = Tensor::cat(norms.iter().map(|norm| norm.gamma.val()).collect(), 0);
    apply(x, gammas, HeadRows { num_parts, num_heads, head_width, epsilon })
}

fn apply(x: Tensor<3>, gammas: Tensor<1>, rows: HeadRows) -> Tensor<3> {
    Tensor::from_dispatch(<Dispatch as RmsNormOps>::rms_norm_heads(x.into_dispatch(), gammas.into_dispatch(), rows))
}

/// The operation of [`rms_norm_heads`] on a backend; `gammas` is `[K E]`.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait RmsNormOps: Backend {
    /// See [`rms_norm_heads`].
    fn rms_norm_heads(x: FloatTensor<Self>, gammas: FloatTensor<Self>, rows: HeadRows) -> FloatTensor<Self>;
}

/// The operation and its gradient. The default implementations run on every backend.
pub trait RmsNormKernels: Backend {
    /// Normalizes heads.
    fn norm_heads(inputs: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        composed_output::<Self>(inputs, rows)
    }

    /// Computes the gradients of `x` and `gammas`.
    fn norm_heads_backward(
        inputs: [FloatTensor<Self>; 2],
        grad: FloatTensor<Self>,
        rows: HeadRows,
    ) -> [FloatTensor<Self>; 2] {
        composed_backward::<Self>(inputs, grad, rows)
    }
}

/// The parts of rows with a norm as a tensor `[BN, K, H, E]`.
struct Parts {
    rows: HeadRows,
    /// BN
    num_rows: usize,
    /// K
    count: usize,
}

impl Parts {
    fn of<B: Backend>(x: &FloatTensor<B>, gammas: &FloatTensor<B>, rows: HeadRows) -> Self {
        let [batch, count, _] = x.shape().dims();
        Self { rows, num_rows: batch * count, count: gammas.shape().num_elements() / rows.head_width }
    }

    /// `[B, N, P H E] -> [BN, to - from, H, E]`
    fn slice<B: Backend>(&self, x: &FloatTensor<B>, from: usize, to: usize) -> FloatTensor<B> {
        let HeadRows { num_parts, num_heads, head_width, .. } = self.rows;
        let x = B::float_reshape(x.clone(), Shape::new([self.num_rows, num_parts, num_heads, head_width]));
        B::float_slice(x, &[0..self.num_rows, from..to, 0..num_heads, 0..head_width].map(Slice::from))
    }

    fn normalized<B: Backend>(&self, x: &FloatTensor<B>) -> FloatTensor<B> {
        self.slice::<B>(x, 0, self.count)
    }

    /// Returns `x` with other values of the parts that have a norm.
    fn replace<B: Backend>(&self, x: FloatTensor<B>, values: FloatTensor<B>) -> FloatTensor<B> {
        let mut parts = vec![values];
        if self.count < self.rows.num_parts {
            parts.push(self.slice::<B>(&x, self.count, self.rows.num_parts));
        }
        B::float_reshape(B::float_cat(parts, 1), x.shape())
    }

    /// `[K E] -> [1, K, 1, E]`
    fn per_head<B: Backend>(&self, gammas: FloatTensor<B>) -> FloatTensor<B> {
        B::float_reshape(gammas, Shape::new([1, self.count, 1, self.rows.head_width]))
    }

    /// Mean over a head: `[BN, K, H, E] -> [BN, K, H, 1]`.
    fn mean<B: Backend>(&self, x: FloatTensor<B>) -> FloatTensor<B> {
        B::float_mul_scalar(B::float_sum_dim(x, 3), (1.0 / self.rows.head_width as f64).into())
    }

    /// Returns `x r` and `r = 1 / sqrt(mean(x^2) + epsilon)`.
    fn normal<B: Backend>(&self, x: FloatTensor<B>) -> (FloatTensor<B>, FloatTensor<B>) {
        let square = self.mean::<B>(B::float_mul(x.clone(), x.clone()));
        let inverse = B::float_recip(B::float_sqrt(B::float_add_scalar(square, self.rows.epsilon.into())));
        (B::float_mul(x, inverse.clone()), inverse)
    }
}

fn composed_output<B: Backend>([x, gammas]: [FloatTensor<B>; 2], rows: HeadRows) -> FloatTensor<B> {
    let parts = Parts::of::<B>(&x, &gammas, rows);
    let (normal, _) = parts.normal::<B>(parts.normalized::<B>(&x));
    parts.replace::<B>(x, B::float_mul(normal, parts.per_head::<B>(gammas)))
}

/// Computes the gradients. With `y = x r` and `g = dO gamma`: `dx = r (g - y mean(g y))`, `dgamma = sum(dO y)` over tokens
/// and heads.
fn composed_backward<B: Backend>(
    [x, gammas]: [FloatTensor<B>; 2],
    grad: FloatTensor<B>,
    rows: HeadRows,
) -> [FloatTensor<B>; 2] {
    let parts = Parts::of::<B>(&x, &gammas, rows);
    let (normal, inverse) = parts.normal::<B>(parts.normalized::<B>(&x));
    let grad_parts = parts.normalized::<B>(&grad);
    let product = B::float_mul(grad_parts.clone(), normal.clone());
    let grad_gammas = B::float_reshape(B::float_sum_dim(B::float_sum_dim(product, 0), 2), gammas.shape());
    let slope = B::float_mul(grad_parts, parts.per_head::<B>(gammas));
    let along = parts.mean::<B>(B::float_mul(slope.clone(), normal.clone()));
    let grad_x = B::float_mul(B::float_sub(slope, B::float_mul(normal, along)), inverse);
    [parts.replace::<B>(grad, grad_x), grad_gammas]
}

impl RmsNormKernels for Flex {
    fn norm_heads([x, gammas]: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        if !is_native(&x) || !is_native(&gammas) {
            return composed_output::<Self>([x, gammas], rows);
        }
        let (mut x, gammas) = (contiguous(x), contiguous(gammas));
        rms_norm_forward(InstructionSet::detected(), rows, values(&gammas), values_mut(&mut x));
        x
    }

    fn norm_heads_backward(
        [x, gammas]: [FloatTensor<Self>; 2],
        grad: FloatTensor<Self>,
        rows: HeadRows,
    ) -> [FloatTensor<Self>; 2] {
        if !is_native(&x) || !is_native(&gammas) {
            return composed_backward::<Self>([x, gammas], grad, rows);
        }
        let ([x, gammas], mut grad) = ([x, gammas].map(contiguous), contiguous(grad));
        let mut grad_gammas = vec![0.0; values(&gammas).len()];
        let inputs = [values(&x), values(&gammas)];
        rms_norm_backward(InstructionSet::detected(), rows, inputs, values_mut(&mut grad), &mut grad_gammas);
        let len = grad_gammas.len();
        [grad, tensor(grad_gammas, [len])]
    }
}

#[cfg(feature = "ndarray")]
impl RmsNormKernels for burn::backend::NdArray {}

#[cfg(feature = "wgpu")]
impl RmsNormKernels for burn::backend::Cube {}

impl<B: RmsNormKernels> RmsNormOps for B {
    fn rms_norm_heads(x: FloatTensor<Self>, gammas: FloatTensor<Self>, rows: HeadRows) -> FloatTensor<Self> {
        Self::norm_heads([x, gammas], rows)
    }
}

impl<B: RmsNormKernels, C: CheckpointStrategy> RmsNormOps for Autodiff<B, C> {
    fn rms_norm_heads(x: FloatTensor<Self>, gammas: FloatTensor<Self>, rows: HeadRows) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let (gammas, gammas_node) = gammas.into_parts();
        match RmsNormBackward.prepare::<C>([node, gammas_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let inputs = [x, gammas];
                let output = B::norm_heads(inputs.clone(), rows);
                prep.finish((inputs, rows), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::norm_heads([x, gammas], rows)),
        }
    }
}

#[derive(Debug)]
struct RmsNormBackward;

impl<B: RmsNormKernels> Backward<B, 2> for RmsNormBackward {
    type State = ([FloatTensor<B>; 2], HeadRows);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 2>(ops, grads, |(inputs, rows), grad_output, _| {
            B::norm_heads_backward(inputs, grad_output, rows).map(Some)
        });
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{
        assert_close, check_gradients, check_native, cpu_devices, devices, output_and_gradients, random,
    };

    /// Normalizes the first two of three parts; gammas are `[1, 1, E]`.
    fn norm([x, query, key]: [Tensor<3>; 3]) -> Tensor<3> {
        let ([_, _, width], [_, _, head_width]) = (x.dims(), query.dims());
        let rows = HeadRows { num_parts: 3, num_heads: width / 3 / head_width, head_width, epsilon: 1e-5 };
        apply(x, Tensor::cat(vec![query, key], 2).reshape([2 * head_width]), rows)
    }

    fn inputs(num_heads: usize, head_width: usize, device: &Device) -> [Tensor<3>; 3] {
        let shapes = [[2, 35, 3 * num_heads * head_width], [1, 1, head_width], [1, 1, head_width]];
        let mut seed = 0;
        shapes.map(|shape| {
            seed += 1;
            random(shape, seed, device)
        })
    }

    /// The operation as Burn's own norms of the parts.
    fn plain([x, query, key]: [Tensor<3>; 3]) -> Tensor<3> {
        let ([batch, count, width], [_, _, head_width]) = (x.dims(), query.dims());
        let part = |i: usize| x.clone().narrow(2, i * width / 3, width / 3);
        let norm = |x: Tensor<3>, gamma: Tensor<3>| {
            let x = x.reshape([batch, count, width / 3 / head_width, head_width]);
            let scale = (x.clone().square().mean_dim(3) + 1e-5).sqrt();
            (x / scale * gamma.unsqueeze_dim(2)).reshape([batch, count, width / 3])
        };
        Tensor::cat(vec![norm(part(0), query), norm(part(1), key), part(2)], 2)
    }

    #[test]
    fn gradients_equal_central_differences_and_plain_autodiff_in_f64() {
        for device in cpu_devices() {
            let [x, query, key] = inputs(2, 6, &device);
            check_gradients([x.narrow(1, 0, 3), query, key], norm, 1e-6);
            let cotangent = random([2, 35, 36], 9, &device);
            let [(output, grads), (expected, expected_grads)] =
                [norm, plain].map(|f| output_and_gradients(inputs(2, 6, &device), cotangent.clone(), f));
            assert_close(&output, &expected, 1e-12);
            for (grad, expected) in grads.iter().zip(&expected_grads) {
                assert_close(grad, expected, 1e-12);
            }
        }
    }

    #[test]
    fn native_kernels_equal_the_composed_operation() {
        let device = Device::flex();
        for (num_heads, head_width) in [(2, 8), (3, 32), (1, 37)] {
            let cotangent = random([2, 35, 3 * num_heads * head_width], 4, &device);
            check_native(inputs(num_heads, head_width, &device), cotangent, norm, 1e-5);
        }
    }

    #[test]
    fn a_head_of_zeros_gives_zeros_and_finite_gradients() {
        for device in devices() {
            let inputs = inputs(2, 8, &device).map(|input| input.cast(DType::F32));
            let [_, query, key] = inputs;
            let x = Tensor::<3>::zeros([1, 2, 48], &device);
            let cotangent = random([1, 2, 48], 3, &device).cast(DType::F32);
            let (output, grads) = output_and_gradients([x.clone(), query, key], cotangent, norm);
            assert_close(&output, &x, 1e-12);
            assert!(grads.into_iter().all(|grad| grad.is_finite().all().into_scalar::<bool>()));
        }
    }
}
