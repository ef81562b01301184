//! `clift plan`.

use std::path::PathBuf;

use anyhow::Context;
use clift_bench::{PartPlan, Plan, check_plan, plan};
use clift_data::replace_file;
use clift_model::{DeviceName, max_tensor_bytes};
use clift_train::{Config, LargestTensor, PARTS, largest_tensor, memory_warning, read_checked_config};

use crate::exit_code::UsageError;
use crate::output::stdout::{print_note, print_result};
use crate::output::table;
use crate::output::units::{bytes, duration, seconds};

/// Prints what a run is going to take.
pub fn run(args: &PlanArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_checked_config(&args.config, &args.set, check_plan)?;
    for change in overrides {
        print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    if let Some(json) = &args.json
        && !crate::output::units::folder_of(json).is_dir()
    {
        return Err(UsageError(format!("there is no folder for --json {}", json.display())).into());
    }
    let planned = plan(&config, !args.no_time)?;
    print_result(&shown(&planned))?;
    print_result(&largest_tensors(&config)?)?;
    if let Some(warning) = memory_warning(&config, planned.available_bytes)? {
        print_note(&format!("warning: {warning}"));
    }
    if let Some(json) = &args.json {
        let mut text = serde_json::to_vec_pretty(&planned).context("writing the plan as JSON")?;
        text.push(b'\n');
        replace_file(json, &text).with_context(|| format!("writing {}", json.display()))?;
        print_result(&format!("plan: {}", json.display()))?;
    }
    Ok(())
}

/// The largest tensor of every part beside what the device takes in one.
fn largest_tensors(config: &Config) -> anyhow::Result<String> {
    // A plan can be made for a device that is not here.
    let limit = config.device.open().ok().and_then(|device| max_tensor_bytes(&device));
    let mut rows = vec![["part", "largest tensor", "bytes", "at most", ""].map(String::from)];
    for part in PARTS {
        let LargestTensor { what, bytes: size, .. } = largest_tensor(config, part)?;
        let verdict = match limit {
            Some(limit) if size > limit => "TOO LARGE: clift train refuses it",
            Some(_) => "fits",
            None => "",
        };
        let most = limit.map_or_else(|| "-".into(), bytes);
        rows.push([part.name().into(), what, bytes(size), most, verdict.into()]);
    }
    Ok(format!("\n{}", table::columns(&rows)))
}

const HEADER: [&str; 8] =
    ["part", "trains", "how many", "peak memory", "GMACs each", "reading each", "time each", "time"];

fn shown(plan: &Plan) -> String {
    let Plan { device, threads, parameters, num_tokens: [fewest, most], available_bytes, parts } = plan;
    let available = available_bytes.map_or_else(|| "unknown".into(), bytes);
    let tokens = if fewest == most { fewest.to_string() } else { format!("{fewest} to {most}") };
    let head = format!(
        "{device}, {threads} threads, memory available: {available}
parameters: {} (encoder {}, condenser {}, renderer {})
tokens of a scene: {tokens}
",
        parameters.total, parameters.encoder, parameters.condenser, parameters.renderer
    );
    let rows: Vec<_> = [HEADER.map(String::from)].into_iter().chain(parts.iter().map(cells)).collect();
    let total: Option<f64> = parts.iter().map(PartPlan::total_s).sum();
    let total = total.map(|total| format!("\nin all: {}", duration(total)));
    [head, table::columns(&rows)].into_iter().chain(total).collect::<Vec<_>>().join("\n")
}

fn cells(part: &PartPlan) -> [String; 8] {
    let dash = || "-".to_owned();
    let count = part.count.map_or_else(|| format!("every {}", part.unit), |count| format!("{count} {}s", part.unit));
    [
        part.part.into(),
        if part.trained_parameters == 0 { dash() } else { part.trained_parameters.to_string() },
        count,
        bytes(part.peak_bytes),
        format!("{:.3}", part.gmacs),
        part.loading_s.map_or_else(dash, seconds),
        part.seconds.map_or_else(dash, seconds),
        part.total_s().map_or_else(dash, duration),
    ]
}

/// Arguments of `clift plan`.
#[derive(Debug, clap::Args)]
pub struct PlanArgs {
    /// The experiment, a TOML file
    pub config: PathBuf,
    /// Change a key of the config: `--set stage1.accumulate=4`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Leave out the times, which take some seconds to find
    #[arg(long)]
    pub no_time: bool,
    /// Write the plan as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use clift_model::{DeviceName, Parameters};

    use super::*;

    #[test]
    fn the_table_says_what_is_not_known() {
        let part = |part, unit, count, seconds| PartPlan {
            part,
            unit,
            count,
            trained_parameters: if unit == "step" { 30 } else { 0 },
            gmacs: 1.5,
            peak_bytes: 3 << 29,
            compute_s: seconds,
            busy_threads: None,
            loading_s: None,
            seconds,
        };
        let plan = Plan {
            device: DeviceName::Flex,
            threads: 2,
            parameters: Parameters { encoder: 10, lift_norm: 0, condenser: 20, renderer: 30, total: 60 },
            num_tokens: [64, 96],
            available_bytes: None,
            parts: vec![part("stage1", "step", Some(7200), Some(0.5)), part("eval", "scene", None, Some(2.0))],
        };
        let expected = "\
flex, 2 threads, memory available: unknown
parameters: 60 (encoder 10, condenser 20, renderer 30)
tokens of a scene: 64 to 96

part    trains  how many     peak memory  GMACs each  reading each  time each  time
stage1  30      7200 steps   1.50 GiB     1.500       -             500 ms     1 h 0 min
eval    -       every scene  1.50 GiB     1.500       -             2.00 s     -";
        assert_eq!(shown(&plan), expected);
    }
}
