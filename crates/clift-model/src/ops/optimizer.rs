//! AdamW and the norm of gradients by one kernel a tensor, on GPUs: composed of Burn's operations, an update of a parameter
//! has a dozen launches.

use burn::tensor::Tensor;

/// Factors of an AdamW update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamWFactors {
    /// Learning rate.
    pub learning_rate: f64,
    /// Decay of the parameters, per learning rate.
    pub weight_decay: f32,
    /// Decays of the means of gradients and of their squares.
    pub betas: [f32; 2],
    /// Added to the root of the mean square.
    pub epsilon: f32,
    /// Number of the update, counted from 1.
    pub time: usize,
    /// Factor of the gradient.
    pub grad_factor: f32,
}

/// Returns a parameter and the means of its gradients and of their squares after an update by a gradient; `None` on devices
/// without the kernel and for types other than f32.
#[cfg(feature = "wgpu")]
pub fn fused_adamw<const D: usize>(
    tensors: [&Tensor<D>; 3],
    grad: &Tensor<D>,
    factors: AdamWFactors,
) -> Option<[Tensor<D>; 3]> {
    use crate::ops::backends::cube_buffers::{buffer, cube_tensor, float_tensor, tensor};
    let grad = cube_tensor(grad)?;
    let [parameter, mean, square] = tensors.map(cube_tensor);
    let (client, shape) = (grad.client.clone(), grad.meta.shape().clone());
    let AdamWFactors { learning_rate, weight_decay, betas: [beta_1, beta_2], epsilon, time, grad_factor } = factors;
    let correction = |beta: f32| 1.0 - beta.powi(time as i32);
    let settings = clift_cube::AdamW {
        learning_rate: learning_rate as f32,
        weight_decay,
        beta_1,
        beta_2,
        correction_1: correction(beta_1),
        correction_2: correction(beta_2),
        epsilon,
        grad_factor,
    };
    let inputs = [parameter?, mean?, square?].map(buffer);
    let outputs = clift_cube::adamw(&client, settings, inputs.each_ref(), &buffer(grad.clone()));
    Some(outputs.map(|output| float_tensor(tensor(&grad, output, shape.clone()))))
}

/// As with the feature `wgpu`, on devices without the kernel.
#[cfg(not(feature = "wgpu"))]
pub fn fused_adamw<const D: usize>(
    _tensors: [&Tensor<D>; 3],
    _grad: &Tensor<D>,
    _factors: AdamWFactors,
) -> Option<[Tensor<D>; 3]> {
    None
}

/// Returns the norm of all gradients together, `[1]`; `None` on devices without the kernel and for types other than f32.
#[cfg(feature = "wgpu")]
pub fn fused_gradient_norm(grads: &[Tensor<1>]) -> Option<Tensor<1>> {
    use crate::ops::backends::cube_buffers::{buffer, cube_tensor, float_tensor, tensor};
    let grads: Vec<_> = grads.iter().map(cube_tensor).collect::<Option<_>>()?;
    let like = grads.first()?.clone();
    let buffers: Vec<_> = grads.into_iter().map(buffer).collect();
    Some(float_tensor(tensor(&like, clift_cube::gradient_norm(&like.client, &buffers), [1])))
}

/// As with the feature `wgpu`, on devices without the kernel.
#[cfg(not(feature = "wgpu"))]
pub fn fused_gradient_norm(_grads: &[Tensor<1>]) -> Option<Tensor<1>> {
    None
}
