//! `clift train`.

use std::path::PathBuf;
use std::rc::Rc;

use clift_eval::available_bytes;
use clift_model::peak_flops;
use clift_train::{
    BatchParts, Config, Event, Ranks, Run, RunEstimate, RunOptions, RunStep, Stage, StageSettings, estimate_run,
    memory_warning,
};

use crate::commands::args::adapter::name_adapter;
use crate::commands::args::parse::{parse_count, parse_training_step};
use crate::commands::args::shared_args::ConfigArgs;
use crate::commands::ranks::{connect, finish};
use crate::interrupt::{self, Ending};
use crate::output::progress_sink::progress_sink;
use crate::output::stdout::{print_run, print_warning};
use crate::output::units::duration;

pub fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let ranks = connect()?;
    finish(&ranks, train(args, &ranks))
}

fn train(args: &TrainArgs, ranks: &Rc<Ranks>) -> anyhow::Result<()> {
    let config = args.overrides.read(&args.config, Config::validate)?;
    // Before the system ends a run for its memory after hours of training.
    let mut of_rank = config.clone();
    for stage in [Stage::Stage1, Stage::Stage2] {
        let StageSettings { batch_size, accumulate, .. } = config.stage(stage);
        of_rank.set_accumulate(stage, BatchParts::new(batch_size, accumulate, ranks).num_parts());
    }
    if let Ok(Some(warning)) = memory_warning(&of_rank, available_bytes(config.device)) {
        print_warning(warning);
    }
    name_adapter(config.device, true);
    let stop = interrupt::flag(Ending::RUN)?;
    let options = RunOptions { only: args.only, overfit: args.overfit, fresh: args.fresh, extend: args.extend };
    let mut sink = progress_sink();
    let (planned, num_ranks) = (config.clone(), ranks.num_ranks());
    // The first measured steps tell the time of the later stages, too.
    let mut sink = move |event: &Event| {
        sink.event(event);
        if let (Event::Pace { stage, step, step_s, .. }, None) = (event, args.only)
            && let Ok(RunEstimate { flops_per_s, remaining_s }) =
                estimate_run(&planned, num_ranks, *stage, *step, *step_s)
        {
            let (rate, left) = (flops_per_s / 1e9, duration(remaining_s));
            let peak = planned.device.open().ok().and_then(|device| peak_flops(&device, planned.precision));
            let share =
                peak.map_or_else(String::new, |peak| format!(" ({:.0} % of the peak)", 100.0 * flops_per_s / peak));
            let text = format!("{rate:.0} GFLOP/s{share}; all stages and the evaluation: about {left} left");
            sink.event(&Event::Message(text));
        }
    };
    let (run_dir, supports_clusters) = (config.run_dir.clone(), config.model.architecture.supports_clusters());
    let run = Run::open_on(ranks.clone(), config, &options, &mut sink)?;
    let summary = run.train(args.only, &stop, &mut sink)?;
    drop(sink);
    summary.map_or(Ok(()), |summary| print_run(&summary, &run_dir, supports_clusters))
}

#[derive(Debug, clap::Args)]
pub struct TrainArgs {
    /// Config file (TOML)
    pub config: PathBuf,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    /// Run one stage: stage1, clusters or stage2
    #[arg(long, value_name = "STAGE", value_parser = parse_training_step)]
    pub only: Option<RunStep>,
    /// Train and evaluate on the first K training scenes
    #[arg(long, value_name = "K", value_parser = parse_count)]
    pub overfit: Option<usize>,
    /// Start a new run; the existing run directory is renamed
    #[arg(long)]
    pub fresh: bool,
    /// Extend an existing run to more steps, with the learning rates of the new count
    #[arg(long, conflicts_with = "fresh")]
    pub extend: bool,
}
