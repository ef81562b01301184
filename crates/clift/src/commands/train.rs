//! `clift train`.

use std::collections::HashSet;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::atomic::AtomicBool;

use clift_eval::available_bytes;
use clift_model::peak_flops;
use clift_train::{
    BatchParts, Config, Event, Launched, RankPlace, Ranks, Run, RunEstimate, RunOptions, RunStep, Stage, StageSettings,
    TrainError, estimate_run, memory_warning,
};

use crate::commands::args::parse::parse_training_step;
use crate::commands::args::shared_args::ConfigArgs;
use crate::exit_code::usage_bail;
use crate::interrupt::{self, Ending};
use crate::output::progress::progress_sink;
use crate::output::stdout::{name_adapter, print_evaluation, print_result, print_warning};
use crate::output::units::duration;
use crate::threads;
use crate::verbosity::Verbosity;

/// Trains on the ranks that a launcher started. Rank 0 alone returns an error, its own or that of another rank: a launcher ends
/// the other ranks with the first that fails.
pub fn run(args: &TrainArgs) -> anyhow::Result<()> {
    let ranks = connect()?;
    let result = ranks.finish(train(args, &ranks));
    if ranks.is_root() { result } else { Ok(()) }
}

/// Connects the processes of a launcher, and gives each its share of the cores. From now on only rank 0 prints.
fn connect() -> Result<Rc<Ranks>, TrainError> {
    let launched = Launched::find();
    if launched.rank > 0 {
        Verbosity::Silent.choose();
    }
    let ranks = launched.connect()?;
    if ranks.num_ranks() > 1 {
        threads::start(Some(RankPlace::find(&ranks)?.num_threads));
    }
    Ok(Rc::new(ranks))
}

/// Trains the configs one after the other, all of them checked before.
fn train(args: &TrainArgs, ranks: &Rc<Ranks>) -> anyhow::Result<()> {
    let read = |path: &PathBuf| args.overrides.read(path, Config::validate);
    let configs: Vec<Config> = args.configs.iter().map(read).collect::<Result<_, _>>()?;
    if configs.iter().map(|config| &config.run_dir).collect::<HashSet<_>>().len() < configs.len() {
        usage_bail!("the configs have the same run_dir: give each its own");
    }
    let stop = interrupt::flag(Ending::RUN)?;
    configs.into_iter().try_for_each(|config| train_config(args, config, &stop, ranks))
}

fn train_config(args: &TrainArgs, config: Config, stop: &AtomicBool, ranks: &Rc<Ranks>) -> anyhow::Result<()> {
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
    let options = RunOptions { only: args.only, fresh: args.fresh };
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
    let (run_dir, has_view) = (config.run_dir.clone(), config.model.architecture.supports_clusters());
    let run = Run::open_on(ranks.clone(), config, &options, &mut sink)?;
    let summary = run.train(args.only, stop, &mut sink)?;
    drop(sink);
    let Some(summary) = summary else { return Ok(()) };
    print_evaluation(&summary, &run_dir.join("eval"))?;
    if has_view { print_result(&format!("scenes: clift view {}", run_dir.display())) } else { Ok(()) }
}

#[derive(Debug, clap::Args)]
pub struct TrainArgs {
    /// Config files (TOML), trained one after the other: a later one may start from the run of an earlier one
    #[arg(required = true, value_name = "CONFIG")]
    pub configs: Vec<PathBuf>,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    /// Run one stage: stage1, clusters or stage2
    #[arg(long, value_name = "STAGE", value_parser = parse_training_step)]
    pub only: Option<RunStep>,
    /// Start a new run; the existing run directory is renamed
    #[arg(long)]
    pub fresh: bool,
}
