//! Table of the GPU adapters for `wgpu`, with their limits.

use clift_eval::table;
use clift_model::{ADAPTER_VARIABLE, Adapter, adapters};

use crate::output::units::memory_size;

/// Formats the adapters with their limits, or the reason why there are none; `None` in a build without `wgpu`.
pub fn adapter_text() -> Option<String> {
    if !cfg!(feature = "wgpu") {
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
    let header = ["adapter of wgpu", "kind", "API", "driver", "largest tensor", "workgroup", "f16"];
    let mut lines = vec![table(header, adapters.iter().map(cells))];
    let details = adapters.iter().map(|adapter| {
        let Adapter { name, limits, .. } = adapter;
        format!(
            "{name}: at most {} per binding, {} per buffer, {} workgroups per dimension",
            memory_size(limits.max_binding_bytes),
            memory_size(limits.max_buffer_bytes),
            limits.max_workgroups
        )
    });
    lines.extend(details);
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

fn cells(adapter: &Adapter) -> [String; 7] {
    let Adapter { name, kind, api, driver, limits, has_f16, .. } = adapter;
    [
        name.clone(),
        (*kind).into(),
        api.clone(),
        driver.clone(),
        memory_size(limits.max_tensor_bytes()),
        format!("{} threads, {} KiB", limits.max_workgroup_threads, limits.max_workgroup_bytes >> 10),
        if *has_f16 { "yes" } else { "no" }.into(),
    ]
}

#[cfg(test)]
mod tests {
    use clift_model::Limits;

    use super::*;

    #[test]
    fn table_names_the_used_adapter_and_the_others() {
        let limits = Limits {
            max_binding_bytes: (1 << 31) - 4,
            max_buffer_bytes: 1 << 40,
            max_workgroup_threads: 1024,
            max_workgroup_bytes: 48 << 10,
            max_workgroups: 65535,
        };
        let adapter = |number: usize| Adapter {
            name: format!("Card {number}"),
            kind: "discrete GPU",
            api: "Vulkan".into(),
            driver: "maker 1.2".into(),
            selector: format!("DiscreteGpu({number})"),
            is_used: number == 0,
            limits,
            has_f16: number == 1,
        };
        let expected = "\
adapter of wgpu  kind          API     driver     largest tensor  workgroup             f16
Card 0           discrete GPU  Vulkan  maker 1.2  2.00 GiB        1024 threads, 48 KiB  no
Card 1           discrete GPU  Vulkan  maker 1.2  2.00 GiB        1024 threads, 48 KiB  yes
Card 0: at most 2.00 GiB per binding, 1024.00 GiB per buffer, 65535 workgroups per dimension
Card 1: at most 2.00 GiB per binding, 1024.00 GiB per buffer, 65535 workgroups per dimension
wgpu uses Card 0; select another with CUBECL_WGPU_DEFAULT_DEVICE='DiscreteGpu(1)'";
        assert_eq!(adapter_table(&[adapter(0), adapter(1)]), expected);
        assert!(adapter_table(&[adapter(1)]).ends_with("matches no adapter"));
    }
}
