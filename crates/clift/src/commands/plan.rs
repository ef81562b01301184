//! `clift plan`.

use std::path::PathBuf;

use clift_data::plural;
use clift_eval::table;
use clift_model::max_tensor_bytes;
use clift_train::{Config, LargestTensor, PartPlan, Plan, check_plan, largest_tensor, memory_warning, plan};

use crate::commands::args::adapter::name_adapter;
use crate::commands::args::parse::parse_count;
use crate::commands::args::shared_args::{ConfigArgs, JsonArg};
use crate::output::stdout::{print_result, print_warning};
use crate::output::units::{file_size, memory_size};

pub fn run(args: &PlanArgs) -> anyhow::Result<()> {
    let config = args.overrides.read(&args.config, check_plan)?;
    let json = args.json.open_for(&args.config, &config)?;
    name_adapter(config.device, false);
    let plan = plan(&config, args.ranks)?;
    print_result(&report_text(&plan))?;
    print_result(&largest_tensors(&config)?)?;
    if let Some(warning) = memory_warning(&config, plan.available_bytes)? {
        print_warning(warning);
    }
    json.write(&plan)
}

fn largest_tensors(config: &Config) -> anyhow::Result<String> {
    // A plan for a device that this machine does not have shows no limit.
    let limit = config.device.open().ok().and_then(|device| max_tensor_bytes(&device));
    let mut rows = Vec::new();
    for &run_step in config.run_steps() {
        let LargestTensor { what, bytes: size, .. } = largest_tensor(config, run_step)?;
        let verdict = match limit {
            Some(limit) if size > limit => "TOO LARGE: `clift train` refuses this config",
            Some(_) => "fits",
            None => "",
        };
        let limit = limit.map_or_else(|| "-".into(), memory_size);
        rows.push([run_step.name().into(), what, memory_size(size), limit, verdict.into()]);
    }
    Ok(format!("\n{}", table(["part", "largest tensor", "size", "limit", ""], rows)))
}

fn report_text(plan: &Plan) -> String {
    let Plan { num_ranks, device, threads, parameters, num_tokens: [fewest, most], available_bytes, parts } = plan;
    let available = available_bytes.map_or_else(|| "unknown".into(), memory_size);
    let tokens = if fewest == most { fewest.to_string() } else { format!("{fewest} to {most}") };
    let head = format!(
        "{device}, {threads} threads, memory available: {available}
parameters: {} (encoder {}, condenser {}, renderer {})
tokens per scene: {tokens}
",
        parameters.total, parameters.encoder, parameters.condenser, parameters.renderer
    );
    let columns = ["part", "trains", "count", "peak memory", "GMACs each"];
    let sums = (*num_ranks > 1).then(|| {
        let sent = parts.iter().filter(|part| part.sent_bytes > 0);
        let sent = sent.map(|part| format!("{} {}", part.part, file_size(part.sent_bytes))).collect::<Vec<_>>();
        format!("\none of {num_ranks} ranks; sent by a rank per step: {}", sent.join(", "))
    });
    let table = table(columns, parts.iter().map(cells));
    [head, table].into_iter().chain(sums).collect::<Vec<_>>().join("\n")
}

fn cells(part: &PartPlan) -> [String; 5] {
    let count = part.count.map_or_else(|| format!("every {}", part.unit), |count| plural(count as usize, part.unit));
    [
        part.part.into(),
        if part.trained_parameters == 0 { "-".into() } else { part.trained_parameters.to_string() },
        count,
        memory_size(part.peak_bytes),
        format!("{:.3}", part.gmacs),
    ]
}

#[derive(Debug, clap::Args)]
pub struct PlanArgs {
    /// Config file (TOML)
    pub config: PathBuf,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    /// Plan for one of N ranks, each with a device like this one
    #[arg(long, value_name = "N", value_parser = parse_count, default_value_t = 1)]
    pub ranks: usize,
    #[command(flatten)]
    pub json: JsonArg,
}

#[cfg(test)]
mod tests {
    use clift_model::{DeviceName, Parameters};

    use super::*;

    #[test]
    fn unknown_values_are_marked() {
        let part = |part, unit, count| PartPlan {
            part,
            unit,
            count,
            trained_parameters: if unit == "step" { 30 } else { 0 },
            gmacs: 1.5,
            peak_bytes: 3 << 29,
            sent_bytes: 120,
        };
        let mut plan = Plan {
            num_ranks: 1,
            device: DeviceName::Flex,
            threads: 2,
            parameters: Parameters { encoder: 10, lift_norm: 0, condenser: 20, renderer: 30, total: 60 },
            num_tokens: [64, 96],
            available_bytes: None,
            parts: vec![part("stage1", "step", Some(7200)), part("eval", "scene", None)],
        };
        let expected = "\
flex, 2 threads, memory available: unknown
parameters: 60 (encoder 10, condenser 20, renderer 30)
tokens per scene: 64 to 96

part    trains  count        peak memory  GMACs each
stage1  30      7200 steps   1.50 GiB     1.500
eval    -       every scene  1.50 GiB     1.500";
        assert_eq!(report_text(&plan), expected);
        plan.num_ranks = 8;
        let expected = "\none of 8 ranks; sent by a rank per step: stage1 120 bytes, eval 120 bytes";
        assert!(report_text(&plan).ends_with(expected));
    }
}
