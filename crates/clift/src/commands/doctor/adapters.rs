//! Table of the GPU adapters for `wgpu`, with the largest tensor of each.

use clift_eval::table;
use clift_model::{ADAPTER_VARIABLE, Adapter, DeviceName, adapters};

use crate::output::units::memory_size;

/// Formats the adapters, or the reason why there are none; `None` in a build without GPUs.
pub fn adapter_text() -> Option<String> {
    if !DeviceName::Wgpu.is_built() {
        return None;
    }
    // Drivers may panic.
    Some(match clift_bench::catch_panic(adapters) {
        Ok(found) if found.is_empty() => "\nno adapter for wgpu; install a Vulkan driver".into(),
        Ok(found) => format!("\n{}", adapter_table(&found)),
        Err(panic) => format!("\nno adapter for wgpu: the driver panicked: {panic}"),
    })
}

fn adapter_table(adapters: &[Adapter]) -> String {
    let header = ["adapter of wgpu", "kind", "API", "driver", "largest tensor", "f16"];
    let mut lines = vec![table(header, adapters.iter().map(cells))];
    match adapters.iter().find(|adapter| adapter.is_used) {
        Some(used) if adapters.len() > 1 => {
            let others = adapters.iter().filter(|adapter| !adapter.is_used);
            let others = others.map(|adapter| format!("{ADAPTER_VARIABLE}='{}'", adapter.selector));
            let others = others.collect::<Vec<_>>().join(" or ");
            lines.push(format!("wgpu uses {}; select another with {others}", used.name));
        }
        Some(used) => lines.push(format!("wgpu uses {}", used.name)),
        None => lines.push(format!("{ADAPTER_VARIABLE} matches no adapter")),
    }
    lines.join("\n")
}

fn cells(adapter: &Adapter) -> [String; 6] {
    let Adapter { name, kind, api, driver, max_tensor_bytes, has_f16, .. } = adapter;
    let largest = memory_size(*max_tensor_bytes);
    [name.clone(), (*kind).into(), api.clone(), driver.clone(), largest, if *has_f16 { "yes" } else { "no" }.into()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_names_the_used_adapter_and_the_others() {
        let adapter = |number: usize| Adapter {
            name: format!("Card {number}"),
            kind: "discrete GPU",
            api: "Vulkan".into(),
            driver: "maker 1.2".into(),
            selector: format!("DiscreteGpu({number})"),
            is_used: number == 0,
            max_tensor_bytes: (1 << 31) - 4,
            has_f16: number == 1,
        };
        let expected = "\
adapter of wgpu  kind          API     driver     largest tensor  f16
Card 0           discrete GPU  Vulkan  maker 1.2  2.00 GiB        no
Card 1           discrete GPU  Vulkan  maker 1.2  2.00 GiB        yes
wgpu uses Card 0; select another with CUBECL_WGPU_DEFAULT_DEVICE='DiscreteGpu(1)'";
        assert_eq!(adapter_table(&[adapter(0), adapter(1)]), expected);
        assert!(adapter_table(&[adapter(1)]).ends_with("matches no adapter"));
    }
}
