//! Devices and networks of the unit tests.

use burn::tensor::Device;
use clift_model::{Architecture, CondenserConfig, DeviceName, ModelConfig};

/// Opens the CPU devices of this build.
pub fn devices() -> Vec<Device> {
    let names = [DeviceName::Flex, DeviceName::Ndarray].into_iter().filter(|name| name.is_built());
    names.map(|name| name.open().expect("a CPU device")).collect()
}

/// Returns a small network with patch tokens.
pub fn small_clift() -> ModelConfig {
    ModelConfig { num_renderer_blocks: 2, ..ModelConfig::small() }
}

/// Returns a small network of LVSM's paper, whose tokens are learned.
pub fn small_lvsm() -> ModelConfig {
    let (architecture, condenser) = (Architecture::LvsmEd, CondenserConfig::NONE);
    ModelConfig { architecture, num_latents: 7, condenser, ..ModelConfig::small() }
}
