//! Matrix products without a backward: of cameras, in K-means and in optimizers. The most that a device reaches in products.

use burn::tensor::{Device, Tensor};
use clift_kernels::InstructionSet;

use crate::ops::precision::Precision;

/// Multiplies matrices, `[.., M, K]` by `[.., K, N]`: on GPUs by the kernels of clift, with sums in f32 and without a gradient.
pub fn matmul_without_gradient<const D: usize>(lhs: Tensor<D>, rhs: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "wgpu")]
    if let Some(product) = product_on_gpu(Precision::F32, &lhs, &rhs) {
        return if lhs.is_autodiff() { product.autodiff() } else { product };
    }
    lhs.matmul(rhs)
}

#[cfg(feature = "wgpu")]
fn product_on_gpu<const D: usize>(precision: Precision, lhs: &Tensor<D>, rhs: &Tensor<D>) -> Option<Tensor<D>> {
    use crate::ops::backends::cube_buffers::{cube_tensor, float_tensor};
    use crate::ops::kernels::Kernels;
    let inner = |x: &Tensor<D>| cube_tensor(&if x.is_autodiff() { x.clone().inner() } else { x.clone() });
    Some(float_tensor(<burn::backend::Cube as Kernels>::matmul(precision, inner(lhs)?, inner(rhs)?)))
}

/// Measures the most floating-point operations per second that a device reaches: on `flex`, all threads in products that stay in
/// registers; on a GPU, a large product. `None` for other devices, for software adapters, and for f16 on CPUs, which has no
/// native kernels.
pub fn peak_flops(device: &Device, precision: Precision) -> Option<f64> {
    let device = device.clone().without_autodiff();
    if device != Device::flex() {
        return gpu_product_flops(precision, &device);
    }
    precision.native_operands().map(|operands| clift_kernels::peak_flops(InstructionSet::detected(), operands))
}

/// Measures the floating-point operations per second of large products on a GPU; `None` for other devices and software adapters.
#[cfg(feature = "wgpu")]
fn gpu_product_flops(precision: Precision, device: &Device) -> Option<f64> {
    use crate::device::adapter::used_adapter;
    let is_gpu = matches!(device.as_dispatch(), burn::backend::DispatchDevice::Cube(_));
    if is_gpu && used_adapter()?.kind != "software" { product_flops(precision, device, 4096) } else { None }
}

/// Returns nothing: this build does not contain the device `wgpu`.
#[cfg(not(feature = "wgpu"))]
fn gpu_product_flops(_precision: Precision, _device: &Device) -> Option<f64> {
    None
}

/// Measures products of square matrices. A GPU raises its clocks only under load: the first products are not counted.
#[cfg(feature = "wgpu")]
fn product_flops(precision: Precision, device: &Device, size: usize) -> Option<f64> {
    const PRODUCTS: usize = 20;
    let x = Tensor::<2>::ones([size, size], device);
    let run = || {
        let started = std::time::Instant::now();
        for _ in 0..PRODUCTS {
            product_on_gpu(precision, &x, &x)?;
        }
        device.sync().ok()?;
        Some(started.elapsed().as_secs_f64())
    };
    run()?;
    Some((2 * PRODUCTS * size.pow(3)) as f64 / run()?)
}

#[cfg(all(test, feature = "wgpu"))]
mod tests {
    use super::*;

    #[test]
    fn a_small_product_on_an_adapter_has_a_rate() {
        // `wgpu_suite` reports a machine without an adapter.
        let device = match crate::device::name::DeviceName::Wgpu.open() {
            Ok(device) => device,
            Err(error) => return assert!(std::env::var_os("CLIFT_REQUIRE_WGPU").is_none(), "{error}"),
        };
        let flops = product_flops(Precision::F32, &device, 64).expect("a rate");
        assert!((1e5..1e15).contains(&flops), "{flops}");
        assert_eq!(gpu_product_flops(Precision::F32, &Device::flex()), None);
    }
}
