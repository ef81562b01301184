//! `clift doctor`: the machine and its devices.

use clift_bench::{DeviceCheck, probe};
use clift_eval::{machine_rows, table};
use clift_model::{DeviceName, InstructionSet, Precision, product_instructions};

use crate::commands::doctor::{adapters, stability};
use crate::output::stdout::print_result;

/// Largest accepted difference of a gradient over its largest entry: orders of sums differ by 1e-6, wrong kernels by 1.
const TOLERANCE: f64 = 1e-3;

/// Largest accepted difference with f16 operands: their rounding of 5e-4 accumulates over four blocks.
const TOLERANCE_F16: f64 = 3e-2;
/// Largest accepted difference with bf16 operands, whose rounding is 8 times that of f16.
const TOLERANCE_BF16: f64 = 2e-1;

/// Prints the machine and a row per device, or runs the stability cases; fails with the default device or a case.
pub fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    if args.stability {
        return stability::run();
    }
    let machine = [("clift", version())].into_iter().chain(machine_rows()).chain([("kernels", kernels())]);
    let machine: Vec<String> = machine.map(|(name, value)| format!("{name:<12}{value}")).collect();
    print_result(&format!("{}\n", machine.join("\n")))?;
    if let Some(adapters) = adapters::adapter_text() {
        print_result(&format!("{adapters}\n"))?;
        // The table says why a device cannot be opened.
        if let Some(text) = DeviceName::Wgpu.open().ok().as_ref().and_then(product_instructions) {
            print_result(&format!("wgpu: {text}\n"))?;
        }
    }
    let default = DeviceName::default();
    let reference = probe(default, Precision::F32).and_then(|probe| check(probe, None, TOLERANCE));
    let expected = reference.as_ref().ok();
    let (mut rows, mut reduced_rows) = (Vec::new(), Vec::new());
    for name in DeviceName::ALL {
        let probed = if name == default {
            reference.clone()
        } else {
            probe(name, Precision::F32).and_then(|probe| check(probe, expected, TOLERANCE))
        };
        for (precision, tolerance) in [(Precision::Bf16, TOLERANCE_BF16), (Precision::F16, TOLERANCE_F16)] {
            let offers = |probe: &DeviceCheck| match precision {
                Precision::Bf16 => name == DeviceName::Flex && InstructionSet::detected().has_bf16(),
                // What offers f16 and cannot be used gets a row with the reason.
                _ => probe.dtypes.contains(&"f16"),
            };
            if probed.as_ref().is_ok_and(offers) {
                let reduced = probe(name, precision).and_then(|probe| check(probe, expected, tolerance));
                reduced_rows.push(row(name, precision, reduced.as_ref(), expected));
            }
        }
        rows.push(row(name, Precision::F32, probed.as_ref(), expected));
    }
    rows.extend(reduced_rows);
    print_result(&device_table(rows))?;
    for name in DeviceName::ALL.into_iter().filter(|name| !name.is_built()) {
        print_result(&format!("{name} is not part of this build: cargo build --release --features {name}"))?;
    }
    match reference {
        Ok(_) => Ok(()),
        Err(reason) => Err(anyhow::anyhow!("the default device {default} failed: {reason}")),
    }
}

fn version() -> String {
    let ndarray = DeviceName::Ndarray.is_built().then_some("ndarray");
    let gpu = DeviceName::Wgpu.is_built().then_some(if cfg!(feature = "wgpu") { "wgpu" } else { "wgsl" });
    let features: Vec<&str> = ndarray.into_iter().chain(gpu).collect();
    let features = if features.is_empty() { "none".into() } else { features.join(", ") };
    let (os, arch) = (std::env::consts::OS, std::env::consts::ARCH);
    format!("{}, cargo features: {features}, {os} {arch}", env!("CARGO_PKG_VERSION"))
}

/// Describes the instruction set of the flex kernels, and the narrower ones of this processor.
fn kernels() -> String {
    let used = InstructionSet::detected();
    let others = InstructionSet::available().filter(|set| *set != used).map(InstructionSet::name);
    let others = Some(others.collect::<Vec<_>>().join(", ")).filter(|names| !names.is_empty());
    format!("{} (widest; also available: {})", used.name(), others.unwrap_or_else(|| "none".into()))
}

/// Refuses a gradient that is zero, not finite or different from the reference.
fn check(probe: DeviceCheck, reference: Option<&DeviceCheck>, tolerance: f64) -> Result<DeviceCheck, String> {
    if let Some(value) = probe.gradient.iter().find(|value| !value.is_finite()) {
        return Err(format!("the gradient contains {value}"));
    }
    if probe.gradient.iter().all(|value| *value == 0.0) {
        return Err("the gradient is zero".into());
    }
    match reference.map(|reference| probe.difference(reference)) {
        Some(difference) if difference.is_nan() || difference > tolerance => {
            Err(format!("the gradient differs by {difference:.1e}, at most {tolerance:.0e} is accepted"))
        }
        _ => Ok(probe),
    }
}

/// Returns the cells of a device, and the reason of a failure.
fn row(
    name: DeviceName,
    precision: Precision,
    probed: Result<&DeviceCheck, &String>,
    reference: Option<&DeviceCheck>,
) -> ([String; 6], Option<String>) {
    let is_default = name == DeviceName::default() && precision == Precision::F32;
    let dash = || "-".to_owned();
    let device = match precision {
        Precision::F32 if is_default => format!("{name} (default)"),
        Precision::F32 => name.to_string(),
        Precision::Bf16 | Precision::F16 => format!("{name}, {precision}"),
    };
    match probed {
        Err(_) if !name.is_built() => ([device, "not built".into(), dash(), dash(), dash(), dash()], None),
        Err(reason) => {
            let failure = format!("{device}: {reason}");
            ([device, "FAILED".into(), dash(), dash(), dash(), dash()], Some(failure))
        }
        Ok(check) => {
            let difference = match reference {
                _ if is_default => "reference".into(),
                Some(reference) => format!("{:.1e}", check.difference(reference)),
                None => dash(),
            };
            let time = format!("{:.1} ms", check.seconds * 1e3);
            ([device, "ok".into(), check.adapter.clone(), check.dtypes.join(" "), time, difference], None)
        }
    }
}

/// Formats the rows, with the reasons of failures below the table.
fn device_table(rows: Vec<([String; 6], Option<String>)>) -> String {
    let (rows, failures): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
    let table = table(["device", "state", "adapter", "dtypes", "fwd+bwd", "gradient difference"], rows);
    [table].into_iter().chain(failures.into_iter().flatten()).collect::<Vec<_>>().join("\n")
}

#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Run the stability cases instead: hard numerical inputs against f64
    #[arg(long)]
    pub stability: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_of(gradient: Vec<f64>) -> DeviceCheck {
        DeviceCheck { adapter: "CPU".into(), dtypes: vec!["f32"], loss: 1.0, gradient, seconds: 0.0125 }
    }

    #[test]
    fn zero_infinite_or_wrong_gradient_fails() {
        let reference = check_of(vec![1.0, -2.0]);
        let checked =
            |values: &[f64]| check(check_of(values.to_vec()), Some(&reference), TOLERANCE).err().unwrap_or_default();
        assert_eq!(checked(&[1.0, -2.0001]), "");
        assert_eq!(checked(&[1.0, f64::NAN]), "the gradient contains NaN");
        assert_eq!(checked(&[0.0, 0.0]), "the gradient is zero");
        assert_eq!(checked(&[1.0, -2.1]), "the gradient differs by 5.0e-2, at most 1e-3 is accepted");
        assert!(checked(&[1.0]).contains("differs"));
    }

    #[test]
    fn table_lists_failures_below_the_rows() {
        let reference = check_of(vec![1.0]);
        let failure = "panicked: a very long reason".to_owned();
        let rows = vec![
            row(DeviceName::Flex, Precision::F32, Ok(&reference), Some(&reference)),
            row(DeviceName::Ndarray, Precision::F32, Err(&failure), Some(&reference)),
            row(DeviceName::Flex, Precision::F16, Ok(&reference), Some(&reference)),
        ];
        let expected = "\
device          state   adapter  dtypes  fwd+bwd  gradient difference
flex (default)  ok      CPU      f32     12.5 ms  reference
ndarray         FAILED  -        -       -        -
flex, f16       ok      CPU      f32     12.5 ms  0.0e0
ndarray: panicked: a very long reason";
        assert_eq!(device_table(rows), expected);
    }
}
