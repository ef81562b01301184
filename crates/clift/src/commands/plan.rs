//! `clift plan`.

use std::path::PathBuf;

use clift_eval::table;
use clift_model::max_tensor_bytes;
use clift_train::{Config, PartPlan, Plan, check_plan, largest_tensor, memory_warning, plan};

use crate::commands::args::shared_args::{ConfigArgs, JsonArg};
use crate::output::stdout::{name_adapter, print_result, print_warning};
use crate::output::units::memory_size;

pub fn run(args: &PlanArgs) -> anyhow::Result<()> {
    let config = args.overrides.read(&args.config, check_plan)?;
    let json = args.json.open_for(&args.config, &config)?;
    name_adapter(config.device, false);
    let plan = plan(&config)?;
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
        let (what, size) = largest_tensor(config, run_step)?;
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
    let Plan { device, threads, parameters, num_tokens: [fewest, most], available_bytes, parts } = plan;
    let available = available_bytes.map_or_else(|| "unknown".into(), memory_size);
    let tokens = if fewest == most { fewest.to_string() } else { format!("{fewest} to {most}") };
    let head = format!(
        "{device}, {threads} threads, memory available: {available}
parameters: {} (encoder {}, condenser {}, renderer {})
tokens per scene: {tokens}
",
        parameters.total, parameters.encoder, parameters.condenser, parameters.renderer
    );
    let columns = ["part", "trains", "peak memory"];
    let table = table(columns, parts.iter().map(cells));
    format!("{head}\n{table}")
}

fn cells(part: &PartPlan) -> [String; 3] {
    let trains = if part.trained_parameters == 0 { "-".into() } else { part.trained_parameters.to_string() };
    [part.part.into(), trains, memory_size(part.peak_bytes)]
}

#[derive(Debug, clap::Args)]
pub struct PlanArgs {
    /// Config file (TOML)
    pub config: PathBuf,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    #[command(flatten)]
    pub json: JsonArg,
}
