//! The adapters that the device `wgpu` can be, with the limits that matter.

use clift_model::{ADAPTER_VARIABLE, Adapter, adapters};

use crate::output::table;
use crate::output::units::bytes;

/// Adapters and their limits, or why there are none; nothing in a build without `wgpu`.
pub fn shown() -> Option<String> {
    if !cfg!(feature = "wgpu") {
        return None;
    }
    // Drivers that fail do so in many ways.
    let found = clift_bench::catch_panic(adapters);
    Some(match found {
        Ok(found) if found.is_empty() => "\nno adapter for wgpu: install a Vulkan driver".into(),
        Ok(found) => format!("\n{}", text(&found)),
        Err(panic) => format!("\nno adapter for wgpu: panicked: {panic}"),
    })
}

const HEADER: [&str; 7] = ["adapter of wgpu", "kind", "API", "driver", "largest tensor", "workgroup", "f16"];

fn text(adapters: &[Adapter]) -> String {
    let rows: Vec<_> = [HEADER.map(String::from)].into_iter().chain(adapters.iter().map(cells)).collect();
    let mut lines = vec![table::columns(&rows)];
    let details = adapters.iter().map(|adapter| {
        let Adapter { name, limits, .. } = adapter;
        format!(
            "{name}: a shader sees {} of a buffer at once, a buffer has at most {}, a launch {} workgroups a side",
            bytes(limits.max_binding_bytes),
            bytes(limits.max_buffer_bytes),
            limits.max_workgroups
        )
    });
    lines.extend(details);
    match adapters.iter().find(|adapter| adapter.is_used) {
        Some(used) if adapters.len() > 1 => {
            let others = adapters.iter().filter(|adapter| !adapter.is_used);
            let others = others.map(|adapter| format!("{ADAPTER_VARIABLE}='{}'", adapter.selector));
            let others = others.collect::<Vec<_>>().join(" or ");
            lines.push(format!("wgpu is {}; to choose another: {others}", used.name));
        }
        Some(used) => lines.push(format!("wgpu is {}", used.name)),
        None => lines.push(format!("{ADAPTER_VARIABLE} names none of them")),
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
        bytes(limits.max_tensor_bytes()),
        format!("{} threads, {} KiB", limits.max_workgroup_threads, limits.max_workgroup_bytes >> 10),
        if *has_f16 { "yes" } else { "no" }.into(),
    ]
}

#[cfg(test)]
mod tests {
    use clift_model::Limits;

    use super::*;

    #[test]
    fn several_adapters_say_which_is_used_and_how_to_choose_another() {
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
Card 0: a shader sees 2.00 GiB of a buffer at once, a buffer has at most 1024.00 GiB, a launch 65535 workgroups a side
Card 1: a shader sees 2.00 GiB of a buffer at once, a buffer has at most 1024.00 GiB, a launch 65535 workgroups a side
wgpu is Card 0; to choose another: CUBECL_WGPU_DEFAULT_DEVICE='DiscreteGpu(1)'";
        assert_eq!(text(&[adapter(0), adapter(1)]), expected);
        assert!(text(&[adapter(1)]).ends_with("names none of them"));
    }
}
