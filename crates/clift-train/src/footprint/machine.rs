//! The memory there is.

use clift_model::DeviceName;

/// Memory that a device has for a run to fill, as far as the system tells: of a CPU device what is free for use, and
/// what the process's control group leaves.
pub fn available_bytes(device: DeviceName) -> Option<u64> {
    if !matches!(device, DeviceName::Flex | DeviceName::Ndarray) {
        return None;
    }
    let meminfo = std::fs::read_to_string("/proc/meminfo").ok()?;
    let kib: u64 = field(&meminfo, "MemAvailable:")?.strip_suffix("kB")?.trim().parse().ok()?;
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let group = number("/sys/fs/cgroup/memory.max").map(|most| {
        let statistics = std::fs::read_to_string("/sys/fs/cgroup/memory.stat").unwrap_or_default();
        let current = number("/sys/fs/cgroup/memory.current").unwrap_or(0);
        most.saturating_sub(current.saturating_sub(reclaimable(&statistics)))
    });
    Some(group.unwrap_or(u64::MAX).min(kib * 1024))
}

/// Memory that a process of this program holds besides its tensors: its code, threads and buffers (docs/guide/training.md).
pub fn process_overhead_bytes() -> u64 {
    20 << 20
}

/// What a control group counts as used and gives back when asked: files that were read and are not in use.
fn reclaimable(statistics: &str) -> u64 {
    field(statistics, "inactive_file ").and_then(|bytes| bytes.parse().ok()).unwrap_or(0)
}

fn field<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find_map(|line| line.strip_prefix(name)).map(str::trim)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_does_not_tell_and_a_processor_has_some_where_the_system_says() {
        assert_eq!(available_bytes(DeviceName::Wgpu), None);
        if let Some(bytes) = available_bytes(DeviceName::Flex) {
            assert!(bytes > 1 << 20, "{bytes}");
        }
        assert_eq!(reclaimable("anon 7\ninactive_anon 3\ninactive_file 4096\nactive_file 5\n"), 4096);
        assert_eq!(reclaimable(""), 0);
        assert_eq!(field("MemTotal: 1 kB\nMemAvailable:   12 kB\n", "MemAvailable:"), Some("12 kB"));
    }
}
