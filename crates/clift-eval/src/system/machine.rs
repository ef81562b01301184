//! Processor and memory of the machine, for reports.

use std::thread::available_parallelism;

/// Returns processor and memory as rows of name and value.
pub fn machine_rows() -> Vec<(&'static str, String)> {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let model = proc_field(&read("/proc/cpuinfo"), "model name").unwrap_or_else(|| "unknown processor".into());
    let cores = available_parallelism().map_or_else(|_| "unknown".into(), |count| count.to_string());
    let meminfo = read("/proc/meminfo");
    let gib = |name: &str| {
        let kib: f64 = proc_field(&meminfo, name)?.strip_suffix("kB")?.trim().parse().ok()?;
        Some(kib / (1024.0 * 1024.0))
    };
    let memory = match (gib("MemTotal"), gib("MemAvailable")) {
        (Some(total), Some(available)) => format!("{total:.1} GiB, {available:.1} GiB available"),
        (Some(total), None) => format!("{total:.1} GiB"),
        (None, _) => "unknown".into(),
    };
    vec![("processor", format!("{model}, threads: {cores}")), ("memory", memory)]
}

/// Returns the value of the first line `name : value` of a file in `/proc`.
pub(crate) fn proc_field(text: &str, name: &str) -> Option<String> {
    let mut lines = text.lines().filter_map(|line| line.split_once(':'));
    lines.find(|(key, _)| key.trim() == name).map(|(_, value)| value.trim().to_owned())
}
