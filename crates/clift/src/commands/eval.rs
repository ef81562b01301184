//! `clift eval`.

use std::path::{Path, PathBuf};

use clift_data::{SourceKind, Split};
use clift_eval::{Experiment, Selection};
use clift_model::{ModelPath, TokenCount, parse_value};
use clift_scene::TokenCoding;
use clift_train::{Config, EvalFolder, Run, evaluate_model};

use crate::commands::args::model_args::check_network;
use crate::commands::args::parse::{parse_run, parse_split};
use crate::commands::args::shared_args::{ConfigArgs, read_config};
use crate::exit_code::usage_bail;
use crate::interrupt::{self, Ending};
use crate::output::progress::progress_sink;
use crate::output::stdout::{print_evaluation, print_warning};

pub fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let model = args.checkpoint.as_deref().map(ModelPath::find).transpose()?;
    let folder = match (&model, &args.run) {
        (Some(model), _) => &model.dir,
        (None, Some(run)) => run,
        (None, None) => unreachable!("clap requires a run or --checkpoint"),
    };
    if model.is_none() && folder.join("config.toml").exists() && !folder.join("run.json").exists() {
        let model = folder.display();
        usage_bail!("{model} is a model, not a run; evaluate it with `clift eval --checkpoint {model} --data DIR`");
    }
    let config = eval_config(args, folder)?;
    let results = if args.split == Split::Train { "eval-train" } else { "eval" };
    let out: PathBuf = args.out.clone().unwrap_or_else(|| folder.join(results));
    let with = args.with.iter().map(|run| -> anyhow::Result<Config> {
        let (mut config, _) = read_config(&run.join("config.toml"), &[], |_| Ok(()))?;
        config.run_dir.clone_from(run);
        Ok(config)
    });
    let with = with.collect::<anyhow::Result<Vec<Config>>>()?;
    if model.is_some() && config.eval.index.is_none() {
        print_warning(
            "without --index, contexts and targets are spread evenly over each scene; published figures use an \
             evaluation index with four contexts and are not comparable",
        );
    }
    let mut sink = progress_sink();
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let folder = EvalFolder::open(&out, args.force, sink.as_mut())?;
    let output = (args.split, &folder);
    let summary = match &model {
        None => Run::reopen(config)?.evaluate(output, &with, &stop, sink.as_mut())?,
        Some(model) => {
            let stage1 = args.stage1.as_deref().map(ModelPath::find).transpose()?;
            evaluate_model(config, model, stage1.as_ref(), output, &stop, sink.as_mut())?
        }
    };
    drop(sink);
    print_evaluation(&summary, &out)
}

fn eval_config(args: &EvalArgs, folder: &Path) -> anyhow::Result<Config> {
    let mut config = args.overrides.read(&folder.join("config.toml"), |_| Ok(()))?;
    check_network(&config.model, &ModelPath { dir: folder.into(), weights: folder.into() })?;
    // The directory may have been moved since it was written.
    config.run_dir = folder.to_path_buf();
    if args.checkpoint.is_some() && !args.overrides.sets("data", "hold_out") {
        // No frame of this data set is held out of the training of a foreign model.
        config.data.hold_out = 0;
    }
    if let Some(data) = &args.data {
        config.data.root = Some(data.clone());
        if config.data.source == SourceKind::Synthetic {
            config.data.source = SourceKind::Auto;
        }
    }
    if let Some(experiment) = args.preset {
        experiment.apply(&mut config.eval);
    }
    if !args.stored_tokens.is_empty() {
        config.eval.stored_tokens.clone_from(&args.stored_tokens);
    }
    if !args.render.is_empty() {
        config.eval.render.clone_from(&args.render);
    }
    config.eval.selection = args.selection.unwrap_or(config.eval.selection);
    if !args.formats.is_empty() {
        config.eval.formats.clone_from(&args.formats);
    }
    if args.index.is_some() {
        config.eval.index.clone_from(&args.index);
    }
    config.eval.drop_context_targets |= args.drop_context_targets;
    Ok(config)
}

#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Run directory
    #[arg(required_unless_present = "checkpoint", conflicts_with = "checkpoint", value_parser = parse_run)]
    pub run: Option<PathBuf>,
    /// Evaluate a model directory, a stage of a run or a weight file instead of a run
    #[arg(long, value_name = "MODEL", requires = "data")]
    pub checkpoint: Option<PathBuf>,
    /// Data set, for --checkpoint or for a run whose data has moved
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Stage-1 model of --checkpoint; adds the methods random and kmeans
    #[arg(long, value_name = "MODEL", requires = "checkpoint")]
    pub stage1: Option<PathBuf>,
    /// Run an experiment of the paper: main, ablation, patchwise or budget
    ///
    /// Sets the methods, --stored-tokens, --render, --selection and --format; options of the command line take precedence.
    /// main: quality against data size. ablation: random tokens, K-means, K-means with condenser. patchwise: tiles of the
    /// views against K-means, with and without condenser; needs --with. budget: half of the tokens stored, decreasing
    /// rendered counts.
    #[arg(long, value_name = "NAME", value_parser = |name: &str| parse_value::<Experiment>("preset", name))]
    pub preset: Option<Experiment>,
    /// Add a run of LVSM, or one of this stage 1 and another clusters.grouping
    ///
    /// Runs with `model.architecture = "lvsm-ed"` are trained on their own and have distinct numbers of latents. The
    /// option is repeatable: `clift eval RUN --preset main --with runs/lvsm-64 --with runs/lvsm-16` is the paper's main figure.
    #[arg(long, value_name = "RUN", conflicts_with = "checkpoint", value_parser = parse_run)]
    pub with: Vec<PathBuf>,
    /// Stored token counts, as numbers or shares, e.g. 256,1/16
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub stored_tokens: Vec<TokenCount>,
    /// Also render from fewer tokens: numbers or shares of the stored, e.g. 128,1/2
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// Select rendered tokens by this rule: paper, global, scaled or random
    #[arg(long, value_name = "PRESET", value_parser = |name: &str| parse_value::<Selection>("selection", name))]
    pub selection: Option<Selection>,
    /// Formats of the tokens: f32, f16, coded, or coded-DB, e.g. f16,coded-0.1
    #[arg(long = "format", value_delimiter = ',', value_name = "FORMAT")]
    pub formats: Vec<TokenCoding>,
    /// Evaluation index (JSON): context and target frames of every scene
    #[arg(long, value_name = "FILE")]
    pub index: Option<PathBuf>,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    /// Leave out targets of the index that are also contexts
    #[arg(long)]
    pub drop_context_targets: bool,
    /// Evaluate this split: test or train
    #[arg(long, value_name = "SPLIT", default_value = "test", value_parser = parse_split)]
    pub split: Split,
    /// Output folder [default: `eval` in the run, `eval-train` for --split train]
    #[arg(long, short, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Replace the evaluation in the output folder
    #[arg(long)]
    pub force: bool,
}
