//! Device names, and opening a device.

use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::error::ModelError;
use crate::names::{names, parse_variant};

/// A device, by its name in configs and on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum DeviceName {
    /// Burn's CPU backend, the default.
    #[default]
    Flex,
    /// Burn's older CPU backend, an independent reference for numerical tests; needs the cargo feature `ndarray`.
    Ndarray,
    /// Any GPU through WebGPU (Vulkan, Metal, DX12); needs the cargo feature `wgpu`.
    Wgpu,
}

impl DeviceName {
    /// All devices, in the order of help texts.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Returns the name in configs and on the command line.
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// Whether the device computes on the processor, in its memory.
    pub const fn is_cpu(self) -> bool {
        match self {
            Self::Flex | Self::Ndarray => true,
            Self::Wgpu => false,
        }
    }

    /// Whether this build contains the device.
    pub fn is_built(self) -> bool {
        match self {
            Self::Flex => true,
            Self::Ndarray => cfg!(feature = "ndarray"),
            Self::Wgpu => cfg!(feature = "wgpu"),
        }
    }

    /// Opens the device, without autodiff.
    pub fn open(self) -> Result<Device, ModelError> {
        match self {
            Self::Flex => Ok(Device::flex()),
            #[cfg(feature = "ndarray")]
            Self::Ndarray => Ok(Device::ndarray()),
            #[cfg(not(feature = "ndarray"))]
            Self::Ndarray => Err(self.not_built("second CPU backend")),
            #[cfg(feature = "wgpu")]
            Self::Wgpu => open_wgpu(),
            #[cfg(not(feature = "wgpu"))]
            Self::Wgpu => Err(self.not_built("GPU support")),
        }
    }

    /// Opens the device of the `index`-th of several processes on a host, and returns the name of its adapter: on wgpu the
    /// adapters of the first kind in turn, unless the environment variable selects one.
    pub fn open_nth(self, index: usize) -> Result<(Device, Option<String>), ModelError> {
        match self {
            Self::Flex | Self::Ndarray => Ok((self.open()?, None)),
            Self::Wgpu => open_nth_wgpu(index),
        }
    }

    #[cfg(not(all(feature = "ndarray", feature = "wgpu")))]
    fn not_built(self, what: &str) -> ModelError {
        let reason = format!(
            "this build has no {what}; rebuild with `cargo build --release --features {self}`, \
             or choose `flex` (`--device flex`)"
        );
        ModelError::NoDevice { name: self.to_string(), reason }
    }
}

impl std::str::FromStr for DeviceName {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        parse_variant(name).ok_or_else(|| ModelError::NoDevice {
            name: name.into(),
            reason: format!("unknown; use one of {}; every GPU is `wgpu`", names::<Self>()),
        })
    }
}

#[cfg(not(feature = "wgpu"))]
fn open_nth_wgpu(_index: usize) -> Result<(Device, Option<String>), ModelError> {
    Ok((DeviceName::Wgpu.open()?, None))
}

#[cfg(feature = "wgpu")]
fn open_nth_wgpu(index: usize) -> Result<(Device, Option<String>), ModelError> {
    use crate::device::adapter::{ADAPTER_VARIABLE, Adapter, adapters};
    use burn::tensor::DeviceKind;
    let first = open_wgpu()?;
    let adapters = std::panic::catch_unwind(adapters).unwrap_or_default();
    let name = |adapter: &Adapter| Some(format!("wgpu with {} ({})", adapter.name, adapter.selector));
    let used = adapters.iter().find(|adapter| adapter.is_used);
    let Some(used) = used.filter(|_| std::env::var_os(ADAPTER_VARIABLE).is_none()) else {
        return Ok((first, used.and_then(name)));
    };
    let same: Vec<&Adapter> = adapters.iter().filter(|adapter| adapter.kind == used.kind).collect();
    let number = index % same.len();
    let kind = match used.kind {
        "discrete GPU" => DeviceKind::DiscreteGpu(number),
        "integrated GPU" => DeviceKind::IntegratedGpu(number),
        "virtual GPU" => DeviceKind::VirtualGpu(number),
        _ => return Ok((first, name(used))),
    };
    Ok((Device::wgpu(kind), name(same[number])))
}

#[cfg(feature = "wgpu")]
fn open_wgpu() -> Result<Device, ModelError> {
    use crate::device::adapter::{ADAPTER_VARIABLE, adapters};
    use burn::tensor::{DeviceKind, DeviceType};
    let missing = |reason: String| Err(ModelError::NoDevice { name: "wgpu".into(), reason });
    // wgpu panics when it opens a device without an adapter.
    let num_adapters = std::panic::catch_unwind(|| Device::enumerate(DeviceType::Wgpu).into_vec().len()).unwrap_or(0);
    if num_adapters == 0 {
        return missing(
            "no adapter was found; install a Vulkan driver (for software rendering: Mesa's lavapipe)".into(),
        );
    }
    // wgpu also panics if the environment variable selects an adapter that does not exist.
    if let Ok(chosen) = std::env::var(ADAPTER_VARIABLE) {
        let adapters = std::panic::catch_unwind(adapters).unwrap_or_default();
        if !adapters.iter().any(|adapter| adapter.is_used) {
            let known = adapters.iter().map(|adapter| adapter.selector.as_str()).collect::<Vec<_>>().join(", ");
            return missing(format!("{ADAPTER_VARIABLE} is `{chosen}`, which is not found; the adapters are {known}"));
        }
    }
    if cfg!(all(feature = "spirv", target_os = "linux")) {
        refuse_old_mesa()?;
    }
    Ok(Device::wgpu(DeviceKind::DefaultDevice))
}

/// Refuses Mesa's software Vulkan before 26, which crashes the process on kernels in SPIR-V.
#[cfg(feature = "wgpu")]
fn refuse_old_mesa() -> Result<(), ModelError> {
    let used = crate::device::adapter::used_adapter();
    let Some(used) = used.filter(|adapter| adapter.kind == "software" && adapter.api == "Vulkan") else {
        return Ok(());
    };
    let version =
        used.driver.split_once("Mesa ").and_then(|(_, version)| version.split('.').next()?.parse::<u32>().ok());
    if version.is_none_or(|version| version >= 26) {
        return Ok(());
    }
    let reason = format!("{used} crashes on kernels in SPIR-V; install Mesa 26, or build with `--features wgsl`");
    Err(ModelError::NoDevice { name: "wgpu".into(), reason })
}
