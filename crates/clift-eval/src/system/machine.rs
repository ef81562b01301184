//! Processor and memory of the machine, for reports.

use std::thread::available_parallelism;

/// Returns processor, instruction sets and memory as rows of name and value.
pub fn machine_rows() -> Vec<(&'static str, String)> {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let model = proc_field(&read("/proc/cpuinfo"), "model name").unwrap_or_else(|| "unknown processor".into());
    let cores = available_parallelism().map_or_else(|_| "unknown".into(), |count| count.to_string());
    let features: Vec<String> = features().iter().map(|(name, has)| format!("{name} {}", yes(*has))).collect();
    vec![
        ("processor", format!("{model}, threads: {cores}")),
        ("features", if features.is_empty() { "none of avx2, fma, avx512".into() } else { features.join(", ") }),
        ("memory", memory(&read("/proc/meminfo"))),
    ]
}

fn yes(has: bool) -> &'static str {
    if has { "yes" } else { "no" }
}

/// Returns the instruction sets that matter for matrix multiplication.
#[cfg(target_arch = "x86_64")]
fn features() -> Vec<(&'static str, bool)> {
    vec![
        ("avx2", is_x86_feature_detected!("avx2")),
        ("fma", is_x86_feature_detected!("fma")),
        ("avx512f", is_x86_feature_detected!("avx512f")),
        ("avx512bw", is_x86_feature_detected!("avx512bw")),
    ]
}

#[cfg(not(target_arch = "x86_64"))]
fn features() -> Vec<(&'static str, bool)> {
    Vec::new()
}

fn memory(meminfo: &str) -> String {
    let gib = |name: &str| {
        let kib: f64 = proc_field(meminfo, name)?.strip_suffix("kB")?.trim().parse().ok()?;
        Some(kib / (1024.0 * 1024.0))
    };
    match (gib("MemTotal"), gib("MemAvailable")) {
        (Some(total), Some(available)) => format!("{total:.1} GiB, {available:.1} GiB available"),
        (Some(total), None) => format!("{total:.1} GiB"),
        (None, _) => "unknown".into(),
    }
}

/// Returns the value of the first line `name : value` of a file in `/proc`.
pub(crate) fn proc_field(text: &str, name: &str) -> Option<String> {
    let mut lines = text.lines().filter_map(|line| line.split_once(':'));
    lines.find(|(key, _)| key.trim() == name).map(|(_, value)| value.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_printed_in_gib_or_unknown() {
        let text = "MemTotal:       25165824 kB\nMemFree: 1 kB\nMemAvailable:   22020096 kB\n";
        assert_eq!(memory(text), "24.0 GiB, 21.0 GiB available");
        assert_eq!(memory("MemTotal: 1048576 kB"), "1.0 GiB");
        assert_eq!(memory(""), "unknown");
    }
}
