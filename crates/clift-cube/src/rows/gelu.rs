//! GELU with its exact gradient.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};
use crate::buffers::elementwise::elementwise;

/// Returns `exp(-x^2 / 2)`.
#[cube]
fn exponential(x: f32) -> f32 {
    (x * x * -0.5f32).exp()
}

/// Returns the normal distribution function at `x` from its [`exponential`], with an absolute error below 1e-7 (Abramowitz and
/// Stegun 7.1.26), without cancellation for negative `x`.
#[cube]
fn normal(x: f32, exponential: f32) -> f32 {
    // 0.3275911 / sqrt(2)
    let t = 1.0f32 / (1.0f32 + 0.231_641_9f32 * x.abs());
    let mut sum = fma(t, 1.061_405_4f32, -1.453_152f32);
    sum = fma(t, sum, 1.421_413_7f32);
    sum = fma(t, sum, -0.284_496_74f32);
    sum = fma(t, sum, 0.254_829_6f32);
    let tail = 0.5f32 * t * sum * exponential;
    select(x < 0.0f32, tail, 1.0f32 - tail)
}

/// Computes `x Phi(x)`.
#[cube]
pub(crate) fn gelu(x: f32) -> f32 {
    x * normal(x, exponential(x))
}

/// Computes `Phi(x) + x phi(x)`.
#[cube]
pub(crate) fn gelu_slope(x: f32) -> f32 {
    let exponential = exponential(x);
    normal(x, exponential) + x * 0.398_942_3f32 * exponential
}

#[cube(launch_unchecked)]
fn forward<X: Float, O: Float, V: Size>(
    x: &[Vector<X, V>],
    output: &mut [Vector<O, V>],
    #[define(X, O)] _types: [ElemType; 2],
) {
    let index = ABSOLUTE_POS;
    if index < x.len() {
        let mut values = Vector::<f32, V>::cast_from(x[index]);
        #[unroll]
        for i in 0..V::value().comptime() {
            values.insert(i, gelu(values.extract(i)));
        }
        output[index] = Vector::cast_from(values);
    }
}

#[cube(launch_unchecked)]
fn backward<X: Float, V: Size>(
    x: &[Vector<X, V>],
    grad: &[Vector<f32, V>],
    grad_x: &mut [Vector<f32, V>],
    #[define(X)] _types: ElemType,
) {
    let index = ABSOLUTE_POS;
    if index < x.len() {
        let mut values = Vector::<f32, V>::cast_from(x[index]);
        #[unroll]
        for i in 0..V::value().comptime() {
            values.insert(i, gelu_slope(values.extract(i)));
        }
        grad_x[index] = values * grad[index];
    }
}

/// Computes `x Phi(x)` with the normal distribution function `Phi`, in type `output`.
pub fn gelu_forward(client: &Client, x: &Buffer, output: Values) -> Buffer {
    let output = Buffer::empty(client, x.len, output);
    let (vector, count, dim) = elementwise(x.len);
    let types = [x.values.elem(), output.values.elem()];
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        forward::launch_unchecked(client, count, dim, vector, x.arg(vector), output.arg(vector), types);
    }
    output
}

/// Computes `grad (Phi(x) + x phi(x))` with the normal density `phi`, in f32.
pub fn gelu_backward(client: &Client, x: &Buffer, grad: &Buffer) -> Buffer {
    let grad_x = Buffer::empty(client, x.len, Values::F32);
    let (vector, count, dim) = elementwise(x.len);
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        backward::launch_unchecked(
            client,
            count,
            dim,
            vector,
            x.arg(vector),
            grad.arg(vector),
            grad_x.arg(vector),
            x.values.elem(),
        );
    }
    grad_x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::row_cases::gelu;
    use crate::testing::{check, client};

    #[test]
    fn gelu_and_its_gradient_equal_f64() {
        let Some(client) = client() else { return };
        for (output, tolerance) in [(Some(Values::F32), 1e-6), (Some(Values::F16), 6e-4), (None, 1e-6)] {
            for len in [121, 1000] {
                check(&client, &gelu(len, output), tolerance);
            }
        }
    }
}
