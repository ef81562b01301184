//! Adapters of the graphics API, GPUs and software renderers, and their limits.

use std::fmt;

use burn::tensor::Device;

/// Environment variable that selects an adapter by its [`Adapter::selector`]. `CubeCL` reads the variable.
pub const ADAPTER_VARIABLE: &str = "CUBECL_WGPU_DEFAULT_DEVICE";

/// An adapter of the graphics API of the device `wgpu`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// Name of the adapter.
    pub name: String,
    /// `discrete GPU`, `integrated GPU`, `virtual GPU`, `software` or `other`.
    pub kind: &'static str,
    /// The graphics API: `Vulkan`, `Metal`, `Dx12` or `Gl`.
    pub api: String,
    /// Name and version of the driver, if known.
    pub driver: String,
    /// The value of [`ADAPTER_VARIABLE`] that selects this adapter.
    pub selector: String,
    /// Whether the device `wgpu` is this adapter.
    pub is_used: bool,
    /// Most bytes of one tensor, which is bound as a single buffer. `CubeCL` requests the limits of the adapter.
    pub max_tensor_bytes: u64,
    /// Whether shaders support f16 in arithmetic and buffers.
    pub has_f16: bool,
}

/// Returns the most bytes of one tensor on an open device; `None` if memory is the only limit.
pub fn max_tensor_bytes(device: &Device) -> Option<u64> {
    match device.clone().without_autodiff().as_dispatch() {
        // The smaller of both limits of the adapter; the allocator refuses larger buffers.
        #[cfg(feature = "wgpu")]
        burn::backend::DispatchDevice::Cube(device) => Some(device.client().properties().memory.max_page_size),
        _ => None,
    }
}

/// Says to which language kernels are compiled for an open GPU and by which instructions they multiply matrices in f32 and
/// f16; `None` for a CPU.
#[cfg(feature = "wgpu")]
pub fn product_instructions(device: &Device) -> Option<String> {
    use clift_cube::{AdapterClass, MatrixShape};
    let device = device.clone().without_autodiff();
    let burn::backend::DispatchDevice::Cube(device) = device.as_dispatch() else { return None };
    let is_vulkan = used_adapter().is_some_and(|adapter| adapter.api == "Vulkan");
    let language = if cfg!(feature = "spirv") && is_vulkan { "SPIR-V" } else { "WGSL" };
    let products = match AdapterClass::of(&device.client()) {
        AdapterClass::Matrices(MatrixShape { sizes: [m, n, k], plane }) => format!(
            "f32 by multiply-adds; f16 by cooperative matrices of {m} x {n} x {k} in subgroups of {plane}, with f32 sums"
        ),
        AdapterClass::Registers => "no cooperative matrices: f32, also with precision = \"f16\"".into(),
    };
    Some(format!("kernels in {language}; {products}"))
}

/// Returns nothing: this build does not contain the device `wgpu`.
#[cfg(not(feature = "wgpu"))]
pub fn product_instructions(_device: &Device) -> Option<String> {
    None
}

impl fmt::Display for Adapter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, kind, api, driver, .. } = self;
        write!(f, "{name} ({kind}, {api}, driver {driver})")
    }
}

/// Returns the adapter of the device `wgpu`; `None` without one, and where the driver panics.
pub fn used_adapter() -> Option<Adapter> {
    std::panic::catch_unwind(adapters).ok()?.into_iter().find(|adapter| adapter.is_used)
}

/// Returns no adapters: this build does not contain the device `wgpu`.
#[cfg(not(feature = "wgpu"))]
pub fn adapters() -> Vec<Adapter> {
    Vec::new()
}

#[cfg(feature = "wgpu")]
pub use available::adapters;

#[cfg(feature = "wgpu")]
mod available {
    use burn::backend::wgpu::graphics::AutoGraphicsApi;
    use burn_cubecl::cubecl::future::block_on;
    use wgpu::{DeviceType, Instance, InstanceDescriptor, PowerPreference, RequestAdapterOptions};

    use super::{ADAPTER_VARIABLE, Adapter};

    /// Returns the adapters that the device `wgpu` can use: those of the first graphics API with a GPU, or else of the
    /// first with any adapter.
    pub fn adapters() -> Vec<Adapter> {
        let mut software = Vec::new();
        for api in AutoGraphicsApi::chain() {
            let available = adapters_of_api(api);
            if available.iter().any(|adapter| adapter.kind != kind(DeviceType::Cpu)) {
                return available;
            }
            if software.is_empty() {
                software = available;
            }
        }
        software
    }

    fn adapters_of_api(api: wgpu::Backend) -> Vec<Adapter> {
        let instance = Instance::new(InstanceDescriptor {
            backends: api.into(),
            ..InstanceDescriptor::new_without_display_handle()
        });
        let all = block_on(instance.enumerate_adapters(api.into()));
        // The request of CubeCL without the environment variable.
        let options =
            RequestAdapterOptions { power_preference: PowerPreference::HighPerformance, ..Default::default() };
        let preferred = block_on(instance.request_adapter(&options)).ok().map(|adapter| adapter.get_info());
        let chosen = std::env::var(ADAPTER_VARIABLE).ok();
        let mut adapters: Vec<Adapter> = Vec::with_capacity(all.len());
        for adapter in all {
            let info = adapter.get_info();
            let number = adapters.iter().filter(|other| other.kind == kind(info.device_type)).count();
            let selector = selector(info.device_type, number);
            let is_used = match &chosen {
                Some(chosen) => *chosen == selector,
                None => preferred.as_ref() == Some(&info),
            };
            let limits = adapter.limits();
            adapters.push(Adapter {
                kind: kind(info.device_type),
                api: format!("{api:?}"),
                driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
                selector,
                is_used,
                max_tensor_bytes: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
                has_f16: adapter.features().contains(wgpu::Features::SHADER_F16),
                name: info.name,
            });
        }
        adapters
    }

    fn kind(device_type: DeviceType) -> &'static str {
        match device_type {
            DeviceType::DiscreteGpu => "discrete GPU",
            DeviceType::IntegratedGpu => "integrated GPU",
            DeviceType::VirtualGpu => "virtual GPU",
            DeviceType::Cpu => "software",
            DeviceType::Other => "other",
        }
    }

    /// Returns the selector of the `number`-th adapter of a type, in `CubeCL`'s syntax.
    fn selector(device_type: DeviceType, number: usize) -> String {
        if device_type == DeviceType::Cpu { "Cpu".into() } else { format!("{device_type:?}({number})") }
    }
}
