//! Peak resident memory of the process, on Linux.

use crate::system::machine::proc_field;

/// Resets the peak to the current resident memory. Returns `None` where the system has no resettable peak.
pub fn start_peak() -> Option<()> {
    release_free_memory();
    // 5 resets the "high water mark" (proc(5)).
    std::fs::write("/proc/self/clear_refs", "5").ok()
}

/// Returns freed memory to the system. glibc keeps freed memory otherwise, and a bench row after an f64 comparison would
/// count the memory of the comparison.
fn release_free_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        unsafe extern "C" {
            fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        // SAFETY: malloc_trim is a function of the linked C library. Any thread may call malloc_trim at any time
        // (malloc_trim(3)); the call touches only free memory.
        unsafe { malloc_trim(0) };
    }
}

/// Returns the peak of the resident memory since [`start_peak`], in bytes.
pub fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    Some(proc_field(&status, "VmHWM")?.strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
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
}
