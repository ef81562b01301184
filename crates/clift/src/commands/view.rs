//! `clift view`.

use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clift_data::{ClipReader, SkipReport, Split};
use clift_eval::{EvalFrames, evaluation_items};
use clift_model::{DeviceName, ModelConfig, is_shipped};
use clift_scene::{ContextChoice, Contexts, EncodeOptions, Scene, load_renderer};
use clift_view::{RunScenes, SceneFile, SceneSet, ViewServer};

use crate::commands::args::model_args::{ModelArgs, default_model, is_data};
use crate::commands::args::parse::parse_split;
use crate::commands::args::shared_args::ConfigArgs;
use crate::commands::render::scene_weights;
use crate::exit_code::usage_bail;
use crate::output::stdout::{print_note, print_result, print_warning};

/// Most scenes of a run in the list, where the config evaluates all.
const MAX_SCENES: usize = 200;

#[derive(Debug, clap::Args)]
pub struct ViewArgs {
    /// Scene file; run or model, whose test scenes are listed; or photos [default: models/rooms]
    ///
    /// Of a run in training, the newest checkpoint renders. Photos are encoded with models/rooms, which ships with clift, or with
    /// the model that `CLIFT_MODEL` names.
    #[arg(value_name = "SCENE|RUN|DIR")]
    pub scene: Option<PathBuf>,
    /// Capture or data set in any layout [default: the data of the run]
    #[arg(value_name = "DIR")]
    pub data: Option<PathBuf>,
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
    let scene = args.scene.clone().unwrap_or_else(default_model);
    let is_run = scene.is_dir() || args.data.is_some() || is_data(&scene) || is_shipped(&scene);
    if !is_run && !scene.exists() {
        usage_bail!("{}: no such file or folder", scene.display());
    }
    let (scenes, device) = if is_run { open_run(&scene, args)? } else { open_file(&scene, args)? };
    let server = ViewServer::bind((args.listen, args.port).into())?;
    let (url, port) = (server.url(), server.address().port());
    print_result(&url)?;
    let remote = if args.listen.is_loopback() {
        format!("ssh -N -L {port}:{} HOST, then the same URL", server.address())
    } else if args.listen.is_unspecified() {
        "the same URL with the name of this machine instead of the address".into()
    } else {
        "the same URL".into()
    };
    print_note(&format!("Ctrl-C ends; from another machine: {remote}"));
    if !args.listen.is_loopback() {
        print_warning("whoever has the URL can use the page; the connection is not encrypted");
    }
    if !args.no_open {
        open_browser(&url);
    }
    Ok(server.run(scenes, device)?)
}

fn open_file(file: &Path, args: &ViewArgs) -> anyhow::Result<(SceneSet, DeviceName)> {
    if !args.overrides.set.is_empty() {
        usage_bail!("--set changes the config of a run; {} is a scene file", file.display());
    }
    let (scene, coding) = Scene::read_for(file, args.model.as_deref())?;
    require_places(&scene.model, file)?;
    let file_bytes = std::fs::metadata(file).map_or(0, |file| file.len());
    let weights = scene_weights(&scene, file, args.model.as_deref())?;
    let device = args.overrides.device.unwrap_or_default();
    let renderer = load_renderer(&scene, &weights, &device.open()?)?;
    let mut render_args = vec![text(file)];
    if let Some(model) = &args.model {
        render_args.extend(["--model".into(), text(model)]);
    }
    render_args.extend(device_args(args.overrides.device));
    Ok((SceneSet::File(Box::new(SceneFile { scene, coding, file_bytes, renderer, render_args })), device))
}

fn open_run(scene: &Path, args: &ViewArgs) -> anyhow::Result<(SceneSet, DeviceName)> {
    if args.model.is_some() {
        usage_bail!("--model is for scene files, {} is a folder; write `clift view RUN DIR`", scene.display());
    }
    let model_args = ModelArgs::find_newest(scene, args.data.as_deref(), &args.overrides)?;
    let opened = model_args.open_data(args.split)?;
    let model = model_args.open()?;
    require_places(&model_args.config.model, &model_args.given)?;
    let is_training_data = model_args.folder.is_none();
    let frames = EvalFrames::new(&opened, args.split, model_args.config.data.hold_out, is_training_data);
    // The pages of all scenes have images of one size.
    let options = model_args.clip_options(opened.source.as_ref(), 0)?;
    let reader = ClipReader { source: opened.source, options };
    // The index of a run lists frames of its own data.
    let has_index = args.overrides.set.iter().any(|set| set.starts_with("eval.index"));
    let (items, skip_report) = if is_training_data || has_index {
        let mut eval = model_args.config.eval.clone();
        if eval.num_scenes == 0 {
            eval.num_scenes = MAX_SCENES;
        }
        let (items, skip_report, _) = evaluation_items(&eval, &reader, frames)?;
        let contexts = items.into_iter().map(|item| (item.scene, ContextChoice::Frames(item.views.context)));
        (contexts.collect(), skip_report)
    } else {
        folder_items(&model_args, &reader)?
    };
    let ModelArgs { given, config, folder, .. } = model_args;
    if skip_report.has_content() {
        print_note(&skip_report.to_string());
    }
    let options = EncodeOptions {
        stored_tokens: Some(config.eval.validation_stored_tokens),
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: text(&given),
        ..EncodeOptions::default()
    };
    let mut encode_args: Vec<String> = std::iter::once(&given).chain(&folder).map(|path| text(path)).collect();
    encode_args.extend(args.overrides.set.iter().flat_map(|set| ["--set".into(), set.clone()]));
    if args.split == Split::Train {
        encode_args.extend(["--split".into(), args.split.to_string()]);
    }
    let scenes = RunScenes {
        model,
        reader,
        items,
        options,
        stored_tokens: config.eval.stored_tokens,
        encode_args,
        render_args: device_args(args.overrides.device),
    };
    Ok((SceneSet::Run(Box::new(scenes)), config.device))
}

/// Lists the scenes of a folder with the context views that `clift encode` takes.
fn folder_items(
    model_args: &ModelArgs,
    reader: &ClipReader,
) -> anyhow::Result<(Vec<(usize, ContextChoice)>, SkipReport)> {
    let source = reader.source.as_ref();
    let count = source.num_scenes().min(MAX_SCENES);
    let (mut items, mut skip_report) = (Vec::with_capacity(count), SkipReport::new(count));
    for scene in 0..count {
        let context = model_args.context();
        match Contexts::choose(reader, scene, &EncodeOptions { context: context.clone(), ..EncodeOptions::default() }) {
            Ok(_) => items.push((scene, context)),
            Err(error) => skip_report.skip(source.key(scene), error.to_string()),
        }
    }
    if items.is_empty() {
        usage_bail!("no scene can be shown: {skip_report}");
    }
    Ok((items, skip_report))
}

/// Refuses learned tokens, which the page could neither show on the context views nor select.
fn require_places(model: &ModelConfig, path: &Path) -> anyhow::Result<()> {
    if !model.has_patch_tokens() {
        usage_bail!(
            "{}: the viewer shows where tokens lie, and learned tokens of {} lie nowhere; use `clift render`",
            path.display(),
            model.architecture
        );
    }
    Ok(())
}

fn device_args(device: Option<DeviceName>) -> Vec<String> {
    device.map_or_else(Vec::new, |device| vec!["--device".into(), device.to_string()])
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// Opens the user's browser where there is a screen. A failure is not an error: the URL is printed.
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
