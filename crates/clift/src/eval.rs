//! `clift eval`.

use std::path::{Path, PathBuf};

use clift_data::SourceKind;
use clift_eval::{System, SystemName};
use clift_model::ModelPath;
use clift_train::Config;
use clift_train::Run;
use clift_train::evaluate_model::evaluate_model;
use clift_train::read_config;

use crate::args::EvalArgs;
use crate::{WrongUsage, terminal};

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
        terminal::print_note(
            "without --index, contexts and targets are spread evenly over each scene: this is not the published protocol, \
             whose evaluation index names four contexts, and the figures do not compare with published ones",
        );
    }
    let mut sink = terminal::sink();
    let stop = crate::interrupt::flag()?;
    let summary = match &model {
        None => Run::reopen(config)?.evaluate(&systems, &out, beside.as_ref(), &stop, sink.as_mut())?,
        Some(model) => {
            let stage1 = args.stage1.as_deref().map(ModelPath::find).transpose()?;
            evaluate_model(config, model, stage1.as_ref(), &systems, &out, &stop, sink.as_mut())?
        }
    };
    drop(sink);
    terminal::print_evaluation(&summary, &out)
}

/// The config of a run or model directory with what the command line changes.
fn read(args: &EvalArgs, folder: &Path) -> anyhow::Result<Config> {
    let (mut config, overrides) = read_config::<Config>(&folder.join("config.toml"), &args.set)?;
    for change in overrides {
        terminal::print_note(&change.to_string());
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
fn systems(args: &EvalArgs) -> anyhow::Result<Vec<System>> {
    let EvalArgs { predictions, name, data_size, .. } = args;
    for (flag, count) in [("--name", name.len()), ("--data-size", data_size.len())] {
        if count != 0 && count != predictions.len() {
            let text =
                format!("{} --predictions but {count} {flag}: write one for each, in their order", predictions.len());
            return Err(WrongUsage(text).into());
        }
    }
    let mut systems: Vec<System> = Vec::new();
    for (i, folder) in predictions.iter().enumerate() {
        if !folder.is_dir() {
            return Err(WrongUsage(format!("there is no folder for --predictions {}", folder.display())).into());
        }
        let of_folder = || folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned();
        let name = SystemName::new(&name.get(i).cloned().unwrap_or_else(of_folder))?;
        if systems.iter().any(|system| system.name == name) {
            return Err(WrongUsage(format!("two --predictions are called {}: write --name", name.as_str())).into());
        }
        systems.push(System { name, folder: Path::to_owned(folder), data_bytes: data_size.get(i).copied() });
    }
    Ok(systems)
}
