//! The adapters of this machine, GPUs and software that stands in for them, as their graphics API describes them; what
//! one tensor may take there.

use burn::tensor::Device;

/// Environment variable that chooses among several adapters, by what [`Adapter::selector`] says. `CubeCL` reads it.
pub const ADAPTER_VARIABLE: &str = "CUBECL_WGPU_DEFAULT_DEVICE";

/// An adapter of the graphics API that the device `wgpu` takes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Adapter {
    /// What it calls itself.
    pub name: String,
    /// `discrete GPU`, `integrated GPU`, `virtual GPU`, `software` or `other`.
    pub kind: &'static str,
    /// The graphics API: `Vulkan`, `Metal`, `Dx12` or `Gl`.
    pub api: String,
    /// Name and version of the driver, as far as it tells them.
    pub driver: String,
    /// The value of [`ADAPTER_VARIABLE`] that chooses it.
    pub selector: String,
    /// Whether the device `wgpu` is this one.
    pub is_used: bool,
    /// What it allows.
    pub limits: Limits,
    /// Whether shaders may compute in f16 and keep it in buffers.
    pub has_f16: bool,
}

/// The limits of an adapter that matter here. `CubeCL` asks for all of what an adapter has, not for WebGPU's defaults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most bytes of a buffer that a shader sees at once.
    pub max_binding_bytes: u64,
    /// Most bytes of a buffer.
    pub max_buffer_bytes: u64,
    /// Most threads of a workgroup.
    pub max_workgroup_threads: u32,
    /// Most bytes that the threads of a workgroup share.
    pub max_workgroup_bytes: u32,
    /// Most workgroups along one side of a launch.
    pub max_workgroups: u32,
}

impl Limits {
    /// Most bytes of one tensor: it lies in one buffer and is bound as a whole.
    pub fn max_tensor_bytes(&self) -> u64 {
        self.max_binding_bytes.min(self.max_buffer_bytes)
    }
}

/// Most bytes of one tensor on an open device; `None` where memory is the only limit.
#[cfg(feature = "wgpu")]
pub fn max_tensor_bytes(device: &Device) -> Option<u64> {
    match device.clone().without_autodiff().as_dispatch() {
        // The least of both limits of the adapter, which is what the allocator refuses beyond.
        burn::backend::DispatchDevice::Cube(device) => Some(device.client().properties().memory.max_page_size),
        _ => None,
    }
}

/// Most bytes of one tensor on an open device; `None` where memory is the only limit.
#[cfg(not(feature = "wgpu"))]
pub fn max_tensor_bytes(_device: &Device) -> Option<u64> {
    None
}

/// All adapters that the device `wgpu` can be; none in a build without it.
#[cfg(not(feature = "wgpu"))]
pub fn adapters() -> Vec<Adapter> {
    Vec::new()
}

#[cfg(feature = "wgpu")]
pub use found::adapters;

#[cfg(feature = "wgpu")]
mod found {
    use burn::backend::wgpu::graphics::AutoGraphicsApi;
    use burn_cubecl::cubecl::future::block_on;
    use wgpu::{DeviceType, Instance, InstanceDescriptor, PowerPreference, RequestAdapterOptions};

    use super::{ADAPTER_VARIABLE, Adapter, Limits};

    /// All adapters that the device `wgpu` can be: those of the first graphics API that has a GPU, or else of the first
    /// that has any.
    pub fn adapters() -> Vec<Adapter> {
        let mut software = Vec::new();
        for api in AutoGraphicsApi::chain() {
            let found = of_api(api);
            if found.iter().any(|adapter| adapter.kind != kind(DeviceType::Cpu)) {
                return found;
            }
            if software.is_empty() {
                software = found;
            }
        }
        software
    }

    fn of_api(api: wgpu::Backend) -> Vec<Adapter> {
        let instance = Instance::new(InstanceDescriptor {
            backends: api.into(),
            ..InstanceDescriptor::new_without_display_handle()
        });
        let all = block_on(instance.enumerate_adapters(api.into()));
        // As CubeCL asks where no variable says otherwise.
        let options =
            RequestAdapterOptions { power_preference: PowerPreference::HighPerformance, ..Default::default() };
        let preferred = block_on(instance.request_adapter(&options)).ok().map(|adapter| adapter.get_info());
        let chosen = std::env::var(ADAPTER_VARIABLE).ok();
        let mut counts: Vec<(DeviceType, usize)> = Vec::new();
        let mut adapters = Vec::with_capacity(all.len());
        for adapter in all {
            let info = adapter.get_info();
            let number = counts.iter().filter(|(of, _)| *of == info.device_type).count();
            counts.push((info.device_type, number));
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
                limits: Limits {
                    max_binding_bytes: limits.max_storage_buffer_binding_size,
                    max_buffer_bytes: limits.max_buffer_size,
                    max_workgroup_threads: limits.max_compute_invocations_per_workgroup,
                    max_workgroup_bytes: limits.max_compute_workgroup_storage_size,
                    max_workgroups: limits.max_compute_workgroups_per_dimension,
                },
                has_f16: adapter.features().contains(wgpu::Features::SHADER_F16),
                name: info.name,
            });
        }
        adapters
    }

    fn kind(of: DeviceType) -> &'static str {
        match of {
            DeviceType::DiscreteGpu => "discrete GPU",
            DeviceType::IntegratedGpu => "integrated GPU",
            DeviceType::VirtualGpu => "virtual GPU",
            DeviceType::Cpu => "software",
            DeviceType::Other => "other",
        }
    }

    /// Adapters are numbered within their kind; of software there is one.
    fn selector(of: DeviceType, number: usize) -> String {
        match of {
            DeviceType::DiscreteGpu => format!("DiscreteGpu({number})"),
            DeviceType::IntegratedGpu => format!("IntegratedGpu({number})"),
            DeviceType::VirtualGpu => format!("VirtualGpu({number})"),
            DeviceType::Cpu => "Cpu".into(),
            DeviceType::Other => format!("Other({number})"),
        }
    }
}
