//! The resident memory of this process at its peak, where the system tells.

use std::path::Path;

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
    fn a_file_without_the_field_gives_none() {
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        std::fs::write(file.path(), "VmRSS:\t  7 kB\nVmHWM:\t  12 kB\n").expect("writable");
        assert_eq!(field_bytes(file.path(), "VmHWM:"), Some(12 * 1024));
        assert_eq!(field_bytes(file.path(), "VmSwap:"), None);
        assert_eq!(field_bytes(Path::new("no/such/file"), "VmHWM:"), None);
    }
}
