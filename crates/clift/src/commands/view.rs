//! `clift view`.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clift_data::{ClipReader, OpenedSource, Split, open_dataset};
use clift_eval::{EncodeOptions, EvalFrames, evaluation_items};
use clift_model::{DeviceName, ModelPath, Scene, TrainedModel, load_renderer};
use clift_view::{RunScenes, SceneFile, SceneSet, ServerOptions, ViewServer};

use crate::commands::args::parse::parse_split;
use crate::commands::args::shared_args::{ConfigArgs, read_config};
use crate::commands::render::run::scene_weights;
use crate::exit_code::usage_bail;
use crate::output::stdout::{print_note, print_result, print_warning};

/// Most scenes of a run in the list, where the config evaluates all.
const MAX_SCENES: usize = 200;

#[derive(Debug, clap::Args)]
pub struct ViewArgs {
    /// Scene file, or a run or model directory, whose test scenes are listed
    #[arg(value_name = "SCENE|RUN")]
    pub scene: PathBuf,
    /// Run or weight file of a scene file [default: the one the scene was encoded with]
    #[arg(long, value_name = "RUN|MODEL")]
    pub model: Option<PathBuf>,
    /// Scenes of a run: test or train
    #[arg(long, value_name = "SPLIT", default_value = "test", value_parser = parse_split)]
    pub split: Split,
    /// Port of the page; 0 takes a free port
    #[arg(long, value_name = "PORT", default_value_t = 0)]
    pub port: u16,
    /// Address to listen on; other machines reach the page through 0.0.0.0
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    pub listen: IpAddr,
    /// Leave the browser closed
    #[arg(long)]
    pub no_open: bool,
    #[command(flatten)]
    pub overrides: ConfigArgs,
}

/// Serves scenes until the process ends.
pub fn run(args: &ViewArgs) -> anyhow::Result<()> {
    let (scenes, device) = if args.scene.is_dir() { open_run(args)? } else { open_file(args)? };
    let server = ViewServer::bind(&ServerOptions { listen: args.listen, port: args.port })?;
    let (url, port) = (server.url(), server.address().port());
    print_result(&url)?;
    print_note(&format!(
        "Ctrl-C ends; from another machine: ssh -N -L {port}:127.0.0.1:{port} HOST, then the same URL"
    ));
    if !args.listen.is_loopback() {
        print_warning("whoever has the URL can use the page; the connection is not encrypted");
    }
    if !args.no_open {
        open_browser(&url);
    }
    Ok(server.run(scenes, device)?)
}

fn open_file(args: &ViewArgs) -> anyhow::Result<(SceneSet, DeviceName)> {
    if !args.overrides.set.is_empty() {
        usage_bail!("--set changes the config of a run; {} is a scene file", args.scene.display());
    }
    let (scene, coding) = Scene::read_for(&args.scene, args.model.as_deref())?;
    let file_bytes = std::fs::metadata(&args.scene).map_or(0, |file| file.len());
    let weights = scene_weights(&scene, &args.scene, args.model.as_deref())?;
    let device = args.overrides.device.unwrap_or_default();
    let renderer = load_renderer(&scene, &weights, &device.open()?)?;
    let mut render_args = vec![text(&args.scene)];
    if let Some(model) = &args.model {
        render_args.extend(["--model".into(), text(model)]);
    }
    render_args.extend(device_args(args.overrides.device));
    Ok((SceneSet::File(Box::new(SceneFile { scene, coding, file_bytes, renderer, render_args })), device))
}

fn open_run(args: &ViewArgs) -> anyhow::Result<(SceneSet, DeviceName)> {
    if args.model.is_some() {
        usage_bail!("--model is for scene files; {} is a directory and has its own weights", args.scene.display());
    }
    let model = ModelPath::find(&args.scene)?;
    let (mut config, _) = read_config(&model.dir.join("config.toml"), &args.overrides.set, |_| Ok(()))?;
    // Tensor shapes do not determine the number of heads: a wrong one would silently change the tokens.
    if config.model != model.config()? {
        usage_bail!("--set model: the weights were trained with another network; remove the override");
    }
    config.device = args.overrides.device.unwrap_or(config.device);
    config.validate()?;
    let opened: OpenedSource = open_dataset(&config.data, args.split)?;
    let frames = EvalFrames::new(&opened, args.split, config.data.hold_out, true);
    let reader = ClipReader { source: opened.source, options: config.data.clip_options() };
    if config.eval.num_scenes == 0 {
        config.eval.num_scenes = MAX_SCENES;
    }
    let (items, skip_report, _) = evaluation_items(&config.eval, &reader, frames)?;
    if skip_report.has_content() {
        print_note(&skip_report.to_string());
    }
    let options = EncodeOptions {
        context: None,
        num_context: config.eval.num_context,
        storage: config.eval.validation_storage,
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: text(&args.scene),
    };
    let mut encode_args = vec![text(&args.scene)];
    encode_args.extend(args.overrides.set.iter().flat_map(|set| ["--set".into(), set.clone()]));
    if args.split == Split::Train {
        encode_args.extend(["--split".into(), args.split.to_string()]);
    }
    let model = TrainedModel::open(&model, &config.model, &config.device.open()?)?;
    let scenes = RunScenes {
        model,
        reader,
        items,
        options,
        storage: config.eval.storage,
        encode_args,
        render_args: device_args(args.overrides.device),
    };
    Ok((SceneSet::Run(Box::new(scenes)), config.device))
}

fn device_args(device: Option<DeviceName>) -> Vec<String> {
    device.map_or_else(Vec::new, |device| vec!["--device".into(), device.to_string()])
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// Opens the user's browser where there is a screen. A failure is no error: the URL is printed.
fn open_browser(url: &str) {
    let has_screen = ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| std::env::var_os(name).is_some());
    let (program, args): (&str, &[&str]) = if cfg!(target_os = "macos") {
        ("open", &[url])
    } else if cfg!(windows) {
        ("rundll32", &["url.dll,FileProtocolHandler", url])
    } else if has_screen {
        ("xdg-open", &[url])
    } else {
        return;
    };
    let started =
        Command::new(program).args(args).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    if started.is_err() {
        print_note(&format!("no browser was opened: `{program}` did not start; open the URL above"));
    }
}
