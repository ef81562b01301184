//! `clift doctor`: what this machine can train on.

use clift_bench::{DeviceCheck, Gradient, probe};
use clift_eval::machine_rows;
use clift_model::InstructionSet;
use clift_model::{DeviceName, Precision};

use crate::commands::doctor::args::DoctorArgs;
use crate::commands::doctor::{adapters, stability};
use crate::output::stdout::print_result;

/// Largest difference of a gradient from the default device's, over its largest entry. Two orders of f32 sums differ
/// by about 1e-6 here, a wrong kernel by a number near 1.
const TOLERANCE: f64 = 1e-3;

/// The same with f16 operands, whose rounding of 5e-4 passes through four blocks.
const TOLERANCE_F16: f64 = 3e-2;

/// Prints the machine and a row per device, or the hard cases; fails if the default device does, or a case.
pub fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    if args.stability {
        return stability::run(args);
    }
    let machine = [("clift", version())].into_iter().chain(machine_rows()).chain([("kernels", kernels())]);
    let machine: Vec<String> = machine.map(|(name, value)| format!("{name:<12}{value}")).collect();
    print_result(&format!("{}\n", machine.join("\n")))?;
    if let Some(adapters) = adapters::shown() {
        print_result(&format!("{adapters}\n"))?;
    }
    let default = DeviceName::default();
    let reference = probe(default, Precision::F32).and_then(|probe| check(probe, None, TOLERANCE));
    let expected = reference.as_ref().ok();
    let mut rows = vec![HEADER.map(String::from)];
    let mut halves = Vec::new();
    for name in DeviceName::ALL {
        let probed = if name == default {
            reference.clone()
        } else {
            probe(name, Precision::F32).and_then(|probe| check(probe, expected, TOLERANCE))
        };
        if probed.as_ref().is_ok_and(|probe| probe.dtypes.contains(&"f16")) {
            let half = probe(name, Precision::F16).and_then(|probe| check(probe, expected, TOLERANCE_F16));
            halves.push(row(name, Precision::F16, half.as_ref(), expected));
        }
        rows.push(row(name, Precision::F32, probed.as_ref(), expected));
    }
    rows.extend(halves);
    print_result(&table(&rows))?;
    for name in DeviceName::ALL.into_iter().filter(|name| !name.is_built()) {
        print_result(&format!("\n{name} is not in this build: cargo build --release --features {name}"))?;
    }
    match reference {
        Ok(_) => Ok(()),
        Err(reason) => Err(anyhow::anyhow!("the default device, {default}, fails: {reason}")),
    }
}

const HEADER: [&str; 6] = ["device", "state", "adapter", "dtypes", "fwd+bwd", "gradient difference"];

fn version() -> String {
    let features = if cfg!(feature = "wgpu") { "wgpu" } else { "none" };
    let (os, arch) = (std::env::consts::OS, std::env::consts::ARCH);
    format!("{}, cargo features: {features}, {os} {arch}", env!("CARGO_PKG_VERSION"))
}

/// The instruction set of flex's kernels, the others there are, and who chose.
fn kernels() -> String {
    let names = |sets: &mut dyn Iterator<Item = InstructionSet>| {
        let names: Vec<_> = sets.map(InstructionSet::name).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    };
    let variable = InstructionSet::VARIABLE;
    match InstructionSet::forced() {
        Err(bad) => format!("{variable} = {}: {bad}", bad.text),
        Ok(forced) => {
            let used = InstructionSet::detected();
            let why = if forced.is_some() { format!("chosen by {variable}") } else { "the widest here".into() };
            let others = names(&mut InstructionSet::available().filter(|set| *set != used));
            format!("{} ({why}; also possible: {others})", used.name())
        }
    }
}

/// Refuses a gradient that is zero or not finite, or far from the reference.
fn check(probe: DeviceCheck, reference: Option<&DeviceCheck>, tolerance: f64) -> Result<DeviceCheck, String> {
    let Gradient { values, .. } = &probe.gradient;
    if let Some(value) = values.iter().find(|value| !value.is_finite()) {
        return Err(format!("the gradient holds {value}"));
    }
    if values.iter().all(|value| *value == 0.0) {
        return Err("the gradient is zero".into());
    }
    match reference.map(|reference| probe.gradient.difference(&reference.gradient)) {
        Some(difference) if difference.is_nan() || difference > tolerance => {
            Err(format!("the gradient differs by {difference:.1e}, more than {tolerance:.0e}"))
        }
        _ => Ok(probe),
    }
}

fn row(
    name: DeviceName,
    precision: Precision,
    probed: Result<&DeviceCheck, &String>,
    reference: Option<&DeviceCheck>,
) -> [String; 6] {
    let is_half = precision == Precision::F16;
    let is_default = name == DeviceName::default() && !is_half;
    let dash = || "-".to_owned();
    let device = match (is_half, is_default) {
        (true, _) => format!("{name}, f16"),
        (false, true) => format!("{name} (default)"),
        (false, false) => name.to_string(),
    };
    match probed {
        Err(_) if !name.is_built() => [device, "not built".into(), dash(), dash(), dash(), dash()],
        Err(reason) => [device, format!("FAILS: {reason}"), dash(), dash(), dash(), dash()],
        Ok(DeviceCheck { adapter, dtypes, gradient, seconds }) => {
            let difference = match reference {
                _ if is_default => "reference".into(),
                Some(reference) => format!("{:.1e}", gradient.difference(&reference.gradient)),
                None => dash(),
            };
            let time = format!("{:.1} ms", seconds * 1e3);
            [device, "works".into(), adapter.clone(), dtypes.join(" "), time, difference]
        }
    }
}

/// Columns of equal width, two blanks apart; a long state, which ends its row, does not widen them.
fn table(rows: &[[String; 6]]) -> String {
    let is_long = |row: &[String; 6]| row[1].starts_with("FAILS");
    let width = |column: usize| {
        let cells = rows.iter().filter(|row| column == 0 || !is_long(row)).map(|row| row[column].chars().count());
        cells.max().unwrap_or(0) + 2
    };
    let line = |row: &[String; 6]| {
        let shown = if is_long(row) { 2 } else { row.len() };
        let cells = (0..shown).map(|column| format!("{:<width$}", row[column], width = width(column)));
        cells.collect::<String>().trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {

    use super::*;

    fn check_of(values: Vec<f64>) -> DeviceCheck {
        let gradient = Gradient { loss: 1.0, values };
        DeviceCheck { adapter: "CPU".into(), dtypes: vec!["f32"], gradient, seconds: 0.0125 }
    }

    #[test]
    fn a_gradient_that_is_zero_not_finite_or_far_off_fails() {
        let reference = check_of(vec![1.0, -2.0]);
        let checked =
            |values: &[f64]| check(check_of(values.to_vec()), Some(&reference), TOLERANCE).err().unwrap_or_default();
        assert_eq!(checked(&[1.0, -2.0001]), "");
        assert_eq!(checked(&[1.0, f64::NAN]), "the gradient holds NaN");
        assert_eq!(checked(&[0.0, 0.0]), "the gradient is zero");
        assert_eq!(checked(&[1.0, -2.1]), "the gradient differs by 5.0e-2, more than 1e-3");
        assert!(checked(&[1.0]).contains("differs"));
    }

    #[test]
    fn the_table_keeps_its_columns_beside_a_long_failure() {
        let reference = check_of(vec![1.0]);
        let failure = "panicked: a very long reason".to_owned();
        let rows = [
            HEADER.map(String::from),
            row(DeviceName::Flex, Precision::F32, Ok(&reference), Some(&reference)),
            row(DeviceName::Ndarray, Precision::F32, Err(&failure), Some(&reference)),
            row(DeviceName::Flex, Precision::F16, Ok(&reference), Some(&reference)),
        ];
        let expected = "\
device          state  adapter  dtypes  fwd+bwd  gradient difference
flex (default)  works  CPU      f32     12.5 ms  reference
ndarray         FAILS: panicked: a very long reason
flex, f16       works  CPU      f32     12.5 ms  0.0e0";
        assert_eq!(table(&rows), expected);
    }

    #[test]
    fn every_built_cpu_device_works_here_and_agrees_with_the_default() {
        let reference = probe(DeviceName::default(), Precision::F32).unwrap();
        for name in [DeviceName::Flex, DeviceName::Ndarray] {
            let probe = probe(name, Precision::F32).and_then(|probe| check(probe, Some(&reference), TOLERANCE));
            assert!(probe.unwrap().dtypes.contains(&"f32"), "{name}");
        }
    }

    #[test]
    fn f16_is_near_f32_where_it_is_there_and_refused_where_not() {
        let reference = probe(DeviceName::Flex, Precision::F32).unwrap();
        let half = probe(DeviceName::Flex, Precision::F16).unwrap();
        let difference = half.gradient.difference(&reference.gradient);
        assert!(difference > 1e-6 && difference < TOLERANCE_F16, "{difference:e}");
        let message = probe(DeviceName::Ndarray, Precision::F16).unwrap_err();
        assert!(message.contains("has no f16"), "{message}");
    }
}
