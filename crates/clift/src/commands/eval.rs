//! `clift eval`.

use std::path::{Path, PathBuf};

use clift_data::SourceKind;
use clift_eval::{Experiment, ExternalMethod, MethodName, Selection};
use clift_model::{DeviceName, ModelPath, TokenCount, TokenFormat};
use clift_train::{Config, Run, evaluate_model, read_config};

use crate::commands::parse::parse_bytes;
use crate::exit_code::UsageError;
use crate::output::{progress, stdout};

/// Evaluates a run or a model and prints the table.
pub fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let systems = systems(args)?;
    let model = args.checkpoint.as_deref().map(ModelPath::find).transpose()?;
    let folder = match (&model, &args.run) {
        (Some(model), _) => &model.dir,
        (None, Some(run)) => run,
        (None, None) => unreachable!("the command line asks for one of the two"),
    };
    let config = read(args, folder)?;
    let out: PathBuf = args.out.clone().unwrap_or_else(|| folder.join("eval"));
    let beside = args.with.as_ref().map(|run| -> anyhow::Result<Config> {
        let (mut other, _) = read_config::<Config>(&run.join("config.toml"), &[])?;
        other.run_dir.clone_from(run);
        Ok(other)
    });
    let beside = beside.transpose()?;
    if model.is_some() && config.eval.index.is_none() {
        stdout::print_note(
            "without --index, contexts and targets are spread evenly over each scene: this is not the published protocol, \
             whose evaluation index names four contexts, and the figures do not compare with published ones",
        );
    }
    let mut sink = progress::sink();
    let stop = crate::interrupt::flag()?;
    let summary = match &model {
        None => Run::reopen(config)?.evaluate(&systems, &out, beside.as_ref(), &stop, sink.as_mut())?,
        Some(model) => {
            let stage1 = args.stage1.as_deref().map(ModelPath::find).transpose()?;
            evaluate_model(config, model, stage1.as_ref(), &systems, &out, &stop, sink.as_mut())?
        }
    };
    drop(sink);
    stdout::print_evaluation(&summary, &out)
}

/// The config of a run or model directory with what the command line changes.
fn read(args: &EvalArgs, folder: &Path) -> anyhow::Result<Config> {
    let (mut config, overrides) = read_config::<Config>(&folder.join("config.toml"), &args.set)?;
    for change in overrides {
        stdout::print_note(&change.to_string());
    }
    // A run may have been moved since it was trained.
    config.run_dir = folder.to_path_buf();
    config.device = args.device.unwrap_or(config.device);
    if let Some(data) = &args.data {
        config.data.root = Some(data.clone());
        if config.data.source == SourceKind::Synthetic {
            config.data.source = SourceKind::Auto;
        }
    }
    if let Some(experiment) = args.preset {
        experiment.apply(&mut config.eval);
    }
    if !args.storage.is_empty() {
        config.eval.storage.clone_from(&args.storage);
    }
    if !args.render.is_empty() {
        config.eval.render.clone_from(&args.render);
    }
    config.eval.selection = args.selection.unwrap_or(config.eval.selection);
    if !args.tokens.is_empty() {
        config.eval.tokens.clone_from(&args.tokens);
    }
    if args.index.is_some() {
        config.eval.index.clone_from(&args.index);
    }
    Ok(config)
}

/// Other systems, with as many names and sizes as there are, or none.
fn systems(args: &EvalArgs) -> anyhow::Result<Vec<ExternalMethod>> {
    let EvalArgs { predictions, name, data_size, .. } = args;
    for (flag, count) in [("--name", name.len()), ("--data-size", data_size.len())] {
        if count != 0 && count != predictions.len() {
            let text =
                format!("{} --predictions but {count} {flag}: write one for each, in their order", predictions.len());
            return Err(UsageError(text).into());
        }
    }
    let mut systems: Vec<ExternalMethod> = Vec::new();
    for (i, folder) in predictions.iter().enumerate() {
        if !folder.is_dir() {
            return Err(UsageError(format!("there is no folder for --predictions {}", folder.display())).into());
        }
        let of_folder = || folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned();
        let name = MethodName::new(&name.get(i).cloned().unwrap_or_else(of_folder))?;
        if systems.iter().any(|system| system.name == name) {
            return Err(UsageError(format!("two --predictions are called {}: write --name", name.as_str())).into());
        }
        systems.push(ExternalMethod { name, folder: Path::to_owned(folder), data_bytes: data_size.get(i).copied() });
    }
    Ok(systems)
}

/// Arguments of `clift eval`.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// A run directory
    #[arg(required_unless_present = "checkpoint", conflicts_with = "checkpoint")]
    pub run: Option<PathBuf>,
    /// Measure the model of a directory, as `clift import` writes, instead of a run
    #[arg(long, value_name = "MODEL", requires = "data")]
    pub checkpoint: Option<PathBuf>,
    /// Folder of the data: with --checkpoint, or where a run's data has moved
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// The first-stage model of --checkpoint: adds random and K-means tokens, drawn by it
    #[arg(long, value_name = "MODEL", requires = "checkpoint")]
    pub stage1: Option<PathBuf>,
    /// An experiment of the paper: main, ablation, patchwise or budget
    ///
    /// Sets variants, --storage, --render and --selection; those given beside it win. main: quality against data size.
    /// ablation: random tokens, K-means, K-means and condenser. patchwise: tiles of the views against K-means, each
    /// with and without condenser; needs --with. budget: half of the tokens stored, fewer and fewer of them rendered.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<Experiment>,
    /// Another run of the same stage 1 with another clusters.grouping, measured on the same views
    #[arg(long, value_name = "RUN", conflicts_with = "checkpoint")]
    pub with: Option<PathBuf>,
    /// Token counts to store, as numbers or shares: --storage 256,1/16
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub storage: Vec<TokenCount>,
    /// Draw views from fewer tokens than are stored too, numbers or shares of those: --render 128,1/2
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// How those are chosen: paper, global, scaled or random
    #[arg(long, alias = "select", value_name = "PRESET")]
    pub selection: Option<Selection>,
    /// Round stored tokens as a scene file would, in each of these formats in turn: f32, f16, int8
    #[arg(long, value_delimiter = ',', value_name = "FORMAT")]
    pub tokens: Vec<TokenFormat>,
    /// Score another system's pictures of the targets too; repeatable
    #[arg(long, value_name = "DIR")]
    pub predictions: Vec<PathBuf>,
    /// What it is called, once per --predictions in their order; the folder's name by default
    #[arg(long, value_name = "NAME", requires = "predictions")]
    pub name: Vec<String>,
    /// What it keeps of a scene, such as 12.5MB, once per --predictions in their order
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes, requires = "predictions")]
    pub data_size: Vec<u64>,
    /// An evaluation index (JSON) with the context and target frames of every scene
    #[arg(long, value_name = "FILE")]
    pub index: Option<PathBuf>,
    /// Change a key of the run's config: `--set eval.num_scenes=10`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Where to write; `eval` inside the run by default
    #[arg(long, short, value_name = "DIR")]
    pub out: Option<PathBuf>,
}
