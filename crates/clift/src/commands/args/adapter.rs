//! The adapter of the device `wgpu`, named before the work on it.

use clift_model::{DeviceName, used_adapter};

use crate::output::stdout::{print_note, print_warning};

/// Prints the adapter of `wgpu`; nothing for other devices. `compiles` says that the silence of the first step follows.
pub fn name_adapter(device: DeviceName, compiles: bool) {
    if device != DeviceName::Wgpu {
        return;
    }
    let Some(adapter) = used_adapter() else { return };
    print_note(&format!("wgpu: {adapter}"));
    if adapter.kind == "software" {
        print_warning("this adapter is software on the CPU: `--device flex` is many times faster");
    }
    if compiles {
        print_note(&format!("compiling kernels for {}: the first step may take minutes", adapter.name));
    }
}
