//! `clift render`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clap::builder::RangedU64ValueParser;
use clift_core::{Camera, StagedDir, interpolate_path, is_empty_folder, mean_intrinsics, median, orbit_path, plural};
use clift_data::read_poses;
use clift_eval::{Animation, Canvas, available_bytes};
use clift_model::{
    DeviceName, ModelConfig, ModelError, ModelPath, PatchGrids, Precision, SelectionPreset, TokenCount, parse_value,
};
use clift_scene::{MAX_SIDE_PX, Scene, SceneRenderer, check_frames, frame_bytes, frames_per_call, load_renderer};
use clift_train::TrainError;
use serde::Serialize;

use crate::commands::args::parse::parse_size;
use crate::exit_code::usage_bail;
use crate::interrupt::{self, Ending};
use crate::output::counter::Counter;
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_result, print_warning};
use crate::output::units::file_size;

/// File of the animation.
const ANIMATION: &str = "animation.png";
/// File of the path, token counts and times of the frames.
const REPORT: &str = "render.json";
/// Frames of `--path interpolate` and `--path orbit` without `--frames`.
const DEFAULT_FRAMES: usize = 60;

/// Content of `render.json`.
#[derive(Debug, Serialize)]
struct Report {
    scene: String,
    path: String,
    /// Rule of token selection; `null` if every frame uses all tokens.
    selection: Option<&'static str>,
    /// Patch grids that each frame is the mean of.
    patch_grids: PatchGrids,
    device: &'static str,
    precision: Precision,
    height: usize,
    width: usize,
    num_frames: usize,
    num_storage_tokens: usize,
    num_render_tokens: usize,
    #[serde(flatten)]
    rendered: Rendered,
}

pub fn run(args: &RenderArgs) -> anyhow::Result<()> {
    let (scene, _) = Scene::read_for(&args.scene, args.model.as_deref())?;
    let [width, height] = args.size.unwrap_or([scene.width, scene.height]);
    let device = args.device.unwrap_or_default();
    let patch_grids = args.patch_grids.unwrap_or(scene.model.patch_grids);
    let model = ModelConfig { patch_grids, ..scene.model.clone() };
    model.validate()?;
    check_size(&scene, &model, [width, height], device)?;
    if height > scene.height {
        print_warning(format!(
            "the network was trained on images of {} x {}; frames of {width} x {height} show no more detail",
            scene.width, scene.height
        ));
    }
    check_out(&args.out, args.force)?;
    let views = path_cameras(&scene, args, height, width)?;
    check_frames(&scene, &views, [height, width])?;
    let weights = scene_weights(&scene, &args.scene, args.model.as_deref())?;
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let opened = device.open()?;
    let precision = args.precision.unwrap_or_else(|| Precision::for_images(&opened));
    precision.check("--precision", &opened)?;
    let _precision = precision.scope();
    let network = load_renderer(&scene, &weights, &opened)?;
    let mut renderer = SceneRenderer::new(&scene, network, args.selection.rules(), &opened)?;
    renderer.set_patch_grids(patch_grids);
    // A share is one of the tokens that a frame can be rendered from.
    let most = renderer.max_render_tokens();
    let num_render_tokens = match args.render {
        Some(count @ TokenCount::Count(_)) => count.of(scene.num_tokens())?.min(most),
        Some(share) => share.of(most)?,
        None => most,
    };
    let creating = || format!("creating {}", args.out.display());
    let files = StagedDir::new(&args.out).with_context(creating)?;
    let size = [height, width];
    let rendered = write_frames(&mut renderer, &views, size, num_render_tokens, args.fps, files.path(), &stop)?;
    let [select_ms, render_ms] = [rendered.select_s, rendered.render_s].map(|seconds| 1e3 * seconds);
    let report = Report {
        scene: scene.key.clone(),
        path: args.path.display().to_string(),
        selection: (num_render_tokens < most).then(|| args.selection.name()),
        patch_grids,
        device: device.as_str(),
        precision,
        height,
        width,
        num_frames: views.len(),
        num_storage_tokens: scene.num_tokens(),
        num_render_tokens,
        rendered,
    };
    OutputFile::new(&files.path().join(REPORT), false, &[])?.write_json(&report)?;
    files.commit().with_context(creating)?;
    remove_later_frames(&args.out, views.len()).with_context(creating)?;
    print_result(&format!(
        "{}: {} of {width} x {height}, each from {num_render_tokens} of {} tokens\n\
         {:.1} ms per frame on {device} in {precision} (median): {select_ms:.1} ms token selection, {render_ms:.1} ms \
         rendering\nanimation, for a browser: {}",
        args.out.display(),
        plural(views.len(), "frame"),
        scene.num_tokens(),
        select_ms + render_ms,
        args.out.join(ANIMATION).display(),
    ))
}

/// Returns the weight file of the scene that was read from `file`: that of `model`, or of the scene's own model.
pub fn scene_weights(scene: &Scene, file: &Path, model: Option<&Path>) -> anyhow::Result<PathBuf> {
    let path = model.map_or_else(|| scene.find_model(file), Path::to_path_buf);
    let weights = ModelPath::for_tokens(&path, scene.kind)?;
    if model.is_none() && !weights.exists() {
        // The path comes from an untrusted file: control characters must not reach the terminal.
        let path = weights.display().to_string();
        usage_bail!("the weights of the scene are not found at {}; set --model RUN", path.escape_debug());
    }
    Ok(weights)
}

/// Refuses sizes that exceed the limit of images or the available memory.
fn check_size(
    scene: &Scene,
    model: &ModelConfig,
    [width, height]: [usize; 2],
    device: DeviceName,
) -> anyhow::Result<()> {
    if width.max(height) > MAX_SIDE_PX {
        usage_bail!("--size {width}x{height}: write at most {MAX_SIDE_PX} pixels per side");
    }
    let needed = frame_bytes(scene, model, [height, width]);
    if let Some(available) = available_bytes(device).filter(|available| needed > *available) {
        let (needed, available) = (file_size(needed), file_size(available));
        usage_bail!(
            "frames of {width} x {height} need {needed} of memory, {available} are available; choose a smaller --size"
        );
    }
    Ok(())
}

/// Returns the cameras of the path, with intrinsics in pixels of the frames.
fn path_cameras(scene: &Scene, args: &RenderArgs, height: usize, width: usize) -> anyhow::Result<Vec<Camera>> {
    let resized = |camera: &Camera| camera.resized([scene.height, scene.width], [height, width]);
    let context: Vec<Camera> = scene.context.iter().map(resized).collect();
    let views = match args.path.to_str() {
        Some("interpolate") => interpolate_path(&context, args.frames.unwrap_or(DEFAULT_FRAMES)),
        Some("orbit") => orbit_path(&context, args.frames.unwrap_or(DEFAULT_FRAMES)),
        _ => {
            let file = &args.path;
            if file.is_dir() || !file.exists() {
                let what = if file.is_dir() { "a folder" } else { "no such file" };
                usage_bail!("--path {}: {what}; write interpolate, orbit or a file of poses", file.display());
            }
            if args.frames.is_some() {
                usage_bail!("a file of poses determines the number of frames; remove --frames");
            }
            let default = mean_intrinsics(&context).context("the scene has no context views")?;
            read_poses(file, &scene.world, default, width, height)?
        }
    };
    if views.is_empty() {
        let fix = "write at least 1".into();
        return Err(ModelError::BadConfig { key: "frames", value: "0".into(), fix }.into());
    }
    Ok(views)
}

/// Times and tokens of the rendered frames.
#[derive(Debug, Serialize)]
struct Rendered {
    /// Median seconds per frame.
    select_s: f64,
    render_s: f64,
    /// Tokens of the scene file that each frame is rendered from, ascending; `None` if every frame uses all tokens.
    tokens: Option<Vec<Vec<u32>>>,
}

/// Checks that the output folder is empty or absent, or holds frames that `replace` allows to replace.
fn check_out(out: &Path, replace: bool) -> anyhow::Result<()> {
    if out.is_file() {
        usage_bail!("output folder {}: that is a file; write the name of a folder", out.display());
    }
    if is_empty_folder(out).with_context(|| format!("reading {}", out.display()))? {
        return Ok(());
    }
    let out_text = out.display();
    match (out.join(REPORT).is_file(), replace) {
        (true, true) => Ok(()),
        (true, false) => {
            usage_bail!("output folder {out_text} holds frames; replace them with --force or choose another")
        }
        (false, _) => usage_bail!("output folder {out_text} is not empty and holds no frames; choose another folder"),
    }
}

/// Removes the frames of a longer path that was replaced by one of `num_frames`.
fn remove_later_frames(out: &Path, num_frames: usize) -> std::io::Result<()> {
    let mut later = (num_frames..).map(|frame| out.join(frame_name(frame))).take_while(|path| path.exists());
    later.try_for_each(std::fs::remove_file)
}

fn frame_name(frame: usize) -> String {
    format!("frame-{frame:05}.png")
}

/// Renders every view and writes the frames and the animation to `folder`, until `stop` is set.
fn write_frames(
    renderer: &mut SceneRenderer,
    views: &[Camera],
    [height, width]: [usize; 2],
    num_render_tokens: usize,
    fps: u16,
    folder: &Path,
    stop: &AtomicBool,
) -> anyhow::Result<Rendered> {
    let mut animation = Animation::new(&folder.join(ANIMATION), width, height, views.len(), fps)?;
    let mut counter = Counter::new("frames", views.len() as u64);
    let (mut select_s, mut render_s, mut tokens) = (Vec::new(), Vec::new(), Vec::new());
    for some in views.chunks(frames_per_call(height, width)) {
        let first = render_s.len();
        if stop.load(Ordering::Relaxed) {
            let task = format!("rendering frame {first} of {}", views.len());
            return Err(TrainError::Abandoned { task }.into());
        }
        let results = renderer.render(some, height, width, num_render_tokens);
        for view in results.with_context(|| format!("rendering frames {first} to {}", first + some.len() - 1))? {
            let image = Canvas::from_unit(&view.pixels, height, width)?;
            image.write_png(&folder.join(frame_name(render_s.len())))?;
            animation.add(&image)?;
            select_s.push(view.select_s);
            render_s.push(view.render_s);
            tokens.push(view.tokens);
        }
        counter.set(render_s.len() as u64);
    }
    animation.finish()?;
    Ok(Rendered { select_s: median(&select_s), render_s: median(&render_s), tokens: tokens.into_iter().collect() })
}

#[derive(Debug, clap::Args)]
pub struct RenderArgs {
    /// Scene file from `clift encode`
    #[arg(value_name = "SCENE")]
    pub scene: PathBuf,
    /// Camera path: interpolate, orbit or a file of poses
    #[arg(long, value_name = "PATH")]
    pub path: PathBuf,
    /// Output folder
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace the frames in the output folder
    #[arg(long)]
    pub force: bool,
    /// Run or weight file [default: the one the scene was encoded with]
    #[arg(long, value_name = "RUN|MODEL")]
    pub model: Option<PathBuf>,
    /// Tokens rendered per frame, as a number or a share [default: all]
    #[arg(long, value_name = "COUNT")]
    pub render: Option<TokenCount>,
    /// Select rendered tokens by this rule: paper, global or scaled
    #[arg(long, value_name = "PRESET", default_value = "scaled")]
    #[arg(value_parser = |name: &str| parse_value::<SelectionPreset>("selection", name))]
    pub selection: SelectionPreset,
    /// Average 1, 2 or 4 renderings with shifted patches [default: the model's]
    #[arg(long, value_name = "COUNT")]
    pub patch_grids: Option<PatchGrids>,
    /// Width and height of a frame in pixels [default: context]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// Number of frames of `interpolate` and `orbit` [default: 60]
    #[arg(long, value_name = "N", value_parser = RangedU64ValueParser::<usize>::new().range(1..=100_000))]
    pub frames: Option<usize>,
    /// Frames per second of the animation
    #[arg(long, value_name = "F", default_value_t = 20, value_parser = clap::value_parser!(u16).range(1..))]
    pub fps: u16,
    /// Device: flex, ndarray or wgpu [default: flex]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Operands of matrix products: f32, bf16 or f16 [default: bf16 if the CPU has its instructions, else f32]
    #[arg(long, value_name = "PRECISION")]
    pub precision: Option<Precision>,
}
