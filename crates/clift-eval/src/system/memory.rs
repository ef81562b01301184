//! The resident memory of this process at its peak, where the system tells.

use std::path::Path;

use clift_model::DeviceName;

/// Starts a new peak at what is resident now. `None` where the system cannot: then there is no peak either.
pub fn start_peak() -> Option<()> {
    give_back();
    // 5 resets the "high water mark" (proc(5)).
    std::fs::write("/proc/self/clear_refs", "5").ok()
}

/// Returns what was freed to the system: glibc keeps it otherwise, and a row after an f64 comparison would seem to
/// need twice its memory.
fn give_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        unsafe extern "C" {
            fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        // SAFETY: a function of the C library that every program here is linked with; it may be called at any time
        // from any thread (malloc_trim(3)) and touches free memory alone.
        unsafe { malloc_trim(0) };
    }
}

/// Most bytes resident since [`start_peak`].
pub fn peak_bytes() -> Option<u64> {
    field_bytes(Path::new("/proc/self/status"), "VmHWM:")
}

/// Returns the free memory of a CPU device: that of the system or of the process's control group, whichever is less.
/// `None` for a GPU and on systems that do not report it.
pub fn available_bytes(device: DeviceName) -> Option<u64> {
    if !matches!(device, DeviceName::Flex | DeviceName::Ndarray) {
        return None;
    }
    let system = field_bytes(Path::new("/proc/meminfo"), "MemAvailable:")?;
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

fn field_bytes(path: &Path, name: &str) -> Option<u64> {
    let text = std::fs::read_to_string(path).ok()?;
    let value = text.lines().find_map(|line| line.strip_prefix(name))?;
    Some(value.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_holds_what_was_freed_and_a_new_one_starts_lower() {
        const BYTES: u64 = 1 << 28;
        if start_peak().is_none() {
            return; // a system without it
        }
        drop(std::hint::black_box(vec![1_u8; BYTES as usize]));
        let Some(peak) = peak_bytes() else { return };
        assert!(peak >= BYTES, "{peak}");
        start_peak();
        // What other tests allocate meanwhile is far from a quarter of a gibibyte.
        assert!(peak_bytes().is_some_and(|after| after < peak - BYTES / 2));
    }

    #[test]
    fn free_memory_is_reported_for_cpu_devices() {
        assert_eq!(available_bytes(DeviceName::Wgpu), None);
        assert!(available_bytes(DeviceName::Flex).is_none_or(|bytes| bytes > 1 << 20));
        assert_eq!(reclaimable_bytes("anon 7\ninactive_anon 3\ninactive_file 4096\nactive_file 5\n"), 4096);
        assert_eq!(reclaimable_bytes(""), 0);
    }

    #[test]
    fn a_file_without_the_field_gives_none() {
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        std::fs::write(file.path(), "VmRSS:\t  7 kB\nVmHWM:\t  12 kB\n").expect("writable");
        assert_eq!(field_bytes(file.path(), "VmHWM:"), Some(12 * 1024));
        assert_eq!(field_bytes(file.path(), "VmSwap:"), None);
        assert_eq!(field_bytes(Path::new("no/such/file"), "VmHWM:"), None);
    }
}
