//! The limits that adapters report hold on the open device. Alone in its process: the Vulkan loader fails when several
//! threads open and close instances.

use burn::tensor::{DType, Tensor};
use clift_model::{DeviceName, Precision, adapters, max_tensor_bytes};

#[allow(dead_code)]
mod support;

#[test]
fn adapter_limits_hold_on_the_open_device() {
    let device = match DeviceName::Wgpu.open() {
        Ok(device) => device,
        Err(error) => return support::skip("wgpu", &error.to_string()),
    };
    let adapters = adapters();
    let used = adapters.iter().find(|adapter| adapter.is_used).expect("the device is one of them");
    let most = used.limits.max_tensor_bytes();
    assert_eq!(max_tensor_bytes(&device), Some(most));
    assert_eq!(max_tensor_bytes(&device.clone().autodiff()), Some(most), "with autodiff as without");
    assert_eq!(device.supports_dtype(DType::F16), used.has_f16);
    assert_eq!(Precision::F16.check("precision", &device).is_ok(), used.has_f16);

    // A tensor of the reported size (at most 128 MiB) can be made and read, as the checks before a run assume. (Burn's sum of
    // as many values is wrong on software Vulkan.)
    let len = (most.min(128 << 20) / 4) as usize;
    let values = Tensor::<1>::ones([len], &device).into_data();
    let values = values.as_slice::<f32>().expect("f32");
    assert_eq!((values.len(), values.iter().filter(|&&value| value == 1.0).count()), (len, len));
}
