//! Kept, peak and free memory, on Linux.

use clift_model::DeviceName;

use crate::system::machine::proc_field;

/// Lets the process keep freed memory, for its next allocation: fresh pages, which the system fills with zeros, take 5 to 8 %
/// of a training step.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: both values are valid (mallopt(3)): never return the end of the heap, no allocations outside of it.
    unsafe {
        libc::mallopt(libc::M_TRIM_THRESHOLD, -1);
        libc::mallopt(libc::M_MMAP_MAX, 0);
    }
}

/// Resets the peak to the current resident memory. Returns `None` where the system has no resettable peak.
pub fn start_peak() -> Option<()> {
    // glibc keeps freed memory otherwise, and a bench row after an f64 comparison would count the memory of the comparison.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: any thread may call malloc_trim at any time (malloc_trim(3)); the call touches only free memory.
    unsafe {
        libc::malloc_trim(0);
    }
    // 5 resets the "high water mark" (proc(5)).
    std::fs::write("/proc/self/clear_refs", "5").ok()
}

/// Returns the peak of the resident memory since [`start_peak`], in bytes.
pub fn peak_bytes() -> Option<u64> {
    field_bytes("/proc/self/status", "VmHWM")
}

/// Returns the free memory of a CPU device: that of the system or of the process's control group, whichever is less.
/// `None` for a GPU and on systems that do not report it.
pub fn available_bytes(device: DeviceName) -> Option<u64> {
    if !device.is_cpu() {
        return None;
    }
    let system = field_bytes("/proc/meminfo", "MemAvailable")?;
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let group = number("/sys/fs/cgroup/memory.max").map(|most| {
        let statistics = std::fs::read_to_string("/sys/fs/cgroup/memory.stat").unwrap_or_default();
        let current = number("/sys/fs/cgroup/memory.current").unwrap_or(0);
        most.saturating_sub(current.saturating_sub(reclaimable_bytes(&statistics)))
    });
    Some(group.unwrap_or(u64::MAX).min(system))
}

/// Returns the bytes of cached files in the statistics of a control group, which the system frees on demand.
fn reclaimable_bytes(statistics: &str) -> u64 {
    let value = statistics.lines().find_map(|line| line.strip_prefix("inactive_file "));
    value.and_then(|bytes| bytes.trim().parse().ok()).unwrap_or(0)
}

fn field_bytes(path: &str, name: &str) -> Option<u64> {
    let text = std::fs::read_to_string(path).ok()?;
    Some(proc_field(&text, name)?.strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_includes_freed_memory_until_reset() {
        const BYTES: u64 = 1 << 28;
        if start_peak().is_none() {
            return;
        }
        drop(std::hint::black_box(vec![1_u8; BYTES as usize]));
        let Some(peak) = peak_bytes() else { return };
        assert!(peak >= BYTES, "{peak}");
        start_peak();
        // Other tests allocate far less meanwhile.
        assert!(peak_bytes().is_some_and(|after| after < peak - BYTES / 2));
    }

    #[test]
    fn free_memory_is_reported_for_cpu_devices() {
        assert_eq!(available_bytes(DeviceName::Wgpu), None);
        assert!(available_bytes(DeviceName::Flex).is_none_or(|bytes| bytes > 1 << 20));
        assert_eq!(reclaimable_bytes("anon 7\ninactive_anon 3\ninactive_file 4096\nactive_file 5\n"), 4096);
        assert_eq!(reclaimable_bytes(""), 0);
    }
}
